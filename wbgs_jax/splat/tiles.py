"""Lists the Gaussians that touch each tile, near to far: one sort of (tile, depth rank) keys, cut into jobs of equal length.

The limits are static so that the step compiles once. Entries that do not fit are never dropped silently: `TileJobs` carries the
required counts and an overflow flag; the caller discards the result and repeats with larger `TileLimits`.
"""

import itertools
import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from wbgs_jax._util.pytree import pytree, static
from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.radio.geometry import AZIMUTH_PERIOD
from wbgs_jax.splat.per_platform import per_platform
from wbgs_jax.splat.projection import CUT, TILE_ROOM, Splats

CHUNK = 16
"""Gaussians per job."""
NO_ENTRY = np.uint32(0xFFFFFFFF)


@dataclass(frozen=True)
class Tiling:
    """Division of an image into tiles of equal size; the last row of tiles may extend beyond it."""

    height: int
    """Pixels."""
    width: int
    """Pixels; divides the image's width and is at most twice `TILE_ROOM`."""

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1 or PAS_WIDTH % self.width or self.width > 2 * TILE_ROOM:
            raise ValueError(
                f"tiles of {self.height} x {self.width} pixels: the width must divide {PAS_WIDTH}, at most {2 * TILE_ROOM}"
            )

    @property
    def rows(self) -> int:
        """Rows of tiles."""
        return -(-PAS_HEIGHT // self.height)

    @property
    def columns(self) -> int:
        """Columns of tiles."""
        return PAS_WIDTH // self.width

    @property
    def tiles(self) -> int:
        """Tiles of an image."""
        return self.rows * self.columns

    @property
    def pixels(self) -> int:
        """Pixels of a tile."""
        return self.height * self.width

    @property
    def lanes(self) -> int:
        """GPU lanes that hold a tile's pixels: a power of two."""
        return 1 << (self.pixels - 1).bit_length()

    def offsets(self) -> tuple[Float[np.ndarray, " pixels"], Float[np.ndarray, " pixels"]]:
        """Returns the offsets (x, y) of a tile's pixels from its centre."""
        y, x = np.divmod(np.arange(self.pixels), self.width)
        return x - (self.width - 1) / 2, y - (self.height - 1) / 2

    def monomials(self) -> Float[np.ndarray, "pixels 6"]:
        """Returns 1, x, y, x^2, xy, y^2 of the offsets: the product of a footprint with them gives its moments."""
        x, y = self.offsets()
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)


CPU_TILING, GPU_TILING = Tiling(9, 8), Tiling(8, 8)
"""For a CPU, vectors of eight pixels in tiles that divide an image evenly; for a GPU, two pixels per thread of a warp."""


