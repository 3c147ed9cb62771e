"""The hybrid field: a mixture of three opinions of its two fields, whose shares are found on links that trained neither."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_dataset, tiny_settings

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.fields import get_field
from wbgs_jax.fields import mixture as noise
from wbgs_jax.fields.base import outputs_of, paths_of
from wbgs_jax.fields.hybrid import HybridField, Trust, _informed
from wbgs_jax.fields.mixture import (
    FEATURES,
    ExpertPredictions,
    Shares,
    coherent_alone,
    constant,
    reported,
    with_floor,
    without_floor,
)
from wbgs_jax.inference.predictor import observe_links
from wbgs_jax.inference.trained_field import RunConfig
from wbgs_jax.radio.array import snapshot_to_pas
from wbgs_jax.training import hooks
from wbgs_jax.training.hooks import Context, ExpertWeights, Seen, probe_of
from wbgs_jax.training.loop import Run, train
from wbgs_jax.training.run_folder import load_trained, prepare_folder

SETTINGS = tiny_settings(
    "hybrid", optim={"steps": 4}, density={"every": 2, "start": 2, "gradient_threshold": 0.0, "max_gaussians": 90}
)


@pytest.fixture(scope="module")
def dataset():
    return hold_out_validation(tiny_dataset(12))


@pytest.fixture(scope="module")
def run(dataset, tmp_path_factory):
    """Before its first step."""
    return Run(dataset, "hybrid", SETTINGS, 0, tmp_path_factory.mktemp("hybrid"))


def trusting(params, spectra, power):
    """Each given as the share of the coherent field over the splatting one's own opinion, and of both over the informed one."""
    trust = Trust(*(Shares(*map(constant, pair)) for pair in (spectra, power)), jnp.zeros(()))
    return dataclasses.replace(params, trust=trust)


def weighted(run, params, batches):
    """Parameters with the shares that some batches tell, and the report."""
    context = Context(run.data, run.prepared, run.dataset.train, validation=lambda: batches)
    edit = ExpertWeights().apply(run.field, params, (), context, 4, np.random.default_rng(0))
    return edit.params, edit.report


def expert_predictions(run, params, index):
    """What the coherent field says, the splatting one by itself, and the splatting one that sees the coherent one."""
    field, dataset = run.field, run.dataset
    wave = observe_links(field.wave, params.wave, dataset, index)
    plan, given = field.wideband.plan(params.wideband, dataset.receiver()), jnp.asarray(wave.pas)
    return wave, *(field.wideband.render(params.wideband, plan, dataset.query(index), g) for g in (0 * given, given))


def mixture(shares, one, other, third):
    first, both = np.clip(shares, 1e-3, 1 - 1e-3)
    return both * (first * one + (1 - first) * other) + (1 - both) * third


@pytest.mark.heavy
@pytest.mark.parametrize("shares", [((0.0, 0.4), (0.2, 0.0)), ((0.3, 0.6), (0.8, 1.0)), ((1.0, 1.0), (1.0, 0.5))])
def test_it_says_a_mixture_of_what_its_fields_say(run, shares):
    params, index = trusting(run.state.params, *shares), run.dataset.validation
    seen = observe_links(run.field, params, run.dataset, index)
    said = expert_predictions(run, params, index)
    # Roots of small powers, in single precision.
    np.testing.assert_allclose(seen.pas, mixture(shares[0], *(one.pas for one in said)), atol=3e-4)
    np.testing.assert_allclose(seen.power_db, mixture(shares[1], *(one.power_db for one in said)), atol=1e-2)
    np.testing.assert_allclose(seen.snapshots, said[0].snapshots, rtol=1e-4, atol=1e-7)  # two programs
    plan = run.field.plan(params, run.dataset.receiver())
    again = run.field.render(params, plan, run.dataset.query(index))
    np.testing.assert_allclose(again.pas, seen.pas, atol=2e-3)  # traced by another program, in single precision, at 94 GHz


