"""Series: every change is one and can work; results of the time before the runner are read; tables show what was run."""

import dataclasses
import itertools

import numpy as np
import pytest

from experiments.catalogue import SERIES, unique_jobs
from experiments.jobs import BASELINES, Job
from experiments.results import FOLDER, Results, read_lines
from experiments.series import robustness
from experiments.settings import settings
from experiments.tables import faults
from experiments.variants import OPTIMIZERS, VARIANTS
from wbgs_jax.config import check
from wbgs_jax.fields.base import check_config

JOBS = unique_jobs(tuple(SERIES))
KINDS = {(job.field, job.variant, job.profile): job for job in JOBS if job.field != BASELINES}


@pytest.mark.parametrize("job", KINDS.values(), ids=lambda job: f"{job.profile}-{job.name}")
def test_a_change_is_one_and_can_work(job):
    variant, chosen, usual = VARIANTS[job.variant], settings(job), settings(dataclasses.replace(job, variant=""))
    check(chosen)
    check_config(job.field, chosen.field)
    assert chosen.optim.steps == (variant.steps or variant.budget * usual.optim.steps) == chosen.optim.min_steps
    for section, values in variant.changes.items():
        assert values.items() <= vars(getattr(chosen, section)).items()
    changed = {name for name, values in vars(chosen).items() if values != vars(usual)[name]}
    if (
        variant.steps is None and variant.budget == 1 and job.variant not in ("fusion_0", *OPTIMIZERS)
    ):  # among which is what the profile has
        assert changed == set(variant.changes)


@pytest.mark.parametrize(
    "series", [one for experiment in SERIES.values() for one in experiment.series], ids=lambda one: one.title
)
def test_no_two_rows_of_a_table_are_the_same(series):
    jobs = [series.jobs_of(series.scenes[0], variant)[0] for variant in series.variants]
    rows = [(settings(job), VARIANTS[job.variant].fault) for job in jobs]
    assert all(one != other for one, other in itertools.combinations(rows, 2))


def test_batches_take_equal_time_and_their_rates_follow_the_square_root():
    small, usual, large = (settings(Job("1", "wideband", variant=f"batch_{n}", profile="choices")) for n in (4, 8, 16))
    assert small.optim.steps > usual.optim.steps > large.optim.steps
    for rate in ("network_lr", "means_lr", "log_scales_lr", "quats_lr", "opacity_lr"):
        rates = [getattr(chosen.field, rate) for chosen in (small, usual, large)]
        np.testing.assert_allclose(np.divide(rates, rates[1]), [0.5**0.5, 1, 2**0.5])
    assert usual.field.network_lr == 1e-3


def test_the_tuned_are_scored_where_the_slowest_one_is():
    scored = {
        field: {frozenset(data.tx_index[data.test].tolist()) for _, data in Job("1", field, profile="tuning").models()}
        for field in ("wideband", "wrfgs", "nerf2")
    }
    (same,) = set.union(*scored.values())
    assert len(same) == 24


@pytest.mark.parametrize(
    ("job", "median", "mean"),
    [
        # As choices_scene1_octaves4.json, choices_scene1_f1-24.25-77.json, choices_scene4_fusion.json,
        # equal_time_scene1_batch.json, baseline_choices_scene1.json and wave_choices_scene4.json had them.
        (Job("1", "wideband", variant="sphere", seed=1, profile="choices_octaves4"), 0.7687, 0.7346),
        (Job("1", "wideband", "C3", variant="frequency_octaves_4", profile="choices"), 0.7559, 0.7118),
        (Job("4", "wideband", variant="fusion_1", seed=1, profile="choices"), 0.7709, 0.752),
        (Job("1", "wideband", variant="batch_16", profile="choices"), 0.8604, 0.8238),
        (Job("1", "wrfgs", variant="lr_1.6e-2", profile="tuning"), 0.732, 0.7057),
        (Job("4", "wave", variant="mesh_moved_3mm", profile="choices"), 0.8595, 0.8166),
    ],
    ids=lambda value: value.name if isinstance(value, Job) else "",
)
def test_what_was_measured_before_the_runner_counts_as_run(job, median, mean):
    assert job in JOBS
    found = Results("quick").get(job)
    assert found is not None
    assert (found.values["median_ssim"], found.values["mean_ssim"]) == (median, mean)


