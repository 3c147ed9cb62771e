"""Outputs of the EM feature networks for every Gaussian and query (paper, sections 4.2 and 4.5), computed in two steps: the
part that depends on the Gaussian only, once for all queries, and the rest."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from wbgs_jax._util.pytree import pytree
from wbgs_jax.fields.networks import (
    AttenuationNetwork,
    GaussianSums,
    PowerNetwork,
    RadianceNetwork,
    attenuation_activation,
    frequency_encoding,
    legendre,
    positional_encoding,
    scale_frequency,
    signal_activation,
)
from wbgs_jax.fields.wideband_settings import WidebandConfig
from wbgs_jax.radio.array import EXACT, array_response, steering_vector
from wbgs_jax.radio.channel import free_space_db
from wbgs_jax.radio.geometry import smooth_length, to_local
from wbgs_jax.types import Gaussians, Query, Receiver

MAX_ATTENUATION = 0.99
"""Upper bound of the final attenuation delta."""
RELATIVE_FEATURES, GIVEN_FEATURES = 7, 3
"""Numbers of relative inputs (`WidebandConfig.relative`) and of inputs from a conditioning spectrum (`given_features`)."""
DARK = 0.02
"""Offset that keeps the logarithm of dark pixels finite."""
Weights = dict[str, Any]
"""Weights of all networks, by name."""


class QueryFeatures(NamedTuple):
    """Outputs of the networks for N Gaussians and B queries."""

    attenuation: Float[Array, "n b"]
    """The final attenuation delta."""
    signal: Float[Array, "n b"]
    """Sig."""
    summary: Float[Array, "b width"]
    """Mean of the hidden features h over the Gaussians."""


@pytree
class Frame:
    """Map from world positions to network inputs of about unit size, computed once from the surface and not trained."""

    centre: Float[Array, "3"]
    half_extent: Float[Array, ""]


@pytree
class GaussianFeatures:
    """Network inputs of every Gaussian that are independent of the query."""

    sums: GaussianSums
    """Sums of the attenuation network's layers over P(G)."""
    direction: Float[Array, "n 3"]
    """Unit vectors from the receiver to the Gaussians, receiver's frame."""
    back: Float[Array, "n 3"]
    """Unit vectors from the Gaussians to the receiver, world frame."""
    steering: Complex[Array, "n elements"] | None
    """Response of the array to waves from the Gaussians; None for an array with positions in metres, whose response depends on
    the frequency."""


def make_networks(config: WidebandConfig) -> tuple[AttenuationNetwork, RadianceNetwork, PowerNetwork]:
    """Returns the EM feature networks and the power network."""
    heads = 1 + config.frequency_heads
    attenuation = AttenuationNetwork(config.width, config.depth, config.skip, config.fusion, heads, config.precision)
    return attenuation, RadianceNetwork(config.radiance_widths, heads, config.precision), PowerNetwork(config.width)


@partial(jax.jit, static_argnames="config")
def gaussian_features(
    gaussians: Gaussians, weights: Weights, frame: Frame, receiver: Receiver, config: WidebandConfig
) -> GaussianFeatures:
    """Returns the network inputs of every Gaussian that are independent of the query."""
    means = gaussians.means
    encoded = positional_encoding((means - frame.centre) / frame.half_extent, config.gaussian_octaves)
    if gaussians.features is not None:
        encoded = jnp.concatenate([encoded, gaussians.features], -1)
    encoded = encoded[:, None, :]
    sums: Any = make_networks(config)[0].apply(weights["attenuation"], [encoded], method="gaussian_sums")
    direction = to_local(means - receiver.position, receiver.orientation)
    direction = direction / smooth_length(direction)
    back = receiver.position - means
    fixed = receiver.unit == "wavelengths"
    steering = steering_vector(receiver.element_positions, direction) if fixed else None
    return GaussianFeatures(sums, direction, back / smooth_length(back), steering)


@partial(jax.jit, static_argnames="config")
def query_features(
    gaussians: Gaussians,
    weights: Weights,
    features: GaussianFeatures,
    frame: Frame,
    receiver: Receiver,
    config: WidebandConfig,
    query: Query,
    given: Float[Array, "n b 3"] | None = None,
) -> QueryFeatures:
    """Returns the final attenuation delta and the signal Sig of every Gaussian and query (paper, equations 1-3 and section
    4.5), and a summary of every query.

    Args:
        gaussians: Gaussians.
        weights: weights of all networks.
        features: result of `gaussian_features`.
        frame: frame of the inputs.
        receiver: one receiver.
        config: settings.
        query: B queries.
        given: features of conditioning spectra (`given_features`), for networks that have inputs for them.
    """
    attenuation, radiance, _ = make_networks(config)
    both, frequency = _query_inputs(gaussians.means, features, frame, receiver, config, query)
    conditioning = [] if given is None else [given]
    outputs: Any = attenuation.apply(weights["attenuation"], features.sums, both + conditioning, method="of_queries")
    hidden, delta_f = outputs
    signal: Any = radiance.apply(weights["radiance"], [hidden, *frequency, *conditioning])
    if config.frequency_heads:
        u = scale_frequency(query.frequency_hz)
        powers = jnp.concatenate([jnp.ones_like(u)[:, None], legendre(u, config.frequency_heads)], -1)
        delta_f, signal = (jnp.sum(heads * powers, -1) for heads in (delta_f, signal))
    delta = attenuation_activation(gaussians.opacity_logits, delta_f, MAX_ATTENUATION)
    shares = gaussians.alive / jnp.sum(gaussians.alive)
    return QueryFeatures(delta, signal_activation(signal), jnp.einsum("n,nbw->bw", shares, hidden, precision=EXACT))


