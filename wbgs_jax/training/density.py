"""Adaptive density control on the host, between jitted epochs (paper, section 4.5; Kerbl et al. 2023).

A region is not well reconstructed if the positional gradient of its Gaussian on the image is large: a small Gaussian is cloned,
with the clone displaced along the descent direction of its mean; a large one is split in two. Gaussians with negligible
attenuation are removed, and delta_o can be reset close to zero at intervals so that unnecessary Gaussians become apparent.
Optimiser moments stay with their Gaussian; those of new Gaussians start at zero.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wbgs_jax._util.pytree import pytree, replaced
from wbgs_jax.config import DensityConfig
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params
from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.radio.geometry import rotation_matrix
from wbgs_jax.splat.tiles import grown_slots
from wbgs_jax.training.hooks import Context, Edit, Hook
from wbgs_jax.types import Gaussians


@pytree
class DensityStatistics:
    """Statistics of every Gaussian for density control, summed since the last control."""

    gradient_norm: Float[Array, " n"]
    """Norm of the positional gradient on the image, in normalised coordinates (-1..1 across the image)."""
    mean_gradient: Float[Array, "n 3"]
    """Gradient of the loss with respect to the mean (per metre)."""
    visible: Float[Array, " n"]
    """Number of steps in which the Gaussian was visible on the image."""


@dataclass(frozen=True)
class DensityReport:
    """Numbers of Gaussians that a control has cloned, split and removed, and of those that are in use afterwards."""

    cloned: int
    split: int
    pruned: int
    alive: int


@dataclass(frozen=True)
class DensityControl(Hook):
    """The hook of fields whose parameters have an attribute `gaussians`. The probe is the offset (n, 2), in pixels, of their
    projected centres; the hook accumulates its gradient."""

    config: DensityConfig
    stream: int = 3

    def statistics(self, params: Params) -> DensityStatistics:
        """Returns zero statistics of all slots."""
        n = params.gaussians.means.shape[0]
        return DensityStatistics(jnp.zeros(n), jnp.zeros((n, 3)), jnp.zeros(n))

    def probe(self, params: Params) -> Float[Array, "n 2"]:
        """Returns zero offsets."""
        return jnp.zeros((params.gaussians.means.shape[0], 2))

    def accumulate(self, statistics: DensityStatistics, gradients: Any, probe: Float[Array, "n 2"]) -> DensityStatistics:
        """Returns the statistics after a step."""
        to_normalised = jnp.array([PAS_WIDTH / 2, PAS_HEIGHT / 2])
        norm = jnp.linalg.norm(probe * to_normalised, axis=-1)
        mean_gradient = statistics.mean_gradient + gradients.gaussians.means
        return DensityStatistics(statistics.gradient_norm + norm, mean_gradient, statistics.visible + (norm > 0))

    def due(self, step: int, steps: int) -> bool:
        """Returns whether a control or a reset is scheduled after this step."""
        config = self.config
        if not config.every or step < max(config.start, 1) or step > config.stop_fraction * steps:
            return False
        return step % config.every == 0 or self._resets(step)

    def _resets(self, step: int) -> bool:
        return bool(self.config.reset_every) and step % self.config.reset_every == 0

    def apply(
        self,
        field: Field,
        params: Params,
        statistics: DensityStatistics,
        context: Context,
        step: int,
        rng: np.random.Generator,
    ) -> Edit:
        """Returns the parameters after cloning, splitting and pruning and, if scheduled, a reset of delta_o."""
        edit = Edit(params, statistics, lambda tree: tree, {})
        if step % self.config.every == 0:
            edit = control_density(params, statistics, self.config, rng)
            edit = edit._replace(statistics=self.statistics(edit.params))
        return reset_attenuation(edit, self.config) if self._resets(step) else edit

    def next_size(self, params: Params, step: int, steps: int) -> tuple[Any, float] | None:
        """Returns the shapes of the parameters with more slots if few are free and Gaussians may still be added, else None."""
        slots, most = len(params.gaussians.means), self.config.max_gaussians
        alive = int(np.asarray(params.gaussians.alive).sum())
        every, last = max(self.config.every, 1), self.config.stop_fraction * steps
        over = not self.config.every or (step // every + 1) * every > last
        nearly_full = 0.9  # fraction of used slots from which on the program for the next size is compiled
        if over or slots >= most or alive < nearly_full * slots:
            return None
        grown, shapes = grown_slots(slots, slots + 1, most), jax.eval_shape(lambda tree: tree, params)
        gaussians = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((grown, *leaf.shape[1:]), leaf.dtype), shapes.gaussians)
        return replaced(shapes, gaussians=gaussians), grown / slots


def control_density(params: Params, statistics: DensityStatistics, config: DensityConfig, rng: np.random.Generator) -> Edit:
    """Returns parameters with Gaussians cloned, split and pruned; the number of slots may grow."""
    gaussians = jax.tree.map(np.asarray, params.gaussians)
    statistics = jax.tree.map(np.asarray, statistics)
    keep, clone, split = choose(gaussians, statistics, config)
    source, fresh = _sources(keep, clone, split)
    edited = _edit(gaussians, statistics, source, clone, int(keep.sum()), rng)
    slots = len(gaussians.means)
    pad = grown_slots(slots, len(source), config.max_gaussians) - len(source)
    source, fresh = np.pad(source, (0, pad)), np.pad(fresh, (0, pad), constant_values=True)
    edited = jax.tree.map(lambda a: jnp.asarray(np.pad(a, [(0, pad)] + [(0, 0)] * (a.ndim - 1))), edited)
    empty = jnp.arange(len(source)) >= len(source) - pad
    edited = dataclasses.replace(edited, opacity_logits=jnp.where(empty, -jnp.inf, edited.opacity_logits))

    def gather_moments(tree: Any) -> Any:
        def gather(leaf: Any) -> Any:
            return jnp.where(fresh.reshape((-1,) + (1,) * (leaf.ndim - 1)), 0, leaf[source])

        return replaced(tree, gaussians=jax.tree.map(gather, tree.gaussians))

    before, alive = int(np.asarray(gaussians.alive).sum()), int(keep.sum() + clone.sum() + split.sum() * 2)
    report = DensityReport(int(clone.sum()), int(split.sum()), before - int(keep.sum()) - int(split.sum()), alive)
    params = dataclasses.replace(params, gaussians=edited)
    growth = len(edited.means) / slots
    return Edit(params, statistics, gather_moments, {"density": dataclasses.asdict(report)}, growth=growth)


def reset_attenuation(edit: Edit, config: DensityConfig) -> Edit:
    """Returns an edit in which delta_o is lowered to at most `reset_attenuation` and its moments are set to zero."""
    gaussians = edit.params.gaussians
    ceiling = math.log(config.reset_attenuation / (1 - config.reset_attenuation))
    lowered = dataclasses.replace(gaussians, opacity_logits=jnp.minimum(gaussians.opacity_logits, ceiling))

    def forget(tree: Any) -> Any:
        tree = edit.moments(tree) if edit.moments else tree
        zero = jax.tree.map(jnp.zeros_like, tree.gaussians.opacity_logits)
        return replaced(tree, gaussians=replaced(tree.gaussians, opacity_logits=zero))

    return edit._replace(params=dataclasses.replace(edit.params, gaussians=lowered), moments=forget)


def choose(
    gaussians: Gaussians, statistics: DensityStatistics, config: DensityConfig
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Returns masks (keep, clone, split) of the Gaussians. A Gaussian that is split is not kept, one that is cloned is kept.
    The resulting number never exceeds the maximum."""
    alive = np.asarray(gaussians.alive)
    attenuation = 1 / (1 + np.exp(-np.asarray(gaussians.opacity_logits)))
    useful = alive & (attenuation >= config.prune_attenuation)
    if not useful.any():  # an empty field could never recover
        useful = alive
    gradient = np.asarray(statistics.gradient_norm) / np.maximum(np.asarray(statistics.visible), 1)
    wanting = useful & (gradient > config.gradient_threshold)
    room = max(config.max_gaussians - int(useful.sum()), 0)
    if wanting.sum() > room:  # the largest gradients first, in a stable order for reproducible runs
        chosen = np.argsort(-np.where(wanting, gradient, -1), kind="stable")[:room]
        wanting = np.zeros_like(wanting)
        wanting[chosen] = True
    large = np.exp(np.asarray(gaussians.log_scales)).max(-1) > config.split_scale
    split = wanting & large
    return useful & ~split, wanting & ~large, split


