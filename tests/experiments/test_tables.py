"""The page of results: marks for what was not run, right numbers where the results are made up, the paper's beside them."""

import dataclasses
import re

import numpy as np
import pytest

from experiments import statistics
from experiments.catalogue import unique_jobs
from experiments.jobs import BASELINES, PICTURED_GHZ, Job
from experiments.profiles import PROFILES
from experiments.results import Results
from experiments.tables import __main__ as command_line
from experiments.tables import (
    baselines,
    cells,
    default_field,
    few,
    figure8,
    headline,
    page,
    power,
    summary,
    table1,
    table2,
    table3,
)
from wbgs_jax._util.files import write_json

LEVELS = {
    ("wideband", ""): 0.8,
    ("wideband", "long"): 0.85,
    ("wrfgs", ""): 0.64,
    ("wrfgs", "long"): 0.75,
    ("wrfgs", "longest"): 0.81,
    ("wave", ""): 0.9,
    ("nerf2", ""): 0.6,
}
ENVIRONMENT = {"version": "0", "commit": "abc123", "device": "cpu x86_64", "jax": "0.10"}


def made_up(job, tx=(3, 5, 8, 9, 11, 20, 21)):
    """Scores around a level of the model: 0.01 higher with every seed, lower at unseen frequencies, their median exact."""
    values = {"environment": ENVIRONMENT, "training_seconds": 60.0, "evaluation_seconds": 6.0}
    if job.field == BASELINES:
        return values | {"baselines": {name: {f"{f:g}": 0.5 for f in job.test_ghz} for name in baselines.NAMES_OF_BASELINES}}
    level = LEVELS.get((job.field, job.variant), 0.7) + 0.01 * job.seed - 0.02 * bool(job.combination)
    spread = np.linspace(-0.03, 0.03, len(tx))
    scores = {f"{f:g}": np.round(level + spread, 4).tolist() for f in job.test_ghz}
    return values | {"tx": list(tx), "ssim": scores, "curve": {"step": [1, 2, 3], "loss": [0.3, 0.2, 0.1]}}


@pytest.fixture(scope="module")
def nothing(tmp_path_factory):
    return Results("quick", tmp_path_factory.mktemp("nothing"))


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    results = Results("quick", tmp_path_factory.mktemp("everything"))
    picture = np.tile(np.linspace(0, 255, 360).astype(np.uint8), (len(PICTURED_GHZ), 90, 1))
    for job in unique_jobs():
        results.write(job, made_up(job), picture if job.pictured else None)
    return results


