"""Jobs: what the tables need is among them, each trains and tests on what it says, budgets are what they are said to be."""

import dataclasses

import numpy as np
import pytest
from builders.synthetic import tiny_scene

from experiments import paper
from experiments.catalogue import EXPERIMENTS, unique_jobs
from experiments.faults import Fault, faulty
from experiments.jobs import BASELINES, ONE_FREQUENCY, SCORED_TRAINED, Job
from experiments.profiles import PROFILES, TABLE_PROFILES
from experiments.settings import settings
from experiments.tables import figure8, table1, table2
from wbgs_jax.config import check
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.fields.base import check_config

JOBS = unique_jobs()
TRAINED = [job for job in JOBS if job.field != BASELINES]


def test_names_are_unique_and_stay_as_they_are():
    assert len({job.name for job in JOBS}) == len(JOBS)
    everything = [(job.profile, job.name) for job in unique_jobs(tuple(EXPERIMENTS))]
    assert len(set(everything)) == len(everything)
    names = {
        "scene1_wideband_seed0": Job("1", "wideband"),
        "scene4_wrfgs_long_seed2": Job("4", "wrfgs", variant="long", seed=2),
        "scene4_wave_C4_alltx_seed0": Job("4", "wave", "C4", all_tx=True),
        "scene1_21f_wideband_pooled_D_alltx_seed1": Job("1_21f", "wideband", "D", all_tx=True, variant="pooled", seed=1),
    }
    assert {name: job.name for name, job in names.items()} == {name: name for name in names}
    assert set(names.values()) <= set(JOBS)


@pytest.mark.parametrize("model", [model for model in table1.MODELS if model not in table1.CONTROLS])
def test_table_1_has_sixty_cells_and_three_seeds_of_every_compared_model(model):
    jobs = [job for job in table1.jobs() if (job.field, job.variant) == model]
    cells = {(job.scene, ghz) for job in jobs for ghz in job.test_ghz}
    assert len(cells) == 60
    assert {job.seed for job in jobs} == {0, 1, 2}


def test_table_2_has_all_combinations_with_and_without_held_out_transmitters():
    found = {(job.scene, job.combination, job.all_tx) for job in table2.jobs() if job.field == "wideband"}
    assert len(found) == 6 * 4 * 2


def test_figure_8_has_all_combinations():
    assert {job.combination for job in figure8.jobs() if job.all_tx} == set("ABCDEFGHIJK")


def test_every_experiment_has_jobs():
    assert all(experiment.jobs() for experiment in EXPERIMENTS.values())


@pytest.mark.parametrize(
    ("combination", "unseen"),
    {
        "C1": (5, 37, 77),
        "C2": (2.4, 10, 37, 60, 94),
        "C3": (2.4, 5, 10, 37, 47, 60, 94),
        "C4": (2.4, 5, 10, 24.25, 37, 47, 60, 77),
        "A": (1,),
        "B": (50,),
        "C": (100,),
        "D": (5, 15, 25, 35, 45, 55, 65, 75, 85, 95),
        "E": (5, 10, 15, 20, 30, 35, 40, 45, 55, 60, 65, 70, 80, 85, 90, 95),
        "F": (5, 10, 15, 20, 25, 30, 35, 40, 45, 55, 60, 65, 70, 75, 80, 85, 90, 95),
        "H": (1, 5, 10, 15, 20, 30, 35, 40, 45, 50, 55, 60, 65, 70, 80, 85, 90, 95, 100),
        "K": tuple(range(5, 101, 5)),
    }.items(),
)
def test_the_test_frequencies_are_those_of_tables_5_and_6(combination, unseen):
    scene = "1" if combination in table2.COMBINATIONS else paper.DENSE_SCENE
    assert Job(scene, "wideband", combination).test_ghz == unseen


def transmitters(dataset, index):
    return set(dataset.tx_index[index].tolist())


def frequencies(dataset, index):
    return set(np.unique(dataset.frequencies_hz[index] / 1e9).tolist())


@pytest.mark.parametrize("all_tx", [True, False])
def test_unseen_frequencies_are_unseen(all_tx):
    job = Job("1", "wideband", "C3", all_tx=all_tx)
    dataset = job.dataset()
    assert frequencies(dataset, dataset.train) == {1, 24.25, 77}
    assert frequencies(dataset, dataset.test) == set(job.test_ghz)
    trained, tested = transmitters(dataset, dataset.train), transmitters(dataset, dataset.test)
    if all_tx:
        assert len(trained) == 877 and len(tested) == SCORED_TRAINED and tested <= trained
    else:
        assert len(trained) == 702 and len(tested) == 175 and not tested & trained


