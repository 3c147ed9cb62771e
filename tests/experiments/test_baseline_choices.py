"""The series of learning rates and inputs: what is changed, and what a run of it leaves."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import tiny_scene

from experiments import baseline_choices
from experiments.baseline_choices import CHANGES
from experiments.jobs import PROFILES, Job, settings
from wbgs_jax.config import check
from wbgs_jax.data import scene_dataset


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_is_one_and_can_work(name, monkeypatch):
    change = CHANGES[name]
    trained = []
    monkeypatch.setattr(Job, "models", lambda self: iter([("all", scene_dataset(tiny_scene(40)))]))
    monkeypatch.setattr(
        baseline_choices,
        "measure",
        lambda _dataset, chosen, _seed, field: (
            trained.append((chosen, field)) or {"median_ssim": 0.8, "mean_ssim": 0.7, "steps": 3, "seconds": 1.0}
        ),
    )
    baseline_choices.measure_change(change, "1", 0)
    ((chosen, field),) = trained
    usual = settings(Job("1", field), PROFILES["quick"])
    check(chosen)
    different = {s: v for s, v in vars(chosen).items() if v != vars(usual)[s]}
    assert set(different) == set(change.values) and field == change.field
    for section, values in change.values.items():
        assert values.items() <= vars(different[section]).items()


def test_models_are_averaged_and_what_is_there_is_skipped(tmp_path, monkeypatch):
    asked = []

    def measure(dataset, _chosen, seed, field):
        asked.append((field, seed, len(np.unique(dataset.tx_index[dataset.test]))))
        return {"median_ssim": 0.7 + 0.1 * (len(asked) % 2), "mean_ssim": 0.6, "steps": 100, "seconds": 2.0}

    monkeypatch.setattr(Job, "models", lambda self: iter([("a", scene_dataset(tiny_scene(200)))] * 2))
    monkeypatch.setattr(baseline_choices, "measure", measure)
    monkeypatch.setattr(sys, "argv", ["baseline_choices", "--only", "wrfgs", "--out", str(tmp_path)])
    for _ in range(2):
        baseline_choices.main()
    assert asked == [("wrfgs", 0, 24)] * 2
    report = SimpleNamespace(**json.loads((tmp_path / "baseline_choices_scene1.json").read_text()))
    (run,) = report.changes["wrfgs"]["runs"]
    assert run["median_ssim"] == pytest.approx(0.75) and run["models"] == 2 and run["steps"] == 200 and run["commit"]