@pytest.mark.heavy
@pytest.mark.parametrize("share", [0.0, 0.35, 1.0])
def test_the_shares_are_what_explains_other_links_best(run, share):
    """Of truths that are mixtures of the coherent and the own opinion, and of these and the informed one."""
    params, index = run.state.params, run.dataset.validation
    batch = run.data.batch(jnp.asarray(index), run.key)
    wave, own, informed = expert_predictions(run, params, index)
    truth = share * wave.pas + (1 - share) * own.pas
    power = share * wave.power_db + (1 - share) * informed.power_db
    batch = batch.with_observations(pas=jnp.asarray(truth), power_db=jnp.asarray(power))
    found, report = weighted(run, params, [batch])
    spectra, powers = found.trust.spectra, found.trust.power
    assert not any(np.any(one.weights) for one in (spectra.coherent, spectra.uninformed, powers.coherent))  # few transmitters
    assert float(jax.nn.sigmoid(spectra.coherent.bias)) == pytest.approx(share, abs=0.05)
    said = mixture(
        [float(jax.nn.sigmoid(one.bias)) for one in (spectra.coherent, spectra.uninformed)], wave.pas, own.pas, informed.pas
    )
    assert np.abs(said - truth).max() < 0.1 * np.abs(wave.pas - own.pas).max()
    learned = [float(jax.nn.sigmoid(one.bias)) for one in (powers.coherent, powers.uninformed)]
    said = mixture(learned, wave.power_db, own.power_db, informed.power_db)
    assert np.abs(said - power).mean() < 0.1 * np.abs(wave.power_db - informed.power_db).mean()
    assert sum(report["shares"]["spectra"][name] for name in ("coherent", "own", "informed")) == pytest.approx(1, abs=2e-3)
    assert report["shares"]["spectra"]["by_query"] is False


def test_without_other_links_the_coherent_field_is_used_alone(run):
    found, report = weighted(run, run.state.params, [])
    expected = Trust(coherent_alone(), coherent_alone(), jnp.zeros(()))
    jax.tree.map(np.testing.assert_array_equal, found.trust, expected)
    assert not report


@pytest.mark.heavy
def test_noise_does_not_speak_against_the_coherent_field_and_is_not_said(run, rng, monkeypatch):
    """The coherent field is right, the splatting one has learned what noise makes of that."""
    params, index = run.state.params, np.arange(len(run.dataset))
    batch = run.data.batch(jnp.asarray(index), run.key)
    seen = observe_links(run.field.wave, params.wave, run.dataset, index)

    def drawn():
        power = np.mean(np.abs(seen.snapshots) ** 2, -1, keepdims=True) / 20
        white = np.sqrt(power) * (rng.normal(size=seen.snapshots.shape) + 1j * rng.normal(size=seen.snapshots.shape))
        return snapshot_to_pas(jnp.asarray(seen.snapshots + white, jnp.complex64), batch.receiver.element_positions)

    own = jnp.mean(jnp.stack([drawn() for _ in range(10)]), 0)
    own = own / own.max((1, 2), keepdims=True)
    said = Seen(
        ExpertPredictions(seen.pas, own, own),
        ExpertPredictions(*3 * (seen.power_db,)),
        jnp.zeros((len(index), FEATURES)),
        drawn(),
        None,
    )

    def opinions_without_floor(field, given, *_):
        assert float(given.trust.floor) == 0  # or it would be found in what is left of it
        return said

    monkeypatch.setattr(hooks, "expert_predictions_of", opinions_without_floor)
    monkeypatch.setattr(noise, "FEWEST_TX", 5)
    found, report = weighted(run, params, [batch])
    assert report["noise_floor"] == pytest.approx(float(found.trust.floor))
    assert found.trust.floor > 1e-3
    assert float(run.field.as_observed(found, jnp.zeros((1, 90, 360))).min()) > 0.03
    again, _ = weighted(run, found, [batch])
    assert float(again.trust.floor) == float(found.trust.floor)
    monkeypatch.setattr(hooks, "floor_of", lambda *_: 0.0)
    without, _ = weighted(run, params, [batch])
    trusted, less = (report_of(p, said.features)["coherent"] for p in (found, without))
    assert trusted > less + 0.1  # the splatting one is as right here, but for the noise


def report_of(params, told):
    return reported(params.trust.spectra, np.asarray(told))


@pytest.mark.heavy
def test_its_answers_are_without_the_floor(run):
    """Of the splatting field's opinions; what arrives along paths has none."""
    params, index = trusting(run.state.params, (0.3, 0.6), (0.8, 1.0)), run.dataset.validation
    noisy = dataclasses.replace(params, trust=dataclasses.replace(params.trust, floor=jnp.asarray(0.02)))
    wave, *learned = expert_predictions(run, params, index)
    said = jnp.asarray(observe_links(run.field, noisy, run.dataset, index).pas)
    np.testing.assert_allclose(
        said, mixture((0.3, 0.6), wave.pas, *(without_floor(one.pas, 0.02) for one in learned)), atol=2e-3
    )
    np.testing.assert_allclose(run.field.as_observed(noisy, said), with_floor(said, 0.02), rtol=1e-6)


