"""Where the wave runs from a transmitter to the receiver: straight legs between facets that mirror it and edges that diffract
it, through facets it crosses.

Every chain of `images.py` gives at most one reflected path, every edge at most one diffracted path for each mirror in front of
it or behind it. The candidates that promise most are cut with all facets, and of those that pass, the strongest are kept.
Nothing here depends on the frequency or on what the facets are made of, and nothing is differentiated.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from wbgs_jax.pytree import pytree
from wbgs_jax.wave.edges import Edges
from wbgs_jax.wave.facets import CORNERS, AnyArray, Facets
from wbgs_jax.wave.images import Chains, DiffractedChains

MAX_ORDER = 3
"""Reflections and diffractions a path may have."""
INTERACTIONS = 5
"""Facets and edges a path may meet; a path that crosses more carries next to nothing."""
NEAR = 1e-3
"""Metres: a leg does not cross the facets within this distance of its ends (those that mirror it)."""
NONE, TRANSMITTED, REFLECTED, DIFFRACTED = 0, 1, 2, 3
"""What happens where a path meets a facet or an edge."""
INDICES, PLACES = 2**12, 2**17
"""A meeting's key holds the index of a facet or vertex (less than `INDICES`) and its place, in parts of a leg."""
MAX_FACETS = INDICES - MAX_ORDER
"""More cannot be told apart by their keys."""
NO_KEY = jnp.uint32(0xFFFFFFFF)
CUT_AT_ONCE = 64
"""Paths: few enough for a CPU's cache."""
THROUGH = 0.5
"""Guess of what is left of the amplitude behind a facet or a mirror, to rank paths by."""


@pytree
class Paths:
    """K paths of one transmitter."""

    points: Float[Array, "k 5 3"]
    """Transmitter, where the wave is reflected or diffracted, receiver; the receiver fills the rest. World frame, metres."""
    met: Int[Array, "k 5"]
    """Facets and edges in the order in which they are met; 0 beyond the last."""
    kind: Int[Array, "k 5"]
    """What happens there: `NONE` beyond the last, `TRANSMITTED`, `REFLECTED` or `DIFFRACTED` (`met` is an edge)."""
    leg: Int[Array, "k 5"]
    """The leg (0: the first) that arrives there."""
    alive: Bool[Array, "k"]


@pytree
class Outline:
    """The edges of all facets: a point of the plane is inside where inward . point >= offset for all four."""

    inward: Float[AnyArray, "f 4 3"]
    """Zero for an edge of no length."""
    offset: Float[AnyArray, "f 4"]


class Candidates(NamedTuple):
    """Paths before they are cut with facets."""

    points: Float[Array, "c 5 3"]
    met: Int[Array, "c 3"]
    kind: Int[Array, "c 3"]
    score: Float[Array, "c"]
    """Guess of the amplitude; 0 for no path."""


@pytree
class Search:
    """What a receiver's paths are searched in: independent of the transmitter."""

    receiver: Float[AnyArray, "3"]
    facets: Facets
    outline: Outline
    edges: Edges
    chains: tuple[Chains, ...]
    diffracted: DiffractedChains


def reflected_paths(tx: Float[Array, "3"], search: Search, tried: int, kept: int) -> Paths:
    """The `kept` strongest paths without diffraction, the line of sight among them, of at most `tried` candidates."""
    parts = [_direct(tx, search.receiver), *(_mirrored(tx, search, chain) for chain in search.chains)]
    return _select(parts, search, tried, kept, MAX_ORDER + 1)


def diffracted_paths(tx: Float[Array, "3"], search: Search, tried: int, kept: int) -> Paths:
    """The `kept` strongest paths with one diffraction and at most one reflection, of at most `tried` candidates."""
    parts = [_diffracted_only(tx, search), _diffracted_then_mirrored(tx, search), _mirrored_then_diffracted(tx, search)]
    return _select(parts, search, tried, kept, 3)


def _diffracted_only(tx, search: Search) -> Candidates:
    edge = jnp.arange(search.edges.length.size)
    point, strength = _diffracted(tx, search.receiver, edge, search.edges)
    return _candidates(tx, search.receiver, [(point, edge, DIFFRACTED)], strength, edge.size)


def _diffracted_then_mirrored(tx, search: Search) -> Candidates:
    facet, edge = jnp.moveaxis(search.diffracted.after, -1, 0)
    point, strength = _diffracted(tx, search.diffracted.after_image, edge, search.edges)
    mirror, valid = _meet(point, search.diffracted.after_image, search.facets.normal[facet], search.facets.offset[facet])
    strength = jnp.where(valid & _inside(mirror, search.outline, facet), strength * THROUGH, 0)
    return _candidates(tx, search.receiver, [(point, edge, DIFFRACTED), (mirror, facet, REFLECTED)], strength, edge.size)


