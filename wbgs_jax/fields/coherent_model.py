"""What the coherent field's parameters make of paths that are known: what arrives over each, snapshots, and spectra.

Waves are coherent as far as the places of surfaces are known:

    R = sum over pairs of paths  coherence(i, j) y_i y_j^H        PAS = sqrt(a^H R a) / max

with y_i the snapshot of path i alone. Where all places are known the coherence is 1 and the PAS that of the snapshot itself;
where nobody knows them within a wavelength, powers add.

The paths of many links, found on the host before a training: whoever trains materials asks for them again and again.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from wbgs_jax._util.blocks import map_blocks
from wbgs_jax._util.complex_math import phasor
from wbgs_jax._util.pytree import pytree, same, static
from wbgs_jax.fields.base import Observation
from wbgs_jax.fields.coherent_settings import WaveConfig
from wbgs_jax.propagation.absorption import Grid, attenuation, smoothed
from wbgs_jax.propagation.displacement import Motion, length_changes, path_coherence
from wbgs_jax.propagation.image_method import Search, Surfaces
from wbgs_jax.propagation.materials import Slabs, complex_permittivity
from wbgs_jax.propagation.paths import DIFFRACTED, REFLECTED, TRANSMITTED, Paths, TracedPaths, trace_paths
from wbgs_jax.propagation.transport import arrivals, covariance_from_paths, snapshots_from_paths
from wbgs_jax.radio.antenna import Antenna, upright
from wbgs_jax.radio.array import (
    EXACT,
    SPEED_OF_LIGHT,
    Beams,
    covariance_to_pas,
    wide_covariance_to_pas,
)
from wbgs_jax.radio.channel import FAINTEST, Arrivals, added_powers, decibels
from wbgs_jax.types import Links, Query, Receiver, check_query

FAINTEST_SUM = 1e-12
"""Of the power of several paths, relative to the strongest: what cancels further, or is nothing, has no spectrum."""
CLUTTER_HZ = 1e9, 1e11
"""Frequencies at which clutter has a density of its own; in between it follows the logarithm of the frequency."""
THIN = 1e-3
"""Density of clutter before training, nepers per metre: a tenth of a decibel in a room."""
LARGEST_LOG_CONDUCTIVITY = float(np.log(1e6))
"""Beyond it (S/m) every material is a mirror, and single precision ends."""


@pytree
class Materials:
    """Stored (unconstrained) properties of M materials, those of ITU-R P.2040: eps_r, and sigma = c f^d with f in GHz."""

    log_susceptibility: Float[Array, " m"]
    """log(eps_r - 1)."""
    log_conductivity: Float[Array, " m"]
    """log c, c in S/m."""
    slope: Float[Array, " m"]
    """d."""
    log_thickness: Float[Array, " m"]
    """log of metres, where the scene does not say."""


@pytree
class WaveParams:
    """What is trained."""

    materials: Materials
    facet_correction: Float[Array, "f 2"]
    """Logarithm of amplitude and phase (radians) by which a facet's reflection differs from its material's."""
    excess_loss: Float[Array, "2 3"]
    """Loss per interaction beyond its slab or wedge (nepers), of (specular, diffracted) paths at (transmission, reflection,
    diffraction)."""
    log_gain: Float[Array, ""]
    """Logarithm of the gain of the transmitter and whatever else scales all snapshots."""
    transmitter: Antenna
    """Of all transmitters, in the world frame."""
    element: Antenna
    """What every element of the array is besides its known pattern, in the receiver's frame."""
    placement: Float[Array, " places"]
    """Logarithm of how far (metres, standard deviation along each axis) the movers of the facets and, last, the transmitters
    stand from where they are said to be."""
    thick: Float[Array, ""]
    """1 where waves behind slabs lack the phase of the air that stood there, as in nature, 0 where not, as in ray tracers
    (`materials.slab_coefficients`)."""
    curved: Float[Array, ""]
    """1 where waves reach the array as spheres, as in nature, 0 where they are plane (`transport.element_voltages`)."""
    clutter: Float[Array, "x y z 2"] | None
    """Stored (unconstrained) density of what stands in the way and is not in the mesh, at both of `CLUTTER_HZ`; `densities`
    gives nepers per metre. None: nothing does."""


