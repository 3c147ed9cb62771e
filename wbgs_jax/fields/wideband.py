"""The paper's model: frequency-embedded 3D Gaussians splatted onto the receiver's hemisphere (paper, section 4).

    delta, Sig = F(P(G), P(TX), f)      the EM feature networks (networks.py), one pair a Gaussian and query
    PAS(p)     = sum_i T_i delta_i G_i(p) Sig_i    the splatting of splat/

The geometry does not depend on the query: it is planned once and shared by a batch.
"""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from wbgs_jax.array import array_response
from wbgs_jax.checks import check_query, check_receiver, check_surface
from wbgs_jax.config import WidebandConfig
from wbgs_jax.encoding import frequency_encoding, positional_encoding
from wbgs_jax.fields.observation import Observation
from wbgs_jax.geometry import smooth_length, to_local
from wbgs_jax.networks import AttenuationNetwork, RadianceNetwork, attenuation_activation, signal_activation
from wbgs_jax.pytree import pytree, static
from wbgs_jax.splat import Capacity, GeometryPlan, geometry_plan, render_splats
from wbgs_jax.types import Gaussians, Query, Receiver, Surface

STARTS_FROM = "points"
MAX_ATTENUATION = 0.99
INITIAL_ATTENUATION = 0.3


@pytree
class Frame:
    """Maps world positions to network inputs of about unit size. Set once from the surface, never trained."""

    centre: Float[Array, "3"]
    half_extent: Float[Array, ""]


@pytree
class WidebandParams:
    """All parameters of the field; `config` is static."""

    gaussians: Gaussians
    networks: dict[str, Any]
    frame: Frame
    config: WidebandConfig = static()


@pytree
class WidebandPlan:
    """What is independent of the query."""

    geometry: GeometryPlan
    receiver: Receiver


@partial(jax.jit, static_argnames=("config", "capacity"))
def init(key: Key[Array, ""], surface: Surface, config: WidebandConfig, capacity: int | None = None) -> WidebandParams:
    """Isotropic Gaussians on the surface points, their standard deviation the mean distance to the 3 nearest neighbours.

    `capacity` >= n pads the Gaussians so that density control has room to grow.
    """
    check_surface(surface)
    low, high = surface.points.min(0), surface.points.max(0)
    frame = Frame(centre=(low + high) / 2, half_extent=jnp.max(high - low) / 2)
    untrained = WidebandParams(_initial_gaussians(surface, capacity), {}, frame, config)
    return dataclasses.replace(untrained, networks=_initial_networks(key, untrained))


def _initial_gaussians(surface: Surface, capacity: int | None) -> Gaussians:
    points = surface.points
    n = points.shape[0]
    pad = (capacity or n) - n
    if pad < 0:
        raise ValueError(f"capacity {capacity} is smaller than the {n} points")
    log_scales = jnp.broadcast_to(jnp.log(jnp.maximum(surface.spacing, 1e-3))[:, None], (n, 3))
    logit = jnp.log(INITIAL_ATTENUATION / (MAX_ATTENUATION - INITIAL_ATTENUATION))
    return Gaussians(
        means=jnp.pad(points, ((0, pad), (0, 0))),
        log_scales=jnp.pad(log_scales, ((0, pad), (0, 0))),
        quats=jnp.zeros((n + pad, 4), points.dtype).at[:, 0].set(1),
        opacity_logits=jnp.full((n + pad,), logit, points.dtype),
        alive=(jnp.arange(n + pad) < n).astype(points.dtype),
    )


def _initial_networks(key: Key[Array, ""], untrained: WidebandParams) -> dict[str, Any]:
    """Initial weights; the inputs matter by their shapes only."""
    centre = untrained.frame.centre
    receiver = Receiver(centre, jnp.array([1.0, 0, 0, 0], centre.dtype), jnp.zeros((1, 3), centre.dtype))
    gaussian, both, frequency = _inputs(untrained, receiver, Query(centre[None], jnp.full((1,), 1e9, centre.dtype)))
    key_attenuation, key_radiance = jax.random.split(key)
    attenuation_network, radiance_network = _networks(untrained.config)
    outputs: Any
    outputs, attenuation = attenuation_network.init_with_output(key_attenuation, gaussian, both)
    return {"attenuation": attenuation, "radiance": radiance_network.init(key_radiance, [outputs[0], *frequency])}


def plan(
    params: WidebandParams,
    receiver: Receiver,
    capacity: Capacity | None = None,
    means2d_offset: Float[Array, "n 2"] | None = None,
) -> WidebandPlan:
    """Project and sort the Gaussians once for all queries (see `splat.geometry_plan` about `capacity`)."""
    check_receiver(receiver)
    return WidebandPlan(geometry_plan(params.gaussians, receiver, capacity, params.config.projection, means2d_offset), receiver)


