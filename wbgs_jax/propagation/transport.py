"""Field transport along paths: the field vector through reflections, transmissions and a diffraction, and the array's snapshot.

The electric field is a complex vector perpendicular to the ray. At every slab it is split into its components perpendicular
(TE) and parallel (TM) to the plane of incidence. Antennas are those of radio/antenna.py. The time factor is exp(+j omega t).

Objects that are not in the mesh, such as furniture, plants and people, attenuate waves by an absorption grid, as in tomography:

    amplitude *= exp(-A),    A = integral of the density (nepers per metre) along the path

The grid models shadowing only: neither reflections by these objects nor phase changes.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Inexact, Int

from wbgs_jax._util.complex_math import phasor
from wbgs_jax._util.pytree import AnyArray, pytree
from wbgs_jax.mesh.edges import Edges
from wbgs_jax.propagation.image_method import Surfaces
from wbgs_jax.propagation.materials import Slabs, slab_coefficients
from wbgs_jax.propagation.paths import MAX_INTERACTIONS, NONE, REFLECTED, PathGeometry, TracedPaths, is_vertex, on_edge
from wbgs_jax.propagation.utd import wedge_coefficients
from wbgs_jax.radio.antenna import Antenna, upright, zenith_vector
from wbgs_jax.radio.array import EXACT, SPEED_OF_LIGHT, steering_vector
from wbgs_jax.radio.channel import Paths
from wbgs_jax.radio.geometry import to_local
from wbgs_jax.types import Receiver

SHORTEST = 1e-9
"""Metres: shorter segments are padding for reflections that a path does not have."""
SOMEWHERE = np.arange(5)[:, None] * np.array([0.3, 0.5, 0.7])
"""Vertices (metres) of padded paths, on a line that is not parallel to any edge or normal."""


class Segments(NamedTuple):
    """Straight segments of K paths."""

    length: Float[Array, "k 4"]
    """Metres."""
    direction: Float[Array, "k 4 3"]
    """Unit vectors in the direction of propagation, world frame."""
    total: Float[Array, " k"]
    """Length of the whole path, metres."""


class SlabInteractions(NamedTuple):
    """Slabs along K paths: the basis in which they split the field, and their coefficients."""

    active: Bool[Array, "k 5"]
    """Which interactions are with a slab; everything else is meaningless for the others."""

    across: Float[Array, "k 5 3"]
    """Unit vectors perpendicular to the plane of incidence (TE)."""
    within_in: Float[Array, "k 5 3"]
    """Unit vectors in that plane, perpendicular to the incident ray (TM)."""
    within_out: Float[Array, "k 5 3"]
    """Unit vectors in that plane, perpendicular to the outgoing ray (TM)."""
    te: Complex[Array, "k 5"]
    tm: Complex[Array, "k 5"]


class Passage(NamedTuple):
    """K paths of one mechanism, and all that the field along them depends on."""

    paths: PathGeometry
    segments: Segments
    interactions: SlabInteractions
    surfaces: Surfaces
    slabs: Slabs
    """Materials of the facets at the frequency."""
    frequency_hz: Float[Array, ""]


Transport = Callable[[Complex[Array, "k 3"], Passage], tuple[Complex[Array, "k 3"], Float[Array, " k"]]]
"""(field at the transmitter (k, 3), passage) -> the field at the receiver without spreading (k, 3), and the spreading factors
(k,), per metre."""


@partial(jax.jit, static_argnames="transports")
def arrivals(
    paths: TracedPaths,
    surfaces: Surfaces,
    slabs: Slabs,
    frequency_hz: Float[Array, ""],
    receiver: Receiver,
    transports: tuple[Transport, ...],
    transmitter: Antenna | None = None,
    element: Antenna | None = None,
) -> Paths:
    """Returns the amplitudes that a transmitter of unit power produces over K paths, in the order of their mechanisms.

    Args:
        paths: of one transmitter (`mechanisms.trace_paths`).
        surfaces: surfaces in which the paths were found; paths refer to their facets and edges by index.
        slabs: materials of the facets at this frequency.
        frequency_hz: of the carrier.
        receiver: the receiver at the end of the paths.
        transports: those of the sets of paths (`mechanisms.transports_of`); static under `jax.jit`.
        transmitter: its antenna in the world frame; by default vertically polarised and isotropic.
        element: an antenna factor of every array element in addition to its given pattern, in the receiver's frame; by default
            vertically polarised and isotropic, which changes nothing.
    """
    isotropic = upright(jnp.zeros_like(receiver.pattern_exponents))
    transmitter, element = transmitter or isotropic, element or isotropic
    # Everything but the transport is computed for all mechanisms together: a program smaller by a quarter.
    whole = paths.together
    # Padded paths may have segments of zero length, whose directions have no derivative.
    somewhere = jnp.asarray(SOMEWHERE, whole.points.dtype)
    whole = dataclasses.replace(whole, points=jnp.where(whole.alive[:, None, None], whole.points, somewhere))
    segments = segments_of(whole)
    sent = transmitter.field(segments.direction[:, 0]).astype(slabs.permittivity.dtype)
    known = sent, whole.points, segments, _slab_interactions(whole, segments, surfaces, slabs, frequency_hz)
    arrived, first = [], 0
    for some, transport in zip(paths.sets, transports, strict=True):
        rows = slice(first, first := first + len(some.alive))
        own, points, legs, met = jax.tree.map(lambda leaf, rows=rows: leaf[rows], known)
        passage = Passage(dataclasses.replace(some, points=points), legs, met, surfaces, slabs, frequency_hz)
        arrived.append(transport(own, passage))
    field, spreading = map(jnp.concatenate, zip(*arrived, strict=True))
    last = last_segment(whole)
    arrival = segments.direction[jnp.arange(len(last)), last]
    local, here = to_local(-arrival, receiver.orientation), to_local(field, receiver.orientation)
    theta, wavelength = zenith_vector(local), SPEED_OF_LIGHT / frequency_hz
    own = _element_field(receiver.antenna, element, local)
    parts = jnp.stack([_dot(here, basis) for basis in (own, theta, jnp.cross(local, theta))], -1)
    scale = wavelength / (4 * jnp.pi) * spreading * phasor(-segments.total / wavelength)
    amplitudes = jnp.where(whole.alive[:, None], scale[:, None] * parts, 0)
    numbers = whole.interaction_type, _materials(whole, surfaces)
    values = amplitudes[:, 0], local, segments.total, segments.direction[:, 0], arrival, amplitudes[:, 1:]
    return Paths(*values, *numbers, points=whole.points)


def _element_field(antenna: Antenna, further: Antenna, direction: Float[Array, "k 3"]) -> Inexact[Array, "k 3"]:
    """Returns the polarised amplitude gain of an element in its receiver's frame: that of its antenna times the gain of a
    further one, which also determines the polarisation if the antenna has neither an orientation nor a table nor a slant."""
    if antenna.orientation is None and antenna.pattern is None and antenna.slant is None:
        return dataclasses.replace(further, exponents=further.exponents + antenna.exponents).field(direction)
    return antenna.field(direction) * further.parametric_gain(direction)[..., None]


def _materials(paths: PathGeometry, surfaces: Surfaces) -> Int[Array, "k 5"]:
    """Returns the material index at every interaction; -1 where there is none."""
    kind, number = paths.interaction_type, paths.interaction_facet
    facet = jnp.where(on_edge(kind), 0, number)
    if surfaces.edges.facet.shape[0]:
        facet = jnp.where(on_edge(kind), surfaces.edges.facet[jnp.where(on_edge(kind), number, 0)], facet)
    return jnp.where(kind == NONE, -1, surfaces.facets.material[facet])


@jax.jit
def element_voltages(
    arrived: Paths,
    receiver: Receiver,
    frequency_hz: Float[Array, ""],
    spherical_wave: Float[Array, ""] | float | None = None,
) -> Complex[Array, "k elements"]:
    """Returns the complex voltage of every element for every single path.

    Args:
        arrived: amplitudes and geometry of K paths at the receiver.
        receiver: the array.
        frequency_hz: of the carrier; needed for element positions in metres.
        spherical_wave: 0 for plane waves; 1 for spherical waves around mirrored sources at a distance of the path's length. A
            wave diffracted by an edge is more strongly curved across the edge than this. By default `arrived.spherical_wave`,
            or else 0.
    """
    if spherical_wave is None:
        spherical_wave = 0.0 if arrived.spherical_wave is None else arrived.spherical_wave
    positions = receiver.element_wavelengths(frequency_hz)
    plane = arrived.amplitude[:, None] * steering_vector(positions, arrived.direction)
    metres, far = positions * (SPEED_OF_LIGHT / frequency_hz), jnp.maximum(arrived.length, SHORTEST)[:, None]
    along = jnp.matmul(arrived.direction, metres.T, precision=EXACT)
    across = jnp.maximum(jnp.sum(metres**2, -1) - along**2, 0)
    distance = jnp.sqrt((far - along) ** 2 + across + SHORTEST**2)
    longer = across / (distance + jnp.abs(far - along))  # than for a plane wave, without a difference of large numbers
    turns = -frequency_hz / SPEED_OF_LIGHT * spherical_wave * longer
    return plane * phasor(turns) * (1 + spherical_wave * (far / distance - 1))


def snapshots_from_paths(
    arrived: Paths,
    receiver: Receiver,
    frequency_hz: Float[Array, ""],
    spherical_wave: Float[Array, ""] | float | None = None,
) -> Complex[Array, " elements"]:
    """Returns the complex voltages of the receiver's elements, summed over paths; use `jax.vmap` for several transmitters.
    Arguments are those of `element_voltages`."""
    return jnp.sum(element_voltages(arrived, receiver, frequency_hz, spherical_wave), 0)


def mimo_matrix(
    arrived: Paths,
    receiver: Receiver,
    frequency_hz: Float[Array, ""],
    tx_elements: Float[Array, "m 3"],
    spherical_wave: Float[Array, ""] | float | None = None,
) -> Complex[Array, "elements m"]:
    """Returns the complex voltages of the receiver's elements for each of M transmit elements. These are identical, and plane
    waves leave them.

    Args:
        arrived, receiver, frequency_hz, spherical_wave: as in `element_voltages`.
        tx_elements: positions relative to the transmitter's, in wavelengths, world frame.
    """
    assert arrived.departure is not None, "arrivals of traced paths have a departure direction"
    voltages = element_voltages(arrived, receiver, frequency_hz, spherical_wave)
    return jnp.matmul(voltages.T, steering_vector(tx_elements, arrived.departure), precision=EXACT)


@jax.jit
def covariance_from_paths(
    arrived: Paths,
    receiver: Receiver,
    frequency_hz: Float[Array, ""],
    coherence: Float[Array, "k k"],
    spherical_wave: Float[Array, ""] | float | None = None,
) -> Complex[Array, "elements elements"]:
    """Returns the mean product y y^H of the snapshots of a transmitter whose K paths are partially coherent.

    Args:
        arrived, receiver, frequency_hz, spherical_wave: as in `element_voltages`.
        coherence: remaining mean product of two paths' amplitudes (`displacement.coherence`); where it is 1 everywhere, the
            result is the outer product of the snapshot.
    """
    voltages = element_voltages(arrived, receiver, frequency_hz, spherical_wave)
    parts = jnp.concatenate([voltages.real, voltages.imag], -1)  # real products: four times as fast on a CPU
    products = jnp.matmul(parts.T, jnp.matmul(coherence, parts, precision=EXACT), precision=EXACT)
    (real, cross), (turned, imaginary) = (jnp.split(half, 2, -1) for half in jnp.split(products, 2))
    return (real + imaginary) + 1j * (turned - cross)


def _dot(a: Array, b: Array) -> Array:
    """Returns the dot product over the last axis."""
    return jnp.sum(a * b, -1)


def _unit(v: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Returns unit vectors; a zero vector stays zero and finite."""
    return v / jnp.sqrt(jnp.maximum(_dot(v, v), 1e-12))[..., None]