@pytree
class PreparedPaths:
    """The paths of some pairs of a receiver and a transmitter."""

    surfaces: Surfaces
    """That they meet, of all receivers alike."""
    beams: Beams | None
    """Of the receivers' array; None where they differ from frequency to frequency or from receiver to receiver."""
    paths: TracedPaths
    """Leading axis: pairs, ascending by receiver, then by transmitter."""
    receiver_index: Int[Array, " pairs"]
    tx_index: Int[Array, " pairs"]

    def place(self, links: Links) -> Int[Array, "*b"]:
        """Returns which of the pairs links belong to."""
        numbers = jnp.max(self.tx_index) + 1
        pairs, asked = (one.receiver_index * numbers + one.tx_index for one in (self, links))
        return jnp.searchsorted(pairs, asked)

    def subset(self, links: Links) -> "PreparedPaths":
        """Returns the pairs of links, one for each, so that what is done with them does not depend on how many others there
        are."""
        place = jnp.sort(self.place(links))
        paths, receiver_index, tx_index = jax.tree.map(
            lambda leaf: leaf[place], (self.paths, self.receiver_index, self.tx_index)
        )
        return dataclasses.replace(self, paths=paths, receiver_index=receiver_index, tx_index=tx_index)

    def of(self, links: Links) -> TracedPaths:
        """Returns the paths of links, with their axes."""
        place = self.place(links)
        paths: TracedPaths = jax.tree.map(lambda leaf: leaf[place], self.paths)
        return paths


@pytree
class WavePlan:
    """What is independent of the query: geometry alone. No parameter is frozen in it."""

    surfaces: Surfaces
    """A `Search` of the receiver where paths have still to be found."""
    receiver: Receiver
    tuning: Float[Array, "elements 2"] | None
    """Logarithm of amplitude, and phase (radians), of its elements; None: they are in tune."""
    known_thickness: Float[Array, " m"]
    motion: Motion | None
    """How far things, and this receiver, stand from where paths were found, while that is being learned."""
    beams: Beams | None
    """Of the array; None where they differ from frequency to frequency, or are traced."""
    grid: Grid | None
    """Of clutter, if there is any."""
    prepared: PreparedPaths | None
    """Paths of the links that it will be asked about; None: they are traced."""
    config: WaveConfig = static()

    def paths_of(self, links: Query | Links) -> TracedPaths:
        """Returns the paths of B links: those that are prepared, or traced anew."""
        if self.prepared is None:
            check_query(links.query)
            return trace(self, links.tx_position)
        if isinstance(links, Query):
            raise TypeError("a plan that was made with prepared paths traces no others; plan without, or ask about `Links`")
        return self.prepared.of(links)


def first_params(config: WaveConfig, facets: int, materials: int, placement: Any, clutter: Any) -> WaveParams:
    """Returns parameters before training, in which all materials are alike; nothing is random."""
    m = Materials(
        log_susceptibility=jnp.full(materials, np.log(config.permittivity - 1), jnp.float32),
        log_conductivity=jnp.full(materials, np.log(config.conductivity), jnp.float32),
        slope=jnp.full(materials, config.slope, jnp.float32),
        log_thickness=jnp.full(materials, np.log(config.thickness), jnp.float32),
    )
    amplitude = jnp.array([[1.0, 1.0, 1.0], [config.excess_amplitude, config.excess_amplitude, 1.0]], jnp.float32)
    nothing = jnp.zeros((), jnp.float32)
    corrections = jnp.zeros((facets, 2), jnp.float32), -jnp.log(amplitude), jnp.zeros_like(nothing)
    # Training gives every array away once.
    transmitter, element = (upright(jnp.zeros(2, jnp.float32)) for _ in range(2))
    placement, clutter = jax.tree.map(jnp.array, (placement, clutter))
    return WaveParams(m, *corrections, transmitter, element, placement, nothing, jnp.zeros_like(nothing), clutter)


@jax.jit
def path_snapshots(
    params: WaveParams, plan: WavePlan, paths: TracedPaths, frequency_hz: Float[Array, " b"]
) -> Complex[Array, "b elements"]:
    """Returns the snapshots of B transmitters whose paths are known."""
    return _snapshots(params, plan, path_arrivals(params, plan, paths, frequency_hz), frequency_hz)


@jax.jit
def path_arrivals(params: WaveParams, plan: WavePlan, paths: TracedPaths, frequency_hz: Float[Array, " b"]) -> Arrivals:
    """Returns every path of B transmitters whose paths are known, leading axis B."""
    found: Any = jax.vmap(lambda paths, f: arrivals_at(params, plan, paths, f))(paths, frequency_hz)
    return found


def _snapshots(
    params: WaveParams, plan: WavePlan, arrived: Arrivals, frequency_hz: Float[Array, " b"]
) -> Complex[Array, "b elements"]:
    y = jax.vmap(lambda arrived, f: snapshots_from_paths(arrived, plan.receiver, f))(arrived, frequency_hz)
    return y if plan.tuning is None else y * element_gains(plan.tuning)


def element_gains(tuning: Float[Array, "elements 2"]) -> Complex[Array, " elements"]:
    """Returns the complex gains of elements that are out of tune."""
    return jnp.exp(tuning[:, 0] + 1j * tuning[:, 1])


