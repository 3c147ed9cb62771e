"""The series of few spectra: what its cases are, and what is made of its rows."""

import json

import numpy as np
import pytest

from experiments import few
from experiments.few import SIMPLE, along_a_track, below, cases, coverage, data_of, rows_of, summary
from experiments.results import FOLDER, Results, add_rows
from experiments.tables import few as table
from wbgs_jax.data import load_dataset
from wbgs_jax.data.dataset import training_links


def row(case="rfid_32", seed=0, score=0.8, best=0.81, level=0.9, held=1.0, tested=8):
    simple = dict.fromkeys(SIMPLE, best - 0.1) | {"kriging": best}
    return {
        "case": case, "seed": seed, "transmitters": 32, "spectra": 32, "tested": tested, "median_ssim": score, "alone": 0.6,
        "simple": simple, "field_answers_alone": False, "level": level, "coverage": held, "expected": 0.7, "scored": 0.8,
        "training_seconds": 60.0,
    }  # fmt: skip


def test_cases_have_names_of_their_own():
    names = [case.name for case in cases()]
    assert len(set(names)) == len(names) and {"rfid_32", "example1_20", "scene4_5_track"} <= set(names)


def test_a_case_is_the_same_for_a_seed_and_keeps_the_test():
    case = next(case for case in cases() if case.name == "scene4_5_random")
    first, again, other = (data_of(case, seed) for seed in (0, 0, 1))
    assert len(np.unique(first.tx_index[training_links(first)])) == 5 and len(first.validation)
    np.testing.assert_array_equal(first.train, again.train)
    assert set(first.train) != set(other.train)
    np.testing.assert_array_equal(first.test, other.test)
    assert set(first.test) <= set(load_dataset("4").test) and len(first.test) == few.TESTED


def test_a_track_is_walked_from_place_to_place():
    dataset = along_a_track(load_dataset("4"), 12, 3)
    tx = np.unique(dataset.tx_index[dataset.train])
    places = np.stack([dataset.tx_positions[dataset.tx_index == one][0] for one in tx])
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + np.diag(np.full(12, np.inf))
    assert len(tx) == 12 and apart.min(1).max() < 1.5


def test_rows_below_the_best_simple_method_are_counted():
    assert not below(row(score=0.8, best=0.81)) and below(row(score=0.78, best=0.81))
    assert coverage([row(held=1.0), row(held=0.5, tested=24), row(level=0.75, held=0.0), row(level=None)]) == 0.625
    assert coverage([row(level=0.75)]) is None
    found = summary([row(seed=0), row(seed=1, score=0.7), row("rfid_10_track", score=0.5, best=0.4)])
    assert found["rows"] == 3 and found["below"] == 1
    assert found["cases"]["rfid_32"] | {"worst": 0.7, "median": 0.75, "below": 1, "seeds": 2} == found["cases"]["rfid_32"]


def test_the_table_has_a_line_a_case(tmp_path):
    made = [row(seed=0), row(seed=1, score=0.7), row("rfid_10_track", score=0.5, best=0.4, level=0.75)]
    add_rows(tmp_path / "few.jsonl", {f"{one['case']}_seed{number}": one for number, one in enumerate(made)})
    assert [own["case"] for own in rows_of(tmp_path / "few.jsonl")] == ["rfid_32", "rfid_32", "rfid_10_track"]
    text = table.render(Results("quick", tmp_path), tmp_path)
    assert "1 of 3 rows are below" in text and "| rfid 32 | 32 | 2 | 0.700 | 0.750 |" in text
    assert "90 % intervals hold 100 %" in text
    assert "not run" in table.render(Results("quick", tmp_path / "nothing"), tmp_path).lower()


def test_rows_of_another_folder_are_taken_over(tmp_path, monkeypatch):
    folder, out = tmp_path / "elsewhere", tmp_path / "few.jsonl"
    folder.mkdir()
    add_rows(out, {"rfid_32_seed0": row(), "rfid_32_seed1": row(seed=1)})
    (folder / "rfid_32_seed1.json").write_text(json.dumps(row(seed=1, score=0.7)))
    monkeypatch.setattr("sys.argv", ["few", "--collect", str(folder), "--out", str(out)])
    few.main()
    assert [own["median_ssim"] for own in rows_of(out)] == [row()["median_ssim"], 0.7]
    assert json.loads((tmp_path / "few.json").read_text())["rows"] == 2


def test_what_pages_quote_is_that_of_the_rows():
    rows = rows_of(FOLDER / "few.jsonl")
    if not rows:
        pytest.skip("no row has been made")
    quoted = json.loads((FOLDER / "few.json").read_text())
    assert {name: quoted[name] for name in ("cases", "rows", "below", "coverage")} == summary(rows)