def _mirrored_then_diffracted(tx, search: Search) -> Candidates:
    facet, edge = jnp.moveaxis(search.diffracted.before, -1, 0)
    normal, offset = search.facets.normal[facet], search.facets.offset[facet]
    image = tx - 2 * (normal @ tx - offset)[:, None] * normal
    point, strength = _diffracted(image, search.receiver, edge, search.edges)
    # Seen from the image, the point must lie behind the mirror: the wave runs from the transmitter to where it meets it.
    mirror, valid = _meet(point, image, normal, offset)
    strength = jnp.where(valid & _inside(mirror, search.outline, facet), strength * THROUGH, 0)
    return _candidates(tx, search.receiver, [(mirror, facet, REFLECTED), (point, edge, DIFFRACTED)], strength, edge.size)


def _candidates(tx, rx, vertices, score, count: int) -> Candidates:
    """Candidates from their vertices (points, facet or edge, kind), in order."""

    def rows(value, shape):
        return jnp.broadcast_to(value, (count, *shape))

    points = [tx, *(point for point, _, _ in vertices)]
    points += [rx] * (MAX_ORDER + 2 - len(points))
    missing = MAX_ORDER - len(vertices)
    met = jnp.stack([*(rows(met, ()) for _, met, _ in vertices), *[jnp.zeros(count, int)] * missing], 1)
    kind = jnp.array([kind for _, _, kind in vertices] + [NONE] * missing)
    return Candidates(jnp.stack([rows(p, (3,)) for p in points], 1), met, rows(kind, (MAX_ORDER,)), rows(score, ()))


def _direct(tx, rx) -> Candidates:
    return _candidates(tx, rx, [], 1 / jnp.maximum(jnp.linalg.norm(tx - rx), NEAR), 1)


def _mirrored(tx, search: Search, chains: Chains) -> Candidates:
    """One candidate a chain."""
    facets, (c, order) = search.facets, chains.facet.shape
    here, valid = jnp.broadcast_to(tx, (c, 3)), jnp.ones(c, bool)
    vertices = []
    for j in range(order):
        facet = chains.facet[:, j]
        here, meets = _meet(here, chains.image[:, j], facets.normal[facet], facets.offset[facet])
        valid &= meets & _inside(here, search.outline, facet)
        vertices.append((here, facet, REFLECTED))
    length = jnp.linalg.norm(chains.image[:, 0] - tx, axis=-1)
    return _candidates(tx, search.receiver, vertices, valid * THROUGH**order / length, c)


def _meet(start, goal, normal, offset):
    """Where the way from `start` to the image `goal` meets the mirror, and whether it does."""
    height, beyond = (jnp.sum(normal * p, -1) - offset for p in (start, goal))
    share = height / jnp.where(height == beyond, 1, height - beyond)
    valid = (height * beyond < 0) & (jnp.abs(height) > NEAR) & (jnp.abs(beyond) > NEAR)
    return start + jnp.clip(share, 0, 1)[..., None] * (goal - start), valid


def _inside(point: Float[Array, "*n 3"], outline: Outline, facet: Int[AnyArray, "*n"]) -> Bool[Array, "*n"]:
    """Whether points of a facet's plane lie inside its edges."""
    return (jnp.sum(outline.inward[facet] * point[..., None, :], -1) >= outline.offset[facet]).all(-1)


def _diffracted(source, goal, edge: Int[Array, "c"], edges: Edges):
    """Where the shortest way over a line meets it (Keller's cone), and a guess of the amplitude, 0 if it misses the edge."""
    start, along = edges.start[edge], edges.direction[edge]

    def place(p):
        t = jnp.sum((p - start) * along, -1)
        return t, jnp.linalg.norm(p - start - t[..., None] * along, axis=-1)

    (t_in, r_in), (t_out, r_out) = place(source), place(goal)
    t = t_in + (t_out - t_in) * r_in / jnp.maximum(r_in + r_out, NEAR)
    point = start + t[..., None] * along
    normal_0, normal_n = edges.normal_0[edge], edges.normal_n[edge]
    valid = (t > 0) & (t < edges.length[edge]) & (jnp.minimum(r_in, r_out) > NEAR)
    for p in (source, goal):
        valid &= jnp.maximum(jnp.sum((p - point) * normal_0, -1), jnp.sum((p - point) * normal_n, -1)) > NEAR
    before, after = (jnp.linalg.norm(p - point, axis=-1) for p in (source, goal))
    flat_in, flat_out = source - point, goal - point
    flat_in -= jnp.sum(flat_in * along, -1, keepdims=True) * along
    flat_out -= jnp.sum(flat_out * along, -1, keepdims=True) * along
    turn = jnp.sum(flat_in * flat_out, -1) / jnp.maximum(r_in * r_out, NEAR**2)
    # Keller's coefficient falls as the wave is turned away from its shadow boundary, where it goes straight on.
    strength = 1 / jnp.sqrt(jnp.maximum(before * after * (before + after), NEAR)) / jnp.sqrt(0.5 * (1 + turn) + 0.02)
    return point, jnp.where(valid, strength, 0)


