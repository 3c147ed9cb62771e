"""One job from its data to its result, through the runner: models, scores, what is kept, what was cut goes on."""

import contextlib
import dataclasses
import json
import signal
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from builders.synthetic import tiny_dataset

from experiments import execute, profiles, runner
from experiments.jobs import Job
from experiments.paper import GHZ_10
from experiments.results import Results
from wbgs_jax._util.errors import UserError
from wbgs_jax.training.loop import Run

JOB = Job("1", "wideband", profile="smoke")


def result_of(command, job=JOB):
    return Results(command.profile, command.results).get(job)


@pytest.mark.usefixtures("scene")
def test_a_training_that_ends_as_the_time_does_is_scored_the_next_time(command, models, monkeypatch):
    train = execute.train

    def slow(*arguments, **options):
        result = train(*arguments, **options)
        with contextlib.suppress(runner.TimeIsUp):
            signal.raise_signal(signal.SIGALRM)  # a training notes it and returns
        return result

    monkeypatch.setattr(execute, "train", slow)
    with mock.patch.object(execute, "predict_spectra", side_effect=AssertionError("scored")):
        assert runner.run([JOB], command) == []
    monkeypatch.setattr(execute, "train", train)
    runner.run([JOB], command)
    assert models == ["all", "all"] and result_of(command) is not None


@pytest.mark.usefixtures("scene", "ripple")
@pytest.mark.parametrize("field", ["ripple", pytest.param("wideband", marks=pytest.mark.slow)])
def test_a_cut_training_goes_on_to_the_same_result(field, command, monkeypatch, tmp_path):
    job, size = dataclasses.replace(JOB, field=field), profiles.PROFILES["smoke"]
    if field == "wideband":
        steady = size.changes | {"density": {"every": 0}}  # compiles once
        monkeypatch.setitem(profiles.PROFILES, "smoke", dataclasses.replace(size, changes=steady))
    original, epochs = Run.epoch, []

    def epoch(run, go_on=False):
        epochs.append(run.step)
        result = original(run, go_on)
        if len(epochs) == 2:
            signal.raise_signal(signal.SIGALRM)  # as if the time were up; the device has the third epoch already
        return result

    monkeypatch.setattr(Run, "epoch", epoch)
    assert runner.run([job], command) == []
    assert epochs == [0, 2, 4] and result_of(command, job) is None
    assert runner.run([job], command) == []
    assert epochs == [0, 2, 4, 6]
    cut = result_of(command, job)
    whole = dataclasses.replace(command, results=tmp_path / "other", runs=tmp_path / "more")
    runner.run([job], whole)
    np.testing.assert_array_equal(cut.ssim, result_of(whole, job).ssim)
    assert cut.values["curve"] == result_of(whole, job).values["curve"] and cut.values["curve"]["step"] == [2, 4, 6, 8]
    assert not (command.runs / "smoke" / job.name).exists()


@pytest.fixture
def models(monkeypatch):
    """Stand-ins for training and prediction; the folders of the models that were trained."""
    trained = []

    def train(dataset, field, settings, seed, folder, resume):
        trained.append(folder.name)
        (folder / "metrics.jsonl").write_text("".join(json.dumps({"step": s, "loss": 1 / s}) + "\n" for s in range(1, 500)))
        return SimpleNamespace(field=None, params=None, steps=499, seconds=1.5, sizes={"gaussians": 7})

    monkeypatch.setattr(execute, "train", train)
    monkeypatch.setattr(execute, "predict_spectra", lambda field, params, dataset, index: np.asarray(dataset.pas(index)) * 0.9)
    return trained


