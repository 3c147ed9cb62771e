"""The coherent field: the snapshot as a sum of waves, its phases from geometry, its materials learned.

    y = sum over paths  a(direction) g(direction) E(f) exp(-j k d) / d        PAS = |a^H y| / max

The mesh gives planar facets and the edges between them, the receiver's mirror images in them give the paths (wave/). What a
path carries follows from the slabs it is reflected by and passes through, and those are learned: permittivity, conductivity
and (where it is not known) thickness of every material, and a small residual of every facet. Phase-blind models cannot follow
interference; this one does, and it yields the channel itself.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, Key

from wbgs_jax.array import normalise, pas_directions, snapshot_to_pas, steering_vector
from wbgs_jax.checks import check_query, check_receiver
from wbgs_jax.config import WaveConfig
from wbgs_jax.errors import UserError
from wbgs_jax.fields.observation import Observation
from wbgs_jax.losses import squared_magnitude
from wbgs_jax.pytree import pytree, static
from wbgs_jax.types import Mesh, Query, Receiver
from wbgs_jax.wave.edges import Edges, edges_of_facets
from wbgs_jax.wave.facets import Facets, facets_from_mesh, outline_of
from wbgs_jax.wave.images import diffracted_chains, receiver_chains
from wbgs_jax.wave.paths import (
    DIFFRACTED,
    MAX_FACETS,
    REFLECTED,
    TRANSMITTED,
    Outline,
    Paths,
    Search,
    diffracted_paths,
    reflected_paths,
)
from wbgs_jax.wave.slab import complex_permittivity
from wbgs_jax.wave.transfer import Arrivals, Slabs, arrivals, snapshot

STARTS_FROM = "mesh"
TRACED_AT_ONCE = 16
"""Transmitters."""
FAINTEST = 1e-30
"""Amplitude that stands for nothing; its square would vanish in single precision."""
LARGEST_LOG_CONDUCTIVITY = float(np.log(1e6))
"""Beyond it (S/m) every material is a mirror, and single precision ends."""


@pytree
class Materials:
    """Stored (unconstrained) properties of M materials, those of ITU-R P.2040: eps_r, and sigma = c f^d with f in GHz."""

    log_susceptibility: Float[Array, "m"]
    """log(eps_r - 1)."""
    log_conductivity: Float[Array, "m"]
    """log c, c in S/m."""
    slope: Float[Array, "m"]
    """d."""
    log_thickness: Float[Array, "m"]
    """log of metres, where the scene does not say."""
    known_thickness: Float[Array, "m"]
    """Metres, not trained; 0 where it is not known."""

    def thickness(self) -> Float[Array, "m"]:
        """Metres."""
        return jnp.where(self.known_thickness > 0, self.known_thickness, jnp.exp(self.log_thickness))


@pytree
class WaveParams:
    """All parameters of the field; geometry is not trained."""

    materials: Materials
    residual: Float[Array, "f 2"]
    """Logarithm of amplitude and phase (radians) by which a facet's reflection differs from its material's."""
    log_survival: Float[Array, "2 3"]
    """Logarithm of the amplitude that a meeting leaves beyond its slab or wedge, of (plain, diffracted) paths at (transmission,
    reflection, diffraction)."""
    directivity: Float[Array, ""]
    """Exponent of the receiver elements' gain: 1 for the element of 3GPP TR 38.901, 0 for isotropic ones."""
    log_gain: Float[Array, ""]
    """Of the transmitter and whatever else scales all snapshots."""
    facets: Facets
    edges: Edges
    config: WaveConfig = static()


@pytree
class WavePlan:
    """What is independent of the query."""

    search: Search
    receiver: Receiver


@pytree
class Traced:
    """The paths of some transmitters."""

    plain: Paths
    diffracted: Paths


def init(key: Key[Array, ""], mesh: Mesh, config: WaveConfig, capacity: int | None = None) -> WaveParams:
    """Facets and edges of a mesh (on the host), all materials alike but for thicknesses that are known.

    Raises:
        UserError: more facets are asked for than the search for paths can number.
    """
    if config.max_facets > MAX_FACETS:
        raise UserError(f"--wave.max-facets is {config.max_facets}; the most is {MAX_FACETS}")
    facets = facets_from_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), np.asarray(mesh.cluster), config.max_facets)
    m = mesh.thickness.shape[0]
    materials = Materials(
        log_susceptibility=jnp.full(m, np.log(config.permittivity - 1), jnp.float32),
        log_conductivity=jnp.full(m, np.log(config.conductivity), jnp.float32),
        slope=jnp.full(m, config.slope, jnp.float32),
        log_thickness=jnp.full(m, np.log(config.thickness), jnp.float32),
        known_thickness=jnp.asarray(mesh.thickness, jnp.float32),
    )
    return WaveParams(
        materials=materials,
        residual=jnp.zeros((len(facets.part), 2)),
        log_survival=jnp.log(jnp.array([[1.0, 1.0, 1.0], [config.survival, config.survival, 1.0]])),
        directivity=jnp.asarray(mesh.directivity, jnp.float32),
        log_gain=jnp.zeros(()),
        facets=_floats(facets),
        edges=_floats(edges_of_facets(facets)),
        config=config,
    )


