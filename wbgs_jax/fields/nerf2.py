"""A NeRF2-style volume (Zhao et al., MobiCom 2023) as a baseline: ray marching from the receiver, with the frequency as an
additional input.

    h, sigma = F(P(x), f)                  the attenuation network, at samples x of the ray in direction w
    Sig      = G(h, w, P(TX), f)           the radiance network: emission of x, as a new source, towards the receiver
    PAS(w)   = sum_s T_s alpha_s Sig_s     alpha_s = 1 - exp(-sigma_s d),  T_s = prod_{j<s} (1 - alpha_j)

That is their ray tracing equation without the phase, since all fields here are trained on powers. It is trained on sampled
directions, which are the same for all spectra of a batch: parts that do not depend on the query are then evaluated once.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree, static
from wbgs_jax.config import PRESETS, check_positive, check_rates
from wbgs_jax.fields.base import Aux, Field, Group, Observation, Optimizer, register, with_field
from wbgs_jax.fields.losses import pixel_loss
from wbgs_jax.fields.networks import (
    AttenuationNetwork,
    RadianceNetwork,
    check_octaves,
    frequency_encoding,
    positional_encoding,
    signal_activation,
)
from wbgs_jax.radio.antenna import Antenna
from wbgs_jax.radio.array import EXACT, PAS_HEIGHT, PAS_SHAPE, PAS_WIDTH, array_response, pas_directions
from wbgs_jax.radio.geometry import rotation_matrix, smooth_length, to_local
from wbgs_jax.types import Batch, Query, Receiver, Scene, Transmitter, check_query, check_receiver

PIXELS = PAS_HEIGHT * PAS_WIDTH
FLUSH_M, MARGIN_M = 1e-2, 1.0
"""Distance from the boundary below which a receiver lies on it, and by which the boundary is then moved outwards, metres."""


@dataclass(frozen=True)
class Nerf2Config:
    """Settings of the NeRF2-style volume."""

    samples: int = 24
    """Number of samples of a ray between the receiver and the end of the scene's box."""
    directions: int = 192
    """Number of directions (pixels) of every spectrum that a training step uses."""
    width: int = 64
    """Units per layer of the attenuation network (authors: 256)."""
    depth: int = 4
    """Number of layers of the attenuation network (authors: 8); the frequency enters the last one."""
    skip: int = 2
    """Layer at which the position enters again (authors: 4)."""
    radiance_widths: tuple[int, ...] = (64, 32)
    """Units of each layer of the radiance network."""
    point_octaves: int = 6
    """Octaves of P(x) (authors: 10)."""
    direction_octaves: int = 2
    """Octaves of P(w)."""
    tx_octaves: int = 4
    """Octaves of P(TX) (authors: 10)."""
    frequency_octaves: int = 0
    """Octaves of the frequency encoding, in addition to the logarithm itself."""
    relative: bool = True
    """Also encode the TX relative to the position, the direction and the receiver array, as the wideband field does."""
    pixel_loss: Literal["l1", "l2"] = "l1"
    """Mean absolute ("l1") or squared ("l2") error of the sampled pixels, which do not form an image and have no SSIM."""
    network_optimizer: Optimizer = "muon"
    """Optimiser of the networks' matrices (`base.Group`; authors: Adam)."""
    network_lr: float = 1e-2
    """Learning rate of the networks (authors: 5e-4)."""
    network_weight_decay: float = 0.0
    """Decoupled weight decay of the networks."""

    def check(self, name: str) -> None:
        """Raises a `UserError` for invalid settings; the message names the option with the field's `name`."""
        counts = {option: getattr(self, option) for option in ("samples", "directions", "width", "depth")}
        check_positive({f"{name}.{option}": n for option, n in counts.items()})
        check_positive({f"{name}.radiance-widths": min(self.radiance_widths, default=0)})
        if self.directions > PIXELS:
            raise UserError(f"--{name}.directions is {self.directions}; a spectrum has {PIXELS} pixels")
        check_rates(name, self)
        check_octaves(name, self, ("point", "direction", "tx", "frequency"))


