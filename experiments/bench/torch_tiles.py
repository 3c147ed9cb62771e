"""The same image in PyTorch, for comparison: tile lists sorted by depth, autograd for the backward pass.

Three ways to blend the lists, all of the image that `wbgs_jax.splat.render_dense` defines:

* `tiles`: tile by tile, vectorised over its Gaussians, pixels and queries: what one writes first. Its cost is the number of
  operations, so its tiles are large;
* `groups`: many tiles at once, their lists padded to equal length; tiles of similar length go together;
* `slots`: the k-th Gaussian of every tile at once, for k = 0, 1, ...; no padding, and no stored product of factors.

Projection is not part of it: the splats are given, and their gradients are taken.
"""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.radio.geometry import AZIMUTH_PERIOD
from wbgs_jax.splat import Splats
from wbgs_jax.splat.projection import CUT, GAIN

GROUP_ELEMENTS = 2**19
"""(tile, query, Gaussian, pixel) values blended at a time by `groups`: more leave the cache, fewer cost calls."""


class TorchSplats(NamedTuple):
    """`wbgs_jax.splat.Splats` as tensors."""

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    radii: Tensor


class TileLists(NamedTuple):
    """Every tile's Gaussians, near to far."""

    gaussian: Tensor
    """Gaussian index of all entries, tile after tile."""
    length: Tensor
    """Entries of a tile."""
    height: int
    width: int


def to_torch(splats: Splats) -> TorchSplats:
    """Copies as tensors."""
    return TorchSplats(*(torch.from_numpy(np.array(getattr(splats, name))) for name in TorchSplats._fields))


def footprint(dx: Tensor, dy: Tensor, conic: Tensor) -> Tensor:
    """G of pixel offsets from the centre; the last axis of `conic` is (xx, xy, yy)."""
    q = conic[..., 0:1] * dx * dx + conic[..., 2:3] * dy * dy + 2 * conic[..., 1:2] * dx * dy
    return torch.clamp(torch.exp(-0.5 * q) - math.exp(-CUT / 2), min=0) * GAIN


def nearest_mahalanobis2(left: Tensor, top: Tensor, conic: Tensor, height: int, width: int) -> Tensor:
    """Smallest q in a rectangle of pixels, given the offset of its first one from the centre."""
    right, bottom = left + width - 1, top + height - 1
    a, b, c = conic.unbind(-1)

    def q(x: Tensor, y: Tensor) -> Tensor:
        return a * x * x + 2 * b * x * y + c * y * y

    columns = [q(x, (-b * x / c).clamp(min=top, max=bottom)) for x in (left, right)]
    rows = [q((-b * y / a).clamp(min=left, max=right), y) for y in (top, bottom)]
    inside = (left <= 0) & (right >= 0) & (top <= 0) & (bottom >= 0)
    return torch.where(inside, 0, torch.stack(columns + rows).amin(0))


