"""The jitted epoch and the host's answer to what it reports: nothing half-done is ever kept."""

import dataclasses
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import make_epoch, tiny_dataset, tiny_scene, tiny_settings

from wbgs_jax.data.layout import export_layout, load_layout
from wbgs_jax._util.errors import UserError
from wbgs_jax.fields import Observation, wideband
from wbgs_jax.splat import Capacity, project
from wbgs_jax.splat.tiles import build_tile_jobs
from wbgs_jax.training.step import loss_and_gradients, training_data
from wbgs_jax.training.loop import Run

LENGTH = 4
SETTINGS = tiny_settings(loop={"epoch_steps": LENGTH})
TINY = Capacity(entries=256, jobs=256)


pytestmark = pytest.mark.usefixtures("compile_once")


@pytest.fixture(scope="module")
def dataset():
    return tiny_dataset()


def new_run(dataset, folder, settings=SETTINGS, capacity=None):
    run = Run(dataset, "wideband", settings, 0, folder)
    if capacity is not None:
        run.capacity = capacity
        run._build()
    return run


def snapshot(state):
    """A copy on the host: an epoch takes its argument's memory."""
    return jax.tree.map(np.array, state)


def assert_equal_states(a, b):
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y, err_msg=jax.tree_util.keystr(path))


def first(step):
    return jnp.asarray(step, jnp.int32)


def test_data_on_the_device_are_the_datasets(tmp_path, dataset):
    export_layout(tiny_scene(), tmp_path / "folder")
    for source in (dataset, load_layout(tmp_path / "folder")):
        data = training_data(source)
        index = source.test[:3]
        np.testing.assert_allclose(data.pas(jnp.asarray(index)), source.pas(index), atol=1e-5)
        np.testing.assert_array_equal(data.query.tx_position[index], source.query(index).tx_position)
        np.testing.assert_array_equal(data.query.frequency_hz[index], source.query(index).frequency_hz)


def test_an_epoch_of_several_steps_equals_as_many_epochs_of_one(tmp_path, dataset):
    run = new_run(dataset, tmp_path)
    batches = jnp.asarray(run.batches(0, LENGTH))
    start = snapshot(run.state)
    together, report = run.run_epoch(run.state, run.data, batches, first(0))
    assert int(report.good_steps) == LENGTH == int(together.step) and not report.stopped
    state, losses = start, []
    for i in range(LENGTH):
        state, one = run.run_epoch(jax.tree.map(jnp.asarray, state), run.data, batches[i : i + 1], first(0))
        losses.append(float(one.loss[0]))
    np.testing.assert_allclose(losses, report.loss, rtol=1e-4)
    for x, y in zip(jax.tree.leaves(together), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-5)


def test_an_epoch_can_start_in_its_middle(tmp_path, dataset):
    run = new_run(dataset, tmp_path)
    batches = jnp.asarray(run.batches(0, LENGTH))
    start = snapshot(run.state)
    whole, _ = run.run_epoch(run.state, run.data, batches, first(0))
    two_by_two = jax.tree.map(jnp.asarray, start)
    for halves in (jnp.concatenate([batches[2:], batches[:2]]), batches):  # the last two places run, twice
        two_by_two, report = run.run_epoch(two_by_two, run.data, halves, first(2))
        assert int(report.good_steps) == 2 and np.isnan(report.loss[:2]).all() and np.isfinite(report.loss[2:]).all()
    assert_equal_states(whole, two_by_two)