@pytest.mark.usefixtures("scene")
def test_models_of_single_frequencies_are_one_job_that_goes_on(command, models):
    job, stop = Job("1", "wrfgs", profile="smoke"), mock.patch.object(execute, "score", side_effect=[KeyboardInterrupt])
    with stop, contextlib.suppress(KeyboardInterrupt):
        runner.run([job], command)
    assert models == ["1GHz"]
    original = execute.score
    answers = [original, original, KeyboardInterrupt]

    def score(dataset, predicted):
        answer = answers.pop(0)
        if answer is KeyboardInterrupt:
            raise KeyboardInterrupt
        return answer(dataset, predicted)

    with mock.patch.object(execute, "score", score), pytest.raises(KeyboardInterrupt):
        runner.run([job], command)
    assert models == ["1GHz", "1GHz", "2.4GHz", "5GHz"]
    runner.run([job], command)
    assert models[4:] == ["5GHz", "10GHz", "24.25GHz", "37GHz", "47GHz", "60GHz", "77GHz", "94GHz"]
    found = result_of(command, job)
    assert found.ghz == list(GHZ_10) and found.ssim.shape == (2, 10)
    assert found.values["models"] == 10 and found.values["steps"] == 4990 and found.values["training_seconds"] == 15


@pytest.mark.usefixtures("scene")
def test_a_result_says_where_it_comes_from(command, models):
    runner.run([JOB], command)
    found = result_of(command).values
    assert {"commit", "device", "jax", "version"} <= set(found["environment"])
    assert found["job"] == dataclasses.asdict(JOB) and found["profile"] == found["preset"] == "smoke"
    assert found["settings"]["wideband.gaussians"] == 60 and found["settings"]["optim.steps"] == 8
    assert len(found["curve"]["step"]) <= execute.CURVE_POINTS
    assert found["samples"] == 499 * 2
    pictures = Results(command.profile, command.results).pictures(JOB)
    assert pictures.shape == (8, 90, 360) and pictures.max() > 200


@pytest.mark.usefixtures("scene")
def test_baselines_are_a_job_of_their_own(command):
    job = Job("1", "baselines", "C4", all_tx=True, profile="smoke")
    runner.run([job], command)
    found = result_of(command, job).values["baselines"]
    assert set(found) == {"mean_image", "nearest_tx", "inverse_distance", "line_of_sight"}
    assert list(found["nearest_tx"]) == ["2.4", "5", "10", "24.25", "37", "47", "60", "77"]


@pytest.mark.usefixtures("scene")
def test_a_change_is_trained_by_the_same_runner(command, models, monkeypatch):
    seen, train = [], execute.train

    def watched(dataset, field, settings, *others, **options):
        seen.append((dataset.vertices, settings))
        return train(dataset, field, settings, *others, **options)

    monkeypatch.setattr(execute, "train", watched)
    wanted = [dataclasses.replace(JOB, field="wave", variant=name) for name in ("", "mesh_moved_3cm", "no_search")]
    assert runner.run(wanted, command) == []
    (still, plain), (moved, same), (_, without) = seen
    assert np.abs(moved - still).max() > 1e-3 and same == plain
    assert plain.search.rounds > without.search.rounds == 0
    settings = [result_of(command, job).values["settings"] for job in wanted]
    assert settings[1] == settings[0] | {"mesh.displacement": 0.03} and settings[2] == settings[0] | {"search.rounds": 0}


def test_scores_find_their_transmitters_and_frequencies_in_any_order(rng):
    """Folders of spectra have an order of their own."""
    dataset = tiny_dataset(8)
    wrong = {
        (int(tx), float(f)): bool(rng.random() < 0.5) for tx in np.unique(dataset.tx_index) for f in dataset.frequencies_hz
    }

    def scored(test):
        shuffled = dataclasses.replace(dataset, test=test)
        told = zip(dataset.tx_index[test], dataset.frequencies_hz[test], strict=True)
        bad = np.array([wrong[int(tx), float(f)] for tx, f in told])
        return execute.score(shuffled, np.where(bad[:, None, None], 0, np.asarray(dataset.pas(test))))

    found, again = scored(dataset.test), scored(rng.permutation(dataset.test))
    for key, values in found.items():
        np.testing.assert_allclose(again[key], values, atol=1e-6)
    np.testing.assert_array_equal(found["ssim"] < 0.999, [[wrong[tx, ghz * 1e9] for ghz in found["ghz"]] for tx in found["tx"]])
    with pytest.raises(UserError, match="at every frequency"):
        scored(dataset.test[1:])
