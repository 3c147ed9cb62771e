"""The paper's model: frequency-embedded 3D Gaussians splatted onto the receiver's hemisphere (paper, section 4).

    delta, Sig = F(P(G), P(TX), f)      the EM feature networks (em_features.py), one pair per Gaussian and query
    PAS(p)     = sum_i T_i delta_i G_i(p) Sig_i    the splatting of splat/

The geometry, and the parts of the networks that depend on the Gaussian only, are independent of the query; the plan holds both.
"""

import dataclasses
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from wbgs_jax._util.pytree import pytree, static, with_leaves
from wbgs_jax.config import PRESETS
from wbgs_jax.fields.base import (
    Aux,
    Field,
    GaussianState,
    Group,
    Inspection,
    Observation,
    TrainingTime,
    compare,
    power_error_db,
    register,
    with_field,
)
from wbgs_jax.fields.em_features import (
    GIVEN_FEATURES,
    MAX_ATTENUATION,
    RELATIVE_FEATURES,
    Frame,
    GaussianFeatures,
    QueryFeatures,
    encoded_frequency,
    gaussian_features,
    given_features,
    make_networks,
    query_features,
    received_power_db,
)
from wbgs_jax.fields.networks import positional_encoding
from wbgs_jax.fields.wideband_settings import CONFIGS, DENSITY, OPTIM, PAPER, WidebandConfig
from wbgs_jax.splat.composite import GeometryPlan, geometry_plan, render_splats
from wbgs_jax.splat.tiles import TileLimits, fit_limits, slots_for
from wbgs_jax.types import (
    Batch,
    Gaussians,
    Query,
    Receiver,
    Scene,
    Surface,
    check_query,
    check_receiver,
    check_surface,
)

INITIAL_ATTENUATION = 0.3
"""Initial attenuation of every Gaussian."""


@pytree
class WidebandParams:
    """Parameters of the splatting field: the Gaussians, and the weights of the networks by name."""

    gaussians: Gaussians
    networks: dict[str, Any]


@pytree
class WidebandPlan:
    """Everything that is independent of the query. Gradients reach parameters through it only if it is made inside the
    differentiated function."""

    geometry: GeometryPlan
    features: GaussianFeatures | None
    """Network inputs of every Gaussian; None in a file, in which case every call computes them."""
    frame: Frame
    receiver: Receiver
    config: WidebandConfig = static()

    def portable(self) -> "WidebandPlan":
        """Returns the plan without the network inputs of the Gaussians, which are ten times as large as the parameters."""
        return dataclasses.replace(self, features=None)