@dataclass(frozen=True)
class TileLimits:
    """Static capacities of the tile lists."""

    entries: int
    """(Gaussian, tile) pairs before culling."""
    jobs: int
    """Jobs of `CHUNK` Gaussians."""
    tile_height: int = CPU_TILING.height
    """Pixels; every size gives the same image, at a different speed (`device_tiling`)."""
    tile_width: int = CPU_TILING.width
    """Pixels."""

    def __post_init__(self) -> None:
        if self.entries < 1 or self.jobs < 1:
            raise ValueError(f"limits of {self.entries} entries and {self.jobs} jobs; give at least 1 of each")

    @property
    def tiling(self) -> Tiling:
        """Returns the tiles of these limits."""
        return Tiling(self.tile_height, self.tile_width)

    def scaled(self, factor: float) -> "TileLimits":
        """Returns limits with `factor` times the capacity."""
        entries, jobs = (-(-math.ceil(size * factor) // 256) * 256 for size in (self.entries, self.jobs))
        return replace(self, entries=entries, jobs=jobs)

    def grown_to(self, others: "TileLimits") -> "TileLimits":
        """Returns limits with the larger capacities of these and others, for tiles of this size."""
        return replace(self, entries=max(self.entries, others.entries), jobs=max(self.jobs, others.jobs))


@pytree
class SlotLists:
    """Positions of the Gaussians in the jobs, for deterministic sums over the slots of each Gaussian.
    Only NVIDIA GPUs use them; elsewhere the slots are zeros and are never read."""

    gaussian: Int[Array, " n"]
    """Gaussian whose entries come first, second, ...: near to far."""
    end: Int[Array, " n"]
    """Index at which its entries end and those of the next one begin."""
    slot: Int[Array, " entries"]
    """Job times `CHUNK` plus position in the job, of every entry; -1: in no job."""


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
    """True: some entries did not fit; the lists are empty and must not be used."""
    slots: SlotLists
    tiling: Tiling = static(default=CPU_TILING)


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
    n, tiling = splats.depths.shape[0], limits.tiling
    if not n:
        raise ValueError("there are no Gaussians to be listed; give at least one")
    most = (2**32 - 2) // tiling.tiles
    if n > most:
        raise ValueError(f"{n} Gaussians are too many for a 32-bit (tile, depth) key; the most is {most}")
    splats = lax.stop_gradient(splats)
    order = _near_to_far(splats.depths)
    means, conics, radii = splats.means2d[order], splats.conics[order], splats.radii[order]
    boxes = _tile_boxes(means, radii, tiling)
    keys, ends = _keys(means, conics, boxes, limits)
    listed = jnp.sort(keys)
    (starts,) = _places(listed, jnp.arange(tiling.tiles + 1, dtype=jnp.uint32) * jnp.uint32(n))
    ranked = order[jnp.minimum(listed % jnp.uint32(n), n - 1).astype(jnp.int32)]
    gaussian, tile, first, count = _cut_into_jobs(ranked, starts, limits)
    (slot,) = _slots(keys, listed, starts, first, order)
    required_jobs = first[-1] + count[-1]
    overflow = (ends[-1] > limits.entries) | (required_jobs > limits.jobs)
    # Overflowed lists are emptied: a GPU would read and write past their end.
    first, count = (jnp.where(overflow, 0, own) for own in (first, count))
    slots = SlotLists(order, ends, jnp.where(overflow, -1, slot))
    return TileJobs(gaussian, tile, first, count, ends[-1], required_jobs, overflow, slots, tiling)


def _near_to_far(depths: Float[Array, " n"]) -> Int[Array, " n"]:
    """Returns the Gaussians in the order of their distance. It is never negative, so its bits, read as an integer, have the
    same order and sort several times faster than floats."""
    bits = lax.bitcast_convert_type(depths, {4: jnp.uint32, 8: jnp.uint64}[depths.dtype.itemsize])
    return lax.sort((bits, jnp.arange(len(depths), dtype=jnp.int32)), num_keys=1)[1]


def _tile_range(
    low: Float[Array, " n"], high: Float[Array, " n"], size: int, tiles: int
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """Returns the first tile and number of tiles that hold pixels in low..high."""
    first = jnp.clip(jnp.floor(jnp.ceil(low) / size), 0, tiles)
    last = jnp.clip(jnp.floor(jnp.floor(high) / size), -1, tiles - 1)
    return first.astype(jnp.int32), jnp.maximum(last - first + 1, 0).astype(jnp.int32)


def _tile_boxes(means: Float[Array, "n 2"], radii: Float[Array, "n 2"], tiling: Tiling) -> _Boxes:
    x, y = means[:, 0], means[:, 1]
    row0, rows = _tile_range(y - radii[:, 1], y + radii[:, 1], tiling.height, tiling.rows)
    column0, columns = _tile_range(x - radii[:, 0], x + radii[:, 0], tiling.width, tiling.columns)
    alias = jnp.where(x < AZIMUTH_PERIOD / 2, AZIMUTH_PERIOD, -AZIMUTH_PERIOD).astype(x.dtype)
    alias_column0, alias_columns = _tile_range(x + alias - radii[:, 0], x + alias + radii[:, 0], tiling.width, tiling.columns)
    rows = jnp.where(radii[:, 0] > 0, rows, 0)
    return _Boxes(row0, rows, column0, columns, alias, alias_column0, alias_columns)


def _keys(
    means: Float[Array, "n 2"], conics: Float[Array, "n 3"], boxes: _Boxes, limits: TileLimits
) -> tuple[UInt32[Array, " entries"], Int[Array, " n"]]:
    """Returns the keys tile * n + depth rank of all (splat, tile) pairs, splat by splat, and the end of every splat's keys;
    `NO_ENTRY` where footprint and tile do not overlap and in unused entries."""
    n, entries, tiling = means.shape[0], limits.entries, limits.tiling
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
    q = _nearest_mahalanobis2(column * tiling.width - centre_x, row * tiling.height - means[rank, 1], conics[rank], tiling)
    # The margin covers rounding: an entry kept wrongly costs time, one dropped wrongly would be an error.
    keep = (entry < end[-1]) & (q < CUT * 1.001)
    tile = (row * tiling.columns + column).astype(jnp.uint32)
    return jnp.where(keep, tile * jnp.uint32(n) + rank.astype(jnp.uint32), NO_ENTRY), end


def _nearest_mahalanobis2(
    left: Float[Array, " e"], top: Float[Array, " e"], conic: Float[Array, "e 3"], tiling: Tiling
) -> Float[Array, " e"]:
    """Returns the smallest q over a tile (a continuous rectangle), given the offset of its first pixel from the splat's
    centre."""
    right, bottom = left + tiling.width - 1, top + tiling.height - 1
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
    ranked: Int[Array, " entries"], starts: Int[Array, " tiles_1"], limits: TileLimits
) -> tuple[Int[Array, "jobs chunk"], Int[Array, " jobs"], Int[Array, " tiles"], Int[Array, " tiles"]]:
    """Returns the Gaussians and the tile of every job, and the first job of every tile and its number of jobs."""
    count = -(-(starts[1:] - starts[:-1]) // CHUNK)
    end = jnp.cumsum(count)
    job = jnp.arange(limits.jobs, dtype=jnp.int32)
    tile = jnp.repeat(jnp.arange(limits.tiling.tiles, dtype=jnp.int32), count, total_repeat_length=limits.jobs)
    index_in_tile = job - (end - count)[tile]
    entry = starts[tile][:, None] + index_in_tile[:, None] * CHUNK + jnp.arange(CHUNK)
    live = (job < end[-1])[:, None] & (entry < starts[tile + 1][:, None])
    return jnp.where(live, ranked[jnp.minimum(entry, ranked.shape[0] - 1)], -1), tile, end - count, count


def _slots_of_entries(keys: Any, listed: Any, starts: Any, first: Any, order: Any) -> list[Any]:
    """Returns the slots of `SlotLists` by looking up each key in the sorted list, where it occurs once."""
    (place,) = _places_unrolled(listed, keys)
    tile = jnp.minimum(keys // jnp.uint32(len(order)), len(first) - 1).astype(jnp.int32)
    return [jnp.where(keys < NO_ENTRY, first[tile] * CHUNK + place - starts[tile], -1)]


def _no_slots(keys: Any, *_: Any) -> list[Any]:
    return [jnp.zeros(keys.shape, jnp.int32)]


def _places_in_a_loop(listed: Any, keys: Any) -> list[Any]:
    """Returns the insertion points of keys in a sorted list."""
    return [jnp.searchsorted(listed, keys).astype(jnp.int32)]


def _places_unrolled(listed: Any, keys: Any) -> list[Any]:
    """Returns the same with a single kernel; on a GPU, each of the loop's roughly 20 steps would wait for the host."""
    return [jnp.searchsorted(listed, keys, method="scan_unrolled").astype(jnp.int32)]


_places = per_platform(
    "splat_places", lambda _, keys: [jax.ShapeDtypeStruct(keys.shape, jnp.int32)], _places_in_a_loop, cuda=_places_unrolled
)
_slots = per_platform(
    "splat_slots", lambda keys, *_: [jax.ShapeDtypeStruct(keys.shape, jnp.int32)], _no_slots, cuda=_slots_of_entries
)


def device_tiling() -> Tiling:
    """Returns the fastest tile size on the default device."""
    return CPU_TILING if jax.default_backend() == "cpu" else GPU_TILING


def fit_limits(required_entries: int, required_jobs: int, slack: float = 1.25, tiling: Tiling | None = None) -> TileLimits:
    """Returns limits from geometric buckets that hold the counts times `slack`, so that small changes do not recompile.

    The counts are those of `tiling`, by default `device_tiling()`.
    """

    def bucket(count: int, smallest: int) -> int:
        steps = math.ceil(math.log2(max(count * slack, smallest) / smallest) * 2)
        return -(-int(smallest * 2 ** (steps / 2)) // 256) * 256

    tiling = tiling or device_tiling()
    return TileLimits(bucket(required_entries, 4096), bucket(required_jobs, 1024), tiling.height, tiling.width)


def slots_for(gaussians: int) -> int:
    """Returns a number of slots that holds the Gaussians; sizes grow by 2^(1/4) from 64, so that few changes recompile."""
    sizes = (-(-int(64 * 2 ** (step / 4)) // 16) * 16 for step in itertools.count())
    return next(size for size in sizes if size >= gaussians)


def grown_slots(slots: int, gaussians: int, most: int) -> int:
    """Returns the number of slots for a grown number of Gaussians: unchanged if it suffices, otherwise doubled, limited by the
    maximum that may ever be needed (`most`). A field compiles once for each doubling."""
    if gaussians <= slots:
        return slots
    return max(min(2 * slots, -(-most // 16) * 16), slots_for(gaussians) if gaussians > min(2 * slots, most) else 0)
