"""Sionna RT's path solver in two stages: rays are traced once, fields are computed at every frequency.

`sionna.rt.PathSolver` does both in one call per frequency. The geometry of paths does not depend on the frequency, and tracing
is nearly all of the cost. The stages below call the solver's own three steps (candidates, image method, fields) in the same
order; a test compares the result with the solver's, bit for bit. These steps are not public, so `pyproject.toml` limits the
versions. Only diffraction differs, where the solver is wrong (`utd.py`).

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
from wbgs_jax.interchange.rooms import own_law


def electrical_constants(material: str) -> Callable[[Any], tuple[Any, Any]]:
    """Returns relative permittivity and conductivity (S/m) of a material as a function of the frequency (hertz)."""
    law = own_law(material)

    def constants(frequency_hz: Any) -> tuple[Any, Any]:
        if law is None:
            return itu_material(material, frequency_hz)
        ghz = frequency_hz / 1e9
        return law.a * dr.power(ghz, law.b), law.c * dr.power(ghz, law.d)

    return constants


class BalancedMaterial(rt.RadioMaterial):
    """A slab of a material of ITU-R P.2040, or of a custom one, that reflects and transmits equally often in the path search.

    Sionna draws reflection or transmission according to power. At 1 GHz walls transmit nearly everything, rays leave the room
    and most reflected paths are never found, while at 94 GHz nothing passes through concrete. With equal probabilities the
    paths found do not depend on the frequency. The amplitude of a path is computed from the exact coefficients, not from the
    probabilities; only diffuse paths, each of which represents many, are divided by their probability.
    """

    encloses: bool = False
    """Part of the room's outer surface: rays are only reflected, since rays that leave the room do not return."""

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

        # Metal transmits nothing, so no ray is wasted on transmission.
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
    """Makes the candidate generator start with these rays, for which it has no argument."""
    original = sb_deterministic.spawn_ray_from_sources
    sb_deterministic.spawn_ray_from_sources = rays.spawn
    try:
        yield
    finally:
        sb_deterministic.spawn_ray_from_sources = original


class PathTracer:
    """Traces the paths between a scene's transmitters and its receiver, and computes their fields.

    Diffuse paths are found by `DiffuseTracer` instead.
    """

    _diffuse = False

    def __init__(self, scene: rt.Scene, rays: RayLauncher, settings: SolverSettings) -> None:
        solver = rt.PathSolver(deterministic=True)
        stages = ("_candidate_generator", "_image_method", "_field_calculator")
        if not all(hasattr(solver, stage) for stage in stages):
            raise UserError("this sionna-rt has a different path solver; install a version that pyproject.toml allows")
        self._candidates, self._image_method, self._fields = (getattr(solver, stage) for stage in stages)
        self._candidates.DIFFRACTION_SAMPLING_PROBABILITY = settings.diffraction_probability
        self._scene, self._rays, self._settings = scene, rays, settings

    def trace(self) -> PathsBuffer | None:
        """Returns the geometry of all paths, for `fields`; None if there are none, as in a closed yard, for which Sionna RT
        fails. The transmitters must not be moved before `fields`.

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
        """Returns the traced paths with their coefficients at the scene's current frequency."""
        if traced is None:
            return None
        scene = self._scene
        # Not the same as in `trace`: the distances between antenna elements scale with the wavelength.
        sources, targets = self._ends()
        paths = traced.gather(dr.arange(mi.UInt, traced.buffer_size))  # a copy, because the next stage modifies it
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
    """Traces only paths with a diffuse reflection.

    A diffuse path represents the part of a surface around its ray, so rays must be uniform over the sphere: rays aimed at edges
    would count furniture many times. Sionna supports no path with both a diffuse reflection and a diffraction.
    """

    _diffuse = True

    def __init__(self, scene: rt.Scene, spec: SceneSpec, settings: SolverSettings) -> None:
        even = replace(settings, diffraction=False, samples_per_src=settings.samples_diffuse)
        super().__init__(scene, RayLauncher(spec, even), even)


def check_room(source_indices: Int[np.ndarray, " candidates"], settings: SolverSettings) -> None:
    """Raises a `UserError` if a transmitter has filled its part of the buffer, since further candidates were dropped."""
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
