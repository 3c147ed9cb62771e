"""A NeRF2-style volume (Zhao et al., MobiCom 2023) as a baseline: ray marching from the receiver, frequency as another input.

    h, sigma = F(P(x), f)                  the attenuation network, at samples x of the ray in direction w
    Sig      = G(h, w, P(TX), f)           the radiance network: what x, as a new source, sends to the receiver
    PAS(w)   = sum_s T_s alpha_s Sig_s     alpha_s = 1 - exp(-sigma_s d),  T_s = prod_{j<s} (1 - alpha_j)

That is their equation of tracing rays with the phase left out, as everything here is trained on powers. It trains on sampled
directions, the same ones for all spectra of a batch: whatever does not depend on the query is then evaluated once.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from wbgs_jax.array import PAS_HEIGHT, PAS_SHAPE, PAS_WIDTH, array_response, pas_directions
from wbgs_jax.checks import check_query, check_receiver
from wbgs_jax.config import Nerf2Config
from wbgs_jax.encoding import frequency_encoding, positional_encoding
from wbgs_jax.fields.observation import Observation
from wbgs_jax.geometry import rotation_matrix, smooth_length, to_local
from wbgs_jax.networks import AttenuationNetwork, RadianceNetwork, signal_activation
from wbgs_jax.pytree import pytree, static
from wbgs_jax.types import Query, Receiver

STARTS_FROM = "box"
PIXELS = PAS_HEIGHT * PAS_WIDTH
MIN_LENGTH = 1e-3
"""Metres: shorter rays are taken to be this long."""


@pytree
class Nerf2Params:
    """All parameters of the field; `config` is static."""

    networks: dict[str, Any]
    box: Float[Array, "2 3"]
    """Smallest and largest coordinates of the scene, metres: rays end there. Never trained."""
    config: Nerf2Config = static()


@pytree
class Rays:
    """Straight lines from the receiver to the end of the box."""

    local: Float[Array, "r 3"]
    """Unit directions in the receiver's frame ..."""
    world: Float[Array, "r 3"]
    """... and in the world's."""
    length: Float[Array, "r"]
    """Metres."""


@pytree
class Nerf2Plan:
    """What is independent of the query: the rays of all pixels, row by row."""

    rays: Rays
    receiver: Receiver


@partial(jax.jit, static_argnames=("config", "capacity"))
def init(key: Key[Array, ""], box: Float[Array, "2 3"], config: Nerf2Config, capacity: None = None) -> Nerf2Params:
    """Networks of random weights; the space they fill is `box`, metres."""
    untrained = Nerf2Params({}, jnp.asarray(box, jnp.float32), config)
    receiver = Receiver(box.mean(0), jnp.array([1.0, 0, 0, 0]), jnp.zeros((1, 3)))
    rays = make_rays(untrained.box, receiver, jnp.array([[0.0, 0.0, 1.0]]))
    query = Query(box[1:], jnp.full((1,), 1e9))
    key_attenuation, key_radiance = jax.random.split(key)
    attenuation, radiance = _networks(config)
    outputs: Any
    outputs, weights = attenuation.init_with_output(key_attenuation, *_place_inputs(untrained, receiver, rays, query))
    inputs = [outputs[0], *_source_inputs(untrained, receiver, rays, query)]
    return Nerf2Params({"attenuation": weights, "radiance": radiance.init(key_radiance, inputs)}, untrained.box, config)


def make_rays(box: Float[Array, "2 3"], receiver: Receiver, local: Float[Array, "r 3"]) -> Rays:
    """Rays in unit directions of the receiver's frame, as long as they stay in the box (metres)."""
    world = local @ rotation_matrix(receiver.orientation).T
    ahead = jnp.where(world > 0, box[1], box[0]) - receiver.position
    parallel = jnp.abs(world) < 1e-9
    exits = jnp.where(parallel, jnp.inf, ahead / jnp.where(parallel, 1.0, world))
    return Rays(local, world, jnp.maximum(exits.min(-1), MIN_LENGTH))


def plan(params: Nerf2Params, receiver: Receiver, capacity: None = None, means2d_offset: Any = None) -> Nerf2Plan:
    """The rays of all pixels."""
    check_receiver(receiver)
    local = jnp.asarray(pas_directions().reshape(-1, 3), params.box.dtype)
    return Nerf2Plan(make_rays(params.box, receiver, local), receiver)


def render(params: Nerf2Params, plan: Nerf2Plan, query: Query) -> Float[Array, "b 90 360"]:
    """Power angular spectra of B queries, a row of the image at a time: in a gradient, too, one row is held in memory."""
    check_query(query)
    rows = jax.tree.map(lambda a: a.reshape(PAS_HEIGHT, PAS_WIDTH, *a.shape[1:]), plan.rays)
    image = jax.lax.map(jax.checkpoint(lambda rays: march(params, plan.receiver, rays, query)), rows)
    return jnp.moveaxis(image, -1, 0).reshape(-1, *PAS_SHAPE)


def remember(params: Nerf2Params, receiver: Receiver, tx_positions: Float[Array, "tx 3"]) -> None:
    """Nothing: directions change in every step."""


def choose_pixels(params: Nerf2Params, key: Key[Array, ""]) -> Int[Array, "r"]:
    """The directions of a training step: a random pixel out of each of R equal stretches of the image, row by row."""
    count = params.config.directions
    places = (jnp.arange(count) + jax.random.uniform(key, (count,))) * (PIXELS / count)
    return jnp.minimum(places.astype(jnp.int32), PIXELS - 1)


