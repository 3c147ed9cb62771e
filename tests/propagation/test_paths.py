"""Paths against image lattices, brute force and the laws of optics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import box, edges_of, facets_of, rectangle, room, search_of, trace

from wbgs_jax.mesh.facets import areas
from wbgs_jax.propagation import image_method
from wbgs_jax.propagation.image_method import make_image_tree
from wbgs_jax.propagation.paths import DIFFRACTED, NONE, REFLECTED, TRANSMITTED

SIZE = np.array([6.0, 4.0, 3.0])


def lengths_of(paths):
    legs = np.diff(np.asarray(paths.points, float), axis=-2)
    return np.linalg.norm(legs, axis=-1).sum(-1)


def traced(search, tx):
    return jax.tree.map(np.asarray, trace(search, tx))


def shortest_over(edges, edge, first, second):
    """The shortest way from one point to another over an edge, by a scan."""
    share = np.linspace(0, 1, 20001)[:, None] * float(edges.length[edge])
    along = np.asarray(edges.start[edge]) + share * np.asarray(edges.direction[edge])
    return (np.linalg.norm(along - first, axis=-1) + np.linalg.norm(along - second, axis=-1)).min()


def images_of(tx):
    """Mirror images of order 0 to 3 of a transmitter in a rectangular room: 1 + 6 + 18 + 38."""
    index = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    index = index[np.abs(index).sum(-1) <= 3]
    return index * SIZE + np.where(index % 2, SIZE - tx, tx)


def in_no_corner(rx, images):
    """Whether no path is reflected twice within centimetres: a mirror nearer than `paths.NEAR` is none."""
    planes = np.arange(-3, 5)[:, None] * SIZE
    share = (planes - rx) / (images - rx)[:, None]  # of the way at which an image's straight line crosses a wall
    share = np.sort(np.where((share > 0) & (share < 1), share, np.inf).reshape(len(images), -1), 1)[:, :3]
    with np.errstate(invalid="ignore"):
        legs = np.diff(share, axis=1) * np.linalg.norm(images - rx, axis=-1)[:, None]
    return not (legs < 0.02).any()


def test_an_empty_box_gives_the_image_lattice(rng):
    """Every image of order 1, 2 and 3 of a rectangular room exactly once, as paths of known lengths."""
    draws = (rng.uniform(0.2, 0.8, (2, 3)) * SIZE for _ in range(1000))
    rx, tx = next((rx, tx) for rx, tx in draws if in_no_corner(rx, images_of(tx)))
    paths = traced(search_of(room(SIZE), rx), tx).specular
    found, expected = lengths_of(paths)[paths.alive], np.linalg.norm(images_of(tx) - rx, axis=-1)
    assert len(found) == len(expected) == 63
    np.testing.assert_allclose(np.sort(found), np.sort(expected), rtol=1e-5)


@pytest.mark.heavy
def test_angles_of_incidence_and_reflection_are_equal(rng):
    rx, tx = rng.uniform(0.2, 0.8, (2, 3)) * SIZE
    search = search_of([*room(SIZE), box((2, 1, 0.5), (3, 2, 1.2))], rx)
    paths = traced(search, tx).specular
    normals = np.asarray(search.facets.normal)
    for k in np.flatnonzero(paths.alive):
        for i, facet in enumerate(paths.interaction_facet[k][paths.interaction_type[k] == REFLECTED]):
            before, here, after = paths.points[k, i], paths.points[k, i + 1], paths.points[k, i + 2]
            if min(np.linalg.norm(here - before), np.linalg.norm(after - here)) > 0.05:  # rounding turns shorter legs
                into, out = ((here - before) / np.linalg.norm(here - before), (after - here) / np.linalg.norm(after - here))
                np.testing.assert_allclose(into - 2 * (into @ normals[facet]) * normals[facet], out, atol=1e-3)


@pytest.mark.heavy
def test_what_is_crossed_is_counted_in_order():
    """Three sheets between the ends, and a closed body off the line."""
    sheets = [rectangle((x, -1, -1), (0, 2, 0), (0, 0, 2)) for x in (1.0, 3.0, 2.0)]
    search = search_of([*sheets, box((1, 3, 0), (2, 4, 1))], (0, 0, 0), mirror_areas=(0.0,))
    paths = traced(search, (4, 0.3, 0.2)).specular
    direct = np.flatnonzero(paths.alive & ~(paths.interaction_type == REFLECTED).any(-1))
    assert len(direct) == 1
    assert paths.interaction_type[direct[0]].tolist() == [TRANSMITTED] * 3 + [NONE] * 2
    order = np.asarray(search.facets.material)[paths.interaction_facet[direct[0]][:3]]
    assert order.tolist() == [1, 2, 0]  # x = 3, 2, 1


@pytest.mark.heavy
def test_six_sheets_are_one_too_many():
    sheets = [rectangle((x, -1, -1), (0, 2, 0), (0, 0, 2)) for x in range(1, 7)]
    for n, seen in ((5, True), (6, False)):
        paths = traced(search_of(sheets[:n], (0, 0, 0), mirror_areas=(0.0,)), (8, 0.1, 0.2)).specular
        assert (paths.alive & ~(paths.interaction_type == REFLECTED).any(-1)).any() == seen


@pytest.mark.heavy
def test_a_diffracted_ray_is_the_shortest_over_its_edge():
    """Keller's cone, by Fermat's principle."""
    rx, tx = np.array([0, 0.2, 0.1]), np.array([2.6, 1.9, 0.3])
    search = search_of([box((1, -1, -1), (2, 1, 1))], rx, mirror_areas=(0.0,))
    paths = traced(search, tx).diffracted
    alone = np.flatnonzero(paths.alive & ((paths.interaction_type != NONE).sum(-1) == 1))
    assert len(alone) >= 1
    for k in alone:
        assert paths.interaction_type[k, 0] == DIFFRACTED
        expected = shortest_over(search.edges, paths.interaction_facet[k, 0], tx, rx)
        np.testing.assert_allclose(lengths_of(paths)[k], expected, rtol=1e-5)


@pytest.mark.heavy
@pytest.mark.parametrize("first", [REFLECTED, DIFFRACTED])
def test_a_mirror_before_or_behind_an_edge(first):
    """The length is that over the mirror image of one end."""
    wall = rectangle((-5, 4, -4), (12, 0, 0), (0, 0, 8))
    rx, tx = np.array([0, 0.2, 0.1]), np.array([2.6, 1.9, 0.3])
    search = search_of([wall, box((1, -1, -1), (2, 1, 1))], rx, mirror_areas=(0.0,))
    paths = traced(search, tx).diffracted
    image = (tx if first == REFLECTED else rx) * [1, -1, 1] + [0, 8, 0]
    chosen = np.flatnonzero(
        paths.alive & (paths.interaction_type[:, 0] == first) & ((paths.interaction_type != NONE).sum(-1) == 2)
    )
    chosen = [k for k in chosen if (np.abs(paths.points[k, 1:3, 1] - 4) < 1e-3).any()]  # by the wall, not the body
    assert chosen
    for k in chosen:
        edge = paths.interaction_facet[k, 1 if first == REFLECTED else 0]
        expected = shortest_over(search.edges, edge, image, rx if first == REFLECTED else tx)
        np.testing.assert_allclose(lengths_of(paths)[k], expected, rtol=1e-5)


def lengths_off_corners(paths):
    """Lengths of paths of whose legs none is shorter than centimetres: a mirror nearer than `paths.NEAR` is none."""
    legs = np.linalg.norm(np.diff(np.asarray(paths.points, float), axis=-2), axis=-1)
    return np.sort(legs.sum(-1)[paths.alive & ~((legs > 0) & (legs < 0.02)).any(-1)])


def test_swapping_the_ends_reverses_the_paths(rng):
    rx, tx = rng.uniform(0.15, 0.4, (2, 3)) * SIZE
    parts = [*room(SIZE), box((3, 1.7, 0.5), (4, 2.7, 1.2))]
    there, back = traced(search_of(parts, rx), tx).specular, traced(search_of(parts, tx), rx).specular
    assert len(lengths_off_corners(there)) > 30
    np.testing.assert_allclose(lengths_off_corners(there), lengths_off_corners(back), rtol=1e-5)


def test_a_search_holds_device_arrays_and_no_mirror_that_is_too_small():
    """13 square metres leave floor, ceiling and the long walls to the first order; 100 leave nothing to the second."""
    facets, edges = facets_of(*room(SIZE)), edges_of(*room(SIZE))
    search = make_image_tree(facets, edges, jnp.array([1.0, 1.0, 1.0]), (13.0, 100.0, 0.0), 0.5, 3.0)
    leaves = jax.tree.leaves(search)
    assert all(isinstance(leaf, jax.Array) for leaf in leaves) and {str(leaf.dtype) for leaf in leaves} == {"float32", "int32"}
    assert [chains.facet.shape for chains in search.sequences] == [(4, 1), (0, 2), (0, 3)]
    assert traced(search, (3.0, 2.0, 1.0)).specular.alive.sum() == 1 + 4


def sequences_of(found):
    """The sequences of one order without padding, which reflects nothing."""
    return np.unique(np.asarray(found.facet), axis=0)


def test_of_too_many_chains_those_of_the_largest_mirrors_are_left(rng, monkeypatch):
    """As many mirrors as can be tried in front of every chain of them alone, and not one more."""
    facets = facets_of(*room(SIZE), box((3, 1.7, 0.5), (4, 2.7, 1.2)), box((1, 1, 0.5), (1.5, 3, 2.2)))
    edges, rx, most = (
        edges_of(*room(SIZE), box((3, 1.7, 0.5), (4, 2.7, 1.2))),
        np.array([2.0, 3.0, 1.1]),
        int(rng.integers(20, 400)),
    )
    everything = make_image_tree(facets, edges, rx, (0.0, 0.0, 0.0), 0.5, 0.5)
    monkeypatch.setattr(image_method, "MOST_TRIED", most)
    monkeypatch.setattr(image_method, "MOST_PAIRS", 3 * len(edges.length))
    limited = make_image_tree(facets, edges, rx, (0.0, 0.0, 0.0), 0.5, 0.5)
    order = np.argsort(-areas(facets), kind="stable")
    before = np.zeros((1, 0), int)
    for own, full in zip(*(map(sequences_of, tree.sequences) for tree in (limited, everything)), strict=True):
        tried = [k for k in range(len(order) + 1) if k * np.isin(before, order[:k]).all(-1).sum() <= most]
        large = order[: max(tried)]
        kept = {tuple(row) for row in before[np.isin(before, large).all(-1)].tolist()}
        assert own.tolist() == [row for row in full.tolist() if row[0] in large and tuple(row[1:]) in kept]
        before = own
    assert len(limited.sequences[2].facet) < len(everything.sequences[2].facet)
    assert set(np.asarray(limited.diffracted.before)[:, 0]) == set(order[:3])
    assert set(np.asarray(limited.diffracted.after)[:, 0]) <= set(order[:3])


def test_fewer_paths_are_returned_than_there_are():
    """The line of sight is the strongest."""
    search = search_of(room(SIZE), (1, 1, 1))
    paths = jax.tree.map(np.asarray, trace(search, (3, 2, 1), specular=(16, 3), diffracted=(1, 1)))
    assert paths.specular.points.shape == (3, 5, 3) and paths.specular.alive.all()
    np.testing.assert_allclose(lengths_of(paths.specular)[0], np.sqrt(5), rtol=1e-6)
    assert not paths.diffracted.alive.any()
