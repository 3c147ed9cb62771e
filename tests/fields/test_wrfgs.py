"""WRF-GS: the wideband field that cannot tell frequencies apart, trained and tested at one of them."""

import dataclasses

import jax
import numpy as np
import pytest
from builders.synthetic import FIELDS, tiny_dataset, tiny_settings

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import select_frequencies
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import Field, get_field
from wbgs_jax.fields.wideband import WidebandField
from wbgs_jax.fields.wrfgs import WrfgsConfig, WrfgsField, without_frequency
from wbgs_jax.inference.predictor import predict_spectra
from wbgs_jax.training.loop import train

SETTINGS = tiny_settings(
    "wrfgs",
    field={"network_lr": 1e-2},
    optim={"steps": 80},
    loop={"epoch_steps": 20, "checkpoint_every": 80, "evaluate_spectra": 0},
)


@pytest.fixture(scope="module")
def dataset():
    """Trained and tested at the same frequency."""
    return select_frequencies(tiny_dataset(12), [10.0], [10.0])


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory):
    return train(dataset, "wrfgs", SETTINGS, 0, tmp_path_factory.mktemp("run"))


def test_it_is_a_field_with_its_own_settings():
    assert issubclass(get_field("wrfgs"), Field)
    for preset in ("smoke", "cpu", "gpu"):
        ours, theirs = (kind.presets[preset].field for kind in (WrfgsField, WidebandField))
        assert dataclasses.asdict(ours) == dataclasses.asdict(without_frequency(theirs))


@pytest.mark.heavy
def test_rendering_is_bit_identical_across_frequency(trained):
    """Of every transmitter at all three frequencies."""
    dataset = tiny_dataset(12)
    spectra = predict_spectra(trained.field, trained.params, dataset, np.arange(18))
    assert len(set(dataset.frequencies_hz[:3])) == 3 and len(set(dataset.tx_index[:18])) == 6
    spectra = spectra.reshape(6, 3, 90, 360)
    assert spectra.max() > 0.01 and spectra.std(0).max() > 1e-3
    np.testing.assert_array_equal(spectra, spectra[:, :1].repeat(3, 1))


@pytest.mark.heavy
def test_no_configuration_lets_the_frequency_in(dataset, trained):
    aware, scene = FIELDS["wideband"], DatasetScene(dataset)
    assert aware.attenuation_frequency and aware.radiance_frequency

    def shapes(kind, config):
        return jax.eval_shape(kind.build(config, scene, 0).init, jax.random.key(0))

    blind = shapes(WrfgsField, aware)
    assert jax.tree.structure(blind) == jax.tree.structure(shapes(WrfgsField, without_frequency(aware)))
    assert jax.tree.structure(blind) != jax.tree.structure(shapes(WidebandField, aware))
    assert [leaf.shape for leaf in jax.tree.leaves(blind)] == [leaf.shape for leaf in jax.tree.leaves(trained.params)]
    with pytest.raises(UserError, match="--field wideband"):
        WrfgsConfig().check("wrfgs")


@pytest.mark.heavy
def test_one_model_a_frequency_learns_it_and_is_asked_about_other_transmitters(dataset, trained):
    for index in (dataset.train, dataset.test):
        np.testing.assert_array_equal(dataset.frequencies_hz[index], 10e9)
    assert not set(dataset.tx_index[dataset.train]) & set(dataset.tx_index[dataset.test])
    field, truth = trained.field, dataset.pas(dataset.train)
    both = (field.init(jax.random.key(0)), trained.params)
    before, after = (np.abs(predict_spectra(field, p, dataset, dataset.train) - truth).mean() for p in both)
    assert after < 0.9 * before
