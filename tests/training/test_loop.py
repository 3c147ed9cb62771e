"""The host loop: a run that was interrupted and resumed is the run that was not."""

import concurrent.futures
import dataclasses
import shutil
import signal
import warnings
from dataclasses import dataclass

import jax
import numpy as np
import pytest
from builders.synthetic import tiny_dataset, tiny_settings
from builders.toys import GROWING, metrics_of, toy_settings

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.evaluation.score import watch
from wbgs_jax.fields import get_field
from wbgs_jax.fields.wideband import WidebandField
from wbgs_jax.splat import TileLimits
from wbgs_jax.training import checkpoint
from wbgs_jax.training.batches import check_data
from wbgs_jax.training.hooks import Edit, Hook
from wbgs_jax.training.loop import Interrupted, Run, train
from wbgs_jax.training.step import init_state
from wbgs_jax.training.step import run_epoch as epoch_programs

pytestmark = pytest.mark.usefixtures("ripple")

STEPS = 8
PLAIN = ("ripple", toy_settings())
CROWDED = ("wideband", GROWING)
"""What is trained: a toy without hooks, or Gaussians that density control adds to, into more slots."""


@pytest.fixture(scope="module")
def dataset():
    return hold_out_validation(tiny_dataset(), 0.25)


@pytest.fixture(scope="module")
def uninterrupted(dataset, tmp_path_factory):
    """Folders of finished runs, by field and settings."""
    finished = {}

    def run(case):
        if case not in finished:
            finished[case] = tmp_path_factory.mktemp("run")
            assert train(dataset, *case, 0, finished[case]).steps == STEPS
        return finished[case]

    return run


def interrupt_after(monkeypatch, epochs, signals=(signal.SIGINT,)):
    """Send signals to this process during the given epoch."""
    original, done = Run.epoch, []

    def epoch(run, go_on=False):
        result = original(run, go_on)
        done.append(run.step)
        if len(done) == epochs:
            for number in signals:
                signal.raise_signal(number)
        return result

    monkeypatch.setattr(Run, "epoch", epoch)


def final_state(dataset, folder, case):
    run = Run(dataset, *case, 0, folder)
    assert run.restore() and run.step == STEPS
    return run.state


def assert_same_run(dataset, folder, other, case):
    a, b = (final_state(dataset, f, case) for f in (folder, other))
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y, err_msg=jax.tree_util.keystr(path))
    assert metrics_of(folder) == metrics_of(other)


def test_a_run_leaves_checkpoints_and_curves(dataset, tmp_path):
    settings = toy_settings(loop={"checkpoint_every": 2, "evaluate_every": 4, "keep_checkpoints": 3})
    result = train(dataset, "ripple", settings, 0, tmp_path)
    assert (result.steps, result.sizes, result.compilations) == (STEPS, {"parameters": 7}, 1)
    assert checkpoint.checkpoint_steps(tmp_path / "checkpoints") == [4, 6, 8]
    entries = metrics_of(tmp_path)
    assert [entry["step"] for entry in entries] == [2, 4, 6, 8]
    assert [entry["step"] for entry in entries if "held_out_ssim" in entry] == [4, 8]
    assert all(entry.keys() >= {"loss", "batch_ssim", "parameters"} for entry in entries)
    assert all(np.isfinite(list(entry.values())).all() for entry in entries)


@pytest.mark.heavy
@pytest.mark.parametrize("case", [PLAIN, CROWDED], ids=["plain", "crowded"])
def test_checkpoints_follow_their_interval(uninterrupted, case):
    assert checkpoint.checkpoint_steps(uninterrupted(case) / "checkpoints") == [4, 8]


def test_equal_seeds_give_equal_runs_and_others_do_not(dataset, tmp_path, uninterrupted):
    train(dataset, *PLAIN, 0, tmp_path / "again")
    assert_same_run(dataset, tmp_path / "again", uninterrupted(PLAIN), PLAIN)
    other = train(dataset, *PLAIN, 1, tmp_path / "other")
    assert (other.params["level"] != final_state(dataset, tmp_path / "again", PLAIN).params["level"]).any()
    assert metrics_of(tmp_path / "other") != metrics_of(tmp_path / "again")