CONFIGS = {
    "smoke": Nerf2Config(samples=8, directions=64, width=32, depth=3, radiance_widths=(32,)),
    "cpu": Nerf2Config(),
    "gpu": Nerf2Config(samples=64, directions=1024, width=256, depth=8, skip=4, radiance_widths=(256, 128)),
}
Weights = dict[str, Any]
"""Trained weights of the two networks."""


@pytree
class Rays:
    """Straight lines from the receiver to the boundary of the box."""

    local: Float[Array, "r 3"]
    """Unit directions in the receiver's frame."""
    world: Float[Array, "r 3"]
    """Unit directions in the world frame."""
    length: Float[Array, " r"]
    """Lengths, metres."""


@pytree
class Nerf2Plan:
    """Everything that is independent of the query: the rays of all pixels, row by row. It contains no parameters."""

    rays: Rays
    receiver: Receiver
    box: Float[Array, "2 3"]
    config: Nerf2Config = static()


@register
@pytree
class Nerf2Field(Field):
    """A volume represented by the networks."""

    box: Float[Array, "2 3"]
    """Smallest and largest coordinates of the scene, metres; rays end at this box."""
    config: Nerf2Config = static()

    name: ClassVar[str] = "nerf2"
    presets: ClassVar = with_field(PRESETS, CONFIGS)

    @classmethod
    def build(cls, config: Nerf2Config, scene: Scene, seed: int) -> "Nerf2Field":
        """Returns the field over the box of a scene, which is larger by `MARGIN_M` if a receiver lies on its boundary, where
        rays would end at once: without a mesh, the antennas alone define it."""
        (low, high), receivers = scene.box, np.asarray(scene.receivers.position)
        inside = np.all((receivers > low + FLUSH_M) & (receivers < high - FLUSH_M))
        margin = 0.0 if inside else MARGIN_M
        return cls(jnp.asarray([low - margin, high + margin], jnp.float32), config)

    def init(self, key: Key[Array, ""]) -> Weights:
        """Returns random weights of the networks."""
        return _init(self, key)

    def plan(self, params: Weights, receiver: Receiver, prepared: None = None, capacity: None = None) -> Nerf2Plan:
        """Returns the rays of all pixels."""
        check_receiver(receiver)
        local = jnp.asarray(pas_directions().reshape(-1, 3), self.box.dtype)
        return self._plan(receiver, local)

    def _plan(self, receiver: Receiver, local: Float[Array, "r 3"]) -> Nerf2Plan:
        box = jax.lax.stop_gradient(self.box)
        return Nerf2Plan(make_rays(box, receiver, local), receiver, box, self.config)

    def render(self, params: Weights, plan: Nerf2Plan, links: Query) -> Observation:
        """Returns the spectra of B links."""
        return Observation(render(params, plan, links))

    def loss(
        self, params: Weights, prepared: None, batch: Batch, capacity: None = None, probe: None = None
    ) -> tuple[Float[Array, ""], Aux]:
        """Returns the loss of random pixels of a batch, drawn with the step's key and the same for all of its spectra."""
        assert batch.pas is not None, "this field is trained on spectra only"
        pixels = choose_pixels(batch.key, self.config.directions)
        local = jnp.asarray(pas_directions().reshape(-1, 3), self.box.dtype)[pixels]
        truth = batch.pas.reshape(batch.pas.shape[0], -1)[:, pixels]
        plan = self._plan(batch.receiver, local)
        predicted = march(params, plan, plan.rays, batch.links).T
        return pixel_loss(predicted, truth, self.config.pixel_loss), Aux({"batch_ssim": jnp.full((), jnp.nan)})

    @classmethod
    def param_groups(cls, config: Nerf2Config, params: Weights | None = None) -> tuple[dict[str, Group], Any]:
        """Returns a single group, that of the networks."""
        group = Group(config.network_lr, config.network_optimizer, config.network_weight_decay, eps=1e-8)
        return {"all": group}, super().param_groups(config, params)[1]


