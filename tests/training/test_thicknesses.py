"""Thicknesses that a scene does not say are found with the materials; those that it says, or that fit, are left alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_settings
from builders.wave_runs import PARTS, places, run_in, snapshots

from wbgs_jax.training.calibration.material_fit import (
    ITU_MATERIALS,
    ONCE_MORE,
    USUAL_M,
    SearchReport,
    Slab,
    _all_slabs,
    _best,
    frequencies_to_look_at,
    search_materials,
    search_slabs,
)
from wbgs_jax.training.calibration.objective import CalibrationProblem

N_TX, FREQUENCIES = 40, np.array([1e9, 2.4e9, 5e9, 12e9, 28e9])
SETTINGS = tiny_settings(
    "wave",
    field={
        "specular_tried": 128,
        "specular_kept": 64,
        "diffracted_tried": 1,
        "diffracted_kept": 1,
        "mirror_areas": (0.0,),
    },
    calibration={"spectra": 60, "rounds": 2, "antenna_rounds": 0, "thickness_spectra": 60},
)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A run of which no thickness is known, before its first step."""
    run = run_in(PARTS, SETTINGS, tmp_path_factory.mktemp("room"), places(N_TX), FREQUENCIES)
    run.field = dataclasses.replace(run.field, known_thickness=jnp.zeros(len(PARTS)))
    return run


def of(params, names, metres):
    permittivity, c, d = jnp.asarray([ITU_MATERIALS[name] for name in names], jnp.float32).T
    materials = dataclasses.replace(
        params.materials,
        log_susceptibility=jnp.log(permittivity - 1),
        log_conductivity=jnp.log(c),
        slope=d,
        log_thickness=jnp.log(jnp.asarray(metres, jnp.float32)),
    )
    return dataclasses.replace(params, materials=materials)


def problem(room, truth, field=None):
    plan = room.field.plan(truth, room.dataset.receiver(), prepared=room.prepared)
    data = room.data.with_observations(snapshots=snapshots(truth, plan, room.prepared, room.data.links))
    return CalibrationProblem(field or room.field, room.prepared, data, np.asarray(room.dataset.train))


@pytest.mark.heavy
def test_they_are_found_with_the_materials(room, rng):
    """Of lossy walls little comes back from the far side: one room in thirty or so is found to 3 % only. Two further rooms then
    have to be found better."""
    errors = [off_in_a_room(room, rng)]
    while max(errors) >= 0.02 and len(errors) < 3:
        errors.append(off_in_a_room(room, rng))
    print(errors)
    assert np.median(errors) < 0.02


def off_in_a_room(room, rng):
    """The median error of optical thicknesses in a room of any walls."""
    names = rng.choice(["concrete", "brick", "plasterboard", "wood", "glass"], len(PARTS))
    metres = rng.uniform(0.01, 0.3, len(PARTS))
    start = room.field.init(jax.random.key(0))
    heard = problem(room, of(start, names, metres))
    found, report, likely = search_slabs(start, heard, SETTINGS.calibration, 60)
    alone, _ = search_materials(start, heard, 60, SETTINGS.calibration)
    left, without = heard.scores()([found, alone]).mean(1)
    assert left < without - 0.5
    assert set(report.thickness_mm) == set(likely) == set(range(len(PARTS)))
    other = {material: [Slab("metal", 0.3)] for material in likely}
    wrong, _, _ = search_slabs(start, heard, SETTINGS.calibration, 60, likely=other)
    assert heard.scores()([wrong]).mean() > left + 0.1, "what is ruled out is looked at no more"
    optical = [m * np.sqrt(ITU_MATERIALS[name][0]) for m, name in zip(metres, names, strict=True)]
    materials = found.materials
    reached = np.exp(np.asarray(materials.log_thickness)) * np.sqrt(1 + np.exp(np.asarray(materials.log_susceptibility)))
    return float(np.median(np.abs(reached / optical - 1)))


@pytest.mark.heavy
def test_what_fits_stays(room, rng):
    """Walls as thick as is usual, which is where the search begins."""
    names = rng.choice(["concrete", "brick", "plasterboard", "wood"], len(PARTS))
    start = room.field.init(jax.random.key(0))
    heard = problem(room, of(start, names, [USUAL_M[name] for name in names]))
    found, report, _ = search_slabs(start, heard, SETTINGS.calibration, 60)
    usual = np.log([USUAL_M[name] for name in names])
    assert not report.thickness_mm or np.abs(np.asarray(found.materials.log_thickness) - usual).max() < 0.02
    assert heard.scores()([found]).mean() < -4