def test_equal_seeds_make_equal_fields_and_others_do_not(dataset):
    """Where the Gaussians start, and with which weights. (Below, a run that starts anew ends as another one did.)"""
    made = [WidebandField.build(GROWING.field, DatasetScene(dataset), seed) for seed in (0, 0, 1)]
    params = [field.init(jax.random.key(seed)) for field, seed in zip(made, (0, 0, 1), strict=True)]
    for x, y in zip(jax.tree.leaves((made[0], params[0])), jax.tree.leaves((made[1], params[1])), strict=True):
        np.testing.assert_array_equal(x, y)
    assert (params[0].gaussians.means != params[2].gaussians.means).any()
    assert any((x != y).any() for x, y in zip(*(jax.tree.leaves(params[i].networks) for i in (0, 2)), strict=True))


@pytest.mark.parametrize(
    "case", [pytest.param(PLAIN, id="plain"), pytest.param(CROWDED, id="across more slots", marks=pytest.mark.heavy)]
)
def test_resuming_from_the_middle_equals_not_stopping(dataset, tmp_path, uninterrupted, case):
    """The density control of step 4 lies before the checkpoint of step 4."""
    shutil.copytree(uninterrupted(case), tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / str(STEPS))
    if case is CROWDED:
        slots = checkpoint.read(tmp_path / "run" / "checkpoints", 4).state[".params.gaussians.means"].shape[0]
        assert slots > 64
    assert train(dataset, *case, 0, tmp_path / "run", resume=True).steps == STEPS
    assert_same_run(dataset, tmp_path / "run", uninterrupted(case), case)


@pytest.mark.heavy
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_saves_and_says_how_to_go_on(dataset, tmp_path, monkeypatch, uninterrupted, number):
    """The device has been given the next epoch already, which is waited for; the density control is due after it."""
    before = signal.getsignal(number)
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1, [number])
        with pytest.raises(Interrupted, match=r"step 4 of 8.*--resume") as stopped:
            train(dataset, *CROWDED, 0, tmp_path)
    assert isinstance(stopped.value, UserError) and "\n" not in str(stopped.value)
    assert signal.getsignal(number) == before
    assert checkpoint.checkpoint_steps(tmp_path / "checkpoints") == [4]
    train(dataset, *CROWDED, 0, tmp_path, resume=True)
    assert_same_run(dataset, tmp_path, uninterrupted(CROWDED), CROWDED)


def test_a_second_interrupt_does_not_wait(dataset, tmp_path, monkeypatch):
    interrupt_after(monkeypatch, 1, [signal.SIGINT, signal.SIGINT])
    with pytest.raises(KeyboardInterrupt):
        train(dataset, *PLAIN, 0, tmp_path)


