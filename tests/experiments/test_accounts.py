"""What is no series: laws of the frequency against what they are exact for, trained fields with and without neighbours."""

import dataclasses
import json

import numpy as np
import pytest
from builders.synthetic import tiny_dataset, tiny_scene, tiny_settings
from builders.untrained import make_coherent_run, make_run

from experiments.bench.main_job import measure
from experiments.studies import frequency_account, neighbours_account, receivers_account
from experiments.studies.frequency_account import LAWS, polynomial
from wbgs_jax.config import changed
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.data.scene_file import save_scene

LOGS = np.log10([1e9, 2.4e9, 10e9, 28e9, 60e9, 94e9])


@pytest.mark.parametrize("degree", [1, 2])
def test_a_polynomial_of_its_degree_is_continued_exactly(rng, degree):
    places = LOGS - LOGS.mean()
    spectra = 0.5 + sum(0.05 * rng.normal(size=(1, 90, 360)) * places[:, None, None] ** k for k in range(1, degree + 1))
    spectra = np.clip(spectra, 0.01, 0.99) if spectra.min() > 0.01 and spectra.max() < 0.99 else 0.5 + (spectra - 0.5) / 4
    for i in range(len(LOGS)):
        rest = np.arange(len(LOGS)) != i
        predicted = polynomial(degree)(spectra[rest], LOGS[rest], LOGS[i])
        np.testing.assert_allclose(predicted, np.clip(spectra[i], 0, 1), atol=1e-9)


def test_half_a_line_lies_between_the_mean_and_the_line(rng):
    spectra, asked = rng.uniform(0.4, 0.6, (5, 90, 360)), LOGS[-1]
    mean, half, line = (LAWS[name](spectra, LOGS[:5], asked) for name in ("mean", "half_a_line", "line"))
    inside = (line > 0) & (line < 1)  # a line is cut where it leaves the range of spectra
    np.testing.assert_allclose(half[inside], (mean + line)[inside] / 2, atol=1e-9)


def test_neighbours_in_frequency_are_the_nearest_and_the_farthest(rng):
    spectra = rng.uniform(size=(6, 90, 360))
    np.testing.assert_allclose(LAWS["nearest"](spectra, LOGS, LOGS[0]), spectra[:4].mean(0))
    np.testing.assert_allclose(LAWS["farthest"](spectra, LOGS, LOGS[0]), spectra[2:].mean(0))


def test_the_account_of_a_scene(tmp_path, monkeypatch):
    save_scene(tmp_path / "box.npz", tiny_scene(24))
    monkeypatch.setattr("sys.argv", ["frequency_account", str(tmp_path / "box.npz"), "--out", str(tmp_path)])
    frequency_account.main()
    scores = json.loads((tmp_path / "frequency_account.json").read_text())["scenes"]["box"]
    assert scores.keys() == LAWS.keys() and all(0 < score < 1 for score in scores.values())
    assert scores["nearest"] == pytest.approx(scores["mean"])  # of three frequencies the others are two


@pytest.mark.heavy
def test_a_run_without_neighbours_scores_the_same_twice(tmp_path, monkeypatch):
    run = make_run(tmp_path)
    monkeypatch.setattr("sys.argv", ["neighbours_account", str(run), "--out", str(tmp_path)])
    neighbours_account.main()
    (scores,) = (value for value in json.loads((tmp_path / "neighbours.json").read_text()).values() if isinstance(value, dict))
    assert scores["alone"] == scores["asked"] and scores["neighbours"] == 0
    assert 0 < scores["nearest_tx"]["median_ssim"] < 1


@pytest.mark.heavy
def test_receivers_that_were_never_heard(tmp_path, monkeypatch):
    """The same receiver under another name scores as it does at home; what was trained is left out there."""
    run = make_coherent_run(tmp_path / "box")
    save_scene(tmp_path / "box_rx2.npz", dataclasses.replace(tiny_scene(), name="box_rx2"))
    away = dataclasses.replace(tiny_scene(), name="box_rx3", rx_position=tiny_scene().rx_position + np.array([0.4, 0.1, 0.0]))
    save_scene(tmp_path / "box_rx3.npz", away)
    monkeypatch.setenv("WBGS_DATA", str(tmp_path))
    monkeypatch.setattr("sys.argv", ["receivers_account", str(run), "--out", str(tmp_path)])
    receivers_account.main()
    scores = json.loads((tmp_path / "receivers.json").read_text())["box"]
    assert scores.pop("provenance")["preset"] == "smoke"
    assert scores.keys() == {"own", "rx2", "rx3"} and all(0 < place["ready_s"] < 60 for place in scores.values())
    assert scores["rx2"]["new"] == scores["own"]["new"] == scores["own"]["test"]
    assert scores["rx3"]["new"]["median_ssim"] != scores["own"]["new"]["median_ssim"]
    assert scores["rx3"]["new"]["n"] == scores["own"]["test"]["n"] > 0
    together = make_coherent_run(tmp_path / "together", f"{tmp_path}/box.npz,{tmp_path}/box_rx3.npz")
    monkeypatch.setattr("sys.argv", ["receivers_account", str(together), "--out", str(tmp_path)])
    monkeypatch.setattr(receivers_account, "released_scenes", lambda: {path.stem: path for path in tmp_path.glob("*.npz")})
    receivers_account.main()
    report = json.loads((tmp_path / "receivers.json").read_text())
    assert report["box"]["own"] == scores["own"], "rows of other runs stay"
    both = report["box+box_rx3"]
    for name, alone in (("box", scores["own"]), ("box_rx3", scores["rx3"])):  # untrained alike
        assert both[name]["median_ssim"] == pytest.approx(alone["test"]["median_ssim"], abs=1e-4)
        assert both[name]["trained_on"] == "box+box_rx3"


@pytest.mark.heavy
def test_the_main_job_is_timed_against_another(tmp_path):
    settings = tiny_settings()
    versions = {"today": settings, "longer": changed(settings, {"optim": {"steps": 3 * settings.optim.steps}})}
    report = measure(hold_out_validation(tiny_dataset()), versions, 2, tmp_path)
    assert report["today"]["steps"] * 3 == report["longer"]["steps"]
    whole = [report[name]["step_cpu_ms"] * report[name]["steps"] for name in versions]
    assert report["share_of_training"] == pytest.approx(whole[0] / whole[1], rel=0.1)
    assert all(report[name]["first_epoch_s"] > 0 for name in versions)
