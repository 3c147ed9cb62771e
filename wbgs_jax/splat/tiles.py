"""Which Gaussians touch which tile, near to far: one sort of (tile, depth rank) keys, cut into jobs of equal length.

The limits are static so that the step compiles once. What does not fit is never dropped silently: `TileJobs` carries the
required counts and an overflow flag, the caller throws the result away and repeats with larger `TileLimits`.
"""

import itertools
import math
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from wbgs_jax._util.pytree import pytree
from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.radio.geometry import AZIMUTH_PERIOD
from wbgs_jax.splat.footprint import CUT
from wbgs_jax.splat.project import Splats

TILE_HEIGHT, TILE_WIDTH = 9, 8
TILE_ROWS, TILE_COLUMNS = PAS_HEIGHT // TILE_HEIGHT, PAS_WIDTH // TILE_WIDTH
N_TILES = TILE_ROWS * TILE_COLUMNS
CHUNK = 16
"""Gaussians in a job."""
NO_ENTRY = np.uint32(0xFFFFFFFF)


@dataclass(frozen=True)
class TileLimits:
    """Static sizes of the tile lists: what a plan may require of them."""

    entries: int
    """(Gaussian, tile) pairs before culling."""
    jobs: int
    """Jobs of `CHUNK` Gaussians."""


@pytree
class TileJobs:
    """Every tile's Gaussians, near to far, cut into jobs of `CHUNK`."""

    gaussian: Int[Array, "jobs chunk"]
    """Gaussian index; -1 in empty slots."""
    tile: Int[Array, " jobs"]
    """Tile index, row-major."""
    first: Int[Array, " tiles"]
    """First job of a tile; its jobs are consecutive."""
    count: Int[Array, " tiles"]
    """Number of jobs of a tile."""
    required_entries: Int[Array, ""]
    required_jobs: Int[Array, ""]
    overflow: Bool[Array, ""]
    """True: some entries did not fit and the lists must not be used."""


@dataclass(frozen=True)
class _Boxes:
    """Tile rectangles of depth-sorted splats. Columns come in two runs: the splat's own and that of its azimuth alias."""

    row0: Int[Array, " n"]
    rows: Int[Array, " n"]
    column0: Int[Array, " n"]
    columns: Int[Array, " n"]
    alias: Float[Array, " n"]
    """Shift of the alias in pixels: + or - one period."""
    alias_column0: Int[Array, " n"]
    alias_columns: Int[Array, " n"]


@partial(jax.jit, static_argnames="limits")
def build_tile_jobs(splats: Splats, limits: TileLimits) -> TileJobs:
    """Returns splats sorted into tiles. Works under jit; carries no gradient."""
    n = splats.depths.shape[0]
    if n * N_TILES >= 2**32 - 1:
        raise ValueError(f"{n} Gaussians are too many for a 32-bit (tile, depth) key; the most is {(2**32 - 2) // N_TILES}")
    splats = jax.lax.stop_gradient(splats)
    order = jnp.argsort(splats.depths).astype(jnp.int32)
    means, conics, radii = splats.means2d[order], splats.conics[order], splats.radii[order]
    boxes = _tile_boxes(means, radii)
    keys, required_entries = _sorted_keys(means, conics, boxes, limits.entries)
    starts = jnp.searchsorted(keys, jnp.arange(N_TILES + 1, dtype=jnp.uint32) * jnp.uint32(n)).astype(jnp.int32)
    ranked = order[jnp.minimum(keys % jnp.uint32(n), n - 1).astype(jnp.int32)]
    return _cut_into_jobs(ranked, starts, required_entries, limits)


