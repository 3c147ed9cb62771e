"""The hybrid field: a mixture of its two fields, whose share is found on links that trained neither."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import tiny_dataset, tiny_settings

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.splits import hold_out_validation
from wbgs_jax.fields import get_field
from wbgs_jax.fields.hybrid import HybridField, Trust
from wbgs_jax.fields.trust import constant
from wbgs_jax.inference.predictor import observe_links
from wbgs_jax.training.loop import Run, train
from wbgs_jax.training.run_folder import RunConfig, load_trained, prepare_folder

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
    return dataclasses.replace(params, trust=Trust(constant(spectra), constant(power)))


def parts(run, params, index):
    """What the coherent field says, and the splatting one that sees it."""
    field, dataset = run.field, run.dataset
    wave = observe_links(field.wave, params.wave, dataset, index)
    plan = field.wideband.plan(params.wideband, dataset.receiver())
    return wave, field.wideband.render(params.wideband, plan, dataset.query(index), jnp.asarray(wave.pas))


@pytest.mark.heavy
@pytest.mark.parametrize("shares", [(0.0, 0.0), (0.3, 0.8), (1.0, 1.0)])
def test_it_says_a_mixture_of_what_its_fields_say(run, shares):
    params, index = trusting(run.state.params, *shares), run.dataset.validation
    seen = observe_links(run.field, params, run.dataset, index)
    wave, wideband = parts(run, params, index)
    spectra, power = np.clip(shares, 1e-3, 1 - 1e-3)
    # Roots of small powers, in single precision.
    np.testing.assert_allclose(seen.pas, spectra * wave.pas + (1 - spectra) * wideband.pas, atol=3e-4)
    np.testing.assert_allclose(seen.power_db, power * wave.power_db + (1 - power) * wideband.power_db, atol=1e-2)
    np.testing.assert_allclose(seen.snapshots, wave.snapshots, rtol=1e-4, atol=1e-7)  # two programs
    plan = run.field.plan(params, run.dataset.receiver())
    again = run.field.render(params, plan, run.dataset.query(index))
    np.testing.assert_allclose(again.pas, seen.pas, atol=2e-3)  # traced by another program, in single precision, at 94 GHz


@pytest.mark.heavy
@pytest.mark.parametrize("share", [0.0, 0.35, 1.0])
def test_the_share_is_what_explains_other_links_best(run, share):
    params, index = run.state.params, run.dataset.validation
    batch = run.data.batch(jnp.asarray(index), run.key)
    wave, wideband = parts(run, params, index)
    truth = share * wave.pas + (1 - share) * wideband.pas
    power = (1 - share) * wave.power_db + share * wideband.power_db  # that of the power is another one
    batch = dataclasses.replace(batch, pas=jnp.asarray(truth), snapshots=None, power_db=jnp.asarray(power))
    found, report = run.field.calibrate(params, run.cache, [batch])
    assert not np.any(found.trust.spectra.weights) and not np.any(found.trust.power.weights)  # of few transmitters
    assert float(jax.nn.sigmoid(found.trust.spectra.bias)) == pytest.approx(share, abs=0.05)
    assert float(jax.nn.sigmoid(found.trust.power.bias)) == pytest.approx(1 - share, abs=0.05)
    assert report["coherent_share"]["spectra"] == {"mean": pytest.approx(share, abs=0.05), "by_query": False}


@pytest.mark.heavy
def test_its_loss_is_the_sum_and_the_coherent_field_knows_of_no_other(run):
    field, params = run.field, run.state.params
    batch = run.data.batch(jnp.asarray(run.dataset.train[:2]), run.key)
    given = jnp.asarray(observe_links(field.wave, params.wave, run.dataset, run.dataset.train[:2]).pas)

    def both(params):
        return field.loss(params, run.cache, batch, run.limits, field.probe(params))[0]

    def one_by_one(params):
        coherent, _ = field.wave.loss(params.wave, run.cache, batch)
        return coherent + field.wideband.loss(params.wideband, None, batch, run.limits, field.probe(params), given)[0]

    (loss, gradient), (expected, other) = (jax.jit(jax.value_and_grad(f))(params) for f in (both, one_by_one))
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)
    for (path, leaf), wanted in zip(jax.tree_util.tree_leaves_with_path(gradient), jax.tree.leaves(other), strict=True):
        rounding = 1e-7 + 1e-4 * float(jnp.abs(wanted).max())  # turns of spheres are nothing but rounding
        np.testing.assert_allclose(leaf, wanted, rtol=1e-2, atol=rounding, err_msg=jax.tree_util.keystr(path))


@pytest.mark.heavy
def test_the_splatting_field_answers_to_the_coherent_one(run):
    field, params, index = run.field, run.state.params, run.dataset.validation[:2]
    plan, query = field.wideband.plan(params.wideband, run.dataset.receiver()), run.dataset.query(index)
    dark, bright = (
        field.wideband.render(params.wideband, plan, query, jnp.full((2, 90, 360), level)).pas for level in (0.0, 1.0)
    )
    assert float(jnp.abs(dark - bright).max()) > 1e-3


def test_elsewhere_it_is_the_coherent_field(run):
    field, params = run.field.anywhere(run.state.params)
    assert field.name == "wave" and params is run.state.params.wave


@pytest.mark.heavy
def test_without_a_mesh_it_is_the_splatting_field(tmp_path):
    nothing = np.zeros((0, 3), np.int32)
    dataset = dataclasses.replace(tiny_dataset(12), faces=nothing, materials=None, face_part=None)
    result = train(hold_out_validation(dataset), "hybrid", SETTINGS, 0, tmp_path)
    assert result.field.wave is None and set(result.field.known()) == {"pas", "power"}
    seen = observe_links(result.field, result.params, dataset, dataset.test)
    alone = observe_links(result.field.wideband, result.params.wideband, dataset, dataset.test)
    np.testing.assert_allclose(seen.pas, alone.pas, atol=1e-6)
    plan = result.field.plan(result.params, dataset.receiver())
    with pytest.raises(UserError, match="no paths"):
        result.field.arrivals(result.params, plan, dataset.query(dataset.test))
    with pytest.raises(UserError, match="no receivers but those"):
        result.field.anywhere(result.params)


@pytest.mark.heavy
def test_it_trains_grows_and_comes_back_as_it_was(dataset, tmp_path):
    """Its host controls act on their parts, and a run that stopped half way ends where one goes that did not."""
    config = RunConfig("box", "hybrid", "smoke", 0, None, SETTINGS)
    prepare_folder(tmp_path / "run", config, resume=False)
    result = train(dataset, "hybrid", SETTINGS, 0, tmp_path / "run")
    assert result.sizes["gaussians"] > SETTINGS.field.wideband.gaussians and result.sizes["facets"] > 0
    again = load_trained(tmp_path / "run")
    for a, b in zip(jax.tree.leaves((result.field, result.params)), jax.tree.leaves((again.field, again.params)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.isfinite(float(again.params.trust.spectra.bias))
    resumed = Run(dataset, "hybrid", SETTINGS, 0, tmp_path / "run")
    assert resumed.restore() and resumed.step == SETTINGS.optim.steps


def test_the_presets_have_both_fields_settings():
    wave, wideband = get_field("wave").presets, get_field("wideband").presets
    for name, settings in HybridField.presets.items():
        assert (settings.field.wave, settings.field.wideband) == (wave[name].field, wideband[name].field)
        assert settings.search == wave[name].search and settings.density == wideband[name].density
    phase_blind = dataclasses.replace(settings.field.wave, coherent=False)
    with pytest.raises(UserError, match="nothing to mix"):
        HybridField.check(dataclasses.replace(settings.field, wave=phase_blind))


@pytest.mark.heavy
def test_of_several_receivers_both_fields_answer_for_each(tmp_path):
    """One set of materials, one share: what is said at a receiver is what both fields say there."""
    dataset = hold_out_validation(tiny_dataset(12, n_rx=3))
    result = train(dataset, "hybrid", SETTINGS, 0, tmp_path)
    field, params = result.field, result.params
    trust = [jax.nn.sigmoid(share.bias) for share in (params.trust.spectra, params.trust.power)]
    assert not np.any(params.trust.spectra.weights) and not np.any(params.trust.power.weights)
    seen = observe_links(field, params, dataset, dataset.test)
    for number in range(3):
        own = dataset.test[dataset.receiver_index[dataset.test] == number]
        wave, wideband = (
            jax.jit(type(one).render)(one, of, one.plan(of, dataset.receiver(number)), dataset.query(own))
            for one, of in ((field.wave, params.wave), (field.wideband, params.wideband))
        )
        place = np.flatnonzero(dataset.receiver_index[dataset.test] == number)
        np.testing.assert_allclose(seen.pas[place], trust[0] * wave.pas + (1 - trust[0]) * wideband.pas, atol=2e-3)
        power = trust[1] * wave.power_db + (1 - trust[1]) * wideband.power_db
        np.testing.assert_allclose(seen.power_db[place], power, atol=0.05)
