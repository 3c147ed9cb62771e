"""Links that nobody measured: where they are, what they hold, and who is trained with them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_dataset, tiny_settings
from builders.toys import toy_settings

from wbgs_jax.config import limit_steps
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import get_field
from wbgs_jax.radio.channel import NO_PATH_DB
from wbgs_jax.training import batches as module
from wbgs_jax.training.batches import (
    BESIDE,
    BEYOND,
    data_with_virtual,
    kriging_weights,
    training_data,
    virtual_links,
    with_virtual_drawn,
)
from wbgs_jax.training.loop import Run, train

pytestmark = pytest.mark.usefixtures("ripple")


def test_kriging_weights_follow_from_the_equations(rng):
    places = rng.normal(size=(9, 3))
    weights = kriging_weights(places, places[4], 2.0, 1e-9)
    np.testing.assert_allclose(weights, np.eye(9)[4], atol=1e-6)
    n, place = 9, rng.normal(size=3)
    system = np.ones((n + 1, n + 1))
    system[:n, :n] = np.exp(-np.linalg.norm(places[:, None] - places[None], axis=-1) / 2.0) + 0.1 * np.eye(n)
    system[n, n] = 0
    expected = np.linalg.solve(system, np.append(np.exp(-np.linalg.norm(places - place, axis=1) / 2.0), 1))[:n]
    np.testing.assert_allclose(kriging_weights(places, place, 2.0, 0.1), expected, atol=1e-9)


def test_they_lie_around_the_known_ones_and_hold_mixtures_of_theirs():
    dataset = tiny_dataset(9, kind="pas")
    found = virtual_links(dataset, 0)
    places = dataset.tx_positions[dataset.train]
    reach = (BEYOND + 5 * BESIDE) * np.linalg.norm(np.ptp(places, axis=0))
    assert len(found.images) == 4 * len(dataset.train)
    assert (found.tx_position > places.min(0) - reach).all() and (found.tx_position < places.max(0) + reach).all()
    assert set(found.frequency_hz) <= set(dataset.frequencies_hz[dataset.train])
    again, other = virtual_links(dataset, 0), virtual_links(dataset, 1)
    np.testing.assert_array_equal(found.images, again.images)
    assert (found.tx_position != other.tx_position).any()
    poisoned = dataset.observations["pas"].copy()
    poisoned[dataset.test] = 255
    np.testing.assert_array_equal(virtual_links(dataset.with_observations(pas=poisoned), 0).images, found.images)


def test_a_spectrum_without_another_at_its_frequency_is_not_repeated_elsewhere():
    dataset = tiny_dataset(9, kind="pas")
    links = len(dataset.frequencies_hz)
    apart = dataclasses.replace(dataset, frequencies_hz=1e9 + 1e8 * np.arange(links))
    assert virtual_links(apart, 0) is None
    pair = dataset.train[np.unique(dataset.tx_index[dataset.train], return_index=True)[1][:2]]
    frequency = apart.frequencies_hz.copy()
    frequency[pair] = 5e9
    found = virtual_links(dataclasses.replace(apart, frequencies_hz=frequency), 0)
    assert set(found.frequency_hz) == {5e9}


def test_who_has_none(monkeypatch):
    dataset = tiny_dataset(9)
    assert virtual_links(tiny_dataset(9, kind="power"), 0) is None
    one = dataset.train[dataset.tx_index[dataset.train] == dataset.tx_index[dataset.train[0]]]
    assert virtual_links(dataclasses.replace(dataset, train=one), 0) is None
    _, (none,) = data_with_virtual(dataset, get_field("hybrid"), 0)  # it follows paths through the mesh
    assert len(none) == 0 and len(data_with_virtual(dataset, get_field("wideband"), None)[1][0]) == 0
    without_mesh = dataclasses.replace(dataset, faces=dataset.faces[:0], face_part=None, materials=None)
    assert len(data_with_virtual(without_mesh, get_field("hybrid"), 0)[1][0]) > 0
    monkeypatch.setattr(module, "FEW", len(dataset.train))
    assert virtual_links(dataset, 0) is None


@pytest.mark.parametrize("kind", ["pas", "snapshot"])
def test_training_data_hold_both(kind):
    dataset = tiny_dataset(9, kind=kind)
    data, (virtual,) = data_with_virtual(dataset, get_field("wideband"), 0)
    plain, index = training_data(dataset), jnp.arange(len(dataset))
    np.testing.assert_allclose(data.pas(index), plain.pas(index), atol=2.1e-3)
    assert len(set(np.asarray(data.links.tx_index)[virtual]) & set(np.asarray(plain.links.tx_index))) == 0
    batch = data.batch(jnp.asarray(virtual[:3]), jax.random.key(0))
    assert batch.pas.shape == (3, 90, 360) and batch.pas.max() > 0.2
    assert batch.received_db is None or (batch.received_db <= NO_PATH_DB).all()


def test_half_of_a_batch_is_virtual_and_of_the_same_receiver(rng):
    dataset = tiny_dataset(9, n_rx=2)
    data, virtual = data_with_virtual(dataset, get_field("wideband"), 0)
    receiver = np.asarray(data.links.receiver_index)
    for number, own in enumerate(virtual):
        drawn = np.flatnonzero(dataset.receiver_index == number)[:4]
        batch = with_virtual_drawn(drawn, own, 0.5, rng)
        assert (batch >= len(dataset)).sum() == 2 and set(receiver[batch]) == {number}
    np.testing.assert_array_equal(with_virtual_drawn(np.array([2, 3]), np.zeros(0, int), 0.5, rng), [2, 3])


def test_a_run_draws_them_and_counts_observed_spectra_only(tmp_path):
    dataset = tiny_dataset(9)
    settings = toy_settings(optim={"batch": 4, "virtual": 0.5})
    run = Run(dataset, "ripple", settings, 0, tmp_path)
    batches = run.batches(0, 6)
    assert ((batches >= len(run.dataset)).sum(1) == 2).all() and batches.max() < len(run.data.links.tx_index)
    result = train(dataset, "ripple", settings, 0, tmp_path / "run")
    assert result.steps == settings.optim.steps


def test_few_spectra_get_fewer_steps_and_gaussians():
    settings = get_field("wideband").presets["cpu"]
    steps = [limit_steps(settings, n, no_paths=True).optim.steps for n in (10, 60, 125, 1000)]
    assert steps == [600, 600, 1000, 2000] and limit_steps(settings, 10).optim.steps == 1000
    dataset, tiny = tiny_dataset(9), tiny_settings()
    config = dataclasses.replace(tiny.field, gaussians=2000)
    field = get_field("wideband").build(config, DatasetScene(dataset), 0)
    assert len(field.surface.points) == 500
    assert len(get_field("wideband").build(tiny.field, DatasetScene(dataset), 0).surface.points) == tiny.field.gaussians
