"""The coherent field: the snapshot is a sum of waves, with phases from geometry and learned materials.

    y = sum over paths  a(direction) g(direction) E(f) exp(-j k d) / d        PAS = |a^H y| / max

The mesh consists of planar facets with edges between them; the receiver's mirror images in the facets determine the paths
(propagation/). The amplitude of a path follows from the slabs that reflect and transmit it. Their properties are learned:
permittivity, conductivity and (if the scene does not define it) thickness of every material, a small correction of every facet,
the standard deviation of the position of every rigid body, and the antennas. Phase-blind models cannot reproduce interference;
this model does, as far as path lengths are accurate, and it also predicts the channel itself.
"""

import dataclasses
import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, Key

from wbgs_jax._util.pytree import pytree, replaced, static, to_device
from wbgs_jax.fields.base import (
    Aux,
    Group,
    Inspection,
    MaterialProperties,
    Observation,
    TrainingTime,
    compare,
    register,
    without_unreceived,
)
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import (
    PRESETS,
    Materials,
    PreparedPaths,
    WaveConfig,
    WaveParams,
    WavePlan,
    arrivals_at,
    densities,
    first_params,
    observe,
    path_arrivals,
    path_covariances,
    path_snapshots,
    phase_blind_pas,
    prepare_paths,
    slabs_at,
    trace,
    transparent_grid,
)
from wbgs_jax.fields.losses import snapshot_losses
from wbgs_jax.mesh.edges import Edges, common_size, edges_of_facets, padded_edges, padded_to
from wbgs_jax.mesh.facets import AnyArray, Facets, remaining
from wbgs_jax.mesh.facets import moved as move_facets
from wbgs_jax.mesh.simplification import facets_that_fit
from wbgs_jax.propagation.displacement import Motion, still, tree_over_time
from wbgs_jax.propagation.image_method import ImageTree, make_image_tree
from wbgs_jax.propagation.transport import Grid, grid_around
from wbgs_jax.radio.antenna import upright
from wbgs_jax.radio.array import LagBasis, make_lag_basis
from wbgs_jax.radio.channel import Paths
from wbgs_jax.radio.geometry import turned
from wbgs_jax.types import Batch, Links, Mesh, Query, Receiver, Scene, check_receiver

__all__ = [
    "Materials",
    "PreparedPaths",
    "WaveConfig",
    "WaveField",
    "WaveParams",
    "WavePlan",
    "arrivals_at",
    "channels",
    "make_field",
    "observe",
    "path_covariances",
    "path_snapshots",
    "phase_blind_pas",
    "render",
    "slabs_at",
    "snapshots",
    "trace",
]

EXACT_PLACE = float(np.log(1e-6))
"""Logarithm of the standard deviation (metres) of a position that is known."""
_last: list[tuple[Any, ...]] = [()]
"""Facets, edges and settings of the last image tree, and the tree: `fields.pas` plans for the same receiver again and again."""