def test_an_interrupt_in_the_last_epoch_is_passed_on(dataset, tmp_path, monkeypatch, uninterrupted):
    interrupt_after(monkeypatch, STEPS // PLAIN[1].loop.epoch_steps)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            train(dataset, *PLAIN, 0, tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    assert_same_run(dataset, tmp_path, uninterrupted(PLAIN), PLAIN)


def test_a_run_killed_before_its_first_checkpoint_starts_anew(dataset, tmp_path, uninterrupted):
    first_lines = (uninterrupted(PLAIN) / "metrics.jsonl").read_text().splitlines(keepends=True)[:1]
    (tmp_path / "metrics.jsonl").write_text("".join(first_lines))
    train(dataset, *PLAIN, 0, tmp_path, resume=True)
    assert_same_run(dataset, tmp_path, uninterrupted(PLAIN), PLAIN)


def test_a_curve_cut_short_is_mended(dataset, tmp_path, uninterrupted):
    shutil.copytree(uninterrupted(PLAIN), tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / str(STEPS))
    curve = tmp_path / "run" / "metrics.jsonl"
    curve.write_text(curve.read_text()[:-20])
    train(dataset, *PLAIN, 0, tmp_path / "run", resume=True)
    assert_same_run(dataset, tmp_path / "run", uninterrupted(PLAIN), PLAIN)


def test_resuming_a_finished_run_changes_nothing(dataset, tmp_path, uninterrupted):
    shutil.copytree(uninterrupted(PLAIN), tmp_path / "run")
    result = train(dataset, *PLAIN, 0, tmp_path / "run", resume=True)
    assert result.steps == STEPS
    assert_same_run(dataset, tmp_path / "run", uninterrupted(PLAIN), PLAIN)


def test_density_controls_are_reported_and_keep_their_schedule(uninterrupted):
    entries = metrics_of(uninterrupted(CROWDED))
    (control,) = [entry for entry in entries if "density" in entry]
    assert control["step"] == 4
    assert control["density"]["alive"] == 90
    assert [entry["gaussians"] for entry in entries if "loss" in entry] == [60, 90, 90, 90]
    assert not any("density" in entry for entry in metrics_of(uninterrupted(PLAIN)))


def test_the_next_size_is_compiled_before_it_is_needed(dataset, tmp_path, monkeypatch):
    """By a call that runs no step; the epoch that needs it compiles nothing, and the capacity has grown in proportion."""
    run, called = Run(dataset, *CROWDED, 0, tmp_path), []
    original = Run._run_epoch

    def run_epoch(run, state, prepared, batches, first, capacity, stopped):
        called.append((len(state.params.gaussians.means), first, capacity))
        return original(run, state, prepared, batches, first, capacity, stopped)

    monkeypatch.setattr(Run, "_run_epoch", run_epoch)
    before = run.capacity
    run.epoch()
    assert run.precompilation.wait(next(iter(run.precompilation._calls)))
    assert called == [(64, 0, before), (96, 2, before.scaled(1.5))] and run.precompilation.seconds > 0
    run.epoch()
    run.run_hooks()
    compiled = epoch_programs._cache_size()
    assert len(run.state.params.gaussians.means) == 96 and run.capacity == before.scaled(1.5) and run.compilations == 2
    seconds = run.compile_seconds
    run.epoch()
    assert epoch_programs._cache_size() == compiled and run.compile_seconds == seconds


@dataclass(frozen=True)
class Calibration(Hook):
    """A hook before the first step that changes no shape."""

    stream: int = 9

    def due(self, step, steps):
        return step == 0

    def apply(self, field, params, statistics, context, step, rng):
        return Edit(params, (), None, {})


def test_the_epoch_is_compiled_while_hooks_calibrate(dataset, tmp_path):
    run = Run(dataset, *PLAIN, 0, tmp_path)
    run.hooks = (Calibration(),)
    run.state = init_state(run.state.params, run.optimizer, run.hooks)
    assert run.run_hooks()
    assert run.precompilation.wait(run._program(run.state.params, run.capacity))
    compiled = epoch_programs._cache_size()
    assert run.epoch()["loss"] > 0
    assert epoch_programs._cache_size() == compiled and run.compile_seconds == 0


@pytest.mark.heavy
def test_a_device_that_goes_on_trains_what_one_does_that_waits(dataset, tmp_path, monkeypatch):
    """Also where the first of two epochs that were given ends early: the second does nothing until the capacity holds."""
    states, figures = [], []
    for ahead in (False, True):
        run = Run(dataset, *CROWDED, 0, tmp_path / str(ahead))
        run.capacity = TileLimits(entries=1024, jobs=1024)
        figures.append([run.epoch(go_on=ahead), run.epoch()])
        assert not run.launched and run.step == 4 and run.compilations > 1
        states.append(run.state)
    assert figures[0] == figures[1]
    for x, y in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_array_equal(x, y)


def test_steps_are_counted_as_far_as_their_figures_are_known(dataset, tmp_path):
    run = Run(dataset, *PLAIN, 0, tmp_path)
    run.epoch(go_on=True)
    assert run.step == 2 and len(run.launched) == 1 and int(run.state.step) == 4
    assert [run.due(step) for step in (2, 4, 6, 8)] == [False, True, False, True]  # checkpoints, and the end


def test_a_reset_of_the_attenuation_happens_at_its_step(dataset, tmp_path, uninterrupted):
    """At that of step 4: all are below the ceiling then, and dead slots stay dead."""
    shutil.copytree(uninterrupted(CROWDED), tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / str(STEPS))
    run = Run(dataset, *CROWDED, 0, tmp_path / "run")
    assert run.restore() and run.step == 4
    alive = np.asarray(run.state.params.gaussians.alive)
    ceiling = np.log(0.01 / 0.99)
    logits = np.asarray(run.state.params.gaussians.opacity_logits)
    assert alive.sum() == 90 and logits[alive].max() <= ceiling + 1e-5 and np.isneginf(logits[~alive]).all()


def test_a_folder_that_cannot_be_written(dataset, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write .*metrics\.jsonl"):
        train(dataset, *PLAIN, 0, tmp_path / "file" / "run")


def test_data_without_training_or_test_spectra(dataset, tmp_path):
    with pytest.raises(UserError, match="box has no training spectra"):
        train(dataclasses.replace(dataset, train=dataset.train[:0]), *PLAIN, 0, tmp_path / "untrained")
    assert not (tmp_path / "untrained").exists()
    neither = dataclasses.replace(dataset, test=dataset.test[:0], validation=dataset.validation[:0])
    train(neither, *PLAIN, 0, tmp_path / "unwatched")
    assert not any("held_out_ssim" in entry for entry in metrics_of(tmp_path / "unwatched"))


def test_training_in_a_thread(dataset, tmp_path):
    """Signals can be handled in the main thread only; sweeps train in others."""
    with concurrent.futures.ThreadPoolExecutor() as pool:
        assert pool.submit(train, dataset, *PLAIN, 0, tmp_path).result().steps == STEPS


def test_curves_watch_the_validation_part_or_nothing(dataset, tmp_path):
    assert len(Run(tiny_dataset(), *PLAIN, 0, tmp_path).watched) == 0
    run = Run(dataset, *PLAIN, 0, tmp_path)
    watched = run.numbers[run.watched]
    assert len(watched) == 2 and set(watched) <= set(dataset.validation.tolist())
    assert run.evaluate() == watch(run.field, run.state.params, dataset, watched)
    assert set(run.numbers[run.batches(0, 50).ravel()]) <= set(dataset.train.tolist())


@pytest.mark.heavy
@pytest.mark.parametrize("field", ["wideband", "nerf2", "wave", "hybrid"])
def test_nothing_of_a_training_looks_at_the_test(dataset, tmp_path, field):
    """What is held out, place and spectrum, may be anything: field, links, data and batches are bit for bit the same."""
    heard, places = dataset.snapshots.copy(), dataset.tx_positions.copy()
    heard[dataset.test], places[dataset.test] = np.nan, 1e3
    poisoned = dataclasses.replace(dataset, observations={"snapshots": heard}, tx_positions=places)
    runs = [Run(data, field, tiny_settings(field), 0, tmp_path) for data in (dataset, poisoned)]
    seen = [(run.field, run.state, run.prepared, run.data, run.batches(0, 3), run.watched) for run in runs]
    for a, b in zip(*map(jax.tree.leaves, seen), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_curriculum_starts_with_low_frequencies_and_ends_with_all(dataset, tmp_path):
    run = Run(dataset, "ripple", toy_settings(optim={"curriculum": 0.5}), 0, tmp_path)
    highest = [run.dataset.frequencies_hz[run.pool(progress)].max() for progress in (0.0, 0.26, 0.49, 0.5, 1.0)]
    assert highest == [1e9, 10e9, 10e9, 94e9, 94e9]
    np.testing.assert_array_equal(run.numbers[run.pool(0.5)], dataset.train)
    assert set(run.batches(0, 20).ravel()) <= set(run.pool(0.0))


def test_coordinates_of_a_map_are_noted():
    dataset = tiny_dataset()
    check_data(dataset, get_field("wideband"))
    far = dataclasses.replace(dataset, tx_positions=dataset.tx_positions + np.array([5e3, 0, 0]))
    with pytest.warns(UserWarning, match="holds coordinates of 5,.* m, where single precision is coarse"):
        check_data(far, get_field("wideband"))


def test_transmitters_on_a_surface_are_counted():
    """Half a millimetre behind a floor they are on both sides of it; two centimetres above it they are not."""
    dataset = tiny_dataset()
    corners = np.array([(-50, -50, 0), (50, -50, 0), (0, 50, 0)], np.float32)
    mesh = dataclasses.replace(dataset, vertices=corners, faces=np.array([[0, 1, 2]], np.int32), face_part=None, materials=None)
    places = mesh.tx_positions.copy()
    places[:, 2] = 0.02
    places[places[:, 0] == places[0, 0], 2] = -0.0005
    count = len(np.unique(places[places[:, 2] < 0], axis=0))
    on_it = dataclasses.replace(mesh, tx_positions=places)
    with pytest.warns(UserWarning, match=f"{count} transmitters and 0 receivers lie on a surface"):
        check_data(on_it, get_field("wave"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_data(on_it, get_field("wideband"))
        check_data(dataclasses.replace(on_it, tx_positions=np.abs(places) + np.array([0, 0, 0.02])), get_field("wave"))