def _floats(tree: Any) -> Any:
    """All arrays as float32, indices too, so that `jax.grad` takes them."""
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), tree)


def plan(params: WaveParams, receiver: Receiver, *_: Any) -> WavePlan:
    """All mirror images of a receiver; on the host, so not under jit."""
    check_receiver(receiver)
    config, rx = params.config, np.asarray(receiver.position, np.float64)
    facets, edges = _on_host(params.facets), _on_host(params.edges)
    outline: Any = outline_of(facets)
    search = Search(
        receiver.position,
        facets,
        Outline(*outline),
        edges,
        receiver_chains(facets, rx, config.mirror_areas),
        diffracted_chains(facets, edges, rx, config.mirror_area_after_edge, config.mirror_area_before_edge),
    )
    return WavePlan(jax.tree.map(_to_device, search), receiver)


def _on_host(tree: Any) -> Any:
    """float64 positions, int32 indices."""
    arrays = {f.name: np.asarray(getattr(tree, f.name), np.float64) for f in dataclasses.fields(tree)}
    return type(tree)(**arrays | {name: arrays[name].astype(np.int32) for name in ("part", "facet") if name in arrays})


def _to_device(leaf: Any) -> Array:
    return jnp.asarray(leaf, jnp.float32 if np.issubdtype(np.asarray(leaf).dtype, np.floating) else jnp.int32)


def trace(params: WaveParams, plan: WavePlan, tx_position: Float[Array, "b 3"]) -> Traced:
    """The paths of B transmitters; independent of frequency and materials."""
    config = params.config

    def one(tx):
        plain = reflected_paths(tx, plan.search, config.plain_tried, config.plain_kept)
        return Traced(plain, diffracted_paths(tx, plan.search, config.diffracted_tried, config.diffracted_kept))

    return jax.lax.map(one, tx_position)


def remember(params: WaveParams, receiver: Receiver, tx_positions: Float[Array, "tx 3"]) -> tuple[WavePlan, Traced]:
    """The receiver's mirror images and the paths of all transmitters: geometry is not trained."""
    planned = plan(params, receiver)
    tracing, n = jax.jit(trace), tx_positions.shape[0]
    parts = []
    for start in range(0, n, TRACED_AT_ONCE):
        index = np.minimum(np.arange(start, start + TRACED_AT_ONCE), n - 1)  # blocks of one shape: one compilation
        parts.append(jax.tree.map(np.asarray, tracing(params, planned, tx_positions[index])))
    return planned, jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)[:n]), *parts)


def observe(
    params: WaveParams,
    memory: tuple[WavePlan, Traced],
    receiver: Receiver,
    query: Query,
    tx_index: Int[Array, "b"],
    capacity: Any = None,
    means2d_offset: Any = None,
) -> Observation:
    """Snapshots and spectra of a training batch."""
    planned, traced = memory
    chosen = jax.tree.map(lambda leaf: leaf[tx_index], traced)
    penalty = params.config.residual_weight * jnp.sum(jnp.mean(params.residual**2, 0))
    if not params.config.coherent:
        return Observation(phase_blind_pas(params, planned, chosen, query.frequency_hz), penalty=penalty)
    y = carry(params, planned, chosen, query.frequency_hz)
    return Observation(to_pas(y, receiver), y, penalty)


def sizes(params: WaveParams) -> dict[str, int]:
    """What decides the shapes of the parameters, besides the configuration."""
    m, f, e = params.materials.slope, params.facets.offset, params.edges.length
    return {"materials": m.shape[0], "facets": f.shape[0], "edges": e.shape[0]}


def skeleton(config: WaveConfig, sizes: dict[str, int]) -> WaveParams:
    """The shapes of parameters."""
    m, f, e = (sizes[name] for name in ("materials", "facets", "edges"))

    def build() -> WaveParams:
        def zeros(*shape: int) -> Array:
            return jnp.zeros(shape, jnp.float32)

        return WaveParams(
            materials=Materials(*[zeros(m)] * 5),
            residual=zeros(f, 2),
            log_survival=zeros(2, 3),
            directivity=zeros(),
            log_gain=zeros(),
            facets=_floats(Facets(zeros(f, 4, 3), zeros(f, 3), zeros(f), jnp.zeros(f, int))),
            edges=_floats(Edges(zeros(e, 3), zeros(e, 3), zeros(e), zeros(e, 3), zeros(e, 3), jnp.zeros(e, int))),
            config=config,
        )

    shaped: Any = jax.eval_shape(build)
    return shaped


