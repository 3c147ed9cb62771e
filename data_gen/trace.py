"""Sionna RT's path solver in two halves: rays traced once, fields at every frequency.

`sionna.rt.PathSolver` does both in one call, a call for every frequency. Where paths run does not depend on the frequency, and
tracing is nearly all of the cost. The halves below are its own three stages (candidates, image method, fields), called in its
own order; a test compares the result with the solver's, bit for bit. They are not public: `pyproject.toml` limits the versions.
Only diffraction differs, where the solver is wrong (`utd.py`).

Import this module only after `data_gen.llvm.ensure_backend()`.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import sionna.rt as rt
from jaxtyping import Int
from sionna.rt.path_solvers import sb_deterministic
from sionna.rt.path_solvers.paths_buffer import PathsBuffer
from sionna.rt.radio_materials.itu import itu_material

from data_gen.rays import RayLauncher
from data_gen.scenes.base import Part, SceneSpec
from data_gen.settings import SolverSettings
from data_gen.utd import diffraction_matrix, end_unused_vertices
from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.room_materials import own_law


def electrical_constants(material: str) -> Callable[[Any], tuple[Any, Any]]:
    """Returns the law by which relative permittivity and conductivity (S/m) of a material follow the frequency (hertz)."""
    law = own_law(material)

    def constants(frequency_hz: Any) -> tuple[Any, Any]:
        if law is None:
            return itu_material(material, frequency_hz)
        ghz = frequency_hz / 1e9
        return law.a * dr.power(ghz, law.b), law.c * dr.power(ghz, law.d)

    return constants


class BalancedMaterial(rt.RadioMaterial):
    """A slab of a material of ITU-R P.2040, or of the user's own, that reflects and transmits equally often in the search.

    Sionna draws reflection or transmission by their power. At 1 GHz walls transmit nearly everything, rays leave the room and
    most reflected paths are never found, while at 94 GHz nothing passes through concrete. With equal chances the paths that
    are found do not depend on the frequency. What a path carries is computed from the exact coefficients, not from chances;
    diffuse paths alone, of which each stands for many, are divided by their chance.
    """

    encloses: bool = False
    """Part of the room's outer surface: rays are only reflected, for what leaves the room does not come back."""

    def __init__(self, name: str, part: Part, settings: SolverSettings) -> None:
        super().__init__(
            name,
            thickness=part.thickness,
            scattering_coefficient=settings.scattering[part.closed],
            frequency_update_callback=electrical_constants(part.material),
            color=(0.5, 0.5, 0.5),
        )
        self.encloses = part.kind == "shell"

    def _event_probabilities(
        self, r_te: Any, r_tm: Any, t_te: Any, t_tm: Any, enabled_interactions: Any
    ) -> tuple[Any, Any, Any, Any]:
        def chance(possible: Any) -> Any:
            return dr.select(possible, mi.Float(1), mi.Float(0))

        # Metal lets nothing through: no ray is wasted on it.
        through = dr.squared_norm(mi.Vector2f(dr.abs(t_te), dr.abs(t_tm)))
        reflect = chance(enabled_interactions & rt.InteractionType.SPECULAR > 0)
        scatter = chance((enabled_interactions & rt.InteractionType.DIFFUSE > 0) & (self.scattering_coefficient > 0))
        transmit = chance((enabled_interactions & rt.InteractionType.REFRACTION > 0) & (through > 0) & (not self.encloses))
        total = reflect + scatter + transmit
        nothing = total == 0
        scale = dr.select(nothing, 1, dr.rcp(total))
        return reflect * scale, scatter * scale, transmit * scale, nothing

    def _diffraction_matrix(
        self, to_world: Any, ki_local: Any, ko_local: Any, si: Any, eta: Any, wavenumber: Any
    ) -> Any:  # fmt: skip
        return diffraction_matrix(self.thickness, to_world, ki_local, ko_local, si, eta, wavenumber)


@contextmanager
def _launching(rays: RayLauncher) -> Iterator[None]:
    """Lets the candidate generator start with these rays: it has no argument for them."""
    original = sb_deterministic.spawn_ray_from_sources
    sb_deterministic.spawn_ray_from_sources = rays.spawn
    try:
        yield
    finally:
        sb_deterministic.spawn_ray_from_sources = original