def rows(text):
    """Cells of all table rows but headings and rulers."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    bodies = [line for line, ruler in zip(lines, [*lines[1:], ""], strict=True) if "---" not in line and "---" not in ruler]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in bodies]


def row(text, first):
    return next(cells[1:] for cells in rows(text) if cells[0] == first)


def test_what_has_not_been_run_says_so_everywhere(nothing, tmp_path):
    text = page.page(nothing, tmp_path)
    assert "None of the" in text and not list(tmp_path.iterdir())
    for module in page.PAGES:
        assert cells.NOT_RUN in module.render(nothing, tmp_path), module.__name__
    known = re.compile(r"not run yet|\(.*\)|ceiling")
    for name, *values in rows(table1.render(nothing, tmp_path)):
        assert "ceiling" in name or "truth" in name or all(known.search(value) for value in values), name


def test_the_papers_values_stand_beside_the_cells(nothing, tmp_path):
    text = table1.scene_table(nothing, "3")
    assert row(text, "wideband (ours)")[:2] == ["not run yet (0.58)", "not run yet (0.63)"]
    assert row(text, "WRF-GS")[10] == "not run yet (0.50)"
    assert row(text, "WRF-GS, pooled")[10] == "not run yet"
    assert "average of" not in headline.by_scene(nothing)


def test_table_1_has_medians_intervals_seeds_and_ceilings(everything):
    text = table1.scene_table(everything, "1")
    ours = row(text, "wideband (ours)")
    assert ours[0] == "0.810 (0.76)" and ours[10] == "0.810 (0.74)"
    low, high = (float(v) for v in ours[11].split("-"))
    assert 0.78 <= low < 0.81 < high <= 0.84
    assert ours[12] == "3: 0.800-0.820"
    assert row(text, "coherent (ours)")[12] == "3: 0.900-0.920"
    assert row(text, "WRF-GS, pooled")[12] == "1"
    assert row(text, "phase-blind ceiling")[:2] == ["0.914", "0.839"]


def test_the_headline_is_computed(everything):
    """Wideband and WRF-GS have three seeds, 0.01 apart: 0.81 and 0.65 are in the middle. Pooled has one but in scene 4."""
    for scene in ("1", "2", "3", "5", "6"):
        ours, theirs, gained, better, difference, pooled = row(headline.by_scene(everything), scene)
        assert (ours[:5], theirs[:5], gained, pooled) == ("0.810", "0.650", "+24.6 %", "0.700")
        assert better == "100 % of 7" and difference == "+0.160"
    assert row(headline.by_scene(everything), "average of 6 (paper)")[:3] == [
        "0.810 (0.66)",
        "0.650 (0.56)",
        "+24.6 % (+17.8 %)",
    ]
    assert row(headline.against_spectra(everything), "wideband") == ["0.810 (3 seeds)", "0.860 (3 seeds)", "0.700 (1 seed)"]
    assert row(headline.against_spectra(everything), "gain")[1] == "+13.2 %"
    mixed, alike, blind = rows(headline.zero_shot_drop(everything))
    assert mixed[1:] == ["0.790", "0.810", "-2.5 % (-2.8 %)"]
    assert alike[1:] == ["0.790", "0.810", "-2.5 %"]
    assert blind[1:] == ["0.690", "0.710", "-2.8 %"]


def test_scenes_that_are_missing_are_left_out_of_the_average_and_counted(tmp_path):
    results = Results("quick", tmp_path)
    for scene in ("1", "4"):
        for field, variant in (("wideband", ""), ("wrfgs", ""), ("wideband", "pooled")):
            job = Job(scene, field, variant=variant)
            results.write(job, made_up(job))
    assert row(headline.by_scene(results), "average of 2 (paper)")[2] == "+25.0 % (+17.8 %)"
    assert row(headline.by_scene(results), "3")[2] == cells.NOT_RUN


def test_results_of_other_settings_count_as_not_run(tmp_path, monkeypatch):
    results, job = Results("quick", tmp_path), Job("1", "wideband")
    results.write(job, made_up(job))
    assert results.get(job) is not None
    monkeypatch.setitem(PROFILES, "quick", dataclasses.replace(PROFILES["quick"], steps=2000))
    assert results.get(job) is None


def test_tables_2_and_3_and_figure_8(everything, tmp_path):
    paper, harder = table2.table(everything, True), table2.table(everything, False)
    assert row(paper, "**1** wideband (ours)") == ["0.780 (0.75)", "0.780 (0.74)", "0.780 (0.73)", "0.780 (0.70)"]
    assert row(paper, "**2** wideband (ours)") == ["0.780", "0.780", "0.780", "0.780 (0.54)"]
    assert row(harder, "**1** wideband (ours)") == ["0.780"] * 4
    assert row(paper, "same TX, nearest frequency") == row(harder, "inverse distance") == ["0.500"] * 4
    ablation = table3.render(everything, tmp_path)
    assert rows(ablation)[0][:3] == ["yes", "yes", "0.810 (0.72)"]
    assert rows(ablation)[3][5] == "0.690 (0.53)"
    bars = figure8.render(everything, tmp_path)
    assert row(bars, "A")[0:2] == ["all but 1", "0.780"]
    assert row(bars, "D")[1] == "0.790 (0.70)"
    assert row(bars, "D")[5:7] == ["0.790", "0.810"]


def test_the_volume_is_compared_with_others_of_its_seed(tmp_path):
    results = Results("quick", tmp_path)
    results.write(Job("4", "wideband"), made_up(Job("4", "wideband")))
    results.write(Job("4", "nerf2"), made_up(Job("4", "nerf2")))
    cells_of_scene = row(baselines.volume(results), "4")
    assert cells_of_scene[0] == "0.800" and cells_of_scene[3] == "0.600"
    assert cells_of_scene[4] == "100 % of 7"
    assert cells_of_scene[1] == cells.NOT_RUN


def test_the_page_is_whole_and_has_its_pictures(everything, tmp_path, monkeypatch):
    monkeypatch.setattr(statistics, "DRAWS", 20)
    text = page.page(everything, tmp_path) + page.long_page(everything, tmp_path)
    for module in (*page.PAGES, *page.LONG):
        assert f"## {module.TITLE}" in text
    shown = set(re.findall(rf"\({tmp_path.name}/(\S+?)\)", text))
    assert shown == {path.name for path in tmp_path.iterdir()} and len(shown) == 6
    for module in (default_field, few, power):  # whose files are no results of jobs
        text = text.replace(module.render(everything, tmp_path), "")
    assert cells.NOT_RUN not in text
    assert "`abc123`" in text and "nan" not in text


def test_the_default_field_is_shown_with_its_percentiles_and_powers(tmp_path):
    powers = {"per_frequency": [{"power_mae_db": 1.5 + i} for i in range(10)]}
    report = {
        "median_ssim": 0.9, "mean_ssim": 0.85, "p5_ssim": 0.5, "p10_ssim": 0.6, "in_sight": {"median_ssim": 0.95},
        "out_of_sight": None, "truth_repeats": 0.97, "angle_error_deg": 1.25, "beam_loss_db": 0.5, "beam_loss_top3_db": 0.25,
        "power": powers | {"power_mae_db": 2.0, "baselines": {"nearest_tx": powers}},
        "confidence": {"coverage": 0.9}, "provenance": {"training_seconds": 600.0},
    }  # fmt: skip
    write_json(tmp_path / "quality_scene3_hybrid_cpu_cpu.json", report)
    text = default_field.render(Results("quick", tmp_path), tmp_path)
    figures = ["0.900", "0.850", "0.500", "0.600", "0.950", "", "0.970", "1.2", "0.50", "0.25", "2.00", "90 %", "10"]
    assert row(text, "scene 3") == figures
    assert row(power.render(Results("quick", tmp_path), tmp_path), "nearest TX")[-1] == "10.50"
    assert row(text, "scene 1")[0] == cells.NOT_RUN


def test_pages_of_two_profiles_share_no_picture(tmp_path):
    job = Job("1", "wideband")
    for profile in ("quick", "smoke"):
        Results(profile, tmp_path).write(job, made_up(job))
        command_line.main(["--profile", profile, "--results", str(tmp_path), "--docs", str(tmp_path / "docs")])
    assert "(images/results_headline.png)" in (tmp_path / "docs" / "results.md").read_text()
    assert "(images_smoke/results_headline.png)" in (tmp_path / "docs" / "results_smoke.md").read_text()
    assert (tmp_path / "docs" / "images_smoke" / "results_headline.png").exists()


def test_the_summary_is_that_of_the_tables(everything, nothing):
    found = summary.summary(everything)
    assert found["wideband"] == pytest.approx(0.81) and found["wrfgs"] == pytest.approx(0.65)
    assert found["gain_percent"] == pytest.approx(100 * (0.81 / 0.65 - 1), abs=0.01)
    assert found["pooled"] == pytest.approx((5 * 0.70 + 0.71) / 6, abs=1e-3) and found["coherent"] == pytest.approx(0.91)
    assert summary.summary(nothing).keys() == {"ceiling"}  # of the scene files
