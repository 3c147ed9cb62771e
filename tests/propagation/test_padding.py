"""What is added to edges and chains is no path, and sizes seldom change."""

import dataclasses

import jax
import numpy as np
import pytest
from builders.rooms import box, edges_of, facets_of, mesh_of, room, trace

from wbgs_jax.fields.coherent import WaveConfig, make_field
from wbgs_jax.mesh.edges import edges_of_facets, padded_edges, padded_size
from wbgs_jax.propagation.image_method import make_image_tree
from wbgs_jax.types import make_receiver

SIZE = np.array([6.0, 4.0, 3.0])


def furnished(rng):
    lows = rng.uniform([0.3, 0.3, 0.1], [4.5, 2.5, 1.5], (6, 3))
    return [*room(SIZE), *(box(low, low + rng.uniform(0.3, 1.0, 3)) for low in lows)]


@pytest.mark.parametrize("count", [0, 1, 7, 8, 15, 16, 17, 1000, 60_000])
def test_sizes_hold_what_is_there_and_at_most_an_eighth_more(count):
    size = padded_size(count)
    assert count <= size <= count * 9 / 8
    assert padded_size(size) == size


@pytest.mark.heavy
def test_padding_adds_no_path(rng):
    """The same paths, in value and in order, with and without it."""
    rx, tx = rng.uniform(0.2, 0.8, (2, 3)) * SIZE
    facets = facets_of(*furnished(rng))
    edges = edges_of_facets(facets)
    own = rx, (0.0, 0.0, 0.0), 0.5, 3.0
    search, padded = make_image_tree(facets, edges, *own), make_image_tree(facets, padded_edges(edges), *own, padded=True)
    assert any(len(more.facet) > len(own.facet) for more, own in zip(padded.sequences, search.sequences, strict=True))
    found, again = (trace(one, tx) for one in (search, padded))
    for paths, others in ((found.specular, again.specular), (found.diffracted, again.diffracted)):
        alive = np.asarray(paths.alive)
        assert alive.any()
        np.testing.assert_array_equal(alive, others.alive)
        for own, other in zip(jax.tree.leaves(paths), jax.tree.leaves(others), strict=True):
            np.testing.assert_array_equal(np.asarray(own)[alive], np.asarray(other)[alive])


def test_no_edge_of_no_length_diffracts(rng):
    edges = edges_of(*furnished(rng), box((0.2, 0.2, 2.0), (0.6, 0.5, 2.5)))
    padded = padded_edges(edges)
    assert len(padded.length) > len(edges.length) or padded_size(len(edges.length)) == len(edges.length)
    assert np.count_nonzero(padded.length) == len(edges.length)
    for own, other in zip(*map(jax.tree.leaves, (edges, padded)), strict=True):
        np.testing.assert_array_equal(own, other[: len(own)])


def test_a_moved_field_has_the_sizes_of_the_one_before(rng):
    """So that it traces paths with the same programs; a number may happen to lie at the border of two sizes."""
    field = make_field(mesh_of(*furnished(rng)), WaveConfig())
    receiver, still = make_receiver(rng.uniform(0.2, 0.8, 3) * SIZE), field.motion
    moved = field.moved(dataclasses.replace(still, shift=rng.normal(0, 1e-3, still.shift.shape).astype(np.float32)))
    numbers = [[leaf.shape for leaf in jax.tree.leaves(one.plan(None, receiver))] for one in (field, moved)]
    assert sum(own != other for own, other in zip(*numbers, strict=True)) <= 6
    edges, params = len(field.edges.length), field.init(jax.random.key(0))
    assert field.inspect(params).sizes["edges"] <= edges == padded_size(edges)
