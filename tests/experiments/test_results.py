"""Result files and the table of all of them: rows of several processes, what counts as run, what a table tool reads."""

import csv
import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from experiments import result_table
from experiments.catalogue import EXPERIMENTS, unique_jobs
from experiments.faults import Fault
from experiments.jobs import BASELINES, Job
from experiments.results import EDITION, FOLDER, Results, add_rows, read_lines, read_row, read_rows
from experiments.settings import differences
from wbgs_jax._util.errors import UserError
from wbgs_jax.config import present_name, to_dict
from wbgs_jax.fields import get_field

JOB = Job("1", "wideband")
VALUES = {"environment": {"commit": "abc", "device": "cpu", "jax": "0.10", "version": "0.1.0"}, "evaluation_seconds": 1.0}
VALUES |= {"tx": [1], "ssim": {"1": [0.5]}}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """The table of the stored results."""
    folder = tmp_path_factory.mktemp("table")
    for path in FOLDER.glob("*.jsonl"):
        (folder / path.name).symlink_to(path)
    return result_table.write(folder)


@pytest.fixture(scope="module")
def table(file):
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


# Results of the first version


def test_results_of_the_first_version_count_as_run():
    """Those whose settings are still what a job has, under names that they had by then."""
    quick, paper = Results("quick"), Results("paper")
    for field in ("wave", BASELINES):
        jobs = [job for job in unique_jobs() if job.field == field]
        assert len(jobs) == len(quick.all(jobs)) > 50
    assert {job.name for job in unique_jobs() if paper.get(job)} == {f"scene{scene}_wave_seed0" for scene in range(1, 7)}


def test_results_of_other_presets_count_as_not_run(tmp_path):
    """A row's settings are differences from the presets of its time."""
    results = Results("quick", tmp_path)
    results.write(JOB, VALUES)
    written = read_row(results.path(JOB), JOB.name)
    add_rows(results.path(JOB), {JOB.name: written | {"presets": EDITION - 1}})
    assert results.get(JOB) is None


def test_settings_of_stored_results_are_settings_that_there_are():
    for path in FOLDER.glob("*.jsonl"):
        for name, row in read_rows(path).items():
            known = {"mesh.displacement"} | {f"fault.{field.name}" for field in dataclasses.fields(Fault)}
            if (field := row.get("job", {}).get("field", BASELINES)) != BASELINES:
                sections = to_dict(get_field(field).presets["cpu"], field)
                known |= {f"{section}.{key}" for section, values in sections.items() for key in values}
            assert {present_name(key) for key in row.get("settings", {})} <= known, (path, name)


def test_rows_of_two_writers_are_all_kept(tmp_path):
    """Each writes the file anew: one at a time, or rows of the others would be lost."""
    path = tmp_path / "rows.jsonl"

    def write(name):
        for i in range(20):
            add_rows(path, {f"{name}{i:02}": {"i": i}})

    with ThreadPoolExecutor(2) as both:
        list(both.map(write, "ab"))
    assert list(read_lines(path)) == [f"{name}{i:02}" for name in "ab" for i in range(20)]
    assert read_row(path, "b19") == {"name": "b19", "i": 19}


@pytest.mark.parametrize("line", ['{"name": "b"', '{"i": 0}', '{"name": "b", "i": 1}}', "<<<<<<< HEAD"])
def test_a_line_that_is_no_row_is_named(line, tmp_path):
    path = tmp_path / "rows.jsonl"
    add_rows(path, {"a": {"i": 0}})
    path.write_text(path.read_text() + line)
    with pytest.raises(UserError, match=r"rows\.jsonl.*remove"):
        read_rows(path)


def test_a_setting_that_matters_makes_a_result_another_one(tmp_path):
    results = Results("quick", tmp_path)
    results.write(JOB, VALUES)
    path = results.path(JOB)
    written = read_row(path, JOB.name)
    for name, counts in {"loop.keep_checkpoints": True, "wideband.width": False, "optim.min_steps": False}.items():
        add_rows(path, {JOB.name: written | {"settings": written["settings"] | {name: 7}}})
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


def test_the_table_has_all_columns(table):
    assert tuple(table[0]) == result_table.COLUMNS


def test_a_row_is_a_job_and_a_frequency(table):
    rows = [row for row in table if (row["profile"], row["job"]) == ("quick", "scene4_wrfgs_long_seed2")]
    values = read_row(FOLDER / "quick.jsonl", "scene4_wrfgs_long_seed2")
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
    files = [path for path in FOLDER.glob("*.jsonl") if path.stem not in result_table.NO_JOBS]
    assert {(row["profile"], row["job"]) for row in table} == {(path.stem, name) for path in files for name in read_lines(path)}
    results = Results("quick")
    jobs = {(job.profile, job.name): results.get(job) for job in unique_jobs(tuple(EXPERIMENTS))}
    for row in table:
        if (key := (row["profile"], row["job"])) in jobs:
            assert (row["current"] == "True") == (jobs[key] is not None), key
    assert {row["scene"] for row in table if row["current"] == "False"} == {"example1"}


def test_files_that_are_no_results_of_jobs_are_no_rows(tmp_path):
    for profile in ("smoke", "quick"):
        Results(profile, tmp_path).write(JOB, VALUES | {"tx": [1], "ssim": {"1": [0.5]}, "psnr_db": {"1": 3.0}})
    add_rows(tmp_path / "few.jsonl", {"rfid_32_seed0": {"case": "rfid_32"}})
    assert [row["profile"] for row in result_table.rows(tmp_path)] == ["quick"]


def test_a_table_tool_reads_it(file):
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    table = pandas.read_csv(file)
    ours = table.query("profile == 'quick' and current and scene == '1' and field == 'wideband' and variant.isna()")
    ours = ours[ours.combination.isna() & ~ours.all_tx]
    assert len(ours) == 30 and ours.ghz.dtype == ours.median_ssim.dtype == np.float64
    assert ours.groupby("seed").median_ssim.mean().median() == pytest.approx(0.873, abs=5e-4)  # as docs/results.md has it
