"""Normal equations of motions against automatic differentiation, and what they say about a wall that was moved."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import wave_runs
from builders.synthetic import tiny_settings
from builders.wave_runs import PARTS, RX, places, run_in
from jax.flatten_util import ravel_pytree

from wbgs_jax.fields.losses import GOOD_MATCH, log_decorrelation
from wbgs_jax.propagation.displacement import Motion, length_changes, length_terms
from wbgs_jax.training.calibration import gauss_newton
from wbgs_jax.training.calibration.gauss_newton import adjust, adjusted_numbers, length_variances, normal_equations

N_TX, FREQUENCIES = 6, np.array([1e9, 3e9])
RECEIVERS = RX, (5.2, 2.9, 1.6)
SETTINGS = tiny_settings(
    "wave",
    field={"specular_tried": 32, "specular_kept": 16, "diffracted_tried": 32, "diffracted_kept": 8, "mirror_areas": (0.0,)},
)
WIDTHS = (2e-2, 1e-3, 1e-3, 2e-3)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Of 6 transmitters whose snapshots, at two receivers, are those of the room as it is."""
    folder = tmp_path_factory.mktemp("room")
    run = run_in(PARTS, SETTINGS, folder, places(N_TX, 0.4), FREQUENCIES, receivers=RECEIVERS)
    _, tree, links = parts_of(run, len(run.data.links.tx_index))
    run.data = run.data.with_observations(snapshots=snapshots(ravel_pytree(run.field.motion)[0], tree, links))
    return run


def widths_of(run):
    still = run.field.motion
    names = (field.name for field in dataclasses.fields(still))
    return Motion(**{name: jnp.full_like(getattr(still, name), width) for name, width in zip(names, WIDTHS, strict=True)})


def drawn(rng, run, size):
    return jax.tree.map(lambda width: size * width * jnp.asarray(rng.normal(size=width.shape), jnp.float32), widths_of(run))


@jax.jit
def snapshots(flat, run_tree, links):
    """Of the room with its things and receivers elsewhere, to first order."""
    field, params, receivers, prepared, nothing = run_tree
    motion = ravel_pytree(nothing)[1](flat)

    def one(link):
        number = link.receiver_index
        plan = field.plan(params, jax.tree.map(lambda leaf: leaf[number], receivers), prepared=prepared)
        of_one = jax.tree.map(lambda leaf: leaf[None], link)
        return wave_runs.snapshots(params, field.displaced(plan, motion.of_receiver(number)), prepared, of_one)[0]

    return jax.vmap(one)(links)


def parts_of(run, count):
    index = jnp.arange(count)
    tree = run.field, run.state.params, run.dataset.receivers, run.prepared, run.field.motion
    return index, tree, jax.tree.map(lambda leaf: leaf[index], run.data.links)


def certain(run):
    pairs = N_TX * len(RECEIVERS)
    return jnp.zeros((pairs, run.prepared.paths.specular.alive.shape[1] + run.prepared.paths.diffracted.alive.shape[1]))


def everything(run):
    return np.arange(ravel_pytree(run.field.motion)[0].size, dtype=np.int32)


def variances(run, covariance, numbers, others):
    own = jnp.asarray(covariance, jnp.float32), jnp.asarray(others, jnp.float32)
    return np.asarray(length_variances(run.prepared, *own, numbers, len(run.field.motion.shift)))


def equations(run, motion, index, data=None, numbers=None):
    """Of eights of snapshots; the block after them is none of them."""
    blocks = jnp.concatenate([index.reshape(-1, 8), jnp.zeros((1, 8), index.dtype)])
    of = run.field, run.state.params, motion, run.prepared, run.data if data is None else data
    every = everything(run) if numbers is None else numbers
    return normal_equations(*of, blocks, certain(run), jnp.asarray(len(blocks) - 1), every)


