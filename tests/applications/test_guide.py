"""docs/applications.md runs, and so does the account that it quotes."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from builders.mirrors import trained
from builders.untrained import make_run

import wbgs_jax
from experiments.studies import downstream

GUIDE = (Path(__file__).parents[2] / "docs" / "applications.md").read_text()


@pytest.mark.heavy
def test_the_guide_runs(monkeypatch):
    monkeypatch.setattr(wbgs_jax, "load_trained", lambda folder: trained())
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL):
        exec(compile(block, "applications.md", "exec"), names)
    assert names["found"].position.shape == names["slope"].shape == (3,)
    assert np.isfinite(names["slope"]).all() and 0 <= float(names["found"].loss) <= 1
    assert names["beams"].shape == (2, 3) and names["scores"] == (1, 1, 0, 0)
    assert names["best"].place.shape == (2, 3) and names["best"].loss[0] <= names["best"].loss[1]
    assert [np.shape(slope) for slope in names["slopes"]] == [(2,), (2, 3)] and np.abs(names["slopes"][0]).max() > 0.1
    assert names["hung"].place.shape == (2, 5) and np.isfinite(names["hung"].loss).all()
    assert -names["hung"].loss[0] >= float(wbgs_jax.applications.soft_minimum(names["without"])) - 0.1
    assert names["turned"].place.shape == (4, 2) and np.linalg.norm(names["quaternion"]) == pytest.approx(1, abs=1e-5)


@pytest.fixture
def account(tmp_path, monkeypatch):
    make_run(tmp_path / "runs" / "box_txall")
    words = f"downstream --scenes {tmp_path}/box.npz --numbers 0 --ghz 1 10 --transmitters 1 --step 3 --settings none"
    monkeypatch.setattr("sys.argv", [*words.split(), "--runs", f"{tmp_path}/runs", "--out", f"{tmp_path}"])
    monkeypatch.setattr(downstream, "use_compilation_cache", lambda: None)
    downstream.main()
    return tmp_path / "downstream.json"


@pytest.mark.heavy
def test_the_account_of_a_scene(account, capsys, monkeypatch):
    report = json.loads(account.read_text())["box"]["txall"]
    nearest = report["localisation"]["nearest_training_transmitter"]["median_m"]
    assert 0 < nearest <= report["localisation"]["fingerprint"]["median_m"]
    assert report["localisation"]["field_or_runner_up"]["median_m"] <= report["localisation"]["field"]["median_m"]
    assert 0 <= report["beams"]["field"]["top1"] <= report["beams"]["field"]["top3"] <= 1
    assert report["provenance"]["preset"] == "smoke"
    monkeypatch.setattr(downstream, "account", None)  # what is there is not made again
    downstream.main()
    text = downstream.localisation_table(json.loads(account.read_text()))
    assert "<!-- downstream.json box.txall.localisation.field.median_m 2 -->" in text and "| box | all |" in text
    assert "beams.nearest_tx.top3" in downstream.beams_table(json.loads(account.read_text()))


def test_of_equal_fingerprints_the_place_is_theirs(rng):
    places, unlike = rng.uniform(size=(6, 3)), rng.uniform(0.1, 1, (2, 6))
    unlike[0, 4] = 0
    found = downstream.by_fingerprint(unlike, places)
    np.testing.assert_allclose(found["fingerprint"][0], places[4])
    np.testing.assert_allclose(found["fingerprints_weighted"][0], places[4], atol=1e-3)