@pytest.mark.heavy
def test_of_what_was_not_observed_the_coherent_field_is_taken(run):
    batch = run.data.batch(jnp.asarray(run.dataset.validation), run.key)
    image = batch.with_observations(pas=batch.pas)
    trust = weighted(run, run.state.params, [image])[0].trust
    power = batch.with_observations(power_db=jnp.full(len(run.dataset.validation), -60.0))
    silent = batch.with_observations(pas=batch.pas, power_db=jnp.full(len(run.dataset.validation), -400.0))
    others = [weighted(run, run.state.params, [one])[0].trust for one in (power, silent)]
    for shares in (trust.power, others[0].spectra, others[1].power):
        assert min(float(jax.nn.sigmoid(one.bias)) for one in (shares.coherent, shares.uninformed)) > 0.99


@pytest.mark.heavy
def test_where_no_path_arrives_the_coherent_field_has_no_opinion(run):
    params, index = run.state.params, run.dataset.validation
    plan, query = run.field.plan(params, run.dataset.receiver()), run.dataset.query(index)
    coherent = run.field.wave.render(params.wave, plan.wave, query)
    silent = coherent._replace(power_db=coherent.power_db.at[0].set(-300.0), pas=coherent.pas.at[0].set(0))
    spectra, powers, _ = run.field._predicted(params, plan, query, silent)
    np.testing.assert_array_equal(powers.coherent[0], powers.own[0])
    np.testing.assert_array_equal(powers.coherent[1:], coherent.power_db[1:])
    np.testing.assert_array_equal(spectra.coherent[0], spectra.own[0])
    np.testing.assert_allclose(spectra.informed[0], spectra.own[0], atol=1e-6)
    np.testing.assert_array_equal(spectra.coherent[1:], coherent.pas[1:])


@pytest.mark.heavy
def test_its_loss_is_the_sum_and_the_coherent_field_knows_of_no_other(run):
    field, params = run.field, run.state.params
    batch = run.data.batch(jnp.asarray(run.dataset.train[:2]), run.key)
    keys = (dataclasses.replace(batch, key=key) for key in jax.random.split(run.key, 50))
    batch = next(own for own in keys if _informed(own).sum() == 1)  # one link with, one without
    seen = observe_links(field.wave, params.wave, run.dataset, run.dataset.train[:2]).pas
    given = jnp.where(_informed(batch), jnp.asarray(seen), 0)

    def both(params):
        return field.loss(params, run.prepared, batch, run.capacity, probe_of(run.hooks, params))[0]

    def one_by_one(params):
        coherent, _ = field.wave.loss(params.wave, run.prepared, batch)
        return coherent + field.wideband.loss(params.wideband, None, batch, run.capacity, probe_of(run.hooks, params), given)[0]

    (loss, gradient), (expected, other) = (jax.jit(jax.value_and_grad(f))(params) for f in (both, one_by_one))
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)
    for (path, leaf), wanted in zip(jax.tree_util.tree_leaves_with_path(gradient), jax.tree.leaves(other), strict=True):
        rounding = 1e-7 + 1e-4 * float(jnp.abs(wanted).max())  # turns of spheres are nothing but rounding
        np.testing.assert_allclose(leaf, wanted, rtol=1e-2, atol=rounding, err_msg=jax.tree_util.keystr(path))


@pytest.mark.heavy
def test_the_splatting_field_sees_the_coherent_one_in_half_of_the_training_links(run):
    keys = jax.random.split(jax.random.key(0), 400)
    batch = run.data.batch(jnp.asarray(run.dataset.train[:2]), run.key)
    told = np.array([_informed(dataclasses.replace(batch, key=key)) for key in keys])
    assert told.shape == (400, 2, 1, 1) and abs(told.mean() - 0.5) < 0.1
    assert 0.3 < (told[:, 0] != told[:, 1]).mean() < 0.7  # each by itself
    halves = [dataclasses.replace(batch, links=jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], batch.links)) for i in range(2)]
    np.testing.assert_array_equal(np.concatenate([_informed(half) for half in halves]), _informed(batch))  # on two devices


@pytest.mark.heavy
def test_the_splatting_field_answers_to_the_coherent_one(run):
    field, params, index = run.field, run.state.params, run.dataset.validation[:2]
    plan, query = field.wideband.plan(params.wideband, run.dataset.receiver()), run.dataset.query(index)
    dark, bright = (
        field.wideband.render(params.wideband, plan, query, jnp.full((2, 90, 360), level)).pas for level in (0.0, 1.0)
    )
    assert float(jnp.abs(dark - bright).max()) > 1e-3