@torch.no_grad()
def tile_lists(splats: TorchSplats, height: int, width: int) -> TileLists:
    """(Gaussian, tile) pairs that overlap, sorted by tile and depth."""
    order = torch.argsort(splats.depths)
    order = order[torch.isfinite(splats.depths[order])]
    means, conics, radii = splats.means2d[order], splats.conics[order], splats.radii[order]
    n, rows, columns = len(order), PAS_HEIGHT // height, PAS_WIDTH // width
    keys = []
    for shift in (-AZIMUTH_PERIOD, 0, AZIMUTH_PERIOD):
        centre = means + torch.tensor([shift, 0], dtype=means.dtype)
        low, high = (centre - radii).ceil(), (centre + radii).floor()
        column0, row0 = (low[:, i].div(size).floor().clamp(min=0).long() for i, size in ((0, width), (1, height)))
        column1 = high[:, 0].div(width).floor().clamp(max=columns - 1).long()
        row1 = high[:, 1].div(height).floor().clamp(max=rows - 1).long()
        wide, tall = (column1 - column0 + 1).clamp(min=0), (row1 - row0 + 1).clamp(min=0)
        count = wide * tall
        rank = torch.repeat_interleave(torch.arange(n), count)
        local = torch.arange(len(rank)) - (count.cumsum(0) - count)[rank]
        row, column = row0[rank] + local // wide[rank], column0[rank] + local % wide[rank]
        left, top = column * width - centre[rank, 0], row * height - centre[rank, 1]
        keep = nearest_mahalanobis2(left, top, conics[rank], height, width) < CUT * 1.001
        keys.append(((row * columns + column) * n + rank)[keep])
    key = torch.cat(keys).sort().values
    return TileLists(order[key % n], torch.bincount(key // n, minlength=rows * columns), height, width)


def _pixels(lists: TileLists, tile: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """x and y of every pixel of some tiles, (tiles, pixels) each."""
    row, column = torch.meshgrid(torch.arange(lists.height), torch.arange(lists.width), indexing="ij")
    columns = PAS_WIDTH // lists.width
    x, y = tile % columns * lists.width, tile // columns * lists.height
    return (x[:, None] + column.reshape(-1)).to(dtype), (y[:, None] + row.reshape(-1)).to(dtype)


def _wrap(dx: Tensor) -> Tensor:
    """The nearest alias of the column offsets of a tile, decided at its middle."""
    middle = 0.5 * (dx[..., :1] + dx[..., -1:]).detach()
    return dx - AZIMUTH_PERIOD * torch.round(middle / AZIMUTH_PERIOD)


def _to_image(tiles: Tensor, lists: TileLists) -> Tensor:
    rows, columns, b = PAS_HEIGHT // lists.height, PAS_WIDTH // lists.width, tiles.shape[1]
    grid = tiles.reshape(rows, columns, b, lists.height, lists.width)
    return grid.permute(2, 0, 3, 1, 4).reshape(b, PAS_HEIGHT, PAS_WIDTH)


def _groups(length: list[int], elements: int, per_entry: int) -> Iterator[tuple[int, int, int]]:
    """(first, end, longest list) of groups of tiles; `length` descends."""
    first = 0
    while first < len(length) and length[first]:
        end = min(first + max(1, elements // (length[first] * per_entry)), len(length))
        yield first, end, length[first]
        first = end


def blend_groups(splats: TorchSplats, attenuation: Tensor, signal: Tensor, lists: TileLists, elements: int) -> Tensor:
    """Groups of tiles with at most `elements` values each, or of one tile."""
    n, b = attenuation.shape
    dtype, pixels = attenuation.dtype, lists.height * lists.width
    parameters = torch.cat([splats.means2d, splats.conics, attenuation, signal], 1)
    parameters = torch.cat([parameters, parameters.new_zeros(1, parameters.shape[1])])  # row n: an empty slot
    first_entry = lists.length.cumsum(0) - lists.length
    tiles = torch.argsort(lists.length, descending=True)
    images = []
    for first, end, longest in _groups(lists.length[tiles].tolist(), elements, pixels * b):
        tile, slot = tiles[first:end], torch.arange(longest)
        entry = (first_entry[tile, None] + slot).clamp(max=len(lists.gaussian) - 1)
        index = torch.where(slot < lists.length[tile, None], lists.gaussian[entry], n)
        own = parameters.index_select(0, index.reshape(-1)).reshape(*index.shape, -1)
        x, y = (c[:, None] for c in _pixels(lists, tile, dtype))
        g = footprint(_wrap(x - own[..., :1]), y - own[..., 1:2], own[..., 2:5])
        alpha = own[..., 5 : 5 + b].transpose(1, 2)[..., None] * g[:, None]
        log_surviving = torch.log1p(-alpha)  # their sums run faster than products, forward and backward
        transmittance = torch.exp(log_surviving.cumsum(2) - log_surviving)
        images.append((own[..., 5 + b :].transpose(1, 2)[..., None] * alpha * transmittance).sum(2))
    empty = len(tiles) - sum(map(len, images))
    images.append(attenuation.new_zeros(empty, b, pixels))
    return _to_image(torch.cat(images)[torch.argsort(tiles)], lists)


def blend_slots(splats: TorchSplats, attenuation: Tensor, signal: Tensor, lists: TileLists) -> Tensor:
    """Slot by slot; the tiles are sorted by descending length, so that those that still have a Gaussian come first."""
    length, b = lists.length, attenuation.shape[1]
    tiles = torch.argsort(length, descending=True)
    place = torch.argsort(tiles)
    tile = torch.repeat_interleave(torch.arange(len(length)), length)
    slot = torch.arange(len(tile)) - (length.cumsum(0) - length)[tile]
    by_slot = torch.argsort(slot * len(length) + place[tile])
    index, tile, live = lists.gaussian[by_slot], tile[by_slot], torch.bincount(slot).tolist()
    own = [a.index_select(0, index) for a in (splats.means2d, splats.conics, attenuation[..., None], signal[..., None])]
    x, y = _pixels(lists, tile, attenuation.dtype)
    g = footprint(_wrap(x - own[0][:, :1]), y - own[0][:, 1:], own[1])[:, None]
    image = attenuation.new_zeros(len(length), b, lists.height * lists.width)
    transmittance, finished = image + 1, []
    for g_k, attenuation_k, signal_k in zip(*(a.split(live) for a in (g, own[2], own[3])), strict=True):
        finished.append(image[len(g_k) :])
        image, transmittance = image[: len(g_k)], transmittance[: len(g_k)]
        weight = attenuation_k * g_k * transmittance
        image, transmittance = torch.addcmul(image, signal_k, weight), transmittance - weight
    return _to_image(torch.cat([image, *reversed(finished)])[place], lists)


def render_tiles(splats: TorchSplats, attenuation: Tensor, signal: Tensor) -> Tensor:
    """PAS of B queries (b, 90, 360): tile by tile."""
    return blend_groups(splats, attenuation, signal, tile_lists(splats, 18, 20), 1)


def render_groups(splats: TorchSplats, attenuation: Tensor, signal: Tensor) -> Tensor:
    """PAS of B queries: groups of tiles."""
    return blend_groups(splats, attenuation, signal, tile_lists(splats, 9, 8), GROUP_ELEMENTS)


def render_slots(splats: TorchSplats, attenuation: Tensor, signal: Tensor) -> Tensor:
    """PAS of B queries: slot by slot."""
    return blend_slots(splats, attenuation, signal, tile_lists(splats, 9, 8))


FORMS: dict[str, Callable[[TorchSplats, Tensor, Tensor], Tensor]] = {
    "tiles": render_tiles,
    "groups": render_groups,
    "slots": render_slots,
}
Gradients = tuple[Tensor, ...]


def gradients(form: str, splats: TorchSplats, attenuation: Tensor, signal: Tensor, cotangent: Tensor) -> Gradients:
    """Forward and backward, tile lists included: d means2d, d conics, d attenuation, d signal of sum(image * cotangent)."""
    leaves = [a.detach().requires_grad_() for a in (splats.means2d, splats.conics, attenuation, signal)]
    image = FORMS[form](splats._replace(means2d=leaves[0], conics=leaves[1]), leaves[2], leaves[3])
    return torch.autograd.grad(torch.sum(image * cotangent), leaves)