@pytest.mark.heavy
def test_the_vector_is_the_gradient_of_the_log_decorrelation(run, rng):
    motion = drawn(rng, run, 0.2)
    index, tree, links = parts_of(run, 8)
    truth = run.data.snapshots[index]

    def objective(flat):
        return truth.shape[-1] * jnp.sum(log_decorrelation(snapshots(flat, tree, links), truth))

    expected = -np.asarray(jax.grad(objective)(ravel_pytree(motion)[0]))
    _, found = equations(run, motion, index)
    assert np.abs(expected).max() > 1
    np.testing.assert_allclose(found, expected, atol=0.01 * np.abs(expected).max())


@pytest.mark.heavy
def test_the_matrix_is_that_of_the_jacobian(run, rng):
    motion = drawn(rng, run, 0.2)
    index, tree, links = parts_of(run, 8)
    flat, truth = ravel_pytree(motion)[0], np.asarray(run.data.snapshots[index], complex)
    parts = [lambda flat, part=part: part(snapshots(flat, tree, links)) for part in (jnp.real, jnp.imag)]
    real, imaginary = (np.asarray(jax.jacfwd(part)(flat), float) for part in parts)
    predicted, changes, expected = np.asarray(snapshots(flat, tree, links), complex), real + 1j * imaginary, 0
    for y, a, t in zip(predicted, changes, truth, strict=True):
        factor, norm = np.vdot(y, t) / np.vdot(y, y), np.linalg.norm(t)
        left = np.linalg.norm(t - factor * y) / norm
        a = (a - np.outer(y, y.conj() @ a) / np.vdot(y, y)) * factor / norm
        expected = expected + 2 * len(t) * (a.conj().T @ a).real / (left**2 + GOOD_MATCH)
    found, _ = equations(run, motion, index)
    np.testing.assert_allclose(found, expected, atol=0.01 * np.abs(expected).max())
    assert np.linalg.matrix_rank(expected) > 10


def test_variances_of_lengths_follow_from_those_of_places(run, rng):
    """One number that is uncertain: the variance is its square times that of the derivative."""
    flat, back = ravel_pytree(run.field.motion)
    number, width = rng.integers(flat.size), 3e-3
    covariance = jnp.zeros((flat.size, flat.size)).at[number, number].set(width**2)
    found = variances(run, covariance, everything(run), np.zeros(flat.size))
    motion = back(jnp.zeros_like(flat).at[number].set(width))
    for k, name in enumerate(("specular", "diffracted")):
        paths = getattr(run.prepared.paths, name)
        changes = jax.vmap(lambda some, number: length_changes(some, run.prepared.surfaces, motion.of_receiver(number)))(
            paths, run.prepared.receiver_index
        )
        own = found[:, : changes.shape[1]] if k == 0 else found[:, -changes.shape[1] :]
        alive = np.asarray(paths.alive)
        np.testing.assert_allclose(own[alive], np.asarray(changes)[alive] ** 2, atol=1e-10)


@pytest.mark.heavy
@pytest.mark.parametrize("most", [3, 1000])
def test_variances_of_lengths_know_what_places_share(most, run, rng, monkeypatch):
    """Any covariance of what is adjusted, and any variances of the rest: those of all lengths are J C J^T, written out."""
    monkeypatch.setattr(gauss_newton, "MOST", most)
    numbers, movers = adjusted_numbers(run.prepared, run.field.motion), len(run.field.motion.shift)
    size = ravel_pytree(run.field.motion)[0].size
    root, others = rng.normal(0, 1e-3, (len(numbers), 5)), rng.uniform(0, 1e-6, size)
    others[numbers] = 0
    found = variances(run, root @ root.T, numbers, others)
    for pair, receiver in enumerate(np.asarray(run.prepared.receiver_index)):
        paths = jax.tree.map(lambda leaf, pair=pair: leaf[pair], run.prepared.paths)
        expected, alive = [], np.concatenate([np.asarray(paths.specular.alive), np.asarray(paths.diffracted.alive)])
        for some in (paths.specular, paths.diffracted):
            number, derivative = (np.asarray(a) for a in length_terms(some, run.prepared.surfaces, movers))
            number = np.where(number < 6 * movers, number, number + 3 * int(receiver))
            jacobian = np.zeros((len(number), size))
            np.add.at(jacobian, (np.arange(len(number))[:, None], number), derivative)
            expected.append(((jacobian[:, numbers] @ root) ** 2).sum(1) + jacobian**2 @ others)
        np.testing.assert_allclose(found[pair][alive], np.concatenate(expected)[alive], rtol=1e-3, atol=1e-9)


