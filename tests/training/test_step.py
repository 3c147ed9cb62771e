"""The jitted epoch and the host's answer to what it reports: nothing half-done is ever kept."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_dataset, tiny_scene
from builders.toys import GROWING, CuspField, RippleField, Room, SwellingField, registered, toy_settings

from wbgs_jax._util.errors import UserError
from wbgs_jax.data import scene_dataset
from wbgs_jax.data.image_folder import export_layout, load_layout
from wbgs_jax.fields.wideband import WidebandParams
from wbgs_jax.splat import TileLimits, project
from wbgs_jax.splat.tiles import build_tile_jobs
from wbgs_jax.training.batches import training_data
from wbgs_jax.training.density import DensityControl
from wbgs_jax.training.hooks import probe_of
from wbgs_jax.training.loop import Run
from wbgs_jax.training.step import loss_and_gradients, run_epoch
from wbgs_jax.types import Gaussians

LENGTH = 4
SETTINGS = toy_settings(loop={"epoch_steps": LENGTH})
TINY = TileLimits(entries=256, jobs=256)


@pytest.fixture(scope="module")
def dataset():
    return tiny_dataset()


@pytest.fixture(scope="module", autouse=True)
def toys():
    with registered(RippleField, SwellingField, CuspField):
        yield


def new_run(dataset, folder, name="ripple", settings=SETTINGS, capacity=None):
    run = Run(dataset, name, settings, 0, folder)
    run.capacity = run.capacity if capacity is None else capacity
    return run


def epoch(run, state, batches, start=0):
    """The epoch of a run, from another state and of other batches than its own; takes the state's memory."""
    return run_epoch(
        jax.tree.map(jnp.asarray, state),
        run.field,
        run.prepared,
        run.data,
        jnp.asarray(batches),
        jnp.asarray(start, jnp.int32),
        run.key,
        optimizer=run.optimizer,
        hooks=run.hooks,
        capacity=run.capacity,
    )


def snapshot(state):
    """A copy on the host: an epoch takes its argument's memory."""
    return jax.tree.map(np.array, state)


def assert_equal_states(a, b):
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y, err_msg=jax.tree_util.keystr(path))


@pytest.mark.parametrize(("kind", "n_rx"), [("snapshot", 1), ("snapshot", 3), ("pas", 3), ("power", 3)])
@pytest.mark.parametrize("unit", ["wavelengths", "metres"])
def test_data_on_the_device_are_the_datasets(kind, n_rx, unit):
    source = scene_dataset(tiny_scene(kind=kind, n_rx=n_rx, unit=unit))
    data = training_data(source)
    for number in range(n_rx):
        index = np.flatnonzero(source.receiver_index == number)[:4]
        batch = data.batch(jnp.asarray(index), jax.random.key(0))
        np.testing.assert_array_equal(batch.links.tx_position, source.query(index).tx_position)
        np.testing.assert_array_equal(batch.links.frequency_hz, source.query(index).frequency_hz)
        np.testing.assert_array_equal(batch.links.receiver_index, source.receiver_index[index])
        np.testing.assert_array_equal(batch.links.tx_index, source.tx_index[index])
        for own, expected in zip(jax.tree.leaves(batch.receiver), jax.tree.leaves(source.receiver(number)), strict=True):
            np.testing.assert_array_equal(own, expected)
        if kind == "power":
            assert batch.pas is None and batch.snapshots is None
            np.testing.assert_array_equal(batch.power_db, source.power_db[index].astype(np.float32))
            continue
        assert batch.power_db is None and (batch.snapshots is None) == (kind == "pas")
        np.testing.assert_allclose(batch.pas, source.pas(index), atol=1e-5)
        if kind == "snapshot":
            np.testing.assert_array_equal(batch.snapshots, source.snapshots[index])


def test_spectra_of_a_folder_on_the_device_are_the_datasets(tmp_path):
    export_layout(tiny_scene(), tmp_path / "folder")
    source = load_layout(tmp_path / "folder")
    data = training_data(source)
    index = source.test[:3]
    np.testing.assert_allclose(data.pas(jnp.asarray(index)), source.pas(index), atol=1e-5)
    np.testing.assert_array_equal(data.links.tx_position[index], source.query(index).tx_position)
    np.testing.assert_array_equal(data.links.frequency_hz[index], source.query(index).frequency_hz)