@partial(jax.jit, static_argnames="config")
def received_power_db(
    summary: Float[Array, "b width"], weights: Weights, frame: Frame, receiver: Receiver, config: WidebandConfig, query: Query
) -> Float[Array, " b"]:
    """Returns the power received by an element relative to the transmitted power (dB): that of free space plus the output of
    the power network."""
    distance = smooth_length(query.tx_position - receiver.position)[:, 0]
    scaled_tx = (query.tx_position - frame.centre) / frame.half_extent
    frequency = [scale_frequency(query.frequency_hz)[:, None]] if config.sees_frequency else []
    parts = [summary, positional_encoding(scaled_tx, config.tx_octaves), *frequency]
    correction: Any = make_networks(config)[2].apply(weights["power"], parts)
    power_unit_db = 10.0  # unit of the power network's output, dB
    return free_space_db(distance, query.frequency_hz) + power_unit_db * correction


def _query_inputs(
    means: Float[Array, "n 3"],
    features: GaussianFeatures,
    frame: Frame,
    receiver: Receiver,
    config: WidebandConfig,
    query: Query,
) -> tuple[list[Float[Array, "_ b _"]], list[Float[Array, "1 b _"]]]:
    """Returns the encoded inputs that depend on the query: those of the attenuation network, and the frequency for the radiance
    network (an empty list if this input is switched off)."""
    scaled_tx = (query.tx_position - frame.centre) / frame.half_extent
    both = [positional_encoding(scaled_tx, config.tx_octaves)[None, :, :]]
    if config.relative:
        both.append(_relative_features(means, features, receiver, query, frame.half_extent))
    encoded = encoded_frequency(query.frequency_hz, config)[None, :, :]
    if config.attenuation_frequency:
        both.append(encoded)
    return both, [encoded] if config.radiance_frequency else []


def given_features(given: Float[Array, "b 90 360"], pixel: Float[Array, "n 2"]) -> Float[Array, "n b 3"]:
    """Returns conditioning spectra sampled in the directions of Gaussians: the value, its logarithm, and 1. All three are 0 for
    a spectrum that is zero everywhere, which means no conditioning.

    Args:
        given: B conditioning spectra.
        pixel: column and row of N Gaussians; values are linear between pixels, and constant below the lowest row.
    """
    rows, columns = given.shape[-2:]
    row = jnp.clip(pixel[:, 1], 0, rows - 1)
    above, left = jnp.minimum(jnp.floor(row), rows - 2), jnp.floor(pixel[:, 0])
    down, right = row - above, pixel[:, 0] - left

    def at(i: int, j: int) -> Float[Array, "b n"]:
        return given[:, above.astype(jnp.int32) + i, (left.astype(jnp.int32) + j) % columns]

    upper, lower = ((1 - right) * at(i, 0) + right * at(i, 1) for i in (0, 1))
    value = ((1 - down) * upper + down * lower).T
    conditioned = jnp.any(given > 0, (-2, -1))[:, None]
    return jnp.where(conditioned, jnp.stack([value, jnp.log(value + DARK), jnp.ones_like(value)], -1), 0)


def encoded_frequency(frequency_hz: Float[Array, " b"], config: WidebandConfig) -> Float[Array, "b d"]:
    """Returns the network inputs that encode the frequency."""
    encoded = frequency_encoding(frequency_hz, config.frequency_octaves, config.frequency_scale)
    return jnp.concatenate([encoded, legendre(scale_frequency(frequency_hz), config.frequency_degree)[:, 1:]], -1)


def _relative_features(
    means: Float[Array, "n 3"], features: GaussianFeatures, receiver: Receiver, query: Query, size: Float[Array, ""]
) -> Float[Array, "n b 7"]:
    """Returns geometric functions of (P(G), P(TX)) and the receiver array, which the network then need not learn: the cosine of
    the angle between Gaussian and TX at the receiver, the array's response to the TX in the Gaussian's direction (the PAS of
    the line of sight), the cosine of the angle of reflection at the Gaussian, and distance and direction from Gaussian to TX.
    """
    to_tx = to_local(query.tx_position - receiver.position, receiver.orientation)
    to_tx = to_tx / smooth_length(to_tx)
    elements = receiver.element_wavelengths(query.frequency_hz)
    response = array_response(elements, features.direction, to_tx, features.steering)
    leg = query.tx_position[None] - means[:, None]
    distance = smooth_length(leg)
    direction = leg / distance
    bounce = jnp.sum(direction * features.back[:, None], -1)
    scalars = jnp.stack([jnp.matmul(features.direction, to_tx.T, precision=EXACT), response, bounce], -1)
    return jnp.concatenate([scalars, distance / size, direction], -1)