@register
@pytree
class WaveField(Calibratable):
    """Facets and edges of the scene, known thicknesses, and the results of calibration."""

    facets: Facets
    edges: Edges
    known_thickness: Float[Array, " m"]
    """Thickness of every material, metres; 0 if the scene does not define it, in which case it is learned."""
    first_placement: Float[Array, " places"]
    """Initial `WaveParams.placement`."""
    receivers: Float[Array, "r 3"]
    """Nominal positions of the receivers of the data, world frame, metres."""
    motion: Motion
    """Estimated displacements of rigid bodies and of those receivers from their nominal positions; the facets are already
    displaced."""
    tuning: Float[Array, "r elements 2"] | None
    """Estimated array gains: logarithm of amplitude, and phase (radians), of the elements of those receivers relative to ideal
    elements; None for ideal elements."""
    grid: Grid | None
    """Cells of the absorption grid, or None without one."""
    first_clutter: Float[Array, "x y z 2"] | None
    """Initial `WaveParams.clutter`; None without an absorption grid."""
    config: WaveConfig = static()

    name: ClassVar[str] = "wave"
    presets: ClassVar = PRESETS
    outputs: ClassVar = ("pas", "snapshots", "power", "paths")
    hooks: ClassVar = ("calibration",)
    seconds: ClassVar = {"cpu": TrainingTime(60, 90, 100), "smoke": TrainingTime(6, 38, 37)}

    @classmethod
    def build(cls, config: WaveConfig, scene: Scene, seed: int) -> "WaveField":
        """Returns the field of a scene's surfaces.

        Raises:
            UserError: the settings are invalid, or the scene has no surfaces.
        """
        config.check(cls.name)
        return make_field(scene.mesh(), config, scene.receivers.position)

    def init(self, key: Key[Array, ""]) -> WaveParams:
        """Returns initial parameters, in which all materials are the same; nothing is random."""
        facets, materials = self.facets.offset.shape[0], self.known_thickness.shape[0]
        return first_params(self.config, facets, materials, self.first_placement, self.first_clutter)

    def plan(
        self, params: WaveParams | None, receiver: Receiver, prepared: PreparedPaths | None = None, capacity: None = None
    ) -> WavePlan:
        """Returns a plan with all mirror images of a receiver (host), or without them if its paths are prepared."""
        check_receiver(receiver)
        receiver, array_gains = self._as_found(receiver)
        surfaces, lag_basis = (
            (self._image_tree(receiver), _lag_basis(receiver)) if prepared is None else (prepared.surfaces, prepared.lag_basis)
        )
        return WavePlan(
            surfaces, receiver, array_gains, self.known_thickness, None, lag_basis, self.grid, prepared, self.config
        )

    def plan_movement(self, receiver: Receiver, tx_position: Float[AnyArray, "t 3"], motion: Motion) -> WavePlan:
        """Returns a plan for all instants of a movement (host), for `moved_plan`."""
        check_receiver(receiver)
        receiver, array_gains = self._as_found(receiver)
        config = self.config
        areas = (config.mirror_areas, config.mirror_area_after_edge, config.mirror_area_before_edge)
        tree = tree_over_time(self.facets, self.edges, np.asarray(receiver.position), tx_position, motion, *areas)
        return WavePlan(tree, receiver, array_gains, self.known_thickness, None, None, self.grid, None, config)

    def displaced(self, plan: WavePlan, motion: Motion) -> WavePlan:
        """Returns a plan whose surfaces and receiver are displaced, to first order, from where its paths were traced.

        Args:
            plan: plan of one receiver.
            motion: displacements; those of receivers are of the plan's receiver only.
        """
        orientation = turned(plan.receiver.orientation, jnp.asarray(motion.receiver_turn))
        return dataclasses.replace(plan, motion=motion, receiver=dataclasses.replace(plan.receiver, orientation=orientation))

    def _image_tree(self, receiver: Receiver) -> ImageTree:
        config = self.config
        if _traced(self.facets, self.edges, receiver.position):
            raise TypeError(
                "the wave field computes a receiver's mirror images on the host: neither the field nor receiver.position can "
                "be traced or differentiated; close over both, or make the plan outside jax.jit and jax.grad"
            )
        areas = (config.mirror_areas, config.mirror_area_after_edge, config.mirror_area_before_edge)
        position = np.asarray(receiver.position)
        made_for = self.facets, self.edges, (position.tobytes(), areas)
        last = _last[0]
        if last and last[0] is made_for[0] and last[1] is made_for[1] and last[2] == made_for[2]:
            known: ImageTree = last[3]
            return known
        with jax.ensure_compile_time_eval():  # no tracers, which would outlive the trace
            tree = make_image_tree(self.facets, self.edges, position, *areas, padded=True)
        _last[0] = *made_for, tree
        return tree

    def _as_found(self, receiver: Receiver) -> tuple[Receiver, Float[Array, "elements 2"] | None]:
        """Returns a receiver of the data at its estimated position and orientation, with its array gains; any other receiver,
        and one of several arrays at the same place, is returned unchanged, without gains."""
        if not len(self.receivers):
            return receiver, None
        known = self.receivers, receiver.position, self.motion.receiver
        xp = jnp if _traced(*known) else np  # mirror images are computed on the host, also inside `jit`
        places, position, shifts = map(xp.asarray, known)
        away = xp.linalg.norm(places - position, axis=-1)
        same_place_m = 1e-3  # distance, metres, below which two receiver positions count as the same
        here = away < same_place_m

        def found(of_all: Any, xp: Any = jnp) -> Any:
            return xp.where(here.sum() == 1, of_all[here.argmax()], 0)

        position = position + found(shifts, xp)
        if xp is np:
            with jax.ensure_compile_time_eval():
                position = jnp.asarray(position)
        orientation = turned(receiver.orientation, found(self.motion.receiver_turn))
        fits = self.tuning is not None and self.tuning.shape[1] == len(receiver.element_positions)
        array_gains = found(self.tuning) if fits else None  # None for another array at the place of a receiver of the data
        return dataclasses.replace(receiver, position=position, orientation=orientation), array_gains

    def prepare(self, links: Links, receivers: Receiver) -> PreparedPaths:
        """Returns the paths between the transmitters and receivers of links (host); geometry is not trained."""
        return prepare_paths(links, lambda number: self.plan(None, jax.tree.map(lambda leaf: leaf[number], receivers)))

    def render(self, params: WaveParams, plan: WavePlan, links: Query) -> Observation:
        """Returns spectra, snapshots, received power and paths of B links, which must be `Links` if paths are prepared."""
        paths = plan.paths_of(links)
        return observe(params, dataclasses.replace(plan, prepared=None), paths, links)

    def loss(
        self,
        params: WaveParams,
        prepared: PreparedPaths,
        batch: Batch,
        capacity: None = None,
        probe: None = None,
    ) -> tuple[Float[Array, ""], Aux]:
        """Returns the image loss, plus the correlation and power losses of snapshots if the data contain them, plus a penalty
        on facet corrections and absorption. The spectra of links on which nothing was received are ignored: predicted spectra
        have a maximum of 1."""
        return self.compared(params, self.render(params, self.plan(params, batch.receiver, prepared), batch.links), batch)

    def compared(self, params: WaveParams, seen: Observation, batch: Batch) -> tuple[Float[Array, ""], Aux]:
        """Returns the loss of predictions on a batch."""
        config = self.config
        loss, aux = compare(seen, without_unreceived(batch, seen), config.ssim_weight, config.ssim_stride)
        if seen.snapshots is not None and batch.snapshots is not None:
            correlation_loss, power_loss = snapshot_losses(seen.snapshots, batch.snapshots)
            loss += config.correlation_weight * correlation_loss + config.power_weight * power_loss
        return loss + self.penalty(params), aux

    def penalty(self, params: WaveParams) -> Float[Array, ""]:
        """Returns the penalty on facet corrections and absorption."""
        corrections = self.config.correction_weight * jnp.sum(jnp.mean(params.facet_correction**2, 0))
        if params.clutter is None:
            return corrections
        return corrections + self.config.clutter_weight * jnp.mean(densities(params.clutter))

    def moved(self, motion: Motion) -> "WaveField":
        """Returns the field with surfaces and receivers displaced further (host)."""
        facets = move_facets(self.facets, np.asarray(motion.shift), np.asarray(motion.turn))
        return self._of(facets, jax.tree.map(lambda a, b: a + b, self.motion, motion))

    def without(self, rigid_bodies: Int[np.ndarray, " k"]) -> "WaveField":
        """Returns the field without some rigid bodies, given by their indices (host)."""
        stays = np.setdiff1d(np.arange(len(self.motion.shift)), rigid_bodies)
        motion = dataclasses.replace(self.motion, shift=self.motion.shift[stays], turn=self.motion.turn[stays])
        placement = self.first_placement[np.append(stays, -1)]
        return dataclasses.replace(self._of(remaining(self.facets, stays), motion), first_placement=placement)

    def with_body(self, params: WaveParams, body: Facets, material: MaterialProperties) -> tuple["WaveField", WaveParams]:
        """Returns the field and parameters with one more rigid body, the last one, of a material of its own (host)."""
        old, numbers = self.facets, {"body": body.body, "material": body.material, "mover": body.mover}
        first = {"body": np.max(old.body) + 1, "material": len(self.known_thickness), "mover": len(self.motion.shift)}
        own = dataclasses.replace(body, **{name: np.full_like(of, first[name]) for name, of in numbers.items()})
        facets = jax.tree.map(lambda a, b: np.concatenate([np.asarray(a), b]), old, own)
        motion = dataclasses.replace(self.motion, shift=_longer(self.motion.shift, 0), turn=_longer(self.motion.turn, 0))
        known = _longer(self.known_thickness, material.thickness)
        field = dataclasses.replace(
            self._of(facets, motion), known_thickness=known, first_placement=_longer(self.first_placement, EXACT_PLACE, at=-1)
        )
        values = np.log(material.permittivity - 1), np.log(material.conductivity), material.slope, np.log(material.thickness)
        leaves, tree = jax.tree.flatten(params.materials)
        materials = jax.tree.unflatten(tree, [_longer(leaf, value) for leaf, value in zip(leaves, values, strict=True)])
        corrections = np.concatenate([params.facet_correction, np.zeros((len(body.offset), 2))])
        return field, dataclasses.replace(
            params,
            materials=materials,
            facet_correction=jnp.asarray(corrections, jnp.float32),
            placement=_longer(params.placement, EXACT_PLACE, at=-1),
        )

    def _of(self, facets: Facets, motion: Motion) -> "WaveField":
        parts = {"facets": facets, "edges": padded_edges(edges_of_facets(facets)), "motion": motion}
        return dataclasses.replace(self, **{name: to_device(part) for name, part in parts.items()})

    def in_common_shapes(self, prepared: PreparedPaths, elements: int) -> tuple["WaveField", PreparedPaths]:
        """Returns the field without what prepared paths do not need, and these paths with padded surfaces (host)."""

        def nothing(part: Any) -> Any:
            return jax.tree.map(lambda leaf: leaf[:0], part)

        gains: Any = self.tuning
        if gains is None and len(self.receivers):
            gains = np.zeros((len(self.receivers), elements, 2), np.float32)
        slim = replaced(
            self,
            facets=nothing(self.facets),
            edges=nothing(self.edges),
            first_placement=nothing(self.first_placement),
            motion=dataclasses.replace(self.motion, shift=nothing(self.motion.shift), turn=nothing(self.motion.turn)),
            known_thickness=padded_to(self._common_materials, self.known_thickness),
            tuning=gains,
            first_clutter=None,
        )
        surfaces = jax.tree.map(lambda leaf: padded_to(common_size(len(leaf)), leaf), prepared.surfaces)
        return to_device(slim), dataclasses.replace(prepared, surfaces=to_device(surfaces))

    def params_in_common_shapes(self, params: WaveParams) -> WaveParams:
        """Returns parameters, whose leaves may have a leading axis, with sizes as in `in_common_shapes` (host)."""
        places, last = params.placement[..., :-1], params.placement[..., -1:]
        return replaced(
            params,
            materials=jax.tree.map(lambda leaf: padded_to(self._common_materials, leaf, -1), params.materials),
            facet_correction=padded_to(common_size(params.facet_correction.shape[-2]), params.facet_correction, -2),
            placement=np.concatenate([padded_to(common_size(places.shape[-1]), places, -1), last], -1),
        )

    @property
    def _common_materials(self) -> int:
        """Number of materials in common shapes, which is enough for one of each rigid body."""
        return common_size(max(len(self.known_thickness), len(self.motion.shift)))

    def with_gains(self, gains: Complex[np.ndarray, "r elements"]) -> "WaveField":
        """Returns the field with the array gains of its receivers multiplied by these complex gains."""
        further = jnp.asarray(np.stack([np.log(np.abs(gains)), np.angle(gains)], -1), jnp.float32)
        return dataclasses.replace(self, tuning=further if self.tuning is None else self.tuning + further)

    def with_absorption(self) -> "WaveField":
        """Returns the field with an absorption grid around its surfaces and receivers, which is nearly transparent at first
        (host)."""
        around = np.concatenate([np.asarray(self.facets.corners).reshape(-1, 3), np.asarray(self.receivers)])
        grid, shape = grid_around(around, self.config.clutter_cell, self.config.clutter_cells)
        return dataclasses.replace(self, grid=to_device(grid), first_clutter=transparent_grid(shape))

    def with_isotropic_elements(self, params: WaveParams) -> WaveParams:
        """Returns parameters without the calibrated pattern of the data's receivers, for other antennas that receive."""
        return dataclasses.replace(params, element=upright(jnp.zeros(2, jnp.float32)))

    def material_properties(self, params: WaveParams) -> MaterialProperties:
        """Returns the learned properties of the materials (host)."""
        m, known = jax.tree.map(np.asarray, (params.materials, self.known_thickness))
        thickness = np.where(known > 0, known, np.exp(m.log_thickness))
        return MaterialProperties(1 + np.exp(m.log_susceptibility), np.exp(m.log_conductivity), m.slope, thickness)

    def with_material(self, params: WaveParams, material: int, permittivity: float, conductivity: float) -> WaveParams:
        """Returns parameters with another relative permittivity (above 1) and conductivity (at 1 GHz, S/m) of one material
        (host)."""
        m = params.materials
        polarised = m.log_susceptibility.at[material].set(np.log(permittivity - 1))
        conducting = m.log_conductivity.at[material].set(np.log(conductivity))
        changed = dataclasses.replace(m, log_susceptibility=polarised, log_conductivity=conducting)
        return dataclasses.replace(params, materials=changed)

    def with_thickness(self, plan: WavePlan, material: int, metres: float) -> tuple["WaveField", WavePlan]:
        """Returns the field and a plan with the thickness of one material fixed, in metres (host)."""
        known = self.known_thickness.at[material].set(metres)
        return tuple(dataclasses.replace(one, known_thickness=known) for one in (self, plan))  # type: ignore[return-value]

    def smoothed(self, params: WaveParams, metres: Float[Array, ""] | float) -> WaveParams:
        """Returns parameters with a larger standard deviation of the transmitter's position: `metres` along each axis, added in
        quadrature."""
        variance = jnp.exp(2 * params.placement[-1]) + jnp.asarray(metres, jnp.float32) ** 2
        return dataclasses.replace(params, placement=params.placement.at[-1].set(0.5 * jnp.log(variance)))

    def receiver_independent(self, params: WaveParams) -> tuple["WaveField", WaveParams]:
        """Returns the field unchanged: estimated displacements and array gains of receivers apply to these receivers only."""
        return self, params

    def inspect(self, params: WaveParams, plan: WavePlan | None = None, links: Query | None = None) -> Inspection:
        """Returns the numbers of materials, facets and edges, the properties of the materials, and the displaced surfaces."""
        edges = int(np.count_nonzero(np.asarray(self.edges.length)))
        sizes = {"materials": len(self.known_thickness), "facets": len(self.facets.offset), "edges": edges}
        shift, displaced = np.asarray(self.motion.shift), None
        if np.any(shift):
            displaced = np.asarray(self.facets.corners), shift[np.asarray(self.facets.mover)]
        return Inspection(sizes, self.material_properties(params), displaced)

    @classmethod
    def param_groups(cls, config: WaveConfig, params: WaveParams | None = None) -> tuple[dict[str, Group], Any]:
        """Returns the groups of parameters, and the group of every parameter; propagation options are not trained, but chosen
        by calibration."""
        groups = {
            "materials": Group(config.materials_lr),
            "thickness": Group(config.thickness_lr),
            "corrections": Group(config.corrections_lr),
            "antennas": Group(config.antennas_lr),
            "placement": Group(config.placement_lr),
            "ideal": Group(0.0),
            "clutter": Group(config.clutter_lr),
        }
        if params is None:
            return groups, None
        group_of = {"materials": "materials", "transmitter": "antennas", "element": "antennas", "placement": "placement"}
        group_of |= {"thick": "ideal", "curved": "ideal", "clutter": "clutter"}

        def label(path: Any, _: Any) -> str:
            *_, last = path
            return "thickness" if last.name == "log_thickness" else group_of.get(path[0].name, "corrections")

        return groups, jax.tree_util.tree_map_with_path(label, params)