def test_the_statistics_are_sums_of_the_positional_gradients(tmp_path, dataset):
    """Against the gradient of the loss with respect to a shift of the splats, at unchanged parameters."""
    run = new_run(dataset, tmp_path)
    index = jnp.asarray(run.batches(0, 1)[0])
    gradients = jax.jit(loss_and_gradients, static_argnums=(0, 4, 5))
    _, (d_params, d_means2d) = gradients(wideband, run.state.params, run.data, index, run.capacity, SETTINGS.optim)
    state, _ = run.run_epoch(run.state, run.data, jnp.tile(index, (LENGTH, 1)), first(LENGTH - 1))
    expected = np.hypot(d_means2d[:, 0] * 180, d_means2d[:, 1] * 45)  # pixels -> -1..1 across the image
    np.testing.assert_allclose(state.density.gradient_norm, expected, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(state.density.mean_gradient, d_params.gaussians.means, rtol=1e-3, atol=1e-6)
    np.testing.assert_array_equal(state.density.visible, (expected > 0).astype(float))


def test_an_overflow_commits_nothing_and_says_what_it_needs(tmp_path, dataset):
    run = new_run(dataset, tmp_path, capacity=TINY)
    before = snapshot(run.state)
    state, report = run.run_epoch(run.state, run.data, jnp.asarray(run.batches(0, LENGTH)), first(0))
    assert bool(report.overflow) and bool(report.stopped) and int(report.good_steps) == 0
    assert int(report.required[0]) > TINY.entries
    assert np.isnan(report.loss).all()
    assert_equal_states(state, before)


def test_the_host_grows_the_tile_lists_and_ends_where_a_roomy_run_ends(tmp_path, dataset):
    roomy, short = new_run(dataset, tmp_path), new_run(dataset, tmp_path, capacity=TINY)
    results = [run.epoch() for run in (roomy, short)]
    assert results[0] == results[1]
    assert short.step == LENGTH and short.compilations > roomy.compilations
    assert short.capacity.entries > TINY.entries
    assert_equal_states(short.state, roomy.state)


def test_an_overflow_in_the_middle_of_an_epoch_repeats_the_rest_of_it(tmp_path, dataset):
    """Small footprints that swell by a third each step outgrow tile lists that fit the first one exactly."""
    swelling = tiny_settings(optim={"log_scales_lr": 0.3}, loop={"epoch_steps": LENGTH})

    def start(capacity=None):
        run = new_run(dataset, tmp_path, swelling, capacity)
        gaussians = run.state.params.gaussians
        small = dataclasses.replace(gaussians, log_scales=gaussians.log_scales - 1)
        run.state = dataclasses.replace(run.state, params=dataclasses.replace(run.state.params, gaussians=small))
        return run

    splats = jax.jit(project)(start().state.params.gaussians, dataset.receiver)
    exact = Capacity(int(jax.jit(build_tile_jobs, static_argnums=1)(splats, TINY).required_entries), 1024)
    short, probe = start(exact), start(exact)
    _, report = probe.run_epoch(probe.state, probe.data, jnp.asarray(probe.batches(0, LENGTH)), first(0))
    assert bool(report.overflow) and 0 < int(report.good_steps) < LENGTH
    losses = short.epoch()
    roomy = start(short.capacity)
    assert roomy.epoch() == losses and roomy.compilations < short.compilations
    assert_equal_states(short.state, roomy.state)


def test_a_spectrum_that_is_not_a_number_stops_with_the_last_good_state(tmp_path, dataset):
    run = new_run(dataset, tmp_path)
    batches = run.batches(0, LENGTH)
    bad = next(int(i) for i in batches[2] if i not in batches[:2])
    broken = dataclasses.replace(dataset, snapshots=dataset.snapshots.copy())
    broken.snapshots[bad] = np.nan
    run.save()
    run.data = training_data(broken)
    with pytest.raises(UserError) as error:
        run.epoch()
    message = str(error.value)
    assert "\n" not in message and "step 2" in message and str(batches[2].tolist()) in message
    assert str(tmp_path / "checkpoints" / "0") in message
    assert run.step == 2
    good = new_run(dataset, tmp_path)
    only_two = np.concatenate([batches[:2], batches[:2]])[[2, 3, 0, 1]]
    expected, _ = good.run_epoch(good.state, good.data, jnp.asarray(only_two), first(2))
    assert_equal_states(run.state, expected)


def test_without_a_checkpoint_the_message_says_so(tmp_path, dataset):
    run = new_run(dataset, tmp_path)
    run.data = training_data(dataclasses.replace(dataset, snapshots=dataset.snapshots * np.nan))
    with pytest.raises(UserError, match=r"step 0 .* no checkpoint"):
        run.epoch()


def test_a_gradient_that_is_not_finite_is_not_committed(tmp_path, dataset):
    """The loss alone can look healthy: its value is finite, its derivative is not."""
    run = new_run(dataset, tmp_path)

    def observe(params, memory, receiver, query, *_):
        """sqrt at zero: value 0, slope infinite."""
        flat = jnp.sqrt(0 * params.gaussians.opacity_logits[0])
        jobs = wideband.plan(params, receiver, run.capacity).geometry.jobs
        return Observation(jnp.full((query.frequency_hz.shape[0], 90, 360), 0.5) + flat, jobs=jobs)

    cusp = ModuleType("cusp")
    cusp.__dict__.update(vars(wideband) | {"observe": observe})
    epoch = make_epoch(cusp, run.optimizer, run.capacity, SETTINGS.optim)
    before = snapshot(run.state)
    state, report = epoch(run.state, run.data, jnp.asarray(run.batches(0, LENGTH)), first(0))
    assert bool(report.stopped) and int(report.good_steps) == 0 and not report.overflow
    assert_equal_states(state, before)


def test_the_loss_decreases(tmp_path, dataset):
    run = new_run(dataset, tmp_path)
    losses, ssims = zip(*(run.epoch() for _ in range(40)), strict=True)
    assert np.mean(losses[-3:]) < 0.7 * losses[0]
    assert np.mean(ssims[-3:]) > ssims[0] + 0.1


def test_batches_depend_on_seed_and_epoch_alone(tmp_path, dataset):
    run, again = new_run(dataset, tmp_path), new_run(dataset, tmp_path)
    np.testing.assert_array_equal(run.batches(3, LENGTH), again.batches(3, LENGTH))
    assert (run.batches(0, LENGTH) != run.batches(1, LENGTH)).any()
    batch = run.batches(5, 50)
    assert set(batch.ravel()) == set(dataset.train.tolist())
    assert all(len(set(row)) == 2 for row in batch)
    few = dataclasses.replace(dataset, train=dataset.train[:1])
    assert new_run(few, tmp_path).batches(0, LENGTH).shape == (LENGTH, 1)
