"""Result files and the table of all of them: results of the first version count as run, and a table tool reads them."""

import csv
import dataclasses
import json
import shutil

import numpy as np
import pytest

from experiments import result_table
from experiments.catalogue import EXPERIMENTS, unique_jobs
from experiments.jobs import BASELINES, Job
from experiments.old_names import BEFORE_MUON, EDITION, MOVED, todays
from experiments.results import FOLDER, Results
from experiments.settings import differences
from wbgs_jax.config import to_dict
from wbgs_jax.fields import get_field

JOB = Job("1", "wideband")
VALUES = {"environment": {"commit": "abc", "device": "cpu", "jax": "0.10", "version": "0.1.0"}, "evaluation_seconds": 1.0}
VALUES |= {"tx": [1], "ssim": {"1": [0.5]}}


@pytest.fixture(scope="module")
def table():
    with (FOLDER / result_table.NAME).open(newline="") as stream:
        return list(csv.DictReader(stream))


# Results of the first version


def test_results_of_the_first_version_count_as_run():
    """Those whose settings are still what a job has, under names that they had by then."""
    quick, paper = Results("quick"), Results("paper")
    for field in ("wave", BASELINES):
        jobs = [job for job in unique_jobs() if job.field == field]
        assert len(jobs) == len(quick.all(jobs)) > 50
    assert {job.name for job in unique_jobs() if paper.get(job)} == {f"scene{scene}_wave_seed0" for scene in range(1, 7)}


def test_settings_that_have_moved_are_found_under_todays_names():
    old = {"optim.network_lr": 0.016, "optim.steps": 100, "loop.checkpoint_every": 200, "density.every": 75}
    wrfgs = {"wrfgs.network_lr": 0.016, "optim.steps": 100, "density.every": 75}
    assert todays({"settings": old, "presets": EDITION}, "wrfgs") == wrfgs
    adam = {"nerf2.network_optimizer": "adam", "nerf2.network_lr": 0.016, "optim.steps": 100}
    assert todays({"settings": old}, "nerf2") == adam == todays({"settings": old, "presets": 2}, "nerf2")
    old = {
        "wave.survival": 0.5,
        "optim.residual_lr": 0.1,
        "optim.snapshot_weight": 0.2,
        "density.start": 75,
        "search.rounds": 0,
    }
    new = {"wave.excess_amplitude": 0.5, "wave.corrections_lr": 0.1, "wave.correlation_weight": 0.2, "search.rounds": 0}
    assert todays({"settings": old}, "wave") == new
    assert todays({"settings": new}, "wave") == new


def test_results_of_before_muon_say_so():
    adam = BEFORE_MUON["wrfgs"]
    assert adam["wrfgs.network_optimizer"] == "adam" and adam["wrfgs.network_lr"] == 4e-3
    slower = {"optim.network_lr": 1e-3, "optim.steps": 100}
    assert todays({"settings": slower}, "wrfgs") == adam | {"wrfgs.network_lr": 1e-3, "optim.steps": 100}
    assert todays({"settings": slower, "preset": "paper"}, "wrfgs") == {"wrfgs.network_lr": 1e-3, "optim.steps": 100}
    assert todays({"presets": EDITION}, "wrfgs") == {}


def test_moved_settings_exist_under_their_new_names():
    known = set()
    for field in ("wideband", "nerf2", "wave"):
        sections = to_dict(get_field(field).presets["cpu"], field)
        known |= {f"{section}.{name}" for section, values in sections.items() for name in values}
    for old, new in MOVED.items():
        assert old not in known and known & {new.format(field=field) for field in ("wideband", "nerf2", "wave")}, old


def test_a_setting_that_matters_makes_a_result_another_one(tmp_path):
    results = Results("quick", tmp_path)
    results.write(JOB, VALUES)
    path = results.path(JOB)
    written = json.loads(path.read_text())
    for name, counts in {"loop.keep_checkpoints": True, "wideband.width": False, "optim.min_steps": False}.items():
        path.write_text(json.dumps(written | {"settings": written["settings"] | {name: 7}}))
        assert (results.get(JOB) is not None) == counts, name


def test_data_of_the_same_name_elsewhere_are_other_data(tmp_path, monkeypatch):
    results, job = Results("quick", tmp_path), Job("here/room.npz", "wideband")
    monkeypatch.chdir(tmp_path)
    results.write(job, VALUES)
    assert results.get(dataclasses.replace(job, scene=str(tmp_path / "here" / "room.npz"))) is not None
    assert results.get(dataclasses.replace(job, scene="there/room.npz")) is None