def render(params: WidebandParams, plan: WidebandPlan, query: Query) -> Float[Array, "b 90 360"]:
    """Power angular spectra of B queries."""
    check_query(query)
    attenuation, signal = em_features(params, plan.receiver, query)
    return render_splats(plan.geometry, attenuation, signal)


def remember(params: WidebandParams, receiver: Receiver, tx_positions: Float[Array, "tx 3"]) -> None:
    """Nothing: Gaussians move in every step."""


def observe(
    params: WidebandParams,
    memory: None,
    receiver: Receiver,
    query: Query,
    tx_index: Int[Array, "b"],
    capacity: Capacity | None,
    means2d_offset: Float[Array, "n 2"] | None,
) -> Observation:
    """The spectra of a training batch."""
    planned = plan(params, receiver, capacity, means2d_offset)
    return Observation(render(params, planned, query), jobs=planned.geometry.jobs)


def sizes(params: WidebandParams) -> dict[str, int]:
    """What decides the shapes of the parameters, besides the configuration."""
    return {"gaussians": params.gaussians.means.shape[0]}


def skeleton(config: WidebandConfig, sizes: dict[str, int]) -> WidebandParams:
    """The shapes of parameters."""
    n = sizes["gaussians"]
    shaped: Any = jax.eval_shape(lambda: init(jax.random.key(0), Surface(jnp.zeros((n, 3)), jnp.zeros(n)), config, n))
    return shaped


def em_features(params: WidebandParams, receiver: Receiver, query: Query) -> tuple[Float[Array, "n b"], Float[Array, "n b"]]:
    """Final attenuation delta and signal Sig of every Gaussian and query (paper, equations 1-3 and section 4.5)."""
    attenuation_network, radiance_network = _networks(params.config)
    gaussian, both, frequency = _inputs(params, receiver, query)
    outputs: Any = attenuation_network.apply(params.networks["attenuation"], gaussian, both)
    hidden, delta_f = outputs
    signal: Any = radiance_network.apply(params.networks["radiance"], [hidden, *frequency])
    delta = attenuation_activation(params.gaussians.opacity_logits, delta_f, MAX_ATTENUATION)
    return delta, signal_activation(signal)


def _networks(config: WidebandConfig) -> tuple[AttenuationNetwork, RadianceNetwork]:
    attenuation = AttenuationNetwork(config.width, config.depth, config.skip, config.fusion)
    return attenuation, RadianceNetwork(config.radiance_widths)


def _inputs(
    params: WidebandParams, receiver: Receiver, query: Query
) -> tuple[list[Float[Array, "n 1 _"]], list[Float[Array, "_ b _"]], list[Float[Array, "1 b _"]]]:
    """Encoded inputs: what depends on the Gaussian alone and the rest, for the attenuation network, and the frequency, for the
    radiance network (empty if switched off)."""
    config, frame = params.config, jax.lax.stop_gradient(params.frame)
    means = params.gaussians.means
    scaled_means = (means - frame.centre) / frame.half_extent
    scaled_tx = (query.tx_position - frame.centre) / frame.half_extent
    gaussian = [positional_encoding(scaled_means, config.gaussian_octaves)[:, None, :]]
    both = [positional_encoding(scaled_tx, config.tx_octaves)[None, :, :]]
    if config.relative:
        both.append(_relative_features(means, receiver, query, frame.half_extent))
    encoded = frequency_encoding(query.frequency_hz, config.frequency_octaves, config.frequency_scale)[None, :, :]
    if config.attenuation_frequency:
        both.append(encoded)
    return gaussian, both, [encoded] if config.radiance_frequency else []


def _relative_features(
    means: Float[Array, "n 3"], receiver: Receiver, query: Query, size: Float[Array, ""]
) -> Float[Array, "n b 7"]:
    """Functions of (P(G), P(TX)) and the receiver array that spare the network learning trigonometry.

    The angle between Gaussian and TX as the receiver sees it, the array's response to the TX in the Gaussian's direction (the
    line of sight's PAS), the cosine of the bounce at the Gaussian, and distance and direction from Gaussian to TX.
    """
    to_g, to_tx = (to_local(p - receiver.position, receiver.orientation) for p in (means, query.tx_position))
    to_g, to_tx = to_g / smooth_length(to_g), to_tx / smooth_length(to_tx)
    response = array_response(receiver.element_positions, to_g, to_tx)
    leg, back = query.tx_position[None] - means[:, None], receiver.position - means
    distance = smooth_length(leg)
    direction = leg / distance
    bounce = jnp.sum(direction * (back / smooth_length(back))[:, None], -1)
    scalars = jnp.stack([to_g @ to_tx.T, response, bounce], -1)
    return jnp.concatenate([scalars, distance / size, direction], -1)