def _select(parts: list[Candidates], search: Search, tried: int, kept: int, legs: int) -> Paths:
    """Cut the best candidates with all facets and keep the best of what is left."""
    candidates = Candidates(*(jnp.concatenate(leaves) for leaves in zip(*parts, strict=True)))
    score, best = jax.lax.top_k(candidates.score, min(tried, candidates.score.size))
    found = Candidates(*(leaf[best] for leaf in candidates))
    met, kind, leg, crossed = jax.lax.map(lambda c: _cut(c, search, legs), found, batch_size=CUT_AT_ONCE)
    whole = crossed + jnp.sum(found.kind != NONE, -1) <= INTERACTIONS
    score, best = jax.lax.top_k(jnp.where(whole, score * THROUGH**crossed, 0), min(kept, score.size))
    return Paths(found.points[best], met[best], kind[best], leg[best], score > 0)


def _cut(candidate: Candidates, search: Search, legs: int):
    """What one path meets, in order: (facet or edge, kind, leg), and how many facets it crosses."""
    # The place of a meeting is leg + share of the leg; a reflection or diffraction ends its leg. Place and index share an
    # integer, so that plain minima find both: sorting or arg-minima take ten times as long on a CPU.
    crossing = _crossings(candidate.points[: legs + 1], search) + jnp.arange(legs)[:, None]
    n = crossing.shape[1]
    vertex = jnp.where(candidate.kind != NONE, jnp.arange(MAX_ORDER) + 1.0, jnp.inf)
    keys = jnp.concatenate([_key(crossing, jnp.arange(n)).reshape(-1), _key(vertex, n + jnp.arange(MAX_ORDER))])
    last, found = jnp.zeros((), jnp.uint32), []
    for _ in range(INTERACTIONS):
        last = jnp.min(jnp.where(keys > last, keys, NO_KEY))
        found.append(last)
    key = jnp.stack(found)
    index, there = (key % INDICES).astype(jnp.int32), key < NO_KEY
    leg = jnp.ceil((key // INDICES) / PLACES).astype(jnp.int32) - 1
    slot = index - n
    met = jnp.where(slot < 0, index, candidate.met[slot])
    kind = jnp.where(slot < 0, TRANSMITTED, candidate.kind[slot])
    crossed = jnp.isfinite(crossing).sum()
    return jnp.where(there, met, 0), jnp.where(there, kind, NONE), jnp.where(there, leg, 0), crossed


def _key(place: Float[Array, "*n"], index: Int[Array, "_"]) -> UInt32[Array, "*n"]:
    """Place and index of a meeting as one integer that sorts by place; `NO_KEY` where the place is infinite."""
    key = (place * PLACES).astype(jnp.uint32) * INDICES + index.astype(jnp.uint32)
    return jnp.where(jnp.isfinite(place), key, NO_KEY)


def _crossings(points: Float[Array, "p 3"], search: Search) -> Float[Array, "legs f"]:
    """After which share of a leg a facet is crossed; infinite if it is not."""
    normal, outline = search.facets.normal, search.outline
    height = points @ normal.T - search.facets.offset
    start, end = height[:-1], height[1:]
    share = start / jnp.where(start == end, 1, start - end)
    length = jnp.linalg.norm(points[1:] - points[:-1], axis=-1, keepdims=True)
    near = NEAR / jnp.maximum(length, NEAR)
    inside = (share > near) & (share < 1 - near)
    for i in range(CORNERS):
        depth = points @ outline.inward[:, i].T - outline.offset[:, i]
        inside &= depth[:-1] + share * (depth[1:] - depth[:-1]) >= 0
    return jnp.where(inside, jnp.clip(share, 2 / PLACES, 1 - 2 / PLACES), jnp.inf)