@register
@pytree
class WidebandField(Field):
    """Initial positions of the Gaussians, and the frame of the networks' inputs."""

    surface: Surface
    frame: Frame
    config: WidebandConfig = static()

    name: ClassVar[str] = "wideband"
    presets: ClassVar = with_field(PRESETS, CONFIGS, density=DENSITY, optim=OPTIM) | {"paper": PAPER}
    outputs: ClassVar = ("pas", "power")
    hooks: ClassVar = ("density",)
    seconds: ClassVar = {"cpu": TrainingTime(330, 27, 22), "smoke": TrainingTime(22, 34, 23)}

    @classmethod
    def build(cls, config: WidebandConfig, scene: Scene, seed: int) -> "WidebandField":
        """Returns the field whose Gaussians start on the surfaces of a scene."""
        # The initial number of Gaussians is at most 16 per training spectrum, but this limit is never below 500.
        fewest_gaussians, gaussians_a_spectrum = 500, 16
        count = min(config.gaussians, max(fewest_gaussians, gaussians_a_spectrum * scene.spectra))
        return make_field(scene.surface(count, seed, config.sampling), config, cls)

    def init(self, key: Key[Array, ""], given: bool = False) -> WidebandParams:
        """Returns isotropic Gaussians on the surface points, with the mean distance to the 3 nearest neighbours as standard
        deviation and with unused slots for density control, and networks with random weights.

        Args:
            key: random key.
            given: whether the networks have inputs for a conditioning spectrum.
        """
        return _init(self, key, given)

    def plan(
        self, params: WidebandParams, receiver: Receiver, prepared: None = None, capacity: TileLimits | None = None
    ) -> WidebandPlan:
        """Returns the projected and sorted Gaussians, and the network inputs that depend on them only.

        Gradients reach the Gaussians through the plan only if it is made inside the differentiated function. A `capacity` is
        needed under jit (`splat.geometry_plan`).
        """
        return self._plan(params, receiver, capacity, None)

    def _plan(
        self,
        params: WidebandParams,
        receiver: Receiver,
        capacity: TileLimits | None,
        offset: Float[Array, "n 2"] | None,
    ) -> WidebandPlan:
        check_receiver(receiver)
        geometry = geometry_plan(params.gaussians, receiver, capacity, self.config.projection, offset)
        frame = jax.lax.stop_gradient(self.frame)
        features = gaussian_features(params.gaussians, params.networks, frame, receiver, self.config)
        return WidebandPlan(geometry, features, frame, receiver, self.config)

    def render(
        self, params: WidebandParams, plan: WidebandPlan, links: Query, given: Float[Array, "b 90 360"] | None = None
    ) -> Observation:
        """Returns the spectra and received powers of B links; `given` are conditioning spectra, for networks that have inputs
        for them."""
        return self._render(params, plan, links, given)

    def _render(
        self,
        params: WidebandParams,
        plan: WidebandPlan,
        query: Query,
        given: Float[Array, "b 90 360"] | None = None,
        detached: bool = False,
    ) -> Observation:
        """Returns spectra and received powers of B queries; `detached` powers have no gradient with respect to the parameters
        of the spectra."""
        check_query(query)
        features = _features(params, plan, query, given)
        spectra = render_splats(plan.geometry, features.attenuation, features.signal)
        summary = jax.lax.stop_gradient(features.summary) if detached else features.summary
        known = plan.frame, plan.receiver, plan.config
        return Observation(spectra, power_db=received_power_db(summary, params.networks, *known, query))

    def loss(
        self,
        params: WidebandParams,
        prepared: None,
        batch: Batch,
        capacity: TileLimits | None = None,
        probe: Float[Array, "n 2"] | None = None,
        given: Float[Array, "b 90 360"] | None = None,
    ) -> tuple[Float[Array, ""], Aux]:
        """Returns the image loss of a batch (paper, equation 5), plus the error of received power if the data contain it.
        `probe` is an offset of the projected centres, pixels; `given` are conditioning spectra."""
        planned = self._plan(params, batch.receiver, capacity, probe)
        seen = self._render(params, planned, batch.links, given, detached=batch.pas is not None)
        loss, aux = compare(seen, batch, self.config.ssim_weight, self.config.ssim_stride)
        if batch.pas is not None and (error_db := power_error_db(seen, batch)) is not None:
            loss += self.config.power_weight * error_db
        jobs = planned.geometry.jobs
        required = jnp.stack([jobs.required_entries, jobs.required_jobs])
        return loss, aux._replace(required=required, overflow=jobs.overflow)

    def capacity(self, params: WidebandParams, receivers: Receiver, required: Int[np.ndarray, "2"] | None = None) -> TileLimits:
        """Returns tile limits that suffice for the plans of all receivers, or for the required numbers of entries and jobs,
        with a margin for footprints that grow."""
        if required is None:
            required = np.zeros(2, int)
            for i in range(receivers.position.shape[0]):
                receiver = jax.tree.map(lambda leaf, i=i: leaf[i], receivers)
                jobs = geometry_plan(params.gaussians, receiver, None, self.config.projection).jobs
                required = np.maximum(required, [int(jobs.required_entries), int(jobs.required_jobs)])
        tile_slack = 1.4  # capacity of the tile lists relative to what is needed, because footprints grow during training
        return fit_limits(int(required[0]), int(required[1]), tile_slack)

    def inspect(self, params: WidebandParams, plan: WidebandPlan | None = None, links: Query | None = None) -> Inspection:
        """Returns the number of Gaussians, and their state for B links."""
        state = None if plan is None or links is None else gaussian_state(params, plan, links)
        return Inspection({"gaussians": int(np.asarray(params.gaussians.alive).sum())}, gaussians=state)

    @classmethod
    def param_groups(cls, config: WidebandConfig, params: WidebandParams | None = None) -> tuple[dict[str, Group], Any]:
        """Returns a group for the networks and one for every kind of parameter of the Gaussians, and the group of every
        parameter."""
        groups = {
            "means": Group(config.means_lr),
            "log_scales": Group(config.log_scales_lr),
            "quats": Group(config.quats_lr),
            "opacity_logits": Group(config.opacity_lr),
            "features": Group(config.features_lr),
            "networks": Group(config.network_lr, config.network_optimizer, config.network_weight_decay, eps=1e-8),
        }
        if params is None:
            return groups, None
        gaussians = ["means", "log_scales", "quats", "opacity_logits", "features"][: len(jax.tree.leaves(params.gaussians))]
        return groups, with_leaves(params, *gaussians, *["networks"] * len(jax.tree.leaves(params.networks)))


def make_field(
    surface: Surface, config: WidebandConfig | None = None, cls: type[WidebandField] = WidebandField
) -> WidebandField:
    """Returns the field whose Gaussians start on surface points; raises an error for points of an invalid shape."""
    check_surface(surface)
    low, high = surface.points.min(0), surface.points.max(0)
    frame = Frame(centre=(low + high) / 2, half_extent=jnp.max(high - low) / 2)
    return cls(surface, frame, config or WidebandConfig())