def segments_of(paths: PathGeometry) -> Segments:
    """Returns the segments of paths."""
    segments = paths.points[:, 1:] - paths.points[:, :-1]
    lengths = jnp.sqrt(jnp.maximum(_dot(segments, segments), SHORTEST**2))
    return Segments(lengths, segments / lengths[..., None], jnp.sum(jnp.where(lengths > SHORTEST, lengths, 0), -1))


def last_segment(paths: PathGeometry) -> Int[Array, " k"]:
    """Returns the index of the segment that ends at the receiver."""
    return jnp.sum(is_vertex(paths.interaction_type), -1)


def _slab_interactions(
    paths: PathGeometry, segments: Segments, surfaces: Surfaces, slabs: Slabs, frequency_hz: Float[Array, ""]
) -> SlabInteractions:
    """Returns the slab basis and coefficients at every interaction; meaningless where an interaction is not with a slab."""
    facet = jnp.where(on_edge(paths.interaction_type), 0, paths.interaction_facet)
    along = jnp.take_along_axis(segments.direction, paths.interaction_segment[..., None], 1)
    normal, reflects = surfaces.facets.normal[facet], paths.interaction_type == REFLECTED
    cosine = _dot(along, normal)
    c = slab_coefficients(jnp.abs(cosine), slabs.permittivity[facet], slabs.thickness[facet], frequency_hz, slabs.air)
    across = _across(along, normal)
    within = jnp.cross(across, along)
    mirrored = along - 2 * cosine[..., None] * normal
    return SlabInteractions(
        (paths.interaction_type != NONE) & ~on_edge(paths.interaction_type),
        across,
        within,
        jnp.where(reflects[..., None], jnp.cross(across, mirrored), within),
        jnp.where(reflects, c.reflect_te, c.transmit_te),
        jnp.where(reflects, c.reflect_tm, c.transmit_tm),
    )


