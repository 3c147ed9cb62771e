"""First-order changes of path lengths against paths that are traced where the surfaces have gone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import box, facets_of, room, search_of, trace
from jax.flatten_util import ravel_pytree

from wbgs_jax.mesh.edges import edges_of_facets
from wbgs_jax.mesh.facets import moved
from wbgs_jax.propagation.displacement import (
    Motion,
    coherence,
    length_changes,
    length_gradient,
    length_terms,
    path_coherence,
    still,
)
from wbgs_jax.propagation.image_method import make_image_tree
from wbgs_jax.propagation.paths import DIFFRACTED, REFLECTED

RX, TX = (1.0, 1.0, 1.2), (4.1, 2.9, 1.7)
PARTS = [*room(), box((3, 1, 0.5), (4, 2, 1.2))]


def lengths(paths):
    """Of every path, by what it interacts with."""
    points = np.asarray(paths.points, float)
    total = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(-1)
    names = [
        tuple(np.stack([kind, facet], -1).ravel())
        for kind, facet in zip(np.asarray(paths.interaction_type), np.asarray(paths.interaction_facet), strict=True)
    ]
    return {name: (k, total[k]) for k, name in enumerate(names) if paths.alive[k]}


def test_closed_bodies_and_separate_walls_move_by_themselves():
    facets = facets_of(*PARTS)
    movers = np.asarray(facets.mover)
    assert len(np.unique(movers)) == len(PARTS)
    sizes = sorted(np.bincount(movers).tolist())
    assert sizes == [1] * 6 + [6]


def drawn(rng, shift=1e-3, turn=0.0) -> Motion:
    """Everything stands elsewhere."""
    size = still(len(PARTS)).of_receiver(0)
    size = dataclasses.replace(size, shift=size.shift + shift, turn=size.turn + turn)
    size = dataclasses.replace(size, receiver=size.receiver + shift)
    return jax.tree.map(lambda leaf: (rng.normal(size=leaf.shape) * leaf).astype(np.float32), size)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["specular", "diffracted"])
def test_lengths_follow_surfaces_and_ends(kind, rng):
    facets = facets_of(*PARTS)
    search = search_of(PARTS, RX, mirror_areas=(0.0, 0.0))
    motion = drawn(rng, turn=3e-4)
    there = moved(facets, motion.shift, motion.turn)
    moved_search = make_image_tree(there, edges_of_facets(there), np.add(RX, motion.receiver), (0.0, 0.0), 0.5, 3.0)
    before, after = (getattr(trace(s, TX), kind) for s in (search, moved_search))
    expected = np.asarray(length_changes(before, search, motion))
    first, second = lengths(before), lengths(after)
    wanted = REFLECTED if kind == "specular" else DIFFRACTED
    both = [name for name in first if name in second and wanted in name[::2]]
    assert len(both) > 5
    found = np.array([second[name][1] - first[name][1] for name in both])
    said = np.array([expected[first[name][0]] for name in both])
    np.testing.assert_allclose(said, found, atol=2e-5)
    assert np.abs(found).max() > 2e-4


@pytest.mark.heavy
def test_nothing_changes_where_nothing_moves():
    search = search_of(PARTS, RX, mirror_areas=(0.0,))
    paths = trace(search, TX).specular
    nothing = still(len(PARTS)).of_receiver(0)
    np.testing.assert_array_equal(length_changes(paths, search, nothing), 0)
    facets = facets_of(*PARTS)
    same = moved(facets, nothing.shift, nothing.turn)
    for name in ("corners", "normal", "offset"):
        np.testing.assert_allclose(getattr(same, name), getattr(facets, name), atol=1e-12)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["specular", "diffracted"])
def test_the_gradient_says_what_the_changes_say(kind, rng):
    search = search_of(PARTS, RX, mirror_areas=(0.0, 0.0))
    paths = getattr(trace(search, TX), kind)
    motion = dataclasses.replace(drawn(rng, 1.0), receiver=np.zeros(3, np.float32))
    alive = np.asarray(paths.alive)
    by_gradient = jnp.sum(length_gradient(paths, search, len(PARTS))[:, :-1] * motion.shift, (-2, -1))
    np.testing.assert_allclose(by_gradient[alive], length_changes(paths, search, motion)[alive], atol=1e-5)


@pytest.mark.parametrize("kind", ["specular", "diffracted"])
def test_the_terms_say_what_the_changes_say(kind, rng):
    search = search_of(PARTS, RX, mirror_areas=(0.0, 0.0))
    paths, motion = getattr(trace(search, TX), kind), drawn(rng, turn=3e-4)
    alive = np.asarray(paths.alive)
    number, derivative = length_terms(paths, search, len(PARTS))
    by_terms = np.sum(np.asarray(derivative) * np.asarray(ravel_pytree(motion)[0])[number], -1)
    np.testing.assert_allclose(by_terms[alive], length_changes(paths, search, motion)[alive], atol=1e-6)


@pytest.mark.heavy
def test_without_paths_nothing_depends_on_anything():
    """A mesh without an edge has none that are diffracted."""
    search = search_of(PARTS, RX, mirror_areas=(0.0, 0.0))
    none = jax.tree.map(lambda leaf: leaf[:0], trace(search, TX).diffracted)
    assert all(len(of_none) == 0 for of_none in length_terms(none, search, len(PARTS)))
    gradient = length_gradient(none, search, len(PARTS))
    assert coherence(gradient, jnp.ones(len(PARTS) + 1), jnp.float32(100.0)).shape == (0, 0)


def test_lengths_follow_the_transmitter(rng):
    search = search_of(PARTS, RX, mirror_areas=(0.0, 0.0))
    step = rng.normal(0, 1e-3, 3)
    paths = trace(search, TX).specular
    first, second = lengths(paths), lengths(trace(search, np.add(TX, step)).specular)
    both = [name for name in first if name in second]
    said = np.asarray(length_gradient(paths, search, len(PARTS)))[:, -1] @ step
    assert len(both) > 10
    for name in both:
        assert second[name][1] - first[name][1] == pytest.approx(said[first[name][0]], abs=2e-5)


def test_coherence_is_the_mean_of_phases_over_places(rng):
    """Against draws of places from normal distributions."""
    gradient, spread, wavenumber = rng.normal(size=(5, 4, 3)), rng.uniform(1e-3, 2e-3, 4), 400.0
    found = coherence(*(jnp.asarray(x, jnp.float32) for x in (gradient, spread, wavenumber)))
    places = rng.normal(size=(200_000, 4, 3)) * spread[:, None]
    phases = np.exp(-1j * wavenumber * np.einsum("kmx,nmx->nk", gradient, places))
    np.testing.assert_allclose(found, (phases.T @ phases.conj() / len(places)).real, atol=0.02)
    assert np.asarray(found)[~np.eye(5, dtype=bool)].min() < 0.6
    np.testing.assert_allclose(np.diag(found), 1, atol=1e-4)


@pytest.mark.heavy
def test_what_paths_share_says_what_their_gradients_say(rng):
    """Values, and gradients with respect to how far everything may stand from its place."""
    search, wavenumber = search_of(PARTS, RX), jnp.float32(300.0)
    paths = trace(search, TX)
    spread = jnp.asarray(rng.uniform(1e-4, 3e-3, len(PARTS) + 1), jnp.float32)
    alive = np.concatenate([paths.specular.alive, paths.diffracted.alive])
    weight = jnp.asarray(rng.normal(size=(len(alive), len(alive))) * (alive[:, None] & alive), jnp.float32)

    def by_gradients(spread):
        gradient = [length_gradient(some, search, len(PARTS)) for some in (paths.specular, paths.diffracted)]
        return coherence(jnp.concatenate(gradient), spread, wavenumber)

    def by_bends(spread):
        return path_coherence(paths, search, spread, wavenumber)

    np.testing.assert_allclose(by_bends(spread)[alive][:, alive], by_gradients(spread)[alive][:, alive], atol=1e-4)
    found, expected = (jax.grad(lambda s, of=of: jnp.sum(weight * of(s)))(spread) for of in (by_bends, by_gradients))
    np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-3 * np.abs(expected).max())
    assert np.abs(expected).max() > 0


def test_paths_off_the_same_wall_stay_coherent_and_a_common_length_is_none():
    """What turns alike at the same mover grows alike, however little its place is known."""
    turn = jnp.zeros((3, 2, 3)).at[:2, 0].set(jnp.array([0.0, 0.6, 0.8])).at[2, 1].set(jnp.array([1.0, 0.0, 0.0]))
    found = coherence(turn, jnp.array([0.05, 0.05]), jnp.float32(2000.0))
    np.testing.assert_allclose(found, [[1, 1, 0], [1, 1, 0], [0, 0, 1]], atol=1e-3)