def _sources(keep, clone, split) -> tuple[Int[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Returns the source of every resulting Gaussian, and whether it is new: kept Gaussians, clones, then pairs of halves."""
    kept, cloned, halves = (np.flatnonzero(mask) for mask in (keep, clone, split))
    source = np.concatenate([kept, cloned, np.repeat(halves, 2)])
    return source, np.arange(len(source)) >= len(kept)


def _edit(
    gaussians: Gaussians, statistics: DensityStatistics, source, clone, n_kept: int, rng: np.random.Generator
) -> Gaussians:
    """Returns the resulting Gaussians, without empty slots: clones are displaced downhill, and the halves of a split are drawn
    from the Gaussian that they replace."""
    means, log_scales, quats, logits = (
        np.asarray(a)[source].copy() for a in (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits)
    )
    clones = slice(n_kept, n_kept + int(clone.sum()))
    halves = slice(n_kept + int(clone.sum()), None)
    gradient = np.asarray(statistics.mean_gradient)[source[clones]]
    downhill = -gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-20)
    clone_step = 0.5  # displacement of a clone, relative to its smallest standard deviation
    means[clones] += clone_step * np.exp(log_scales[clones]).min(-1, keepdims=True) * downhill
    draw = rng.normal(size=means[halves].shape) * np.exp(log_scales[halves])
    rotation = np.asarray(rotation_matrix(jnp.asarray(quats[halves])))
    means[halves] += np.einsum("nij,nj->ni", rotation, draw).astype(means.dtype)
    # Standard deviations of the two halves, relative to the Gaussian they come from (as in 3D Gaussian splatting).
    split_shrink = 1.6
    log_scales[halves] -= math.log(split_shrink)
    features = None if gaussians.features is None else jnp.asarray(np.asarray(gaussians.features)[source])
    return dataclasses.replace(Gaussians(*map(jnp.asarray, (means, log_scales, quats, logits))), features=features)