def test_a_result_read_twice_is_read_again_where_it_has_changed(tmp_path):
    results = Results("quick", tmp_path)
    for seconds in (1.0, 2.0):
        results.write(JOB, VALUES | {"evaluation_seconds": seconds})
        assert results.get(JOB).seconds == results.get(JOB).seconds == seconds


def test_what_was_moved_is_part_of_what_makes_a_result():
    assert differences(dataclasses.replace(JOB, variant="lr_1.6e-2"))["wideband.network_lr"] == 0.016
    assert differences(Job("4", "wave", variant="mesh_moved_1m", profile="choices"))["mesh.displacement"] == 1


# The table


def test_the_table_is_that_of_the_results(table, tmp_path):
    shutil.copytree(FOLDER, tmp_path / "results", ignore=shutil.ignore_patterns("*.png", "*.csv", "smoke"))
    written = result_table.write(tmp_path / "results")
    assert written.read_bytes() == (FOLDER / result_table.NAME).read_bytes(), "write it again: make tables"
    assert tuple(table[0]) == result_table.COLUMNS


def test_a_row_is_a_job_and_a_frequency(table):
    rows = [row for row in table if (row["profile"], row["job"]) == ("quick", "scene4_wrfgs_long_seed2")]
    values = json.loads((FOLDER / "quick" / "scene4_wrfgs_long_seed2.json").read_text())
    assert [float(row["ghz"]) for row in rows] == [float(f) for f in values["ssim"]]
    for row, (ghz, ssim) in zip(rows, values["ssim"].items(), strict=True):
        assert (float(row["median_ssim"]), float(row["mean_ssim"])) == pytest.approx((np.median(ssim), np.mean(ssim)), abs=6e-5)
        assert int(row["n"]) == len(ssim) and float(row["psnr_db"]) == values["psnr_db"][ghz]
        expected = {"scene": "4", "field": "wrfgs", "variant": "long", "combination": "", "all_tx": "False", "seed": "2"}
        expected |= {name: str(values[name]) for name in ("steps", "samples", "gaussians", "training_seconds", "models")}
        expected |= {name: values["environment"][name] for name in ("version", "commit", "device", "jax")}
        assert expected.items() <= row.items() and row["current"] == "True"


def test_baselines_are_rows_by_their_names(table):
    rows = [row for row in table if (row["profile"], row["job"]) == ("quick", "scene2_baselines_C4_alltx_seed0")]
    assert len(rows) == 4 * 8 and {row["field"] for row in rows} == {BASELINES}
    assert {row["variant"] for row in rows} == {"mean_image", "nearest_tx", "inverse_distance", "line_of_sight"}
    assert {row["all_tx"] for row in rows} == {"True"} and {row["combination"] for row in rows} == {"C4"}


def test_what_was_kept_without_frequencies_is_one_row(table):
    (row,) = (row for row in table if row["profile"] == "tuning" and row["job"] == "scene1_wrfgs_lr_8e-3_seed0")
    assert (row["ghz"], row["median_ssim"], row["mean_ssim"], row["steps"], row["models"]) == (
        "",
        "0.7215",
        "0.6944",
        "1000",
        "10",
    )


def test_every_result_is_in_the_table_and_says_whether_it_counts(table):
    files = {(path.parent.name, path.stem) for path in FOLDER.glob("*/*.json") if path.parent.name not in result_table.NO_JOBS}
    assert {(row["profile"], row["job"]) for row in table} == files
    results = Results("quick")
    jobs = {(job.profile, job.name): results.get(job) for job in unique_jobs(tuple(EXPERIMENTS))}
    for row in table:
        if (key := (row["profile"], row["job"])) in jobs:
            assert (row["current"] == "True") == (jobs[key] is not None), key
    assert {row["scene"] for row in table if row["current"] == "False"} == {"example1"}


def test_files_that_are_no_results_of_jobs_are_no_rows(tmp_path):
    for profile in ("smoke", "quick"):
        Results(profile, tmp_path).write(JOB, VALUES | {"tx": [1], "ssim": {"1": [0.5]}, "psnr_db": {"1": 3.0}})
    (tmp_path / "gpu").mkdir()
    (tmp_path / "gpu" / "parity_h100.json").write_text('{"environment": {}}')
    assert [row["profile"] for row in result_table.rows(tmp_path)] == ["quick"]


def test_a_table_tool_reads_it():
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    table = pandas.read_csv(FOLDER / result_table.NAME)
    ours = table.query("profile == 'quick' and current and scene == '1' and field == 'wideband' and variant.isna()")
    ours = ours[ours.combination.isna() & ~ours.all_tx]
    assert len(ours) == 30 and ours.ghz.dtype == ours.median_ssim.dtype == np.float64
    assert ours.groupby("seed").median_ssim.mean().median() == pytest.approx(0.873, abs=5e-4)  # as docs/results.md has it
