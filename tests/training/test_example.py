"""The example: a trained field in the package that answers as its scores state, without any training."""

import json
import time

import numpy as np
import pytest
from builders.commands import call
from builders.untrained import make_run

import wbgs_jax as wb
from tools.example_field import pack
from wbgs_jax._util.files import read_json
from wbgs_jax.commands import predict
from wbgs_jax.metrics import ssim
from wbgs_jax.training import EXAMPLE
from wbgs_jax.training.run_folder import MANIFEST, load_trained, read_config

LARGEST = 8e6
"""Bytes."""
GHZ = 60.0


def test_the_example_is_small_and_names_its_origin():
    assert sum(path.stat().st_size for path in EXAMPLE.rglob("*")) < LARGEST
    config, manifest = read_config(EXAMPLE), read_json(EXAMPLE / MANIFEST)
    assert (config.source, config.field, config.preset, config.seed) == ("1", "hybrid", "cpu", 0)
    assert manifest["data"]["sha256"] and manifest["versions"]["commit"] and manifest["training"]["settings"]
    for part, name in (("test", "eval.json"), ("validation", "eval_validation.json")):
        report = read_json(EXAMPLE / name)
        assert report["part"] == part
        for score in ("n", "median_ssim", "mean_ssim"):
            assert manifest["scores"][part][score] == report[score] > 0.9


def test_what_is_packed_predicts_as_the_run(tmp_path):
    """Also over an older one; the checkpoint holds no more than field and parameters."""
    run = make_run(tmp_path / "box")
    pack(run, tmp_path / "packed")
    pack(run, tmp_path / "packed")
    before, after = load_trained(run), load_trained(tmp_path / "packed")
    query = [1.0, 0.5, 1.5], [28e9, 2e9]
    np.testing.assert_array_equal(wb.make_predictor(after)(*query), wb.make_predictor(before)(*query))
    assert sorted(path.name for path in (tmp_path / "packed").iterdir()) == ["checkpoints", "config.json"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["box", "box.npz", "packed"]


@pytest.mark.heavy
def test_the_example_scores_as_it_states(monkeypatch):
    """All test transmitters at one frequency."""
    monkeypatch.delenv("WBGS_DATA", raising=False)
    begin = time.monotonic()
    trained = wb.load_trained()
    dataset = trained.dataset()
    assert time.monotonic() - begin < 15  # seconds
    links = dataset.test[dataset.frequencies_hz[dataset.test] == GHZ * 1e9]
    query = dataset.query(links)
    found = ssim(
        wb.predict_many(wb.make_predictor(trained), query.tx_position, query.frequency_hz), np.asarray(dataset.pas(links))
    )
    (stated,) = (row for row in read_json(EXAMPLE / "eval.json")["per_frequency"] if row["frequency_ghz"] == GHZ)
    assert stated["n"] == len(links) > 100
    assert np.median(found) == pytest.approx(stated["median_ssim"], abs=1e-3)
    assert np.mean(found) == pytest.approx(stated["mean_ssim"], abs=1e-3)


@pytest.mark.heavy
def test_the_example_answers_commands(tmp_path, monkeypatch):
    monkeypatch.delenv("WBGS_DATA", raising=False)
    ask = ["--example", "--tx", "1,0.5,1.5", "--ghz", 28, "--what"]
    for what in ("power", "paths", "frequency-response"):
        out, picture = tmp_path / f"{what}.npz", tmp_path / f"{what}.svg"
        result = call(predict.main, *ask, what, "--out", out, "--picture", picture)
        assert result.code == 0, result.err
        with np.load(out) as found:
            assert json.loads(str(found["meta"]))["scene"] == "scene1"
        assert picture.read_bytes().startswith(b"<?xml")