class PathTracer:
    """Traces the paths between the transmitters and the receiver that a scene holds, and gives the fields they carry.

    All but diffuse ones, which `DiffuseTracer` finds.
    """

    _diffuse = False

    def __init__(self, scene: rt.Scene, rays: RayLauncher, settings: SolverSettings) -> None:
        solver = rt.PathSolver(deterministic=True)
        stages = ("_candidate_generator", "_image_method", "_field_calculator")
        if not all(hasattr(solver, stage) for stage in stages):
            raise UserError("this sionna-rt has another path solver; install a version that pyproject.toml allows")
        self._candidates, self._image_method, self._fields = (getattr(solver, stage) for stage in stages)
        self._candidates.DIFFRACTION_SAMPLING_PROBABILITY = settings.diffraction_probability
        self._scene, self._rays, self._settings = scene, rays, settings

    def trace(self) -> PathsBuffer | None:
        """Returns the geometry of all paths, for `fields`; None where there is none, as in a closed yard, which
        Sionna RT stumbles over. The transmitters must stay where they are between the two.

        Raises:
            UserError: a transmitter has more candidate paths than the buffer holds.
        """
        options, scene = self._settings, self._scene.mi_scene
        sources, targets = self._ends()
        dr.make_opaque(sources[0], targets[0], sources[1], targets[1])
        with _launching(self._rays):
            paths = self._candidates(
                mi_scene=scene, src_positions=sources[0], tgt_positions=targets[0], samples_per_src=self._rays.count,
                max_num_paths_per_src=options.max_paths_per_src, max_depth=options.max_depth, los=True,
                specular_reflection=True, diffuse_reflection=self._diffuse, refraction=True, diffraction=options.diffraction,
                edge_diffraction=False, seed=options.seed,
            )  # fmt: skip
        paths.schedule()
        dr.eval()
        paths.shrink()
        check_room(np.array(paths.source_indices), options)
        paths.detach_geometry()
        paths = self._image_method(
            scene=scene, paths=paths, src_positions=sources[0], tgt_positions=targets[0], diffraction=options.diffraction,
            diffraction_lit_region=True,
        )  # fmt: skip
        if self._diffuse:
            _keep_diffuse(paths)
        paths.discard_invalid()
        if not paths.buffer_size:
            return None
        end_unused_vertices(paths, targets[0])
        return paths

    def fields(self, traced: PathsBuffer | None) -> rt.Paths | None:
        """Returns the traced paths with the coefficients they have at the scene's present frequency."""
        if traced is None:
            return None
        scene = self._scene
        # Not those of `trace`: the distances between antenna elements follow the wavelength.
        sources, targets = self._ends()
        paths = traced.gather(dr.arange(mi.UInt, traced.buffer_size))  # a copy: the next stage writes into it
        paths = self._fields(
            wavelength=scene.wavelength, paths=paths, samples_per_src=self._rays.count,
            diffraction=self._settings.diffraction, src_positions=sources[0], tgt_positions=targets[0],
            src_orientations=sources[1], tgt_orientations=targets[1],
            src_antenna_patterns=scene.tx_array.antenna_pattern.patterns,
            tgt_antenna_patterns=scene.rx_array.antenna_pattern.patterns,
        )  # fmt: skip
        paths.discard_invalid()
        return rt.Paths(scene, sources[0], targets[0], sources[3], targets[3], True, paths, sources[2], targets[2])

    def _ends(self) -> tuple[Any, Any]:
        """Returns positions, orientations, element positions and velocities of the transmitters and of the receiver."""
        return self._scene.sources(True, True), self._scene.targets(True, True)


class DiffuseTracer(PathTracer):
    """Traces the paths with a diffuse reflection, and no others.

    A diffuse path stands for the part of a surface that its ray meets, so rays must be even over the sphere: those aimed at
    edges would count furniture many times. Sionna allows no path with both a diffuse reflection and a diffraction.
    """

    _diffuse = True

    def __init__(self, scene: rt.Scene, spec: SceneSpec, settings: SolverSettings) -> None:
        even = replace(settings, diffraction=False, samples_per_src=settings.samples_diffuse)
        super().__init__(scene, RayLauncher(spec, even), even)


def check_room(source_indices: Int[np.ndarray, " candidates"], settings: SolverSettings) -> None:
    """Raises a `UserError` when a transmitter has filled its part of the buffer, for what came later was dropped."""
    limit = settings.max_paths_per_src
    full = np.flatnonzero(np.bincount(source_indices) >= limit)
    if len(full):
        where = f"transmitter {full[0]} of the batch and {len(full) - 1} more"
        raise UserError(f"more than {limit} candidate paths at {where}; raise --max-paths")


def _keep_diffuse(paths: PathsBuffer) -> None:
    """Marks all other paths as invalid."""
    found = dr.zeros(mi.Bool, paths.buffer_size)
    for depth in range(1, paths.max_depth + 1):
        found |= paths.get_interaction_type(mi.UInt(depth), mi.Bool(True)) == rt.InteractionType.DIFFUSE
    paths.valid &= found
