"""WRF-GS: the wideband field that cannot tell frequencies apart, trained and tested at one of them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import tiny_dataset, tiny_settings

from wbgs_jax.config import WidebandConfig, check, preset_settings, without_frequency
from wbgs_jax.data.splits import select_frequencies
from wbgs_jax.data.surface import make_surface
from wbgs_jax._util.errors import UserError
from wbgs_jax.fields import Field, get_field, wideband, wrfgs
from wbgs_jax.inference.predictor import predict_spectra
from wbgs_jax.training.loop import train
from wbgs_jax.types import Query

BLIND = {"attenuation_frequency": False, "radiance_frequency": False}
SETTINGS = tiny_settings(
    wrfgs=vars(tiny_settings().wideband) | BLIND, optim={"steps": 40, "network_lr": 1e-2}, loop={"evaluate_every": 40}
)

pytestmark = pytest.mark.usefixtures("compile_once")


@pytest.fixture(scope="module")
def dataset():
    """Trained and tested at the same frequency."""
    return select_frequencies(tiny_dataset(12), [10.0], [10.0])


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory):
    return train(dataset, "wrfgs", SETTINGS, 0, tmp_path_factory.mktemp("run")).params


def test_it_is_a_field_with_its_own_settings():
    assert isinstance(get_field("wrfgs"), Field)
    for preset in ("smoke", "cpu", "gpu"):
        settings = preset_settings(preset, "wrfgs")
        assert settings.wrfgs == without_frequency(settings.wideband)


def test_rendering_is_bit_identical_across_frequency(rng, trained):
    tx = jnp.asarray(rng.uniform([-2, -1, 0.5], [2, 2, 2.5], (3, 3)), jnp.float32)
    plan, render = wrfgs.plan(trained, tiny_dataset().receiver), jax.jit(wrfgs.render)
    low, high = (np.asarray(render(trained, plan, Query(tx, jnp.full(3, f, jnp.float32)))) for f in (1e9, 94e9))
    assert low.max() > 0.01
    np.testing.assert_array_equal(low, high)


def test_no_configuration_lets_the_frequency_in(trained):
    aware = tiny_settings().wideband
    assert aware.attenuation_frequency and aware.radiance_frequency
    shapes = wrfgs.skeleton(aware, {"gaussians": 64})
    assert jax.tree.structure(shapes) == jax.tree.structure(wrfgs.skeleton(without_frequency(aware), {"gaussians": 64}))
    assert jax.tree.structure(shapes) != jax.tree.structure(wideband.skeleton(aware, {"gaussians": 64}))
    assert [leaf.shape for leaf in jax.tree.leaves(shapes)] == [leaf.shape for leaf in jax.tree.leaves(trained)]
    with pytest.raises(UserError, match="--field wideband"):
        check(dataclasses.replace(SETTINGS, wrfgs=WidebandConfig()))


def test_one_model_a_frequency_learns_it_and_is_asked_about_other_transmitters(dataset, trained):
    for index in (dataset.train, dataset.test):
        np.testing.assert_array_equal(dataset.frequencies_hz[index], 10e9)
    assert not set(dataset.tx_index[dataset.train]) & set(dataset.tx_index[dataset.test])
    surface = make_surface(dataset, SETTINGS.wrfgs.gaussians, 0)
    untrained = wrfgs.init(jax.random.key(0), surface, SETTINGS.wrfgs, 64)
    truth = dataset.pas(dataset.train)
    before, after = (np.abs(predict_spectra(wrfgs, p, dataset, dataset.train) - truth).mean() for p in (untrained, trained))
    assert after < 0.9 * before
