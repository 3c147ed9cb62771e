"""`wbgs-jax benchmark` as people call it."""

import dataclasses
import json

import numpy as np
import pytest
from builders.commands import assert_error_for_people, call

from wbgs_jax.commands import benchmark
from wbgs_jax.commands.benchmark import main, score_scene
from wbgs_jax.data import load_dataset
from wbgs_jax.inference.queries import read_queries

N = 6


@pytest.fixture(scope="module")
def dataset():
    """Scene 1 with few links."""
    whole = load_dataset("1")
    return dataclasses.replace(whole, test=whole.test[::200][:N], train=whole.train[::20])


def test_queries_are_the_test_links_in_order(tmp_path, dataset):
    done = call(main, "--queries", tmp_path / "queries", "--scenes", "1")
    assert done.code == 0, done.err
    positions, ghz = read_queries(tmp_path / "queries" / "scene1.csv")
    whole = load_dataset("1")
    np.testing.assert_allclose(positions, whole.tx_positions[whole.test], atol=1e-6)
    np.testing.assert_allclose(ghz, whole.frequencies_hz[whole.test] / 1e9, rtol=1e-6)


def test_the_truth_scores_one_and_others_what_the_metric_gives(tmp_path, dataset, rng):
    truth = dataset.observations["snapshots"][dataset.test]
    np.savez(tmp_path / "scene1.npz", snapshots=truth, power_db=dataset.received_db(dataset.test) + 3)
    report = score_scene(tmp_path / "scene1.npz", dataset)
    assert report["median_ssim"] > 0.999 and report["snapshot_correlation"] > 0.999 and report["n"] == N
    assert 2.9 < report["power"]["power_error_db"] < 3.1
    assert report["baselines"]["nearest_tx"]["median_ssim"] < 0.9
    noise = rng.uniform(-0.01, 1.01, (N, 90, 360))  # learned spectra are clipped
    np.savez(tmp_path / "scene1.npz", pas=noise)
    assert score_scene(tmp_path / "scene1.npz", dataset)["median_ssim"] < 0.2


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"spectra": np.zeros(3)}, "has none of the arrays pas, snapshots, power_db"),
        ({"pas": np.zeros((2, 90, 360))}, "pas of {} has shape (2, 90, 360); the 6 test links need (6, 90, 360)"),
        ({"pas": np.full((N, 90, 360), 255.0)}, "lies within 255 to 255; give amplitudes from 0 to 1"),
        ({"pas": np.full((N, 90, 360), "a")}, "pas of {} has the type <U1; give real numbers"),
        ({"power_db": np.full(N, np.nan)}, "contains NaN or infinity"),
    ],
)
def test_files_of_other_shapes_or_units_are_refused(tmp_path, dataset, monkeypatch, arrays, says):
    path = tmp_path / "scene1.npz"
    np.savez(path, **arrays)
    monkeypatch.setattr("wbgs_jax.data.load_dataset", lambda scene: dataset)
    result = call(main, "--predictions", tmp_path)
    assert result.code == 2 and says.format(path) in result.err.splitlines()[-1]


def test_an_entry_is_scored_and_written(tmp_path, dataset, monkeypatch):
    np.savez(tmp_path / "scene1.npz", pas=np.asarray(dataset.pas(dataset.test)))
    monkeypatch.setattr("wbgs_jax.data.load_dataset", lambda scene: dataset)
    done = call(main, "--predictions", tmp_path, "--name", "mine", "--out", tmp_path / "entry.json")
    assert done.code == 0, done.err
    entry = json.loads((tmp_path / "entry.json").read_text())
    assert entry["name"] == "mine" and entry["scenes"]["1"]["median_ssim"] > 0.999 and "version" in str(entry["environment"])
    assert "mine: SSIM of the test links" in done.out


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ([], "nothing to do; give --queries FOLDER"),
        (["--queries", "q", "--scenes", "9"], "--scenes 9 is not of the benchmark"),
        (["--queries", "q", "--out", "entry.json"], "--out is for scores"),
        (["--predictions", "nowhere"], "nowhere has no predictions scene1.npz"),
        (["--predictions", "nowhere", "--scenes", "3"], "nowhere has no predictions scene3.npz"),
    ],
)
def test_errors_are_for_people(options, says):
    assert_error_for_people(call(main, *options), says)


def test_all_scenes_of_the_benchmark_are_released():
    from wbgs_jax.data.load import released_scenes

    assert set(benchmark.SCENES) <= set(released_scenes())