def render(params: WaveParams, plan: WavePlan, query: Query) -> Float[Array, "b 90 360"]:
    """Power angular spectra of B queries."""
    if not params.config.coherent:
        return phase_blind_pas(params, plan, trace(params, plan, query.tx_position), query.frequency_hz)
    return to_pas(snapshots(params, plan, query), plan.receiver)


def snapshots(params: WaveParams, plan: WavePlan, query: Query) -> Complex[Array, "b elements"]:
    """Complex array snapshots (channel state) of B queries."""
    check_query(query)
    return carry(params, plan, trace(params, plan, query.tx_position), query.frequency_hz)


def channels(params: WaveParams, plan: WavePlan, query: Query) -> Arrivals:
    """Every path of B queries, leading axis B: amplitudes, directions, lengths."""
    check_query(query)
    traced = trace(params, plan, query.tx_position)
    found: Any = jax.vmap(lambda traced, f: arrivals_at(params, plan, traced, f))(traced, query.frequency_hz)
    return found


def carry(params: WaveParams, plan: WavePlan, traced: Traced, frequency_hz: Float[Array, "b"]) -> Complex[Array, "b elements"]:
    """Snapshots of B transmitters whose paths are known."""
    return jax.vmap(lambda traced, f: snapshot(arrivals_at(params, plan, traced, f), plan.receiver))(traced, frequency_hz)


def to_pas(y: Complex[Array, "b elements"], receiver: Receiver) -> Float[Array, "b 90 360"]:
    """Spectra of snapshots of any scale."""
    y = y / jnp.sqrt(jnp.sum(squared_magnitude(y), -1, keepdims=True) + 1e-30)
    return snapshot_to_pas(y, receiver.element_positions)


def phase_blind_pas(
    params: WaveParams, plan: WavePlan, traced: Traced, frequency_hz: Float[Array, "b"]
) -> Float[Array, "b 90 360"]:
    """Spectra with the powers of all paths added: what is left of this model without its phases."""

    def covariance(traced, f):
        found = arrivals_at(params, plan, traced, f)
        steering = steering_vector(plan.receiver.element_positions, found.direction)
        strongest = jax.lax.stop_gradient(jnp.max(jnp.abs(found.amplitude)))
        power = squared_magnitude(found.amplitude / jnp.maximum(strongest, FAINTEST))
        weighted = steering * (power / jnp.maximum(jnp.sum(power), FAINTEST))[:, None]
        return steering.T @ weighted.conj()  # sum of power times a a^H

    grid = steering_vector(plan.receiver.element_positions, jnp.asarray(pas_directions(), jnp.float32))
    beams = jnp.einsum("hwe,bef,hwf->bhw", grid.conj(), jax.vmap(covariance)(traced, frequency_hz), grid)
    return normalise(jnp.sqrt(jnp.maximum(beams.real, 1e-12)))


def slabs_at(params: WaveParams, plan: WavePlan, frequency_hz: Float[Array, ""]) -> Slabs:
    """What every facet is made of."""
    m, cluster = params.materials, plan.search.facets.part
    sigma = jnp.exp(jnp.minimum(m.log_conductivity + m.slope * jnp.log(frequency_hz / 1e9), LARGEST_LOG_CONDUCTIVITY))
    permittivity = complex_permittivity(1 + jnp.exp(m.log_susceptibility), sigma, frequency_hz)
    return Slabs(permittivity[cluster], m.thickness()[cluster])


def arrivals_at(params: WaveParams, plan: WavePlan, traced: Traced, frequency_hz: Float[Array, ""]) -> Arrivals:
    """What one transmitter sends over all of its paths."""
    slabs, search = slabs_at(params, plan, frequency_hz), plan.search
    found = []
    for row, paths in enumerate((traced.plain, traced.diffracted)):
        one = arrivals(
            paths, search.facets, search.edges, slabs, frequency_hz, plan.receiver, params.directivity, diffracted=row == 1
        )
        gain = jnp.exp(params.log_gain) * _corrections(params, paths, row)
        found.append(one._replace(amplitude=one.amplitude * gain))
    return Arrivals(*(jnp.concatenate(leaves) for leaves in zip(*found, strict=True)))


def _corrections(params: WaveParams, paths: Paths, row: int) -> Complex[Array, "k"]:
    """What the path loses or turns beyond its slabs."""
    counts = jnp.stack([jnp.sum(paths.kind == kind, -1) for kind in (TRANSMITTED, REFLECTED, DIFFRACTED)], -1)
    reflects = paths.kind == REFLECTED
    residual = jnp.where(reflects[..., None], params.residual[jnp.where(reflects, paths.met, 0)], 0).sum(-2)
    return jnp.exp(counts @ params.log_survival[row] + residual[:, 0] + 1j * residual[:, 1])
