"""What paths carry: the field vector through every reflection, transmission and diffraction, and the receiver's snapshot.

The electric field is a complex vector across the ray, split at every slab into its components across (TE) and in (TM) the
plane of incidence. Antennas are vertically polarised: along theta-hat of their own frame.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from wbgs_jax.array import SPEED_OF_LIGHT, steering_vector
from wbgs_jax.geometry import to_local
from wbgs_jax.pytree import pytree
from wbgs_jax.types import Receiver
from wbgs_jax.wave.edges import Edges
from wbgs_jax.wave.facets import Facets
from wbgs_jax.wave.paths import DIFFRACTED, INTERACTIONS, NONE, REFLECTED, Paths
from wbgs_jax.wave.slab import slab_coefficients
from wbgs_jax.wave.wedge import wedge_coefficients

SHORTEST = 1e-9
"""Metres: legs that are shorter fill the places of reflections that a path does not have."""


@pytree
class Slabs:
    """What every facet is made of at one frequency."""

    permittivity: Complex[Array, "f"]
    thickness: Float[Array, "f"]
    """Metres."""


class Arrivals(NamedTuple):
    """What reaches the receiver over K paths."""

    amplitude: Complex[Array, "k"]
    """At the array's centre, carrier phase included; 0 for paths that are none."""
    direction: Float[Array, "k 3"]
    """Unit vectors in the receiver's frame, towards where the wave comes from."""
    length: Float[Array, "k"]
    """Of the whole path, metres."""


class _Meetings(NamedTuple):
    """Every slab on every path: how it splits the field and what it does to the parts."""

    across: Float[Array, "k 5 3"]
    within_in: Float[Array, "k 5 3"]
    within_out: Float[Array, "k 5 3"]
    te: Complex[Array, "k 5"]
    tm: Complex[Array, "k 5"]