@partial(jax.jit, static_argnames="given")
def _init(field: WidebandField, key: Key[Array, ""], given: bool) -> WidebandParams:
    return WidebandParams(_initial_gaussians(field.surface, field.config.features), _initial_networks(key, field, given))


def _initial_gaussians(surface: Surface, features: int) -> Gaussians:
    points = surface.points
    n = points.shape[0]
    # One slot in so many is free at first: most scenes need few Gaussians more than they begin with, and another number of
    # slots is another program to compile.
    spare = 16
    slots = slots_for(n + n // spare)
    pad = slots - n
    log_scales = jnp.broadcast_to(jnp.log(jnp.maximum(surface.spacing, 1e-3))[:, None], (n, 3))
    logit = jnp.log(INITIAL_ATTENUATION / (MAX_ATTENUATION - INITIAL_ATTENUATION))
    return Gaussians(
        means=jnp.pad(points, ((0, pad), (0, 0))),
        log_scales=jnp.pad(log_scales, ((0, pad), (0, 0))),
        quats=jnp.zeros((slots, 4), points.dtype).at[:, 0].set(1),
        opacity_logits=jnp.where(jnp.arange(slots) < n, logit, -jnp.inf).astype(points.dtype),
        features=jnp.zeros((slots, features), points.dtype) if features else None,
    )


def _initial_networks(key: Key[Array, ""], field: WidebandField, given: bool) -> dict[str, Any]:
    """Returns initial weights; only the shapes of the inputs matter."""
    config, points = field.config, field.surface.points
    attenuation, radiance, power = make_networks(config)
    encoded = positional_encoding(points, config.gaussian_octaves)
    gaussian = [jnp.pad(encoded, ((0, 0), (0, config.features)))[:, None, :]]
    tx = [positional_encoding(points[:1], config.tx_octaves)[None]]
    frequency = encoded_frequency(jnp.full((1,), 1e9, points.dtype), config)[None]
    relative = [jnp.zeros((len(points), 1, RELATIVE_FEATURES), points.dtype)] if config.relative else []
    seen = [jnp.zeros((len(points), 1, GIVEN_FEATURES), points.dtype)] if given else []
    query = tx + relative + ([frequency] if config.attenuation_frequency else []) + seen
    key_attenuation, key_radiance = jax.random.split(key)
    outputs: Any
    outputs, weights = attenuation.init_with_output(key_attenuation, gaussian, query)
    inputs = [outputs[0], *([frequency] if config.radiance_frequency else []), *seen]
    summary, scaled_frequency = (jnp.zeros((1, size), points.dtype) for size in (config.width, 1))
    known = [summary, tx[0][0], *([scaled_frequency] if config.sees_frequency else [])]
    return {
        "attenuation": weights,
        "radiance": radiance.init(key_radiance, inputs),
        "power": power.init(jax.random.fold_in(key, 2), known),
    }


def render(params: WidebandParams, plan: WidebandPlan, query: Query) -> Float[Array, "b 90 360"]:
    """Returns the power angular spectra of B queries.

    The plan is a constant to gradients of this function: for `jax.grad` over parameters use `fields.pas`, which makes the plan
    inside.
    """
    check_query(query)
    return render_splats(plan.geometry, *em_features(params, plan, query))


def em_features(
    params: WidebandParams, plan: WidebandPlan, query: Query, given: Float[Array, "b 90 360"] | None = None
) -> tuple[Float[Array, "n b"], Float[Array, "n b"]]:
    """Returns the final attenuation delta and the signal Sig of every Gaussian and query (paper, equations 1-3 and section
    4.5).

    Args:
        params: parameters.
        plan: plan of one receiver.
        query: B queries.
        given: conditioning spectra, for networks that have inputs for them.
    """
    features = _features(params, plan, query, given)
    return features.attenuation, features.signal


def gaussian_state(
    params: WidebandParams, plan: WidebandPlan, query: Query, given: Float[Array, "b 90 360"] | None = None
) -> GaussianState:
    """Returns the Gaussians with their attenuation and signal for B queries; the arguments are those of `em_features`."""
    return GaussianState(params.gaussians, *em_features(params, plan, query, given))


def _features(
    params: WidebandParams, plan: WidebandPlan, query: Query, given: Float[Array, "b 90 360"] | None = None
) -> QueryFeatures:
    known = plan.frame, plan.receiver, plan.config
    features = plan.features or gaussian_features(params.gaussians, params.networks, *known)
    seen = None if given is None else given_features(given, jax.lax.stop_gradient(plan.geometry.splats.means2d))
    return query_features(params.gaussians, params.networks, features, *known, query, seen)