@jax.jit
def _init(field: Nerf2Field, key: Key[Array, ""]) -> Weights:
    """Returns initial weights; only the shapes of the inputs matter."""
    box = field.box
    receiver = Receiver(box.mean(0), jnp.array([1.0, 0, 0, 0]), jnp.zeros((1, 3)), Antenna(None, jnp.zeros(2)))
    rays = make_rays(box, receiver, jnp.array([[0.0, 0.0, 1.0]]))
    plan = Nerf2Plan(rays, receiver, box, field.config)
    query = Query(Transmitter(box[1:]), jnp.full((1,), 1e9))
    key_attenuation, key_radiance = jax.random.split(key)
    attenuation, radiance = _networks(field.config)
    outputs: Any
    outputs, weights = attenuation.init_with_output(key_attenuation, *_place_inputs(plan, rays, query))
    inputs = [outputs[0], *_source_inputs(plan, rays, query)]
    return {"attenuation": weights, "radiance": radiance.init(key_radiance, inputs)}


def make_rays(box: Float[Array, "2 3"], receiver: Receiver, local: Float[Array, "r 3"]) -> Rays:
    """Returns rays from the receiver to the boundary of a box.

    Args:
        box: smallest and largest coordinates, metres.
        receiver: receiver.
        local: unit directions in the receiver's frame.
    """
    world = jnp.matmul(local, rotation_matrix(receiver.orientation).T, precision=EXACT)
    ahead = jnp.where(world > 0, box[1], box[0]) - receiver.position
    parallel = jnp.abs(world) < 1e-9
    exits = jnp.where(parallel, jnp.inf, ahead / jnp.where(parallel, 1.0, world))
    min_length = 1e-3  # minimum length of a ray, metres
    return Rays(local, world, jnp.maximum(exits.min(-1), min_length))


def render(params: Weights, plan: Nerf2Plan, query: Query) -> Float[Array, "b 90 360"]:
    """Returns the power angular spectra of B queries, one image row at a time, so that also a gradient holds only one row in
    memory."""
    check_query(query)
    rows = jax.tree.map(lambda a: a.reshape(PAS_HEIGHT, PAS_WIDTH, *a.shape[1:]), plan.rays)
    image = jax.lax.map(jax.checkpoint(lambda rays: march(params, plan, rays, query)), rows)
    return jnp.moveaxis(image, -1, 0).reshape(-1, *PAS_SHAPE)


def choose_pixels(key: Key[Array, ""], count: int) -> Int[Array, " r"]:
    """Returns flat indices of random pixels, one from each of `count` equal segments of the image, row by row."""
    places = (jnp.arange(count) + jax.random.uniform(key, (count,))) * (PIXELS / count)
    return jnp.minimum(places.astype(jnp.int32), PIXELS - 1)


def march(params: Weights, plan: Nerf2Plan, rays: Rays, query: Query) -> Float[Array, "r b"]:
    """Returns the accumulated signal along every ray for every query."""
    attenuation, radiance = _networks(plan.config)
    with jax.default_matmul_precision("highest"):  # errors of TF32 add up along a ray: 17 % of the gradient on an H100
        outputs: Any = attenuation.apply(params["attenuation"], *_place_inputs(plan, rays, query))
        hidden, sigma = outputs
        logits: Any = radiance.apply(params["radiance"], [hidden, *_source_inputs(plan, rays, query)])
    step = rays.length / plan.config.samples / _half_extent(plan.box)
    depth = jax.nn.softplus(sigma) * step[:, None, None]
    return accumulate(depth, signal_activation(logits))