def _tile_range(
    low: Float[Array, " n"], high: Float[Array, " n"], size: int, tiles: int
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """Returns the first tile and number of tiles that hold pixels in low..high."""
    first = jnp.clip(jnp.floor(jnp.ceil(low) / size), 0, tiles)
    last = jnp.clip(jnp.floor(jnp.floor(high) / size), -1, tiles - 1)
    return first.astype(jnp.int32), jnp.maximum(last - first + 1, 0).astype(jnp.int32)


def _tile_boxes(means: Float[Array, "n 2"], radii: Float[Array, "n 2"]) -> _Boxes:
    x, y = means[:, 0], means[:, 1]
    row0, rows = _tile_range(y - radii[:, 1], y + radii[:, 1], TILE_HEIGHT, TILE_ROWS)
    column0, columns = _tile_range(x - radii[:, 0], x + radii[:, 0], TILE_WIDTH, TILE_COLUMNS)
    alias = jnp.where(x < AZIMUTH_PERIOD / 2, AZIMUTH_PERIOD, -AZIMUTH_PERIOD).astype(x.dtype)
    alias_column0, alias_columns = _tile_range(x + alias - radii[:, 0], x + alias + radii[:, 0], TILE_WIDTH, TILE_COLUMNS)
    rows = jnp.where(radii[:, 0] > 0, rows, 0)
    return _Boxes(row0, rows, column0, columns, alias, alias_column0, alias_columns)


def _sorted_keys(
    means: Float[Array, "n 2"], conics: Float[Array, "n 3"], boxes: _Boxes, entries: int
) -> tuple[UInt32[Array, " entries"], Int[Array, ""]]:
    """Returns sorted keys tile * n + depth rank of all (splat, tile) pairs whose footprints overlap; `NO_ENTRY` in the rest."""
    n = means.shape[0]
    width = boxes.columns + boxes.alias_columns
    count = width * boxes.rows
    end = jnp.cumsum(count)
    entry = jnp.arange(entries, dtype=jnp.int32)
    rank = jnp.repeat(jnp.arange(n, dtype=jnp.int32), count, total_repeat_length=entries)
    local = entry - (end - count)[rank]
    row = boxes.row0[rank] + local // jnp.maximum(width[rank], 1)
    step = local % jnp.maximum(width[rank], 1)
    is_alias = step >= boxes.columns[rank]
    column = jnp.where(is_alias, boxes.alias_column0[rank] + step - boxes.columns[rank], boxes.column0[rank] + step)
    centre_x = means[rank, 0] + jnp.where(is_alias, boxes.alias[rank], 0)
    q = _nearest_mahalanobis2(column * TILE_WIDTH - centre_x, row * TILE_HEIGHT - means[rank, 1], conics[rank])
    # The margin covers rounding: a wrongly kept entry costs time, a wrongly dropped one would be an error.
    keep = (entry < end[-1]) & (q < CUT * 1.001)
    tile = (row * TILE_COLUMNS + column).astype(jnp.uint32)
    return jnp.sort(jnp.where(keep, tile * jnp.uint32(n) + rank.astype(jnp.uint32), NO_ENTRY)), end[-1]


def _nearest_mahalanobis2(left: Float[Array, " e"], top: Float[Array, " e"], conic: Float[Array, "e 3"]) -> Float[Array, " e"]:
    """Returns the smallest q over a tile's pixels (a continuous rectangle), given the offset of the first from the centre."""
    right, bottom = left + TILE_WIDTH - 1, top + TILE_HEIGHT - 1
    a, b, c = jnp.moveaxis(jnp.where(conic[:, :1] > 0, conic, jnp.array([1, 0, 1], conic.dtype)), -1, 0)

    def on_column(x):
        y = jnp.clip(-b * x / c, top, bottom)
        return a * x * x + 2 * b * x * y + c * y * y

    def on_row(y):
        x = jnp.clip(-b * y / a, left, right)
        return a * x * x + 2 * b * x * y + c * y * y

    inside = (left <= 0) & (right >= 0) & (top <= 0) & (bottom >= 0)
    edges = jnp.minimum(jnp.minimum(on_column(left), on_column(right)), jnp.minimum(on_row(top), on_row(bottom)))
    return jnp.where(inside, 0, edges)


def _cut_into_jobs(
    ranked: Int[Array, " entries"], starts: Int[Array, " tiles_1"], required_entries: Int[Array, ""], limits: TileLimits
) -> TileJobs:
    count = -(-(starts[1:] - starts[:-1]) // CHUNK)
    end = jnp.cumsum(count)
    job = jnp.arange(limits.jobs, dtype=jnp.int32)
    tile = jnp.repeat(jnp.arange(N_TILES, dtype=jnp.int32), count, total_repeat_length=limits.jobs)
    index_in_tile = job - (end - count)[tile]
    entry = starts[tile][:, None] + index_in_tile[:, None] * CHUNK + jnp.arange(CHUNK)
    live = (job < end[-1])[:, None] & (entry < starts[tile + 1][:, None])
    gaussian = jnp.where(live, ranked[jnp.minimum(entry, ranked.shape[0] - 1)], -1)
    overflow = (required_entries > limits.entries) | (end[-1] > limits.jobs)
    return TileJobs(gaussian, tile, end - count, count, required_entries, end[-1], overflow)


def fit_limits(required_entries: int, required_jobs: int, slack: float = 1.25) -> TileLimits:
    """Returns limits from geometric buckets that hold the counts with some slack, so that small changes do not recompile."""

    def bucket(count: int, smallest: int) -> int:
        steps = math.ceil(math.log2(max(count * slack, smallest) / smallest) * 2)
        return -(-int(smallest * 2 ** (steps / 2)) // 256) * 256

    return TileLimits(entries=bucket(required_entries, 4096), jobs=bucket(required_jobs, 1024))


def slots_for(gaussians: int) -> int:
    """Returns the number of slots that hold so many Gaussians; it grows by 2^(1/4) from 64, so that few changes recompile."""
    sizes = (-(-int(64 * 2 ** (step / 4)) // 16) * 16 for step in itertools.count())
    return next(size for size in sizes if size >= gaussians)
