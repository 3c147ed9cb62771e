"""The search names materials from spectra alone, where frequencies are too far apart for gradients to follow the phase."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_settings
from builders.wave_runs import PARTS, THICKNESS, places, run_in, snapshots

from wbgs_jax.config import changed
from wbgs_jax.fields import coherent
from wbgs_jax.radio.channel import received_power_db
from wbgs_jax.training.calibration import pipeline as search_module
from wbgs_jax.training.calibration.material_fit import ITU_MATERIALS, search_materials, with_entry
from wbgs_jax.training.calibration.objective import CalibrationProblem
from wbgs_jax.training.loop import Run

FREQUENCIES = np.array([1e9, 94e9])
N_TX = 40
SETTINGS = tiny_settings(
    "wave",
    field={
        "specular_tried": 128,
        "specular_kept": 64,
        "diffracted_tried": 32,
        "diffracted_kept": 16,
        "mirror_areas": (0.0,),
        "slope": 0.0,
    },
    optim={"steps": 20, "min_steps": 20},
    calibration={"spectra": 48, "rounds": 3, "antenna_rounds": 0, "array_gain_spectra": 0},
)


@pytest.fixture(scope="module")
def untrained(tmp_path_factory):
    return run_in(PARTS, SETTINGS, tmp_path_factory.mktemp("untrained"), places(N_TX), FREQUENCIES)


@pytest.fixture
def run_on(untrained, tmp_path):
    """Gives a run, before its first step, on snapshots that these materials (eps_r, c, d) made, as ray tracers have them or
    in some ways as nature has them."""

    def make(materials, search=SETTINGS.calibration, natural=(), **start):
        run = object.__new__(Run)
        run.__dict__.update(untrained.__dict__)
        run.folder = tmp_path
        run.settings = dataclasses.replace(changed(SETTINGS, {"field": start}), calibration=search)
        run.hooks = (search_module.Calibration(search),)
        field = dataclasses.replace(run.field, config=run.settings.field)
        params = field.init(run.key)
        columns = [jnp.asarray(column, jnp.float32) for column in np.array(materials).T]
        made_of = dataclasses.replace(
            params.materials, log_susceptibility=jnp.log(columns[0] - 1), log_conductivity=jnp.log(columns[1]), slope=columns[2]
        )
        plan = run.field.plan(params, run.dataset.receiver(), prepared=run.prepared)
        truth = dataclasses.replace(params, materials=made_of, **{name: jnp.asarray(1.0) for name in natural})
        y = snapshots(truth, plan, run.prepared, run.data.links)
        run.data = run.data.with_observations(snapshots=y)
        run.state = jax.tree.map(jnp.copy, dataclasses.replace(run.state, params=params))  # an epoch gives its own away
        return run

    return make


@pytest.mark.heavy
def test_it_names_the_materials(run_on, tmp_path, rng):
    """All seven at random, from 1 and 94 GHz alone, all starting alike."""
    names = rng.choice([name for name in ITU_MATERIALS if name != "metal"], len(PARTS), replace=False)
    run = run_on([ITU_MATERIALS[name] for name in names])
    run.run_hooks()
    report = json.loads((tmp_path / "metrics.jsonl").read_text())["search"]
    found = [report["taken"].get(str(i)) for i in range(len(PARTS))]
    assert sum(a == b for a, b in zip(found, names, strict=True)) >= len(PARTS) - 1, (found, names)
    assert report["after"] < report["before"] - 1
    for i, name in enumerate(found):
        if name is not None:
            permittivity = 1 + np.exp(float(run.state.params.materials.log_susceptibility[i]))
            assert permittivity == pytest.approx(ITU_MATERIALS[name][0], rel=1e-5)


@pytest.mark.heavy
def test_what_fits_better_than_the_list_is_kept(run_on):
    run = run_on([(9.3, 0.05, 0.0)] * len(PARTS), permittivity=9.3, conductivity=0.05)
    before = np.asarray(run.state.params.materials.log_susceptibility)
    np.testing.assert_allclose(1 + np.exp(before), 9.3, rtol=1e-5)
    run.run_hooks()
    np.testing.assert_array_equal(before, np.asarray(run.state.params.materials.log_susceptibility))


@pytest.mark.parametrize(("gain", "expected"), [(0.005, "concrete"), (-0.005, "brick")])
def test_an_entry_that_a_glance_overlooks_is_replaced_by_a_better_one_alone(run_on, monkeypatch, rng, gain, expected):
    """The first spectra speak for four other entries than what is there, which all of them together prefer, or do not."""
    run = run_on([ITU_MATERIALS["wood"]] * len(PARTS))
    favourites = [np.log(ITU_MATERIALS[name][0] - 1) for name in ("brick", "wood", "glass", "marble")]

    def scores(*_):
        def score(candidates, first=None):
            found = np.array([params.materials.log_susceptibility[0] for params in candidates])
            listed = np.isclose(found[:, None], favourites, atol=1e-5)
            others = 0.3 if first else 0
            means = np.where(listed.any(1), gain + 0.1 * listed[:, 1:].any(1), others)
            return means[:, None] + listed.any(1)[:, None] * noise[: first or 48]

        return score

    noise = rng.normal(0, 0.1, 48)  # much more than the gain
    noise -= noise.mean()
    monkeypatch.setattr("wbgs_jax.training.calibration.objective.make_scores", scores)
    materials = with_entry(run.state.params.materials, 0, "concrete")
    params = dataclasses.replace(run.state.params, materials=materials)
    problem = CalibrationProblem(run.field, run.prepared, run.data, np.asarray(run.dataset.train))
    found, _ = search_materials(params, problem, 48, dataclasses.replace(SETTINGS.calibration, rounds=1))
    np.testing.assert_allclose(found.materials.log_susceptibility[0], np.log(ITU_MATERIALS[expected][0] - 1), rtol=1e-5)


@pytest.mark.heavy
def test_it_ends_when_nothing_is_left_to_change(run_on, monkeypatch):
    """Where the last change was that of material k, nobody looks again at k and those behind it."""
    run = run_on([ITU_MATERIALS["wood"]] * len(PARTS))
    looked_at = []

    def scores(*_):
        def score(candidates, first=None):
            if np.ptp([params.placement[0] for params in candidates]):  # where surfaces may stand is another question
                return np.zeros((len(candidates), 48))
            susceptibility = np.array([params.materials.log_susceptibility for params in candidates])
            if first:  # the first glance; a closer look follows
                looked_at.append(int(np.argmax(np.ptp(susceptibility, 0))))
            wanted = np.log(5.24 - 1 if looked_at[-1] == 2 else 4.0 - 1)  # concrete, or what is there
            return np.abs(susceptibility[:, looked_at[-1], None] - wanted) + np.zeros(first or 48)

        return score

    monkeypatch.setattr("wbgs_jax.training.calibration.objective.make_scores", scores)
    monkeypatch.setattr(search_module, "search_idealisations", lambda params, *_: (params, {}))
    run.run_hooks()
    count = len(PARTS)
    assert looked_at == [*range(count), 0, 1]


@pytest.mark.heavy
@pytest.mark.parametrize("natural", [(), ("thick",), ("curved", "thick")])
def test_it_finds_out_what_ray_tracers_leave_out(natural, run_on, tmp_path, rng):
    names = rng.choice(["concrete", "wood", "plasterboard", "glass"], len(PARTS))
    run = run_on([ITU_MATERIALS[name] for name in names], natural=natural)
    run.run_hooks()
    report = json.loads((tmp_path / "metrics.jsonl").read_text())["idealisations"]
    for name in ("curved", "thick"):
        assert report[name]["dropped"] == (name in natural) == float(getattr(run.state.params, name)), report


@pytest.mark.heavy
@pytest.mark.parametrize("steps, rounds", [(5, 3), (0, 0)])
def test_it_is_left_out_when_resumed_or_switched_off(steps, rounds, run_on, tmp_path):
    search = dataclasses.replace(SETTINGS.calibration, rounds=rounds)
    run = run_on([ITU_MATERIALS["wood"]] * len(PARTS), search)
    run.state = dataclasses.replace(run.state, step=jnp.asarray(steps))
    before = run.state
    run.run_hooks()
    assert run.state is before
    assert not (tmp_path / "metrics.jsonl").exists()


_thickness = jax.jit(
    jax.value_and_grad(lambda params, plan: jnp.sum(coherent.slabs_at(params, plan, jnp.float32(28e9)).thickness)), inline=True
)


@pytest.mark.heavy
def test_known_thickness_is_not_trained(run_on):
    """It belongs to the field, not to the parameters; what is learned where it is not known does not reach the slabs."""
    run = run_on([ITU_MATERIALS["wood"]] * len(PARTS))
    params = run.state.params
    places = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(params)]
    assert not any("known" in place for place in places)
    np.testing.assert_array_equal(run.field.known_thickness, np.full(len(PARTS), THICKNESS, np.float32))
    plan = run.field.plan(params, run.dataset.receiver(), prepared=run.prepared)
    facets = run.field.facets.offset.shape[0]
    total, slope = _thickness(params, plan)
    assert float(total) == pytest.approx(THICKNESS * facets, rel=1e-6)
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(slope))
    unknown = dataclasses.replace(plan, known_thickness=jnp.zeros(len(PARTS)))
    total, slope = _thickness(params, unknown)
    assert float(total) == pytest.approx(SETTINGS.field.thickness * facets, rel=1e-6)
    assert float(slope.materials.log_thickness.sum()) == pytest.approx(SETTINGS.field.thickness * facets, rel=1e-5)


@pytest.mark.slow
def test_known_thickness_stays_where_it_is_in_training(run_on):
    run = run_on([ITU_MATERIALS["wood"]] * len(PARTS))
    before = np.asarray(run.state.params.materials.log_thickness)
    run.epoch()
    np.testing.assert_array_equal(run.state.params.materials.log_thickness, before)
    np.testing.assert_array_equal(run.field.known_thickness, np.full(len(PARTS), THICKNESS, np.float32))
    assert (run.state.params.materials.log_conductivity != np.log(SETTINGS.field.conductivity)).any()


@pytest.mark.heavy
@pytest.mark.parametrize("rounds", [0, 3])
def test_of_powers_alone_the_unknown_gain_is_found(rounds, run_on, tmp_path, rng):
    """Nobody has said what was transmitted; what reflects well and what does not is told by powers."""
    search = dataclasses.replace(SETTINGS.calibration, rounds=rounds, antenna_rounds=1)
    run, offset = run_on([ITU_MATERIALS["concrete"]] * len(PARTS), search), float(rng.uniform(-90, 40))
    powers = received_power_db(run.data.snapshots) + offset
    run.data = dataclasses.replace(run.data, steering=None, observations={"power_db": powers})
    run.run_hooks()
    entry = json.loads((tmp_path / "metrics.jsonl").read_text())
    assert entry["gain_db"] == pytest.approx(offset, abs=2.5 if rounds else 10)  # wrong materials reflect more or less
    assert set(entry) == ({"step", "search", "gain_db"} if rounds else {"step", "gain_db"})
    assert not rounds or entry["search"]["after"] < entry["search"]["before"] - 0.15, entry


@pytest.mark.heavy
def test_the_level_of_single_elements_is_not_explained_by_antennas(run_on, tmp_path):
    """A cable of 20 dB before the only element."""
    search = dataclasses.replace(SETTINGS.calibration, rounds=0, antenna_rounds=1, position_std_spectra=16)
    run = run_on([ITU_MATERIALS["concrete"]] * len(PARTS), search)
    receivers = run.data.receivers
    first = dataclasses.replace(receivers, element_positions=receivers.element_positions[..., :1, :])
    own = dataclasses.replace(run.data, receivers=first, steering=run.data.steering[..., :1])
    run.data = own.with_observations(snapshots=0.1 * run.data.snapshots[..., :1])
    run.run_hooks()
    entry = json.loads((tmp_path / "metrics.jsonl").read_text())
    assert (
        entry["gain_db"] == pytest.approx(-20, abs=10) and not entry["antennas"]["taken"]
    )  # wrong materials reflect more or less


@pytest.mark.slow
@pytest.mark.parametrize("ordinary", [False, True])
def test_snapshots_in_a_unit_of_their_own_get_a_gain(ordinary, run_on, tmp_path, rng):
    """Measured voltages are not relative to what was transmitted; gradients alone cover less than 40 dB."""
    search = dataclasses.replace(SETTINGS.calibration, rounds=0, antenna_rounds=1, position_std_spectra=16)
    offset = 0.0 if ordinary else float(rng.choice([-1, 1]) * rng.uniform(60, 160))
    run = run_on([ITU_MATERIALS["concrete"]] * len(PARTS), search)
    silent = np.asarray(run.dataset.train)[:2]
    loud = (run.data.snapshots * 10 ** (offset / 20)).at[silent].set(0)
    run.data = run.data.with_observations(snapshots=loud)
    run.run_hooks()
    entry = json.loads((tmp_path / "metrics.jsonl").read_text())
    assert ("gain_db" in entry) is not ordinary
    assert ordinary or entry["gain_db"] == pytest.approx(offset, abs=10)  # wrong materials reflect more or less
    assert float(run.state.params.log_gain) == pytest.approx(entry.get("gain_db", 0.0) * np.log(10) / 20, abs=1e-5)