@jax.jit
def observe(params: WaveParams, plan: WavePlan, paths: TracedPaths, frequency_hz: Float[Array, " b"]) -> Observation:
    """Returns spectra, snapshots, received power and all that arrives of B transmitters whose paths are known."""
    if not plan.config.coherent:
        blind = phase_blind_pas(params, plan, paths, frequency_hz)
        return Observation(blind, paths=path_arrivals(params, plan, paths, frequency_hz))
    arrived = path_arrivals(params, plan, paths, frequency_hz)
    y, elements = _snapshots(params, plan, arrived, frequency_hz), plan.receiver.element_wavelengths(frequency_hz)
    covariance, power = path_covariances(params, plan, paths, arrived, frequency_hz)
    if plan.beams is not None:
        pas = covariance_to_pas(covariance, plan.beams)
    else:
        pas = wide_covariance_to_pas(covariance, jnp.broadcast_to(elements, (y.shape[0], *elements.shape[-2:])))
    return Observation(pas, y, decibels(power), covariance, arrived)


@jax.jit
def path_covariances(
    params: WaveParams, plan: WavePlan, paths: TracedPaths, arrived: Arrivals, frequency_hz: Float[Array, " b"]
) -> tuple[Complex[Array, "b elements elements"], Float[Array, " b"]]:
    """Returns the mean products y y^H of the snapshots of B transmitters over the places where surfaces may stand
    (`WaveParams.placement`), scaled to a trace of 1; and the mean power that an element receives."""
    spread = jnp.exp(params.placement)

    def one(paths: TracedPaths, arrived: Arrivals, f: Float[Array, ""]) -> Any:
        strongest = jax.lax.stop_gradient(jnp.max(jnp.abs(arrived.amplitude)))
        strongest = jnp.where(strongest > FAINTEST, strongest, 1)  # without any path: 1 / FAINTEST^2 is no float
        arrived = arrived._replace(amplitude=arrived.amplitude / strongest)
        left = path_coherence(paths, plan.surfaces, spread, 2 * jnp.pi * f / SPEED_OF_LIGHT)
        covariance = covariance_from_paths(arrived, plan.receiver, f, left)
        if plan.tuning is not None:
            gains = element_gains(plan.tuning)
            covariance = covariance * gains[:, None] * gains.conj()
        trace = jnp.trace(covariance).real
        return covariance / jnp.maximum(trace, FAINTEST_SUM), trace / len(covariance) * strongest**2

    found: Any = jax.vmap(one)(paths, arrived, frequency_hz)
    return found


@jax.jit
def phase_blind_pas(
    params: WaveParams, plan: WavePlan, paths: TracedPaths, frequency_hz: Float[Array, " b"]
) -> Float[Array, "b 90 360"]:
    """Returns spectra with the powers of all paths added: what is left of this model without its phases."""
    return jax.vmap(lambda paths, f: added_powers(arrivals_at(params, plan, paths, f), plan.receiver.element_wavelengths(f)))(
        paths, frequency_hz
    )


def slabs_at(params: WaveParams, plan: WavePlan, frequency_hz: Float[Array, ""]) -> Slabs:
    """Returns what every facet is made of at one frequency."""
    m, material = params.materials, plan.surfaces.facets.material
    sigma = jnp.exp(jnp.minimum(m.log_conductivity + m.slope * jnp.log(frequency_hz / 1e9), LARGEST_LOG_CONDUCTIVITY))
    permittivity = complex_permittivity(1 + jnp.exp(m.log_susceptibility), sigma, frequency_hz)
    thickness = jnp.where(plan.known_thickness > 0, plan.known_thickness, jnp.exp(m.log_thickness))
    return Slabs(permittivity[material], thickness[material], params.thick)


def arrivals_at(params: WaveParams, plan: WavePlan, paths: TracedPaths, frequency_hz: Float[Array, ""]) -> Arrivals:
    """Returns what one transmitter sends over all of its paths."""
    slabs, found = slabs_at(params, plan, frequency_hz), []
    clutter = None if params.clutter is None else _clutter_at(params.clutter, frequency_hz)
    for row, some in enumerate((paths.specular, paths.diffracted)):
        antennas = params.transmitter, params.element
        one = arrivals(some, plan.surfaces, slabs, frequency_hz, plan.receiver, row == 1, *antennas)
        gain = jnp.exp(params.log_gain) * _corrections(params, some, row)
        if clutter is not None:
            assert plan.grid is not None, "the field has both"
            gain = gain * jnp.exp(-attenuation(one.points, clutter, plan.grid))
        if plan.motion is not None:
            turns = frequency_hz / SPEED_OF_LIGHT * length_changes(some, plan.surfaces, plan.motion)
            gain = gain * phasor(-turns)
        assert one.polarised is not None, "paths that were traced have it"
        found.append(one._replace(amplitude=one.amplitude * gain, polarised=one.polarised * gain[:, None]))
    joined: Any = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
    return joined._replace(curved=params.curved)


