"""Adaptive density control on the host, between jitted epochs (paper, section 4.5; Kerbl et al. 2023).

A Gaussian whose positional gradient on the image is large is not well reconstructed: a small one is cloned, the clone moved
along the descent direction of its mean; a large one is split in two. Gaussians that hardly attenuate are removed, and now and
then delta_o is reset close to zero so that the useless ones can be told. Optimiser moments travel with their Gaussian;
new ones start from zero moments.
"""

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from wbgs_jax.config import DensityConfig
from wbgs_jax.geometry import rotation_matrix
from wbgs_jax.train_step import DensityStats, TrainState, empty_density_stats
from wbgs_jax.types import Gaussians

SPLIT_SHRINK = 1.6
"""Standard deviations of the two halves, relative to the Gaussian they come from (as in 3D Gaussian splatting)."""
CLONE_STEP = 0.5
"""How far a clone moves, in its smallest standard deviations."""


@dataclass(frozen=True)
class DensityReport:
    """What one control did."""

    cloned: int
    split: int
    pruned: int
    alive: int


def capacity_bucket(n: int) -> int:
    """The smallest capacity that holds n Gaussians; buckets grow by 2^(1/4) from 64, so that small changes do not recompile."""
    sizes = (-(-int(64 * 2 ** (step / 4)) // 16) * 16 for step in itertools.count())
    return next(size for size in sizes if size >= n)


def control_density(state: TrainState, config: DensityConfig, rng: np.random.Generator) -> tuple[TrainState, DensityReport]:
    """Clone, split and prune. The Gaussians' capacity may change; statistics start anew."""
    gaussians = jax.tree.map(np.asarray, state.params.gaussians)
    stats = jax.tree.map(np.asarray, state.density)
    keep, clone, split = choose(gaussians, stats, config)
    source, fresh = _sources(keep, clone, split)
    edited = _edit(gaussians, stats, source, clone, split, int(keep.sum()), rng)
    capacity = capacity_bucket(len(source))
    source = np.pad(source, (0, capacity - len(source)))
    fresh = np.pad(fresh, (0, capacity - len(fresh)), constant_values=True)
    edited = jax.tree.map(lambda a: jnp.asarray(np.pad(a, [(0, capacity - len(a))] + [(0, 0)] * (a.ndim - 1))), edited)
    params = dataclasses.replace(state.params, gaussians=edited)
    moments = _carry_moments(state.optimizer, source, fresh)
    alive = int(keep.sum() + clone.sum() + split.sum() * 2)
    report = DensityReport(
        int(clone.sum()), int(split.sum()), int((gaussians.alive > 0).sum() - keep.sum() - split.sum()), alive
    )
    return TrainState(params, moments, empty_density_stats(capacity), state.step), report


def choose(
    gaussians: Gaussians, stats: DensityStats, config: DensityConfig
) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Masks (keep, clone, split) of the Gaussians: a split one is not kept, a cloned one is. Never grows beyond the maximum."""
    alive = np.asarray(gaussians.alive) > 0
    attenuation = 1 / (1 + np.exp(-np.asarray(gaussians.opacity_logits)))
    useful = alive & (attenuation >= config.prune_attenuation)
    if not useful.any():  # an empty field could never recover
        useful = alive
    gradient = np.asarray(stats.gradient_norm) / np.maximum(np.asarray(stats.visible), 1)
    wanting = useful & (gradient > config.gradient_threshold)
    room = max(config.max_gaussians - int(useful.sum()), 0)
    if wanting.sum() > room:  # the neediest first; stable, so that equal runs stay equal
        chosen = np.argsort(-np.where(wanting, gradient, -1), kind="stable")[:room]
        wanting = np.zeros_like(wanting)
        wanting[chosen] = True
    large = np.exp(np.asarray(gaussians.log_scales)).max(-1) > config.split_scale
    split = wanting & large
    return useful & ~split, wanting & ~large, split


def reset_attenuation(state: TrainState, config: DensityConfig) -> TrainState:
    """Lower delta_o to at most `reset_attenuation` and forget its moments."""
    gaussians = state.params.gaussians
    ceiling = math.log(config.reset_attenuation / (1 - config.reset_attenuation))
    lowered = dataclasses.replace(gaussians, opacity_logits=jnp.minimum(gaussians.opacity_logits, ceiling))
    nobody = np.arange(gaussians.means.shape[0])
    moments = _carry_moments(state.optimizer, nobody, np.ones(len(nobody), bool), only="opacity_logits")
    return TrainState(dataclasses.replace(state.params, gaussians=lowered), moments, state.density, state.step)


def _sources(keep, clone, split) -> tuple[Int[np.ndarray, "m"], Bool[np.ndarray, "m"]]:
    """For every new slot the Gaussian it comes from, and whether it is new: kept ones, clones, then pairs of halves."""
    kept, cloned, halves = (np.flatnonzero(mask) for mask in (keep, clone, split))
    source = np.concatenate([kept, cloned, np.repeat(halves, 2)])
    return source, np.arange(len(source)) >= len(kept)


def _edit(gaussians: Gaussians, stats: DensityStats, source, clone, split, n_kept: int, rng: np.random.Generator) -> Gaussians:
    """The new Gaussians, unpadded: clones stepped downhill, halves drawn from the Gaussian they replace."""
    means, log_scales, quats, logits = (
        np.asarray(a)[source].copy() for a in (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits)
    )
    clones = slice(n_kept, n_kept + int(clone.sum()))
    halves = slice(n_kept + int(clone.sum()), None)
    gradient = np.asarray(stats.mean_gradient)[source[clones]]
    downhill = -gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-20)
    means[clones] += CLONE_STEP * np.exp(log_scales[clones]).min(-1, keepdims=True) * downhill
    draw = rng.normal(size=means[halves].shape) * np.exp(log_scales[halves])
    rotation = np.asarray(rotation_matrix(jnp.asarray(quats[halves])))
    means[halves] += np.einsum("nij,nj->ni", rotation, draw).astype(means.dtype)
    log_scales[halves] -= math.log(SPLIT_SHRINK)
    arrays = (means, log_scales, quats, logits, np.ones(len(source), means.dtype))
    return Gaussians(*map(jnp.asarray, arrays))


def _carry_moments(optimizer: Any, source: Int[np.ndarray, "m"], fresh: Bool[np.ndarray, "m"], only: str = "") -> Any:
    """Gather every per-Gaussian moment by source; zero the fresh ones (of one parameter, or of all)."""

    def carry(path, leaf):
        names = [str(getattr(entry, "name", "")) for entry in path]
        if "gaussians" not in names or (only and only not in names):
            return leaf
        mask = fresh.reshape((-1,) + (1,) * (leaf.ndim - 1))
        return jnp.where(mask, 0, leaf[source])

    return jax.tree_util.tree_map_with_path(carry, optimizer)