def test_an_epoch_of_several_steps_equals_as_many_epochs_of_one(tmp_path, dataset):
    run = new_run(dataset, tmp_path)
    batches = run.batches(0, LENGTH)
    start = snapshot(run.state)
    together, report = epoch(run, start, batches)
    assert int(report.good_steps) == LENGTH == int(together.step) and not report.stopped
    state, losses = start, []
    for i in range(LENGTH):
        state, one = epoch(run, state, batches[i : i + 1])
        losses.append(float(one.loss[0]))
    np.testing.assert_allclose(losses, report.loss, rtol=1e-4)
    for x, y in zip(jax.tree.leaves(together), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-5)


def test_an_epoch_can_start_in_its_middle(tmp_path, dataset):
    run = new_run(dataset, tmp_path)
    batches = run.batches(0, LENGTH)
    start = snapshot(run.state)
    whole, _ = epoch(run, start, batches)
    two_by_two = start
    for halves in (np.concatenate([batches[2:], batches[:2]]), batches):  # the last two places run, twice
        two_by_two, report = epoch(run, two_by_two, halves, 2)
        assert int(report.good_steps) == 2 and np.isnan(report.loss[:2]).all() and np.isfinite(report.loss[2:]).all()
        similarity = report.metrics["batch_ssim"]
        assert np.isnan(similarity[:2]).all() and np.isfinite(similarity[2:]).all()
    assert_equal_states(whole, two_by_two)


