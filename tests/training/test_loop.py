"""The host loop: a run that was interrupted and resumed is the run that was not."""

import concurrent.futures
import dataclasses
import json
import shutil
import signal

import jax
import numpy as np
import pytest
from synthetic import tiny_dataset, tiny_settings

from wbgs_jax.training import checkpoint
from wbgs_jax._util.errors import UserError
from wbgs_jax.training.loop import Interrupted, Run, train

STEPS = 8
SETTINGS = tiny_settings()
GROWING = tiny_settings(
    wideband={"gaussians": 60},
    density={"every": 4, "start": 4, "stop_fraction": 0.5, "gradient_threshold": 0.0, "max_gaussians": 90, "reset_every": 4},
)
"""Half way, the Gaussians outgrow their capacity of 64."""


pytestmark = pytest.mark.usefixtures("compile_once")


@pytest.fixture(scope="module")
def dataset():
    return tiny_dataset()


@pytest.fixture(scope="module")
def uninterrupted(dataset, tmp_path_factory):
    """Folders of finished runs, by settings."""
    finished = {}

    def run(settings):
        if settings not in finished:
            finished[settings] = tmp_path_factory.mktemp("run")
            train(dataset, "wideband", settings, 0, finished[settings])
        return finished[settings]

    return run


def interrupt_after(monkeypatch, epochs, signals=(signal.SIGINT,)):
    """Send signals to this process during the given epoch."""
    original, done = Run.epoch, []

    def epoch(run):
        result = original(run)
        done.append(run.step)
        if len(done) == epochs:
            for number in signals:
                signal.raise_signal(number)
        return result

    monkeypatch.setattr(Run, "epoch", epoch)


def final_state(dataset, folder, settings):
    run = Run(dataset, "wideband", settings, 0, folder)
    assert run.restore() and run.step == STEPS
    return run.state


def metrics_of(folder):
    """Curve entries without the wall-clock time."""
    entries = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in entry.items() if key != "seconds"} for entry in entries]


def assert_same_run(dataset, folder, other, settings):
    a, b = (final_state(dataset, f, settings) for f in (folder, other))
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y, err_msg=jax.tree_util.keystr(path))
    assert metrics_of(folder) == metrics_of(other)


def test_a_run_leaves_checkpoints_and_curves(dataset, tmp_path):
    settings = tiny_settings(loop={"checkpoint_every": 2, "evaluate_every": 4, "keep_checkpoints": 3})
    result = train(dataset, "wideband", settings, 0, tmp_path)
    assert (result.steps, result.gaussians) == (STEPS, 60)
    assert checkpoint.checkpoint_steps(tmp_path / "checkpoints") == [4, 6, 8]
    entries = metrics_of(tmp_path)
    assert [entry["step"] for entry in entries] == [2, 4, 6, 8]
    assert [entry["step"] for entry in entries if "held_out_ssim" in entry] == [4, 8]
    assert all(np.isfinite(list(entry.values())).all() for entry in entries)


def test_checkpoints_follow_their_interval(uninterrupted):
    assert checkpoint.checkpoint_steps(uninterrupted(SETTINGS) / "checkpoints") == [4, 8]


def test_equal_seeds_give_equal_runs_and_others_do_not(dataset, tmp_path, uninterrupted):
    train(dataset, "wideband", SETTINGS, 0, tmp_path / "again")
    assert_same_run(dataset, tmp_path / "again", uninterrupted(SETTINGS), SETTINGS)
    other = train(dataset, "wideband", SETTINGS, 1, tmp_path / "other")
    assert (other.params.gaussians.means != final_state(dataset, tmp_path / "again", SETTINGS).params.gaussians.means).any()


@pytest.mark.parametrize("settings", [SETTINGS, GROWING], ids=["plain", "across a larger capacity"])
def test_resuming_from_the_middle_equals_not_stopping(dataset, tmp_path, uninterrupted, settings):
    """The density control of step 4 lies before the checkpoint of step 4."""
    shutil.copytree(uninterrupted(settings), tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / str(STEPS))
    capacity = checkpoint.load_metadata(tmp_path / "run" / "checkpoints", 4)["sizes"]["gaussians"]
    assert capacity == 64 if settings is SETTINGS else capacity > 64
    assert train(dataset, "wideband", settings, 0, tmp_path / "run", resume=True).steps == STEPS
    assert_same_run(dataset, tmp_path / "run", uninterrupted(settings), settings)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_saves_and_says_how_to_go_on(dataset, tmp_path, monkeypatch, uninterrupted, number):
    """Here the density control comes after the interrupt."""
    before = signal.getsignal(number)
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1, [number])
        with pytest.raises(Interrupted, match=r"step 2 of 8.*--resume") as stopped:
            train(dataset, "wideband", GROWING, 0, tmp_path)
    assert isinstance(stopped.value, UserError) and "\n" not in str(stopped.value)
    assert signal.getsignal(number) == before
    assert checkpoint.checkpoint_steps(tmp_path / "checkpoints") == [2]
    train(dataset, "wideband", GROWING, 0, tmp_path, resume=True)
    assert_same_run(dataset, tmp_path, uninterrupted(GROWING), GROWING)