@pytest.mark.heavy
def test_a_known_thickness_is_not_searched(room, rng):
    start = room.field.init(jax.random.key(0))
    metres = rng.uniform(0.01, 0.3, len(PARTS))
    known = dataclasses.replace(room.field, known_thickness=jnp.full(len(PARTS), 0.1))
    heard = problem(room, of(start, ["wood"] * len(PARTS), metres), known)
    found, report, _ = search_slabs(start, heard, SETTINGS.calibration, 60)
    assert not report.thickness_mm
    np.testing.assert_array_equal(found.materials.log_thickness, start.materials.log_thickness)


@pytest.mark.heavy
def test_pictures_alone_are_not_asked(room, rng, monkeypatch):
    start = room.field.init(jax.random.key(0))
    heard = problem(room, of(start, ["wood"] * len(PARTS), rng.uniform(0.01, 0.3, len(PARTS))))
    heard = dataclasses.replace(heard, data=heard.data.with_observations())
    nothing = SearchReport(0.0, 0.0, {})
    module = "wbgs_jax.training.calibration.material_fit"
    monkeypatch.setattr(f"{module}.search_materials", lambda params, *_, **__: (params, nothing))
    monkeypatch.setattr(f"{module}._sized", lambda *_: pytest.fail("searched"))
    found, report, _ = search_slabs(start, heard, SETTINGS.calibration, 60)
    assert found is start and report is nothing


def test_of_what_no_path_meets_no_slab_is_ruled_out(room):
    """Of two materials, the scores tell of the second alone."""
    params, slabs = room.field.init(jax.random.key(0)), _all_slabs(2.4e9)

    def score(candidates, first=None):
        wanted = np.log(ITU_MATERIALS["glass"][0] - 1)
        off = [abs(float(one.materials.log_susceptibility[1]) - wanted) for one in candidates]
        return np.array(off)[:, None] + np.zeros(first or 60)

    same, unseen = _best(params, 0, slabs, score, 48)
    found, likely = _best(params, 1, slabs, score, 48)
    assert same is params and unseen == slabs
    assert len(likely) < len(slabs) and likely[0].entry == "glass"
    assert float(found.materials.log_susceptibility[1]) == pytest.approx(np.log(ITU_MATERIALS["glass"][0] - 1))


@pytest.mark.parametrize("silent", [0, 16])
def test_what_the_first_spectra_say_nothing_of_is_not_ruled_out(room, silent):
    """All slabs get a glance where a third of its spectra cannot tell them apart, and the best third where it can."""
    params, slabs, asked = room.field.init(jax.random.key(0)), _all_slabs(2.4e9), []

    def score(candidates, first=60):
        off = [abs(float(one.materials.log_thickness[0]) - np.log(0.07)) for one in candidates]
        asked.append((len(candidates), first))
        return np.array(off)[:, None] * (np.arange(first) >= silent)

    found, _ = _best(params, 0, slabs, score, 48)
    assert asked == [(len(slabs), 16), (len(slabs) if silent else len(slabs) // 3, 48), (5, 60)]
    nearest = min(abs(np.log(slab.metres / 0.07)) for slab in slabs)
    assert abs(float(found.materials.log_thickness[0]) - np.log(0.07)) == pytest.approx(nearest, abs=1e-6)


def test_a_glance_at_a_single_spectrum_is_one(room):
    """A third of it is not none."""

    def score(candidates, first=60):
        off = [abs(float(one.materials.log_thickness[0]) - np.log(0.07)) for one in candidates]
        assert first > 0
        return np.array(off)[:, None] + np.zeros(first)

    _, likely = _best(room.field.init(jax.random.key(0)), 0, _all_slabs(2.4e9), score, 1)
    assert len(likely) == ONCE_MORE


def test_frequencies_stand_apart_and_are_believed():
    of_data = np.repeat([1.0, 2.4, 2.5, 5.0, 5.2, 28.0, 60.0, 61.0], 3) * 1e9
    np.testing.assert_allclose(frequencies_to_look_at(of_data, np.inf), np.array([2.5, 5.2, 28.0, 61.0]) * 1e9)
    np.testing.assert_allclose(frequencies_to_look_at(of_data, 30e9), np.array([2.5, 5.2, 28.0]) * 1e9)
    np.testing.assert_allclose(frequencies_to_look_at(of_data, 1e9), [2.5e9])  # one look there is in any case
    assert frequencies_to_look_at(np.full(4, 3e9), np.inf) == [3e9]
    few = np.array([1.0, 24.25, 77.0]) * 1e9
    assert frequencies_to_look_at(few, np.inf) == few.tolist(), "a first look at 24.25 GHz would end at walls of 5 cm"