def test_a_model_for_every_frequency_sees_that_frequency_alone():
    models = list(Job("1", "wrfgs").models())
    assert [name for name, _ in models[:3]] == ["1GHz", "2.4GHz", "5GHz"] and len(models) == 10
    for (_, dataset), ghz in zip(models, paper.GHZ_10, strict=True):
        assert frequencies(dataset, dataset.train) == frequencies(dataset, dataset.test) == {ghz}


def test_all_fields_are_scored_on_the_same_transmitters():
    volume, others = Job("1", "nerf2").dataset(), Job("1", "wideband").dataset()
    np.testing.assert_array_equal(volume.test, others.test)
    np.testing.assert_array_equal(volume.train, others.train)


def test_a_folder_of_spectra_is_a_job_too(tmp_path):
    path = tmp_path / "kitchen.npz"
    save_scene(path, tiny_scene())
    job = Job(str(path), "wrfgs", profile="smoke")
    assert job.name == "kitchen_wrfgs_seed0" and job.known_ghz == job.test_ghz == (1, 10, 94)
    assert [name for name, _ in job.models()] == ["1GHz", "10GHz", "94GHz"]
    assert settings(job).optim.steps == 2


@pytest.mark.parametrize("profile", TABLE_PROFILES)
def test_all_settings_can_work_and_have_the_steps_of_the_profile(profile):
    size = PROFILES[profile]
    for job in {(job.field, job.variant, job.scene): job.sized(profile) for job in TRAINED}.values():
        chosen = settings(job)
        check(chosen)
        check_config(job.field, chosen.field)
        assert chosen.optim.min_steps == chosen.optim.steps  # no data set cuts them
        if job.field in ONE_FREQUENCY:
            block, share = chosen.loop.epoch_steps, size.steps * job.budget / len(job.test_ghz)
            assert chosen.optim.steps == block or abs(chosen.optim.steps - share) <= block / 2


def test_series_keep_their_size_but_are_small_too():
    job = Job("1", "wideband", profile="choices")
    assert job.sized("paper") == job and job.sized("smoke").profile == "smoke"
    assert Job("1", "wideband").sized("paper").profile == "paper"
    for variant in ("steps_6000", "batch_16"):  # which have steps of their own
        assert settings(Job("1", "wideband", variant=variant, profile="smoke")).optim.steps < 20


@pytest.mark.parametrize("variant", ["", "long"])
def test_wrfgs_sees_as_many_spectra_as_the_wideband_field(variant):
    ours, theirs = (settings(Job("1", field, variant=variant)).optim for field in ("wideband", "wrfgs"))
    assert 10 * theirs.steps * theirs.batch == ours.steps * ours.batch


def test_the_longest_wrfgs_sees_as_many_spectra_at_every_frequency():
    ours = settings(Job("1", "wideband")).optim
    theirs = settings(Job("1", "wrfgs", variant="longest")).optim
    assert theirs.steps * theirs.batch == ours.steps * ours.batch


def test_variants_change_what_they_name():
    blind = settings(Job("1_21f", "wideband", variant="pooled")).field
    assert not blind.attenuation_frequency and not blind.radiance_frequency and blind.gaussians == 1000
    usual, fast = (settings(Job("1", "wrfgs", variant=variant)) for variant in ("", "lr_1.6e-2"))
    assert fast.field.network_lr > usual.field.network_lr and fast.optim == usual.optim
    assert dataclasses.replace(fast.field, network_lr=usual.field.network_lr) == usual.field


def test_a_job_of_a_displaced_mesh_trains_on_it(tmp_path):
    path = tmp_path / "box.npz"
    save_scene(path, tiny_scene(4))
    whole, moved = (Job(str(path), "wave", variant=variant, seed=3).dataset() for variant in ("", "mesh_moved_3cm"))
    np.testing.assert_array_equal(moved.vertices, faulty(whole, Fault(displaced_m=0.03), 3).vertices)
    assert np.abs(moved.vertices - whole.vertices).max() > 1e-3


def test_the_papers_averages_are_those_of_its_rows():
    rows = [(paper.TABLE_1[s][m], paper.TABLE_1_AVERAGE[s][m]) for s in paper.SCENES for m in ("wrfgs", "wideband")]
    for row, average in rows:
        assert len(row) == 10 and np.mean(row) == pytest.approx(average, abs=0.0061)
    for model, value in paper.TABLE_1_OVERALL.items():
        assert np.mean([paper.TABLE_1_AVERAGE[s][model] for s in paper.SCENES]) == pytest.approx(value, abs=0.006)
    assert paper.TABLE_1_OVERALL["wideband"] / paper.TABLE_1_OVERALL["wrfgs"] - 1 == pytest.approx(paper.GAIN, abs=1e-3)
    assert 1 - paper.FIGURE_8["D"] / paper.FIGURE_7_AVERAGE["wideband"] == pytest.approx(paper.ZERO_SHOT_DROP, abs=1e-3)