def test_no_result_of_a_series_is_lost():
    results, profiles = Results("quick"), ("choices", "choices_octaves4", "tuning")
    found = {(profile, name) for profile in profiles for name in read_lines(FOLDER / f"{profile}.jsonl")}
    known = {(job.profile, job.name) for job in JOBS if job.profile in profiles and results.get(job)}
    published = {row for row in found if row[1].startswith("example1_")}  # of 800 steps: in the table, and no job
    assert len(published) == 15 and len(known) == 73
    assert found == known | published


def test_a_table_has_seeds_their_median_and_what_is_missing(tmp_path):
    results = Results("quick", tmp_path)
    (series,) = (one for one in SERIES["choices"].series if "fusion_0" in one.variants)
    for seed, score in ((0, 0.5), (1, 0.7)):
        results.write(series.jobs_of("2", "fusion_3")[seed], {"median_ssim": score, "mean_ssim": 0.4, "steps": 1500})
    lines = series.render(results).splitlines()
    assert "| 2 | fusion_3 | 0.500 | 0.700 | **0.600** | 0.400 | 1,500 |" in lines
    assert "| 2 | fusion_2 | not run | not run |  |  |  |" in lines


@pytest.mark.parametrize("name", ["choices", "tuning", "wave_choices"])
def test_every_series_is_shown(name, tmp_path):
    assert SERIES[name].jobs() and "not run" in SERIES[name].render(Results("quick", tmp_path))
    assert "**0." in SERIES[name].render(Results("quick"))


def test_faults_show_the_range_of_seeds_and_how_far_one_command_is_ahead(tmp_path):
    """Of all together, the others notice the noise. Seeds draw the faults: those that some have not run do not count."""
    results = Results("quick", tmp_path)
    for seed, score in ((0, 0.875), (2, 0.905)):
        (job,) = (job for job in robustness.HYBRID.jobs_of("2", "all_together") if job.seed == seed)
        results.write(job, {"average_of_medians": score, "median_ssim": score})
    results.write(robustness.SPLATTING.jobs_of("2", "snr_20")[0], {"average_of_medians": 0.8, "median_ssim": 0.8})
    nothing = {"nearest_tx": {"1": 0.6, "2": 0.8}, "inverse_distance": {"1": 0.8, "2": 0.84}}
    results.write(robustness.NOTHING.jobs_of("2", "snr_20")[0], {"baselines": nothing})
    lines = robustness.render(results).splitlines()
    assert "| all together | 0.890 (0.875 to 0.905, 2 seeds) | not run |  |  |  | +0.055 |" in lines
    assert "| snr 20 | not run | not run | 0.800 | 0.700 | 0.820 |  |" in lines
    assert sum("among the 1 faults with which all were run, is +0.055, with *all together*" in line for line in lines) == 1


def test_curves_of_faults_are_medians_over_seeds_with_gaps(tmp_path):
    results = Results("quick", tmp_path)
    for seed, score in ((0, 0.7), (1, 0.9), (2, 0.75)):
        results.write(robustness.HYBRID.jobs_of("4", "snr_20")[seed], {"average_of_medians": score, "median_ssim": score})
    results.write(robustness.SPLATTING.jobs_of("4", "")[0], {"average_of_medians": 0.6, "median_ssim": 0.6})
    axes = dict(zip(faults.PANELS, faults.draw(results).axes, strict=True))

    def drawn(title):
        return {(line.get_color(), line.get_linestyle()): line.get_ydata() for line in axes[title].lines}

    by_noise = drawn("snapshot SNR (dB)")
    np.testing.assert_array_equal(by_noise["C2", "-"], [np.nan, np.nan, 0.75, np.nan])
    np.testing.assert_array_equal(by_noise["C2", "--"], [0.6, np.nan, np.nan, np.nan])
    assert np.isnan(by_noise["C0", "-"]).all()
    np.testing.assert_array_equal(drawn("mesh position error (mm)")["C2", "--"], 0.6)
