"""Clutter is found where the room has something that the mesh lacks, and nowhere else."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_settings
from builders.wave_runs import PARTS, REFLECTIONS, heard_in, of_concrete, places, run_in

from wbgs_jax._util.errors import UserError
from wbgs_jax.fields.base import paths_of
from wbgs_jax.fields.coherent import WaveConfig
from wbgs_jax.fields.coherent_model import densities, stored
from wbgs_jax.training.calibration.objective import CalibrationProblem
from wbgs_jax.training.calibration.obstacles import search_clutter
from wbgs_jax.training.curves import read
from wbgs_jax.training.loop import train

N_TX, FREQUENCIES = 80, np.array([2e9, 10e9])
PLACES = places(N_TX, 0.4)
SETTINGS = tiny_settings(
    "wave",
    field=REFLECTIONS | {"clutter_cell": 0.3},
    optim={"steps": 4, "min_steps": 4},
    calibration={"spectra": 80, "rounds": 1, "antenna_rounds": 0, "absorption_spectra": 160, "absorption_steps": 400},
)  # fmt: skip


def hedge(field, rng):
    """Clutter across the room, between the receiver and most of the transmitters, and which cells it fills."""
    density, grid = np.asarray(densities(field.first_clutter)).copy(), field.grid
    middles = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in density.shape[:3]), indexing="ij"), -1)
    low = rng.uniform((1.8, 0.2, 0.0), (2.4, 0.8, 0.1))
    inside = np.asarray(grid.low) + np.asarray(grid.cell) * middles - low
    filled = np.all((inside > 0) & (inside < (0.8, 2.5, 2.2)), -1)
    density[filled] = 1.5
    return stored(jnp.asarray(density)), filled


def heard_behind_a_hedge(folder, rng):
    """Snapshots of all places, and which cells the hedge fills."""
    run = run_in(PARTS, SETTINGS, folder, PLACES, FREQUENCIES)
    run.field = run.field.with_absorption()
    clutter, filled = hedge(run.field, rng)
    return heard_in(run, dataclasses.replace(of_concrete(run), clutter=clutter), PLACES, FREQUENCIES), filled


def told_of(parts, truth, folder, n_tx=N_TX):
    run = run_in(parts, SETTINGS, folder, PLACES[:n_tx], FREQUENCIES, truth[:n_tx])
    return of_concrete(run), CalibrationProblem(
        run.field, run.prepared, run.data, np.random.default_rng(0).permutation(run.dataset.train)
    )


@pytest.mark.heavy
@pytest.mark.long
def test_a_hedge_that_the_mesh_lacks_is_found_where_it_stands_and_read_again(tmp_path, rng):
    truth, filled = heard_behind_a_hedge(tmp_path / "true", rng)
    dataset = run_in(PARTS, SETTINGS, tmp_path, PLACES, FREQUENCIES, truth).dataset
    trained = train(dataset, "wave", SETTINGS, 0, tmp_path / "run")
    (report,) = (entry["clutter"] for entry in read(tmp_path / "run" / "metrics.jsonl") if "clutter" in entry)
    assert report["taken"]
    assert report["after"] < 0.8 * report["before"]
    density = np.asarray(densities(trained.params.clutter)).mean(-1)
    assert density[filled].mean() > 3 * density[~filled].mean()
    again = train(dataset, "wave", SETTINGS, 0, tmp_path / "run", resume=True)
    query = dataset.query(dataset.train[:8])
    seen = [one.field.render(one.params, one.field.plan(one.params, dataset.receiver()), query).pas for one in (trained, again)]
    np.testing.assert_array_equal(again.params.clutter, trained.params.clutter)
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-6)


@pytest.mark.heavy
def test_nothing_is_found_in_a_room_as_the_mesh_has_it(tmp_path, rng):
    run = run_in(PARTS, SETTINGS, tmp_path / "true", PLACES, FREQUENCIES)
    params, problem = told_of(PARTS, heard_in(run, of_concrete(run), PLACES, FREQUENCIES), tmp_path / "same")
    same, still, report = search_clutter(params, problem, SETTINGS.calibration, rng)
    assert not report.taken
    assert same is params
    assert still is problem
    assert same.clutter is None


@pytest.mark.parametrize("values", [{"clutter_cells": 0}, {"clutter_cell": 0.0}])
def test_grids_without_cells_are_refused(values):
    with pytest.raises(UserError, match="absorption-spectra 0 disables the grid"):
        WaveConfig(**values).check("wave")


@pytest.mark.heavy
def test_few_transmitters_prove_nothing(tmp_path, rng):
    nothing = np.ones((12, 1, len(FREQUENCIES), 16), np.complex64)
    params, problem = told_of(PARTS, nothing, tmp_path, n_tx=12)
    assert search_clutter(params, problem, SETTINGS.calibration, rng) == (params, problem, None)


@pytest.mark.heavy
def test_clutter_everywhere_darkens_all(tmp_path, rng):
    """With a density d everywhere, every path loses d times its length."""
    run = run_in(PARTS, SETTINGS, tmp_path, PLACES[:6], FREQUENCIES)
    field, density = run.field.with_absorption(), rng.uniform(0.1, 0.5)
    empty = of_concrete(run)
    dense = dataclasses.replace(empty, clutter=stored(jnp.full_like(field.first_clutter, density)))
    links = run.dataset.links(np.arange(6))
    seen = {}
    for name, one, params in (("empty", run.field, empty), ("dense", field, dense)):
        plan = one.plan(params, run.dataset.receiver())
        seen[name] = paths_of(one, params, plan, links)
    before, after = (np.abs(np.asarray(seen[name].amplitude)) for name in ("empty", "dense"))
    heard = before > 0
    expected = before * np.exp(-density * np.asarray(seen["empty"].length))
    np.testing.assert_allclose(after[heard], expected[heard], rtol=1e-3)