def test_a_second_interrupt_does_not_wait(dataset, tmp_path, monkeypatch):
    interrupt_after(monkeypatch, 1, [signal.SIGINT, signal.SIGINT])
    with pytest.raises(KeyboardInterrupt):
        train(dataset, "wideband", SETTINGS, 0, tmp_path)


def test_an_interrupt_in_the_last_epoch_is_passed_on(dataset, tmp_path, monkeypatch, uninterrupted):
    interrupt_after(monkeypatch, STEPS // SETTINGS.loop.epoch_steps)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            train(dataset, "wideband", SETTINGS, 0, tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    assert_same_run(dataset, tmp_path, uninterrupted(SETTINGS), SETTINGS)


def test_a_run_killed_before_its_first_checkpoint_starts_anew(dataset, tmp_path, uninterrupted):
    first_lines = (uninterrupted(SETTINGS) / "metrics.jsonl").read_text().splitlines(keepends=True)[:1]
    (tmp_path / "metrics.jsonl").write_text("".join(first_lines))
    train(dataset, "wideband", SETTINGS, 0, tmp_path, resume=True)
    assert_same_run(dataset, tmp_path, uninterrupted(SETTINGS), SETTINGS)


def test_a_curve_cut_short_is_mended(dataset, tmp_path, uninterrupted):
    shutil.copytree(uninterrupted(SETTINGS), tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / str(STEPS))
    curve = tmp_path / "run" / "metrics.jsonl"
    curve.write_text(curve.read_text()[:-20])
    train(dataset, "wideband", SETTINGS, 0, tmp_path / "run", resume=True)
    assert_same_run(dataset, tmp_path / "run", uninterrupted(SETTINGS), SETTINGS)


def test_resuming_a_finished_run_changes_nothing(dataset, tmp_path, uninterrupted):
    shutil.copytree(uninterrupted(SETTINGS), tmp_path / "run")
    result = train(dataset, "wideband", SETTINGS, 0, tmp_path / "run", resume=True)
    assert result.steps == STEPS
    assert_same_run(dataset, tmp_path / "run", uninterrupted(SETTINGS), SETTINGS)


def test_density_controls_are_reported_and_keep_their_schedule(uninterrupted):
    entries = metrics_of(uninterrupted(GROWING))
    (control,) = [entry for entry in entries if "density" in entry]
    assert control["step"] == 4
    assert control["density"]["alive"] == 90 == [entry for entry in entries if "loss" in entry][-1]["gaussians"]
    assert not any("density" in entry for entry in metrics_of(uninterrupted(SETTINGS)))


def test_a_reset_of_the_attenuation_happens_at_its_step(dataset, tmp_path, uninterrupted):
    shutil.copytree(uninterrupted(GROWING), tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / str(STEPS))
    run = Run(dataset, "wideband", GROWING, 0, tmp_path / "run")
    assert run.restore()
    alive = np.asarray(run.state.params.gaussians.alive) > 0
    ceiling = np.log(0.01 / 0.99)
    assert np.asarray(run.state.params.gaussians.opacity_logits)[alive].max() <= ceiling + 1e-5


def test_a_folder_that_cannot_be_written(dataset, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write .*metrics\.jsonl"):
        train(dataset, "wideband", SETTINGS, 0, tmp_path / "file" / "run")


def test_data_without_training_or_test_spectra(dataset, tmp_path):
    with pytest.raises(UserError, match="box has no training spectra"):
        train(dataclasses.replace(dataset, train=dataset.train[:0]), "wideband", SETTINGS, 0, tmp_path / "untrained")
    assert not (tmp_path / "untrained").exists()
    train(dataclasses.replace(dataset, test=dataset.test[:0]), "wideband", SETTINGS, 0, tmp_path / "unwatched")
    assert not any("held_out_ssim" in entry for entry in metrics_of(tmp_path / "unwatched"))


def test_training_in_a_thread(dataset, tmp_path):
    """Signals can be handled in the main thread only; sweeps train in others."""
    with concurrent.futures.ThreadPoolExecutor() as pool:
        assert pool.submit(train, dataset, "wideband", SETTINGS, 0, tmp_path).result().steps == STEPS


def test_a_curriculum_starts_with_low_frequencies_and_ends_with_all(dataset, tmp_path):
    settings = dataclasses.replace(SETTINGS, optim=dataclasses.replace(SETTINGS.optim, curriculum=0.5))
    run = Run(dataset, "wideband", settings, 0, tmp_path)
    highest = [dataset.frequencies_hz[run.pool(progress)].max() for progress in (0.0, 0.26, 0.49, 0.5, 1.0)]
    assert highest == [1e9, 10e9, 10e9, 94e9, 94e9]
    np.testing.assert_array_equal(run.pool(0.5), dataset.train)
    assert set(run.batches(0, 20).ravel()) <= set(run.pool(0.0))
