"""What legs cross, against double precision and division, one facet at a time."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import box, facets_of, room, search_of, trace

from wbgs_jax._util.pytree import to_device
from wbgs_jax.mesh.facets import Facets, half_planes_of
from wbgs_jax.propagation import paths as paths_module
from wbgs_jax.propagation.mechanisms import trace_paths
from wbgs_jax.propagation.occlusion import (
    FEW_BLOCKS,
    LEAF,
    NEAR,
    WORD,
    Crossings,
    crossed,
    crossing_share,
    crossings,
    first_of,
    hierarchy_of,
    listed,
    planes_of,
)
from wbgs_jax.propagation.paths import NONE, TRANSMITTED


def random_facets(rng, count) -> Facets:
    """Triangles and parallelograms anywhere."""
    origin, a, b = rng.uniform(-1, 1, (3, count, 3))
    quads = np.stack([origin, origin + a, origin + a + b, origin + b], 1)
    quads[::2, 3] = quads[::2, 2]  # a triangle repeats its last corner
    normal = np.cross(a, b)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    number = np.arange(count)
    return Facets(quads, normal, np.sum(normal * origin, -1), number, number, number)


def shares(facets, start, end):
    """After which share of a leg it crosses every facet, infinite where it does not, and how many metres decide that."""
    outline = half_planes_of(facets)
    here, there = (facets.normal @ p - facets.offset for p in (start, end))
    share = here / (here - there)
    point = start + share[:, None] * (end - start)
    depth = np.einsum("fed,fd->fe", outline.inward, point) - outline.offset
    ends = np.minimum(share, 1 - share) * np.linalg.norm(end - start) - NEAR
    inside = (depth >= 0).all(-1) & (ends > 0)
    margin = np.minimum(np.abs(np.where(outline.inward.any(-1), depth, np.inf)).min(-1), np.abs(ends))
    return np.where(inside, share, np.inf), margin


def test_bits_say_what_division_says(rng):
    facets = random_facets(rng, 77)
    points = rng.uniform(-2, 2, (60, 3))
    words = np.asarray(crossed(jnp.asarray(points, jnp.float32), jnp.asarray(planes_of(facets), jnp.float32)))
    assert words.shape == (59, 3) and words.dtype == np.uint32
    bits = (words[:, :, None] >> np.arange(WORD, dtype=np.uint32) & 1).reshape(len(words), -1).astype(bool)
    assert not bits[:, 77:].any()
    met = 0
    for leg, (start, end) in enumerate(itertools.pairwise(points)):
        share, margin = shares(facets, start, end)
        clear = margin > 1e-5
        np.testing.assert_array_equal(bits[leg, :77][clear], np.isfinite(share)[clear])
        met += np.isfinite(share).sum()
        for facet in np.flatnonzero(np.isfinite(share)):
            args = (jnp.asarray(x, jnp.float32) for x in (start, end))
            found = crossing_share(*args, jnp.int32(facet), facets)
            np.testing.assert_allclose(found, share[facet], atol=1e-4)
    assert met > 50


def test_a_facet_at_the_end_of_a_leg_is_not_crossed():
    facets = facets_of(box((0, 0, 0), (1, 1, 1)))
    planes = jnp.asarray(planes_of(facets), jnp.float32)
    for short, expected in ((0.5 * NEAR, 0), (2 * NEAR, 1)):
        legs = jnp.array([[0.5, 0.4, 3.0], [0.5, 0.4, 1 - short]], jnp.float32)
        assert np.bitwise_count(crossed(legs, planes)).sum(-1).tolist() == [expected]


def test_the_first_bits_come_in_order(rng):
    bits = rng.random(4 * WORD) < 0.1
    bits[[0, 31, 32, 127]] = True
    words = np.packbits(bits, bitorder="little").view(np.uint32)
    expected = np.flatnonzero(bits)
    for most in (1, 3, 64):
        number, there = first_of(jnp.asarray(words), most)
        assert there.tolist() == [True] * min(most, len(expected)) + [False] * (most - len(expected))
        np.testing.assert_array_equal(np.asarray(number)[np.asarray(there)], expected[:most])
        assert not np.asarray(number)[~np.asarray(there)].any()


def crossings_compared(rng) -> int:
    """Compares every path of a furnished room, leg by leg, and says how many crossings that were."""
    parts = [*room(), *(box(low, low + rng.uniform(0.3, 0.9, 3)) for low in rng.uniform(0.3, (4.5, 2.5, 1.2), (12, 3)))]
    tx, rx = rng.uniform(0.2, (5.5, 3.5, 2.4), (2, 3))
    facets = facets_of(*parts)
    met = 0
    for paths in trace(search_of(parts, rx), tx).sets:
        paths = jax.tree.map(np.asarray, paths)
        for k in np.flatnonzero(paths.alive):
            crossings, clear = [], True
            for leg, (start, end) in enumerate(itertools.pairwise(paths.points[k])):
                if np.linalg.norm(end - start) > 0:
                    share, margin = shares(facets, start.astype(float), end.astype(float))
                    clear &= bool((margin > 1e-4).all())
                    crossings += [(leg + share[f], f) for f in np.flatnonzero(np.isfinite(share))]
            places = np.sort([place for place, _ in crossings])
            if not clear or (np.diff(places) < 1e-4).any():
                continue  # rounding decides
            through = paths.interaction_type[k] == TRANSMITTED
            assert paths.interaction_facet[k][through].tolist() == [f for _, f in sorted(crossings)]
            leg = paths.interaction_segment[k][paths.interaction_type[k] != NONE]
            assert (np.diff(leg) >= 0).all() and paths.interaction_segment[k][through].tolist() == [int(p) for p in places]
            met += len(crossings)
    return met


@pytest.mark.heavy
def test_paths_cross_what_brute_force_finds_in_that_order(rng):
    """One room alone may have hardly anything in the way."""
    met = 0
    for _ in range(5):
        met += crossings_compared(rng)
        if met > 20:
            return
    raise AssertionError(f"{met} crossings in five rooms")


def brute_force(points, living, hierarchy, most, near=NEAR):
    """What `crossings` returns, from tests of all segments with all facets."""
    planes = hierarchy.planes.reshape(5, 4, -1)
    words = jax.lax.map(lambda path: crossed(path, planes, near), jax.lax.stop_gradient(points))
    words = jnp.where(living[:, None, None], words, 0).reshape(len(points), -1)
    number, there = jax.vmap(lambda bits: first_of(bits, most))(words)  # of facets, in the order of leaves
    bit = jnp.where(there, jnp.left_shift(jnp.uint32(1), (number % LEAF).astype(jnp.uint32)), 0)
    return Crossings(jnp.bitwise_count(words).astype(jnp.int32).sum(-1), number // LEAF, bit)


@pytest.mark.heavy
def test_boxes_hide_no_crossing(rng):
    """Facets of all sizes, and segments of all lengths: with one level of boxes and with two, all are found."""
    most = 64
    for count in (1, 300, (FEW_BLOCKS + 1) * LEAF * WORD):
        facets, scale = random_facets(rng, count), rng.uniform(0.001, 1, count)
        facets = dataclasses.replace(facets, corners=facets.corners * scale[:, None, None], offset=facets.offset * scale)
        hierarchy = to_device(hierarchy_of(facets))
        points = jnp.asarray(rng.uniform(-1, 1, (40, 4, 3)) * rng.uniform(0.01, 1, (40, 1, 1)), jnp.float32)
        points, living = points.at[:, 3].set(points[:, 2]), jnp.arange(40) % 5 > 0  # the last segment has no length
        found, expected = (find(points, living, hierarchy, most) for find in (crossings, brute_force))
        np.testing.assert_array_equal(found.total, expected.total)
        there = (np.arange(most) < np.asarray(expected.total)[:, None]) & (np.asarray(expected.total) <= most)[:, None]
        assert count == 1 or there.sum() > 50
        for one, other in zip(listed(found, hierarchy), listed(expected, hierarchy), strict=True):
            np.testing.assert_array_equal(np.where(there, one, 0), np.where(there, other, 0))


@pytest.mark.heavy
def test_paths_and_gradients_are_those_of_brute_force(rng, monkeypatch):
    """All sequences and pairs are scored, and all segments tested with all facets."""
    parts = [*room(), *(box(low, low + rng.uniform(0.02, 0.4, 3)) for low in rng.uniform(0.1, (5.5, 3.5, 2.5), (360, 3)))]
    tree = search_of(parts, rng.uniform(0.5, (5.5, 3.5, 2.4)), (0.0, 0.0, 2.0))
    assert len(tree.hierarchy.leaf_low) > FEW_BLOCKS and len(tree.sequences[1].facet) > paths_module.FEW_ROWS
    tx = jnp.asarray(rng.uniform(0.5, (5.5, 3.5, 2.4)), jnp.float32)
    weights = jnp.asarray(rng.normal(size=(5, 3)), jnp.float32)

    def found(tx):
        return trace_paths(tree, tx, (("specular", 256, 64), ("diffracted", 256, 64)))

    def size(tx):
        return sum(jnp.sum(jnp.where(some.alive[:, None, None], some.points * weights, 0)) for some in found(tx).sets)

    quick = jax.jit(found)(tx), jax.jit(jax.grad(size))(tx)
    monkeypatch.setattr(paths_module, "crossings", brute_force)
    monkeypatch.setattr(paths_module, "FEW_ROWS", 10**9)
    slow = jax.jit(found)(tx), jax.jit(jax.grad(size))(tx)
    assert min(int(some.alive.sum()) for some in quick[0].sets) > 10
    for one, other in zip(*(jax.tree.leaves(every) for every in (quick, slow)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