def unit(v: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Unit vectors; a zero vector stays finite."""
    return v / jnp.sqrt(jnp.maximum(dot(v, v), 1e-12))[..., None]


def dot(a: Array, b: Array) -> Array:
    """Scalar product over the last axis."""
    return jnp.sum(a * b, -1)


def zenith_vector(direction: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """The unit vector theta-hat of a direction: vertical polarisation."""
    x, y, z = jnp.moveaxis(direction, -1, 0)
    horizontal = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-12))
    return jnp.stack([z * x / horizontal, z * y / horizontal, -horizontal], -1)


def element_gain(direction: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """Amplitude of the element of 3GPP TR 38.901 (table 7.3-1), boresight +x, 8 dBi."""
    x, y, z = jnp.moveaxis(direction, -1, 0)
    zenith = jnp.degrees(jnp.arccos(jnp.clip(z, -1, 1)))
    azimuth = jnp.degrees(jnp.arctan2(y, x))
    vertical = jnp.minimum(12 * ((zenith - 90) / 65) ** 2, 30.0)
    horizontal = jnp.minimum(12 * (azimuth / 65) ** 2, 30.0)
    return 10 ** ((8 - jnp.minimum(vertical + horizontal, 30.0)) / 20)


def arrivals(
    paths: Paths,
    facets: Facets,
    edges: Edges,
    slabs: Slabs,
    frequency_hz: Float[Array, ""],
    receiver: Receiver,
    directivity: Float[Array, ""],
    diffracted: bool,
) -> Arrivals:
    """What isotropic vertical transmitters of unit power send over K paths.

    `directivity` is the exponent of the receiver elements' gain; `diffracted` says whether every path has one diffraction, or
    none.
    """
    k = jnp.arange(paths.leg.shape[0])
    legs = paths.points[:, 1:] - paths.points[:, :-1]
    lengths = jnp.sqrt(jnp.maximum(dot(legs, legs), SHORTEST**2))
    directions = legs / lengths[..., None]
    length = jnp.sum(jnp.where(lengths > SHORTEST, lengths, 0), -1)
    meetings = _meetings(paths, directions, facets, slabs, frequency_hz)
    slab = (paths.kind != NONE) & (paths.kind != DIFFRACTED)
    field = zenith_vector(directions[:, 0]).astype(slabs.permittivity.dtype)
    if diffracted:
        slot = jnp.argmax(paths.kind == DIFFRACTED, -1)
        leg, edge, place = paths.leg[k, slot], paths.met[k, slot], jnp.arange(INTERACTIONS)
        before = jnp.sum(jnp.where(jnp.arange(lengths.shape[1]) <= leg[:, None], lengths, 0), -1)
        after = jnp.maximum(length - before, SHORTEST)
        field = _pass(field, meetings, slab & (place < slot[:, None]))
        field = _diffract(field, directions[k, leg], directions[k, leg + 1], before, after, edge, edges, slabs, frequency_hz)
        field = _pass(field, meetings, slab & (place > slot[:, None]))
        spreading = 1 / jnp.sqrt(before * after * length)
    else:
        field = _pass(field, meetings, slab)
        spreading = 1 / length
    last = jnp.sum((paths.kind == REFLECTED) | (paths.kind == DIFFRACTED), -1)
    local = to_local(-directions[k, last], receiver.orientation)
    seen = dot(to_local(field, receiver.orientation), zenith_vector(local))
    wavelength = SPEED_OF_LIGHT / frequency_hz
    carrier = jnp.exp(-2j * jnp.pi * jnp.mod(length / wavelength, 1.0))
    amplitude = wavelength / (4 * jnp.pi) * spreading * element_gain(local) ** directivity * seen * carrier
    return Arrivals(jnp.where(paths.alive, amplitude, 0), local, length)


def _meetings(paths: Paths, directions: Float[Array, "k 4 3"], facets: Facets, slabs: Slabs, frequency_hz) -> _Meetings:
    facet = jnp.where(paths.kind == DIFFRACTED, 0, paths.met)
    along = jnp.take_along_axis(directions, paths.leg[..., None], 1)
    normal, reflects = facets.normal[facet], paths.kind == REFLECTED
    cosine = dot(along, normal)
    c = slab_coefficients(jnp.abs(cosine), slabs.permittivity[facet], slabs.thickness[facet], frequency_hz)
    across = _across(along, normal)
    within = jnp.cross(across, along)
    mirrored = along - 2 * cosine[..., None] * normal
    return _Meetings(
        across,
        within,
        jnp.where(reflects[..., None], jnp.cross(across, mirrored), within),
        jnp.where(reflects, c.reflect_te, c.transmit_te),
        jnp.where(reflects, c.reflect_tm, c.transmit_tm),
    )


def _pass(field: Complex[Array, "k 3"], meetings: _Meetings, active: Bool[Array, "k 5"]) -> Complex[Array, "k 3"]:
    """The field behind the slabs that are active, in their order."""
    for i in range(INTERACTIONS):
        across, into, out, te, tm = (leaf[:, i] for leaf in meetings)
        changed = (te * dot(field, across))[:, None] * across + (tm * dot(field, into))[:, None] * out
        field = jnp.where(active[:, i, None], changed, field)
    return field


def _across(along: Float[Array, "*n 3"], normal: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Unit vector across the plane of incidence; any one at normal incidence."""
    s = jnp.cross(along, normal)
    return unit(jnp.where(dot(s, s)[..., None] < 1e-8, jnp.cross(along, normal[..., jnp.array([1, 2, 0])]), s))


def _diffract(
    field: Complex[Array, "k 3"],
    ki: Float[Array, "k 3"],
    ko: Float[Array, "k 3"],
    before: Float[Array, "k"],
    after: Float[Array, "k"],
    edge: Int[Array, "k"],
    edges: Edges,
    slabs: Slabs,
    frequency_hz: Float[Array, ""],
) -> Complex[Array, "k 3"]:
    """The field vector behind the edge, without spreading: the dyadic of wedge.py in vectors."""
    normal_0, normal_n, direction = edges.normal_0[edge], edges.normal_n[edge], edges.direction[edge]
    n = 1 + jnp.arccos(jnp.clip(dot(normal_0, normal_n), -1, 1)) / jnp.pi
    tangent = jnp.cross(normal_0, direction)

    def angle(v):
        phi = jnp.arctan2(dot(v, normal_0), dot(v, tangent))
        return jnp.where(phi < 0, phi + 2 * jnp.pi, phi)

    def components(vector, along, basis):
        return dot(vector, basis), dot(vector, jnp.cross(along, basis))

    sin_beta = jnp.sqrt(jnp.maximum(1 - dot(ki, direction) ** 2, 1e-6))
    wavenumber = 2 * jnp.pi * frequency_hz / SPEED_OF_LIGHT
    kl = wavenumber * before * after / (before + after) * sin_beta**2
    incident, d_n, d_0 = wedge_coefficients(angle(-ki), angle(ko), n, sin_beta, kl, wavenumber)
    first, second = (-incident * part for part in components(field, ki, unit(jnp.cross(ki, direction))))
    facet = edges.facet[edge]
    for normal, cosine, weight in ((normal_0, dot(ki, normal_0), d_0), (normal_n, dot(ko, normal_n), d_n)):
        c = slab_coefficients(jnp.abs(cosine), slabs.permittivity[facet], slabs.thickness[facet], frequency_hz)
        mirrored = ki - 2 * dot(ki, normal)[:, None] * normal
        across = _across(ki, normal)
        s, p = components(field, ki, across)
        reflected = (weight * c.reflect_te * s)[:, None] * across
        reflected += (weight * c.reflect_tm * p)[:, None] * jnp.cross(mirrored, across)
        # Its components in the basis of the reflection boundary are those in the basis of the diffracted ray.
        s, p = components(reflected, mirrored, -unit(jnp.cross(mirrored, direction)))
        first, second = first + s, second + p
    basis = -unit(jnp.cross(ko, direction))
    return first[:, None] * basis + second[:, None] * jnp.cross(ko, basis)


def snapshot(arrived: Arrivals, receiver: Receiver) -> Complex[Array, "elements"]:
    """The array's complex voltages: every path a plane wave."""
    return arrived.amplitude @ steering_vector(receiver.element_positions, arrived.direction)
