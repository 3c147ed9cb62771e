"""Sionna RT's own path solver and materials, unmodified: a ground truth that shares neither the path search nor the diffraction
with this project.

Such a ground truth has in common with this project only the scene, the carrier phase and the order of summation (`solve.py`).
Reflection and slab coefficients are the simulator's in both.

The solver searches again at every frequency, because its rays are reflected or transmitted according to the power there. A full
path buffer silently drops candidates, so these are counted.

Import this module only after `data_gen.llvm.ensure_backend()`.
"""

from typing import Any

import drjit as dr
import numpy as np
import sionna.rt as rt
from sionna.rt.path_solvers.paths_buffer import PathsBuffer

from data_gen.scenes.base import Part
from data_gen.settings import SolverSettings
from data_gen.trace import check_room, electrical_constants
from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.rooms import own_law


def public_material(name: str, part: Part, settings: SolverSettings) -> rt.RadioMaterial:
    """Returns the simulator's material of a part: one of ITU-R P.2040, or a slab with the law of a custom material."""
    slab: dict[str, Any] = {"thickness": part.thickness, "scattering_coefficient": settings.scattering[part.closed]}
    if own_law(part.material) is None:
        return rt.ITURadioMaterial(name, part.material, **slab)
    return rt.RadioMaterial(name, frequency_update_callback=electrical_constants(part.material), **slab)


class PublicTracer:
    """`sionna.rt.PathSolver` with the interface of `PathTracer`."""

    def __init__(self, scene: rt.Scene, settings: SolverSettings) -> None:
        self._scene, self._settings = scene, settings
        self._solver = rt.PathSolver(deterministic=True)
        if not hasattr(self._solver, "_candidate_generator"):
            raise UserError("this sionna-rt has a different path solver; install a version that pyproject.toml allows")
        self._solver._candidate_generator = _Watched(self._solver._candidate_generator, settings)

    def trace(self) -> None:
        """Does nothing: the solver traces again at every frequency."""

    def fields(self, _: None) -> rt.Paths:
        """Returns the paths that the solver finds at the scene's current frequency.

        Raises:
            UserError: a transmitter has more candidate paths than the buffer holds.
        """
        options = self._settings
        return self._solver(
            self._scene, max_depth=options.max_depth, samples_per_src=options.samples_per_src, seed=options.seed,
            max_num_paths_per_src=options.max_paths_per_src, diffraction=options.diffraction, diffuse_reflection=options.rough,
        )  # fmt: skip


class _Watched:
    """Wraps the solver's candidate generator and counts its candidates."""

    def __init__(self, generator: Any, settings: SolverSettings) -> None:
        self._generator, self._settings = generator, settings

    def __call__(self, **arguments: Any) -> PathsBuffer:
        candidates = self._generator(**arguments)
        candidates.schedule()
        dr.eval()
        found = np.array(candidates.paths_counter).item()
        check_room(np.array(candidates.source_indices)[:found], self._settings)
        return candidates