def no_clutter(shape: tuple[int, int, int]) -> Float[Array, "x y z 2"]:
    """Returns `WaveParams.clutter` of an empty room."""
    return stored(jnp.full((*shape, len(CLUTTER_HZ)), THIN, jnp.float32))


def densities(clutter: Float[Array, "x y z 2"]) -> Float[Array, "x y z 2"]:
    """Returns nepers per metre."""
    return jax.nn.softplus(clutter)


def stored(density: Float[Array, "x y z 2"]) -> Float[Array, "x y z 2"]:
    """Returns the clutter that has these `densities`, all of them positive."""
    return jnp.log(jnp.expm1(density))


def _clutter_at(clutter: Float[Array, "x y z 2"], frequency_hz: Float[Array, ""]) -> Float[Array, "x y z"]:
    """Returns the density at one frequency."""
    low, high = CLUTTER_HZ
    share = jnp.clip(jnp.log(frequency_hz / low) / np.log(high / low), 0, 1)
    at_low, at_high = jnp.moveaxis(smoothed(densities(clutter)), -1, 0)  # once for all links of a batch
    return (1 - share) * at_low + share * at_high


def _corrections(params: WaveParams, paths: Paths, row: int) -> Complex[Array, " k"]:
    """Returns the factor by which paths differ from their slabs and wedges."""
    kind = paths.interaction_type
    counts = jnp.stack([jnp.sum(kind == one, -1) for one in (TRANSMITTED, REFLECTED, DIFFRACTED)], -1)
    reflects = kind == REFLECTED
    correction = params.facet_correction[jnp.where(reflects, paths.interaction_facet, 0)]
    total = jnp.where(reflects[..., None], correction, 0).sum(-2)
    losses = jnp.matmul(counts.astype(total.dtype), params.excess_loss[row], precision=EXACT)
    return jnp.exp(total[:, 0] - losses + 1j * total[:, 1])


TRACED_AT_ONCE = 16
"""Transmitters."""


def prepare_paths(links: Links, plan_of: Callable[[int], WavePlan]) -> PreparedPaths:
    """Returns the paths of all receivers and transmitters of some links (host).

    Args:
        links: any number of them, of any receivers.
        plan_of: plans a receiver by its number.
    """
    numbers = np.stack([np.asarray(links.receiver_index), np.asarray(links.tx_index)], -1)
    pairs, first = np.unique(numbers, axis=0, return_index=True)
    positions, found, beams = np.asarray(links.query.tx_position)[first], [], []
    for receiver in np.unique(pairs[:, 0]):
        plan = plan_of(int(receiver))  # one at a time: mirror images of many receivers are many
        found.append(_traced_in_blocks(plan, positions[pairs[:, 0] == receiver]))
        beams.append(plan.beams)
    paths = TracedPaths(_stacked([one.specular for one in found]), _stacked([one.diffracted for one in found]))
    surfaces = Surfaces(plan.surfaces.facets, plan.surfaces.edges)
    return PreparedPaths(surfaces, _shared(beams), paths, *jnp.asarray(pairs.T, jnp.int32))


@jax.jit
def trace(plan: WavePlan, tx_position: Float[Array, "b 3"]) -> TracedPaths:
    """Returns the paths of B transmitters; independent of frequency and materials."""
    config, search = plan.config, plan.surfaces
    if not isinstance(search, Search):
        raise TypeError("a plan that was made with prepared paths traces no others; plan without them")
    sizes = config.specular_tried, config.specular_kept, config.diffracted_tried, config.diffracted_kept
    return jax.lax.map(lambda tx: trace_paths(search, tx, *sizes), tx_position)


def _traced_in_blocks(plan: WavePlan, positions: Float[np.ndarray, "n 3"]) -> Any:
    return map_blocks(lambda block: trace(plan, jnp.asarray(block)), positions, TRACED_AT_ONCE)


def _stacked(some: list[Paths]) -> Paths:
    """Returns paths one after the other, all with as much room as those that have most: receivers have different numbers."""
    room = max(paths.alive.shape[1] for paths in some)

    def filled(leaf: np.ndarray, mode: Any) -> np.ndarray:
        return np.pad(leaf, [(0, 0), (0, room - leaf.shape[1])] + [(0, 0)] * (leaf.ndim - 2), mode)

    together: Paths = jax.tree.map(
        lambda *leaves: jnp.asarray(np.concatenate([filled(leaf, "edge") for leaf in leaves])), *some
    )
    alive = np.concatenate([filled(np.asarray(paths.alive), "constant") for paths in some])
    return dataclasses.replace(together, alive=jnp.asarray(alive))


def _shared(beams: list[Beams | None]) -> Beams | None:
    """Returns the beams of all receivers, if they are the same."""
    first, *others = beams
    return first if all(same(first, other) for other in others) else None