def observe_pixels(params: Nerf2Params, receiver: Receiver, query: Query, pixels: Int[Array, "r"]) -> Float[Array, "b r"]:
    """Some pixels of the spectra of a training batch."""
    local = jnp.asarray(pas_directions().reshape(-1, 3), params.box.dtype)[pixels]
    return march(params, receiver, make_rays(params.box, receiver, local), query).T


def observe(
    params: Nerf2Params,
    memory: None,
    receiver: Receiver,
    query: Query,
    tx_index: Int[Array, "b"],
    capacity: None,
    means2d_offset: Any,
) -> Observation:
    """Whole spectra."""
    return Observation(render(params, plan(params, receiver), query))


def sizes(params: Nerf2Params) -> dict[str, int]:
    """Nothing but the configuration decides the shapes."""
    return {}


def skeleton(config: Nerf2Config, sizes: dict[str, int]) -> Nerf2Params:
    """The shapes of parameters."""
    shaped: Any = jax.eval_shape(lambda: init(jax.random.key(0), jnp.zeros((2, 3)), config))
    return shaped


def march(params: Nerf2Params, receiver: Receiver, rays: Rays, query: Query) -> Float[Array, "r b"]:
    """What arrives along every ray for every query."""
    attenuation, radiance = _networks(params.config)
    outputs: Any = attenuation.apply(params.networks["attenuation"], *_place_inputs(params, receiver, rays, query))
    hidden, sigma = outputs
    logits: Any = radiance.apply(params.networks["radiance"], [hidden, *_source_inputs(params, receiver, rays, query)])
    step = rays.length / params.config.samples / _half_extent(params.box)
    depth = jax.nn.softplus(sigma) * step[:, None, None]
    return accumulate(depth, signal_activation(logits))


def accumulate(depth: Float[Array, "r s b"], signal: Float[Array, "r s b"]) -> Float[Array, "r b"]:
    """sum_s T_s alpha_s Sig_s, front to back, with optical depths sigma_s d of the samples."""
    behind = jnp.cumsum(depth, 1)
    weight = jnp.exp(depth - behind) * -jnp.expm1(-depth)
    return jnp.sum(weight * signal, 1)


def _networks(config: Nerf2Config) -> tuple[AttenuationNetwork, RadianceNetwork]:
    """The frequency enters the last layer of the attenuation network: those before it are evaluated once for all queries."""
    attenuation = AttenuationNetwork(config.width, config.depth, config.skip, fusion=config.depth - 1)
    return attenuation, RadianceNetwork(config.radiance_widths)


def _half_extent(box: Float[Array, "2 3"]) -> Float[Array, ""]:
    """The length (metres) that the networks' inputs count in."""
    return jnp.max(box[1] - box[0]) / 2


def _scaled(params: Nerf2Params, points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """World positions as network inputs of about -1..1."""
    box = jax.lax.stop_gradient(params.box)
    return (points - box.mean(0)) / _half_extent(box)


def _points(receiver: Receiver, rays: Rays, samples: int) -> Float[Array, "r s 3"]:
    """The middles of equal stretches of every ray, world frame, metres."""
    distances = (jnp.arange(samples) + 0.5) / samples * rays.length[:, None]
    return receiver.position + rays.world[:, None] * distances[..., None]


def _frequency(params: Nerf2Params, query: Query) -> Float[Array, "1 1 b _"]:
    return frequency_encoding(query.frequency_hz, params.config.frequency_octaves)[None, None]


def _place_inputs(
    params: Nerf2Params, receiver: Receiver, rays: Rays, query: Query
) -> tuple[list[Float[Array, "r s 1 _"]], list[Float[Array, "1 1 b _"]]]:
    """Inputs of the attenuation network: of the place, and the frequency."""
    points = _points(receiver, rays, params.config.samples)
    encoded = positional_encoding(_scaled(params, points), params.config.point_octaves)
    return [encoded[:, :, None]], [_frequency(params, query)]


def _source_inputs(params: Nerf2Params, receiver: Receiver, rays: Rays, query: Query) -> list[Float[Array, "_ _ b_or_1 _"]]:
    """Inputs of the radiance network besides h: direction, transmitter, frequency and, if asked for, how they lie."""
    config = params.config
    direction = positional_encoding(rays.world, config.direction_octaves)[:, None, None]
    tx = positional_encoding(_scaled(params, query.tx_position), config.tx_octaves)[None, None]
    inputs = [direction, tx, _frequency(params, query)]
    return inputs + _relative_inputs(params, receiver, rays, query) if config.relative else inputs


def _relative_inputs(params: Nerf2Params, receiver: Receiver, rays: Rays, query: Query) -> list[Float[Array, "_ _ b _"]]:
    """What the wideband field knows of transmitter, place and receiver too (`WidebandConfig.relative`).

    Of a direction: its angle to the TX and the array's response to the TX there. Of a place: the cosine of the bounce, and
    distance and direction to the TX.
    """
    to_tx = to_local(query.tx_position - receiver.position, receiver.orientation)
    to_tx = to_tx / smooth_length(to_tx)
    response = array_response(receiver.element_positions, rays.local, to_tx)
    of_ray = jnp.stack([rays.local @ to_tx.T, response], -1)[:, None]
    points = _points(receiver, rays, params.config.samples)
    leg = query.tx_position - points[:, :, None]
    distance = smooth_length(leg)
    direction = leg / distance
    bounce = -jnp.sum(direction * rays.world[:, None, None], -1, keepdims=True)
    return [of_ray, jnp.concatenate([bounce, distance / _half_extent(params.box), direction], -1)]