def through_slabs(
    field: Complex[Array, "k 3"], interactions: SlabInteractions, active: Bool[Array, "k 5"]
) -> Complex[Array, "k 3"]:
    """Returns the field behind the active ones of the slabs, applied in order."""

    def through(field, one):
        (_, across, into, out, te, tm), active = one
        changed = (te * _dot(field, across))[:, None] * across + (tm * _dot(field, into))[:, None] * out
        return jnp.where(active[:, None], changed, field).astype(field.dtype), None

    # A scan: unrolled, it takes XLA twice as long to compile, and the code for a CPU is slower.
    return jax.lax.scan(through, field, jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), (interactions, active)))[0]


def _across(along: Float[Array, "*n 3"], normal: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Returns the unit vector perpendicular to the plane of incidence; an arbitrary one at normal incidence."""
    s = jnp.cross(along, normal)
    other = jnp.eye(3, dtype=normal.dtype)[jnp.argmin(jnp.abs(normal), -1)]  # the axis least parallel to the normal
    return _unit(jnp.where(_dot(s, s)[..., None] < 1e-8, jnp.cross(along, other), s))


def specular_transport(field: Complex[Array, "k 3"], passage: Passage) -> tuple[Complex[Array, "k 3"], Float[Array, " k"]]:
    """Returns the field behind all slabs, and the spreading factor."""
    return through_slabs(field, passage.interactions, passage.interactions.active), 1 / passage.segments.total


def diffracted_transport(field: Complex[Array, "k 3"], passage: Passage) -> tuple[Complex[Array, "k 3"], Float[Array, " k"]]:
    """Returns the field after the slabs before an edge, the edge, and the slabs behind it; and the spreading factor."""
    paths, segments, interactions, surfaces, slabs, frequency_hz = passage
    k, place = jnp.arange(len(field)), jnp.arange(MAX_INTERACTIONS)
    slot, active = jnp.argmax(on_edge(paths.interaction_type), -1), interactions.active
    segment, edge = paths.interaction_segment[k, slot], paths.interaction_facet[k, slot]
    before = jnp.sum(jnp.where(jnp.arange(segments.length.shape[1]) <= segment[:, None], segments.length, 0), -1)
    after = jnp.maximum(segments.total - before, SHORTEST)
    field = through_slabs(field, interactions, active & (place < slot[:, None]))
    rays = segments.direction[k, segment], segments.direction[k, segment + 1]
    field = _diffract(field, *rays, before, after, edge, surfaces.edges, slabs, frequency_hz)
    field = through_slabs(field, interactions, active & (place > slot[:, None]))
    return field, 1 / jnp.sqrt(before * after * segments.total)


def _diffract(
    field: Complex[Array, "k 3"],
    ki: Float[Array, "k 3"],
    ko: Float[Array, "k 3"],
    before: Float[Array, " k"],
    after: Float[Array, " k"],
    edge: Int[Array, " k"],
    edges: Edges,
    slabs: Slabs,
    frequency_hz: Float[Array, ""],
) -> Complex[Array, "k 3"]:
    """Returns the field vector behind the edge, without spreading: the dyadic of `utd.py` in vector form.

    Args:
        field: at the edge.
        ki, ko: unit vectors along the incident and the diffracted ray.
        before, after: path length to the edge and from it, metres.
        edge: index of the edge.
        edges, slabs: of the scene.
        frequency_hz: of the carrier.
    """
    normal_0, normal_n, direction = edges.normal_0[edge], edges.normal_n[edge], edges.direction[edge]
    incident, d_n, d_0 = _edge_coefficients(ki, ko, before, after, normal_0, normal_n, direction, frequency_hz)
    first, second = (-incident * part for part in _components(field, ki, _unit(jnp.cross(ki, direction))))
    facet = edges.facet[edge]
    for normal, cosine, weight in ((normal_0, _dot(ki, normal_0), d_0), (normal_n, _dot(ko, normal_n), d_n)):
        c = slab_coefficients(jnp.abs(cosine), slabs.permittivity[facet], slabs.thickness[facet], frequency_hz)
        mirrored = ki - 2 * _dot(ki, normal)[:, None] * normal
        across = _across(ki, normal)
        s, p = _components(field, ki, across)
        reflected = (weight * c.reflect_te * s)[:, None] * across
        reflected += (weight * c.reflect_tm * p)[:, None] * jnp.cross(mirrored, across)
        # Its components in the basis of the reflection boundary are those in the basis of the diffracted ray.
        s, p = _components(reflected, mirrored, -_unit(jnp.cross(mirrored, direction)))
        first, second = first + s, second + p
    basis = -_unit(jnp.cross(ko, direction))
    return first[:, None] * basis + second[:, None] * jnp.cross(ko, basis)


def _edge_coefficients(ki, ko, before, after, normal_0, normal_n, direction, frequency_hz):
    """Returns the diffraction coefficients of edges for rays of given lengths (`utd.wedge_coefficients`)."""
    tangent = jnp.cross(normal_0, direction)

    def angle(v):
        phi = jnp.arctan2(_dot(v, normal_0), _dot(v, tangent))
        return jnp.where(phi < 0, phi + 2 * jnp.pi, phi)

    n = 1 + jnp.arccos(jnp.clip(_dot(normal_0, normal_n), -1, 1)) / jnp.pi
    sin_beta = jnp.sqrt(jnp.maximum(1 - _dot(ki, direction) ** 2, 1e-6))
    wavenumber = 2 * jnp.pi * frequency_hz / SPEED_OF_LIGHT
    kl = wavenumber * before * after / (before + after) * sin_beta**2
    return wedge_coefficients(angle(-ki), angle(ko), n, sin_beta, kl, wavenumber)


def _components(
    vector: Complex[Array, "k 3"], along: Float[Array, "k 3"], basis: Float[Array, "k 3"]
) -> tuple[Complex[Array, " k"], Complex[Array, " k"]]:
    """Returns the components of a field perpendicular to a ray: along `basis`, a unit vector perpendicular to the ray, and
    along the third direction."""
    return _dot(vector, basis), _dot(vector, jnp.cross(along, basis))


SAMPLES = 64
"""Sample points of the density along a path."""


@pytree
class Grid:
    """Position and size of the cells; their number along each axis is the shape of the density array."""

    low: Float[AnyArray, "3"]
    """Corner of the first cell, world frame, metres."""
    cell: Float[AnyArray, ""]
    """Edge length of a cell, metres."""


def grid_around(points: Float[np.ndarray, "n 3"], finest_m: float, most: int) -> tuple[Grid, tuple[int, int, int]]:
    """Returns a grid over the bounding box of points, and its shape (computed on the host).

    Args:
        points: world frame, metres.
        finest_m: smallest edge length of the cubic cells, metres; enlarged until there are at most `most` cells.
        most: largest number of cells.
    """
    low, extent = points.min(0), np.ptp(points, axis=0)
    cell = finest_m
    while np.prod(shape := np.maximum(np.ceil(extent / cell), 1).astype(int)) > most:
        cell *= 1.05
    x, y, z = shape.tolist()
    return Grid(np.asarray(low, np.float32), np.asarray(cell, np.float32)), (x, y, z)


def smoothed(density: Float[Array, "x y z *n"]) -> Float[Array, "x y z *n"]:
    """Returns the density with every cell replaced by a mean of itself (1/2) and its two neighbours (1/4 each), axis by axis,
    so that the attenuation of paths varies gradually from cell to cell. Beyond the grid the outermost cells are repeated."""
    for axis, count in enumerate(density.shape[:3]):
        padded = jnp.pad(density, [(int(axis == other),) * 2 for other in range(density.ndim)], mode="edge")
        before, own, after = (jax.lax.slice_in_dim(padded, start, start + count, axis=axis) for start in range(3))
        density = 0.25 * before + 0.5 * own + 0.25 * after
    return density


def attenuation(points: Float[Array, "k p 3"], density: Float[Array, "x y z"], grid: Grid) -> Float[Array, " k"]:
    """Returns the integral of the density (1/m) along K paths, by the midpoint rule with `SAMPLES` points.

    Args:
        points: vertices of the paths, joined by straight segments (the last ones may coincide), world frame, metres.
        density: nepers per metre of every cell; beyond the grid, that of the nearest cell.
        grid: position and size of the cells.
    """
    start, segment = points[:, :-1], jnp.diff(points, axis=1)
    length = jnp.sqrt(jnp.maximum(jnp.sum(segment**2, -1), SHORTEST**2))
    passed = jnp.cumsum(length, -1) - length
    total = jnp.sum(length, -1)
    at = (jnp.arange(SAMPLES) + 0.5) / SAMPLES * total[:, None]
    share = jnp.clip((at[..., None] - passed[:, None]) / length[:, None], 0, 1)  # of every segment: the fraction passed so far
    place = start[:, None, 0] + jnp.sum(share[..., None] * segment[:, None], -2)
    last = jnp.asarray(density.shape) - 1
    x, y, z = jnp.moveaxis(jnp.clip(jnp.floor((place - grid.low) / grid.cell).astype(jnp.int32), 0, last), -1, 0)
    return total * jnp.mean(density[x, y, z], -1)