def accumulate(depth: Float[Array, "r s b"], signal: Float[Array, "r s b"]) -> Float[Array, "r b"]:
    """Returns sum_s T_s alpha_s Sig_s, front to back, from the optical depths sigma_s d of the samples."""
    behind = jnp.cumsum(depth, 1)
    weight = jnp.exp(depth - behind) * -jnp.expm1(-depth)
    return jnp.sum(weight * signal, 1)


def _networks(config: Nerf2Config) -> tuple[AttenuationNetwork, RadianceNetwork]:
    """Returns both networks. The frequency enters the last layer of the attenuation network; the layers before it are evaluated
    once for all queries."""
    attenuation = AttenuationNetwork(config.width, config.depth, config.skip, fusion=config.depth - 1)
    return attenuation, RadianceNetwork(config.radiance_widths)


def _half_extent(box: Float[Array, "2 3"]) -> Float[Array, ""]:
    """Returns the unit of length of the networks' inputs, metres."""
    return jnp.max(box[1] - box[0]) / 2


def _scaled(plan: Nerf2Plan, points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Returns world positions scaled to about -1..1 for the networks."""
    return (points - plan.box.mean(0)) / _half_extent(plan.box)


def _points(plan: Nerf2Plan, rays: Rays) -> Float[Array, "r s 3"]:
    """Returns the midpoints of equal segments of every ray, world frame, metres."""
    samples = plan.config.samples
    distances = (jnp.arange(samples) + 0.5) / samples * rays.length[:, None]
    return plan.receiver.position + rays.world[:, None] * distances[..., None]


def _frequency(plan: Nerf2Plan, query: Query) -> Float[Array, "1 1 b _"]:
    return frequency_encoding(query.frequency_hz, plan.config.frequency_octaves)[None, None]


def _place_inputs(
    plan: Nerf2Plan, rays: Rays, query: Query
) -> tuple[list[Float[Array, "r s 1 _"]], list[Float[Array, "1 1 b _"]]]:
    """Returns the inputs of the attenuation network: the encoded position, and the frequency."""
    encoded = positional_encoding(_scaled(plan, _points(plan, rays)), plan.config.point_octaves)
    return [encoded[:, :, None]], [_frequency(plan, query)]


def _source_inputs(plan: Nerf2Plan, rays: Rays, query: Query) -> list[Float[Array, "_ _ b_or_1 _"]]:
    """Returns the inputs of the radiance network in addition to h: direction, transmitter, frequency and, with
    `Nerf2Config.relative`, relative positions."""
    config = plan.config
    direction = positional_encoding(rays.world, config.direction_octaves)[:, None, None]
    tx = positional_encoding(_scaled(plan, query.tx_position), config.tx_octaves)[None, None]
    inputs = [direction, tx, _frequency(plan, query)]
    return inputs + _relative_inputs(plan, rays, query) if config.relative else inputs


def _relative_inputs(plan: Nerf2Plan, rays: Rays, query: Query) -> list[Float[Array, "_ _ b _"]]:
    """Returns the relative inputs that the wideband field has as well (`WidebandConfig.relative`): for every direction the
    cosine of its angle to the TX and the array's response to the TX there; for every position the cosine of the angle of
    reflection, and distance and direction to the TX."""
    receiver = plan.receiver
    to_tx = to_local(query.tx_position - receiver.position, receiver.orientation)
    to_tx = to_tx / smooth_length(to_tx)
    response = array_response(receiver.element_wavelengths(query.frequency_hz), rays.local, to_tx)
    of_ray = jnp.stack([jnp.matmul(rays.local, to_tx.T, precision=EXACT), response], -1)[:, None]
    leg = query.tx_position - _points(plan, rays)[:, :, None]
    distance = smooth_length(leg)
    direction = leg / distance
    bounce = -jnp.sum(direction * rays.world[:, None, None], -1, keepdims=True)
    return [of_ray, jnp.concatenate([bounce, distance / _half_extent(plan.box), direction], -1)]