@pytest.mark.heavy
def test_the_movers_that_most_paths_meet_are_adjusted(run, monkeypatch):
    """All of them where there are few; every receiver in any case."""
    np.testing.assert_array_equal(adjusted_numbers(run.prepared, run.field.motion), everything(run))
    monkeypatch.setattr(gauss_newton, "MOST", 2)
    movers, meets = len(run.field.motion.shift), np.zeros(len(run.field.motion.shift))
    for some in (run.prepared.paths.specular, run.prepared.paths.diffracted):
        number, derivative = jax.vmap(lambda paths: length_terms(paths, run.prepared.surfaces, movers))(some)
        shifts = np.asarray(some.alive)[..., None] & (np.asarray(number) < 3 * movers)
        np.add.at(meets, np.asarray(number)[shifts] // 3, np.asarray(derivative)[shifts] ** 2)
    chosen = np.sort(np.argsort(-meets)[:2])
    shifts = np.concatenate([3 * m + np.arange(3) for m in chosen])
    expected = np.concatenate([shifts, 3 * movers + shifts, everything(run)[6 * movers :]])
    np.testing.assert_array_equal(adjusted_numbers(run.prepared, run.field.motion), expected)


@pytest.mark.heavy
def test_fewer_numbers_have_the_rows_and_columns_of_all(run, rng):
    motion, (index, *_), every = drawn(rng, run, 0.2), parts_of(run, 8), everything(run)
    some = np.sort(rng.choice(every, len(every) // 2, replace=False))
    (matrix, vector), (own, its) = equations(run, motion, index), equations(run, motion, index, numbers=some)
    np.testing.assert_allclose(own, np.asarray(matrix)[np.ix_(some, some)], atol=1e-5 * np.abs(matrix).max())
    np.testing.assert_allclose(its, np.asarray(vector)[some], atol=1e-4 * np.abs(vector).max())


@pytest.mark.heavy
def test_what_has_moved_is_found_and_what_nobody_sees_stays(run, rng):
    """Snapshots of a room whose things stand elsewhere, without noise: lengths come back, and numbers that no path depends on
    keep the variance of their prior."""
    moved = drawn(rng, run, 0.5)
    index, tree, links = parts_of(run, len(run.data.links.tx_index))
    heard = snapshots(ravel_pytree(moved)[0], tree, links)
    data = run.data.with_observations(snapshots=heard)
    still, widths = run.field.motion, widths_of(run)
    prior = np.asarray(ravel_pytree(widths)[0], float) ** 2
    found, covariance, frequency = still, np.diag(prior), np.asarray(links.frequency_hz)
    for highest in FREQUENCIES:
        pool, known = np.flatnonzero(frequency <= highest), (found, covariance, widths, everything(run))
        found, covariance = adjust(run.field, run.state.params, run.prepared, *known, data, pool, 64, rng)
    before, after = (
        float(jnp.mean(log_decorrelation(snapshots(ravel_pytree(m)[0], tree, links), heard))) for m in (still, found)
    )
    assert after < before - 1, (before, after)
    curvature, _ = equations(run, still, jnp.resize(index, 16), data)
    unseen = np.diag(curvature) * prior < 1e-6  # along walls and about their normals: no path says anything of it but rounding
    assert 0 < unseen.sum() < len(unseen)
    np.testing.assert_allclose(np.diag(covariance)[unseen], prior[unseen], rtol=1e-3)
    assert np.abs(np.asarray(ravel_pytree(found)[0])[unseen]).max() < 1e-2 * np.sqrt(prior[unseen].min())
    assert (np.diag(covariance) / prior).min() < 0.5
