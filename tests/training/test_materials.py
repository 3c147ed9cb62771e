"""The search names materials from spectra alone, where frequencies are too far apart for gradients to follow the phase."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import box, field_of, room
from synthetic import tiny_scene, tiny_settings
from test_field import make_mesh_arrays

from wbgs_jax import make_query
from wbgs_jax.training import materials as material_search
from wbgs_jax.data import scene_dataset
from wbgs_jax.fields import wave
from wbgs_jax.training.materials import ITU_MATERIALS
from wbgs_jax.training.loop import Run

RX, FREQUENCIES = (1.0, 1.0, 1.2), np.array([1e9, 94e9])
PARTS = [*room(), box((3, 1, 0.5), (4, 2, 1.2))]
PATHS = {"plain_tried": 128, "plain_kept": 64, "diffracted_tried": 32, "diffracted_kept": 16, "mirror_areas": (0.0, 0.0)}


def run_on(materials, folder, **wave_settings):
    """A run, before its first step, on spectra that these materials (eps_r, c, d) made."""
    params, plan = field_of(PARTS, RX, thickness=0.05, survival=0.7, **PATHS)
    columns = [jnp.asarray(column, jnp.float32) for column in np.array(materials).T]
    made_of = dataclasses.replace(
        params.materials, log_susceptibility=jnp.log(columns[0] - 1), log_conductivity=jnp.log(columns[1]), slope=columns[2]
    )
    tx = np.random.default_rng(3).uniform([0.3, 0.3, 0.3], [5.7, 3.7, 2.7], (40, 3))
    query = make_query(np.repeat(tx, 2, 0), np.tile(FREQUENCIES, 40))
    y = jax.jit(wave.snapshots)(dataclasses.replace(params, materials=made_of), plan, query)
    scene = dataclasses.replace(
        tiny_scene(40),
        snapshots=np.asarray(y, np.complex64).reshape(40, 2, 16),
        tx_positions=tx,
        frequencies_hz=FREQUENCIES,
        rx_position=np.array(RX),
        **make_mesh_arrays(PARTS)
        | {"meta": {"parts": [{"name": f"{i}", "material": f"{i}", "thickness": 0.05} for i in range(len(PARTS))]}},
    )
    settings = tiny_settings(wave=PATHS | wave_settings, optim={"steps": 20, "min_steps": 20}, search={"spectra": 48})
    return Run(scene_dataset(scene), "wave", settings, 0, folder)


def test_it_names_the_materials(tmp_path, rng):
    """All seven at random, from 1 and 94 GHz alone, all starting alike."""
    names = rng.choice([name for name in ITU_MATERIALS if name != "metal"], len(PARTS), replace=False)
    run = run_on([ITU_MATERIALS[name] for name in names], tmp_path)
    run.search()
    report = json.loads((tmp_path / "metrics.jsonl").read_text())["search"]
    found = [report["taken"].get(str(i)) for i in range(len(PARTS))]
    assert sum(a == b for a, b in zip(found, names, strict=True)) >= len(PARTS) - 1, (found, names)
    assert report["after"] < report["before"] - 1


def test_what_fits_better_than_the_list_is_kept(tmp_path):
    unlisted = [(9.3, 0.05, 0.0)] * len(PARTS)
    run = run_on(unlisted, tmp_path, permittivity=9.3, conductivity=0.05, slope=0.0)
    before = np.asarray(run.state.params.materials.log_susceptibility)
    run.search()
    np.testing.assert_array_equal(before, np.asarray(run.state.params.materials.log_susceptibility))


def test_it_ends_when_nothing_is_left_to_change(tmp_path, monkeypatch):
    """Where the last change was that of material k, nobody looks again at k and those behind it."""
    run = run_on([ITU_MATERIALS["wood"]] * len(PARTS), tmp_path)
    looked_at = []

    def scores(_field):
        def score(params, candidates, *_):
            susceptibility = np.asarray(candidates.log_susceptibility)
            looked_at.append(int(np.argmax(np.ptp(susceptibility, 0))))
            wanted = np.log(5.24 - 1 if looked_at[-1] == 2 else 4.0 - 1)  # concrete, or what is there
            return np.abs(susceptibility[:, looked_at[-1], None] - wanted) + np.zeros(48)

        return score

    monkeypatch.setattr(material_search, "_make_scores", scores)
    run.search()
    count = len(PARTS)
    assert looked_at == [*range(count), 0, 1]


@pytest.mark.parametrize("steps, rounds", [(5, 3), (0, 0)])
def test_it_is_left_out_when_resumed_or_switched_off(steps, rounds, tmp_path):
    run = run_on([ITU_MATERIALS["wood"]] * len(PARTS), tmp_path)
    run.settings = dataclasses.replace(run.settings, search=dataclasses.replace(run.settings.search, rounds=rounds))
    run.state = dataclasses.replace(run.state, step=jnp.asarray(steps))
    run.search()
    assert not (tmp_path / "metrics.jsonl").exists()


def test_known_thickness_is_not_trained(tmp_path):
    run = run_on([ITU_MATERIALS["wood"]] * len(PARTS), tmp_path)
    run.epoch()
    np.testing.assert_array_equal(run.state.params.materials.known_thickness, np.float32(0.05))
    np.testing.assert_array_equal(run.state.params.materials.thickness(), np.float32(0.05))