def make_field(mesh: Mesh, config: WaveConfig | None = None, receivers: Any = ()) -> WaveField:
    """Returns the field of a mesh, with facets and edges computed on the host.

    Args:
        mesh: mesh of the scene.
        config: settings.
        receivers: positions (r, 3), world frame, metres, of the receivers that may be calibrated; none by default.
    """
    config = config or WaveConfig()
    facets = facets_that_fit(mesh, config.max_facets)
    edges = padded_edges(edges_of_facets(facets))
    rigid_bodies = int(facets.mover.max()) + 1
    placement = jnp.full(rigid_bodies + 1, np.log(config.placement), jnp.float32)
    thickness, known = jnp.asarray(mesh.thickness, jnp.float32), jnp.asarray(receivers, jnp.float32).reshape(-1, 3)
    motion = to_device(still(rigid_bodies, len(known)))
    return WaveField(to_device(facets), to_device(edges), thickness, placement, known, motion, None, None, None, config)


def _longer(rows: Any, value: Any, at: int | None = None) -> Float[Array, "..."]:
    """Returns rows with one more, filled with a value, in front of `at`, by default at the end."""
    place = len(rows) if at is None else at
    return jnp.asarray(np.insert(np.asarray(rows), place, value, axis=0), jnp.float32)


def _lag_basis(receiver: Receiver) -> LagBasis | None:
    """Returns the lag basis of an array with positions in wavelengths that are available on the host, else None."""
    positions = receiver.element_positions
    if receiver.unit != "wavelengths" or _traced(positions):
        return None
    return _lag_basis_of(np.asarray(positions).tobytes(), np.asarray(positions).dtype.str)


@functools.lru_cache(maxsize=8)
def _lag_basis_of(positions: bytes, dtype: str) -> LagBasis:
    """Returns the lag basis of an array from its positions: those of most receivers are the same."""
    with jax.ensure_compile_time_eval():
        return make_lag_basis(np.frombuffer(positions, dtype).reshape(-1, 3))


def _traced(*trees: Any) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def render(params: WaveParams, plan: WavePlan, query: Query) -> Float[Array, "b 90 360"]:
    """Returns the power angular spectra of B queries."""
    return observe(params, plan, plan.paths_of(query), query).pas


def snapshots(params: WaveParams, plan: WavePlan, query: Query) -> Complex[Array, "b elements"]:
    """Returns the complex array snapshots (channel state) of B queries."""
    return path_snapshots(params, plan, plan.paths_of(query), query)


def channels(params: WaveParams, plan: WavePlan, query: Query) -> Paths:
    """Returns all paths of B queries, leading axis B, with amplitudes, directions and lengths."""
    return path_arrivals(params, plan, plan.paths_of(query), query)