def test_the_statistics_of_density_control_are_sums_over_steps(rng):
    """Of the positional gradients, on the image and in the world, and of the steps in which there was one."""
    n = 9
    gaussians = Gaussians(jnp.zeros((n, 3)), jnp.zeros((n, 3)), jnp.ones((n, 4)), jnp.zeros(n))
    control = DensityControl(GROWING.density)
    statistics = control.statistics(WidebandParams(gaussians, {}))
    probes, means = rng.normal(size=(2, n, 2)).astype(np.float32), rng.normal(size=(2, n, 3)).astype(np.float32)
    probes[0, :5] = probes[1, 3:7] = 0
    for probe, mean in zip(probes, means, strict=True):
        gradients = WidebandParams(dataclasses.replace(gaussians, means=jnp.asarray(mean)), {})
        statistics = control.accumulate(statistics, gradients, jnp.asarray(probe))
    norms = np.hypot(probes[..., 0] * 180, probes[..., 1] * 45)  # pixels -> -1..1 across the image
    np.testing.assert_allclose(statistics.gradient_norm, norms.sum(0), rtol=1e-5)
    np.testing.assert_allclose(statistics.mean_gradient, means.sum(0), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(statistics.visible, (norms > 0).sum(0))


@pytest.mark.slow
def test_the_statistics_are_sums_of_the_positional_gradients(tmp_path, dataset):
    """Against the gradient of the loss with respect to a shift of the splats, at unchanged parameters. (test_controls.py does
    so for a toy field, quicker.)"""
    run = new_run(dataset, tmp_path, "wideband", GROWING)
    index = jnp.asarray(run.batches(0, 1)[0])
    gradients, probe = jax.jit(loss_and_gradients, static_argnames="capacity"), probe_of(run.hooks, run.state.params)
    _, (d_params, d_means2d) = gradients(
        run.field, run.state.params, run.prepared, run.data, index, run.capacity, run.key, None, probe
    )
    state, _ = epoch(run, run.state, jnp.tile(index, (2, 1)), 1)
    expected = np.hypot(d_means2d[:, 0] * 180, d_means2d[:, 1] * 45)
    (seen,) = state.statistics
    np.testing.assert_allclose(seen.gradient_norm, expected, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(seen.mean_gradient, d_params.gaussians.means, rtol=1e-3, atol=1e-6)
    np.testing.assert_array_equal(seen.visible, (expected > 0).astype(float))


@pytest.mark.heavy
def test_an_overflow_commits_nothing_and_the_host_grows_the_tile_lists(tmp_path, dataset):
    """And ends where a roomy run ends."""
    roomy, short = (new_run(dataset, tmp_path, "wideband", GROWING, capacity) for capacity in (None, TINY))
    before = snapshot(short.state)
    state, report = epoch(short, before, short.batches(0, 2))
    assert bool(report.overflow) and bool(report.stopped) and int(report.good_steps) == 0
    assert int(report.required[0]) > TINY.entries
    assert np.isnan(report.loss).all()
    assert_equal_states(state, before)
    results = [run.epoch() for run in (roomy, short)]
    assert results[0] == results[1]
    assert short.step == 2 and short.compilations > roomy.compilations
    assert short.capacity.entries > TINY.entries
    assert_equal_states(short.state, roomy.state)


def test_an_overflow_in_the_middle_of_an_epoch_repeats_the_rest_of_it(tmp_path, dataset):
    """A field that needs more room with every step outgrows a capacity that fits the first step exactly."""
    swelling = toy_settings(field={"learning_rate": 0.2}, loop={"epoch_steps": LENGTH})
    short, probe = (new_run(dataset, tmp_path, "swelling", swelling) for _ in range(2))
    _, report = epoch(probe, probe.state, probe.batches(0, LENGTH))
    assert bool(report.overflow) and 0 < int(report.good_steps) < LENGTH
    assert int(report.required[0]) > short.capacity.size
    figures = short.epoch()
    roomy = new_run(dataset, tmp_path, "swelling", swelling, short.capacity)
    assert roomy.epoch() == figures and roomy.compilations < short.compilations
    assert_equal_states(short.state, roomy.state)


def test_limits_that_have_grown_are_kept_by_checkpoints(tmp_path, dataset):
    run = new_run(dataset, tmp_path, "swelling", SETTINGS)
    first = run.capacity
    run.epoch()
    assert run.capacity.size > first.size
    run.save()
    again = new_run(dataset, tmp_path, "swelling", SETTINGS)
    assert again.capacity == first and again.restore() and again.capacity == run.capacity == Room(run.capacity.size)
    assert again.epoch() == run.epoch() and again.capacity == run.capacity
    assert_equal_states(again.state, run.state)


@pytest.mark.slow
def test_tile_lists_that_overflow_in_the_middle_of_an_epoch(tmp_path, dataset):
    """The same of the wideband field: small footprints that swell by a third each step outgrow tile lists that fit the first
    one exactly."""
    swelling = dataclasses.replace(
        GROWING,
        field=dataclasses.replace(GROWING.field, log_scales_lr=0.3),
        loop=dataclasses.replace(GROWING.loop, epoch_steps=LENGTH),
    )

    def start(capacity=None):
        run = new_run(dataset, tmp_path, "wideband", swelling, capacity)
        gaussians = run.state.params.gaussians
        small = dataclasses.replace(gaussians, log_scales=gaussians.log_scales - 1)
        run.state = dataclasses.replace(run.state, params=dataclasses.replace(run.state.params, gaussians=small))
        return run

    splats = jax.jit(project)(start().state.params.gaussians, dataset.receiver())
    exact = TileLimits(int(build_tile_jobs(splats, TINY).required_entries), 1024)
    short, probe = start(exact), start(exact)
    batches = probe.batches(0, LENGTH)
    good, report = epoch(probe, probe.state, batches)
    assert bool(report.overflow) and 0 < int(report.good_steps) < LENGTH
    figures = short.epoch()
    # Bit for bit where both parts ran with the same capacity; another sums in another order, and Adam makes much of it.
    expected, _ = epoch(start(short.capacity), good, batches, int(report.good_steps))
    assert_equal_states(short.state, expected)
    roomy = start(short.capacity)
    assert roomy.epoch() == pytest.approx(figures, rel=1e-3) and roomy.compilations < short.compilations


def broken(dataset, factor=np.nan, index=slice(None)):
    """The data set with snapshots that are no numbers."""
    made = dataset.with_observations(snapshots=dataset.snapshots.copy())
    made.snapshots[index] *= factor
    return made


def test_a_spectrum_that_is_not_a_number_stops_with_the_last_good_state(tmp_path, dataset):
    run = new_run(dataset, tmp_path)
    batches = run.batches(0, LENGTH)
    bad = next(int(i) for i in batches[2] if i not in batches[:2])
    run.save()
    run.data = training_data(broken(run.dataset, index=bad))
    with pytest.raises(UserError) as error:
        run.epoch()
    message = str(error.value)
    assert "\n" not in message and "step 2" in message and str(run.numbers[batches[2]].tolist()) in message
    assert str(tmp_path / "checkpoints" / "0") in message
    assert run.step == 2
    good = new_run(dataset, tmp_path)
    only_two = np.concatenate([batches[:2], batches[:2]])[[2, 3, 0, 1]]
    expected, _ = epoch(good, good.state, only_two, 2)
    assert_equal_states(run.state, expected)


def test_without_a_checkpoint_the_message_says_so(tmp_path, dataset):
    run = new_run(dataset, tmp_path)
    run.data = training_data(broken(dataset))
    with pytest.raises(UserError, match=r"step 0 .* no checkpoint"):
        run.epoch()


def test_a_gradient_that_is_not_finite_is_not_committed(tmp_path, dataset):
    """The loss alone can look healthy: its value is finite, its derivative is not."""
    run = new_run(dataset, tmp_path, "cusp")
    before = snapshot(run.state)
    (loss, _), _ = jax.jit(loss_and_gradients)(
        run.field, run.state.params, run.prepared, run.data, jnp.arange(2), None, run.key
    )
    assert np.isfinite(loss)
    state, report = epoch(run, before, run.batches(0, LENGTH))
    assert bool(report.stopped) and int(report.good_steps) == 0 and not report.overflow
    assert_equal_states(state, before)


@pytest.mark.heavy
def test_the_loss_decreases(tmp_path, dataset):
    """Three spectra are learned by heart."""
    few = dataclasses.replace(dataset, train=dataset.train[:3])
    run = new_run(few, tmp_path, "wideband", GROWING)
    figures = [run.epoch() for _ in range(20)]
    losses, ssims = ([f[name] for f in figures] for name in ("loss", "batch_ssim"))
    assert np.mean(losses[-5:]) < 0.6 * losses[0]
    assert np.mean(ssims[-5:]) > ssims[0] + 0.25


def test_batches_depend_on_seed_and_epoch_alone(tmp_path, dataset):
    run, again = new_run(dataset, tmp_path), new_run(dataset, tmp_path)
    np.testing.assert_array_equal(run.batches(3, LENGTH), again.batches(3, LENGTH))
    assert (run.batches(0, LENGTH) != run.batches(1, LENGTH)).any()
    batch = run.batches(5, 50)
    assert set(run.numbers[batch].ravel()) == set(dataset.train.tolist())
    assert all(len(set(row)) == 2 for row in batch)
    few = dataclasses.replace(dataset, train=dataset.train[:1])
    assert new_run(few, tmp_path).batches(0, LENGTH).shape == (LENGTH, 1)


@pytest.mark.heavy
def test_a_batch_is_of_one_receiver_and_every_receiver_has_its_share(tmp_path):
    dataset = tiny_dataset(n_rx=3)
    links = dataset.train
    two_of_the_last = links[dataset.receiver_index[links] == 2][:1]
    dataset = dataclasses.replace(dataset, train=np.sort([*links[dataset.receiver_index[links] < 2], *two_of_the_last]))
    run = new_run(dataset, tmp_path)
    batches = run.numbers[run.batches(0, 300)]
    assert batches.shape == (300, 2)
    of = dataset.receiver_index[batches]
    np.testing.assert_array_equal(of[:, 0], of[:, 1])
    assert set(batches.ravel()) == set(dataset.train.tolist())
    share = np.bincount(dataset.receiver_index[dataset.train]) / len(dataset.train)
    np.testing.assert_allclose(np.bincount(of[:, 0]) / len(of), share, atol=4 * np.sqrt(0.25 / 300))