def test_elsewhere_it_is_the_coherent_field(run):
    field, params = run.field.receiver_independent(run.state.params)
    assert field.name == "wave" and params is run.state.params.wave


@pytest.mark.heavy
def test_without_a_mesh_it_is_the_splatting_field(tmp_path):
    nothing = np.zeros((0, 3), np.int32)
    dataset = dataclasses.replace(tiny_dataset(12), faces=nothing, materials=None, face_part=None)
    with pytest.warns(UserWarning, match="uses its wideband component only: box has no mesh(, only points)?$"):
        result = train(hold_out_validation(dataset), "hybrid", SETTINGS, 0, tmp_path)
    assert result.field.wave is None and set(outputs_of(result.field)) == {"pas", "power"}
    seen = observe_links(result.field, result.params, dataset, dataset.test)
    alone = observe_links(result.field.wideband, result.params.wideband, dataset, dataset.test)
    np.testing.assert_allclose(seen.pas, alone.pas, atol=1e-6)
    plan = result.field.plan(result.params, dataset.receiver())
    with pytest.raises(UserError, match="no paths"):
        paths_of(result.field, result.params, plan, dataset.query(dataset.test))
    with pytest.raises(UserError, match="predicts only the receivers"):
        result.field.receiver_independent(result.params)


@pytest.mark.heavy
def test_it_trains_grows_and_comes_back_as_it_was(dataset, tmp_path):
    """Its hooks act on their parts, and a run that stopped half way ends where one goes that did not."""
    config = RunConfig("box", "hybrid", "smoke", 0, None, SETTINGS)
    prepare_folder(tmp_path / "run", config, resume=False)
    result = train(dataset, "hybrid", SETTINGS, 0, tmp_path / "run")
    assert result.sizes["gaussians"] > SETTINGS.field.wideband.gaussians and result.sizes["facets"] > 0
    again = load_trained(tmp_path / "run")
    for a, b in zip(jax.tree.leaves((result.field, result.params)), jax.tree.leaves((again.field, again.params)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.isfinite(float(again.params.trust.spectra.coherent.bias))
    resumed = Run(dataset, "hybrid", SETTINGS, 0, tmp_path / "run")
    assert resumed.restore() and resumed.step == SETTINGS.optim.steps


def test_the_presets_have_both_fields_settings():
    wave, wideband = get_field("wave").presets, get_field("wideband").presets
    for name, settings in HybridField.presets.items():
        assert (settings.field.wave, settings.field.wideband) == (wave[name].field, wideband[name].field)
        assert settings.calibration == wave[name].calibration and settings.density == wideband[name].density
    phase_blind = dataclasses.replace(settings.field.wave, coherent=False)
    with pytest.raises(UserError, match="no coherent field to mix"):
        dataclasses.replace(settings.field, wave=phase_blind).check("hybrid")


@pytest.mark.heavy
def test_of_several_receivers_both_fields_answer_for_each(tmp_path):
    """One set of materials, one share: what is said at a receiver is what both fields say there."""
    dataset = hold_out_validation(tiny_dataset(12, n_rx=3))
    result = train(dataset, "hybrid", SETTINGS, 0, tmp_path)
    field, params = result.field, result.params
    trust = params.trust
    shares = [[float(jax.nn.sigmoid(one.bias)) for one in (of.coherent, of.uninformed)] for of in (trust.spectra, trust.power)]
    assert not any(np.any(one.weights) for of in (trust.spectra, trust.power) for one in (of.coherent, of.uninformed))
    seen = observe_links(field, params, dataset, dataset.test)
    for number in range(3):
        own = dataset.test[dataset.receiver_index[dataset.test] == number]
        query, receiver = dataset.query(own), dataset.receiver(number)
        wave = jax.jit(type(field.wave).render)(field.wave, params.wave, field.wave.plan(params.wave, receiver), query)
        plan = field.wideband.plan(params.wideband, receiver)
        splatted = [field.wideband.render(params.wideband, plan, query, given) for given in (0 * wave.pas, wave.pas)]
        place = np.flatnonzero(dataset.receiver_index[dataset.test] == number)
        np.testing.assert_allclose(seen.pas[place], mixture(shares[0], *(one.pas for one in (wave, *splatted))), atol=2e-3)
        power = mixture(shares[1], *(one.power_db for one in (wave, *splatted)))
        np.testing.assert_allclose(seen.power_db[place], power, atol=0.05)
