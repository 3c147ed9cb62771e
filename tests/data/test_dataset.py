"""A data set: links, receivers, and spectra of whatever was observed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import FIXED_ARRAY_HZ, FREQUENCIES_HZ, RECEIVERS, tiny_dataset

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import select_receivers
from wbgs_jax.radio.array import SPEED_OF_LIGHT, pas_directions, planar_array, snapshot_to_pas
from wbgs_jax.radio.geometry import to_local
from wbgs_jax.types import Batch, Query, make_receiver, stack_receivers

KINDS = ("snapshot", "pas", "power")


@pytest.fixture(scope="module")
def data():
    """Data sets of three receivers, by kind and unit."""
    return {(kind, unit): tiny_dataset(n_rx=3, kind=kind, unit=unit) for kind in KINDS for unit in ("wavelengths", "metres")}


def test_kinds(data):
    for (kind, _), dataset in data.items():
        assert (len(dataset), dataset.n_receivers) == (6 * 3 * 3, 3)
        assert (dataset.has_spectra, dataset.has_scale) == (kind != "power", kind != "pas")
        assert [dataset.has(name) for name in ("snapshots", "pas", "power_db")] == [kind == one for one in KINDS]


def test_one_receiver_of_several(data):
    dataset = data["snapshot", "metres"]
    for i, position in enumerate(RECEIVERS):
        receiver = dataset.receiver(i)
        np.testing.assert_array_equal(receiver.position, np.float32(position))
        assert receiver.element_positions.shape == (16, 3) and receiver.pattern_exponents.shape == (2,)
        assert receiver.unit == "metres"
    for absent in (3, -1):
        with pytest.raises(UserError, match=f"box has no receiver {absent}; choose 0 to 2"):
            dataset.receiver(absent)


def test_links_are_arrays_of_the_device(data):
    dataset, index = data["snapshot", "wavelengths"], np.array([0, 4, 53])
    links = dataset.links(index)
    np.testing.assert_array_equal(links.tx_position, np.float32(dataset.tx_positions[index]))
    np.testing.assert_array_equal(links.frequency_hz, np.float32(dataset.frequencies_hz[index]))
    assert (links.receiver_index.tolist(), links.tx_index.tolist()) == ([0, 1, 2], [0, 0, 5])
    assert links.receiver_index.dtype == links.tx_index.dtype == jnp.int32
    assert isinstance(links, Query) and jax.tree.structure(links) != jax.tree.structure(dataset.query(index))


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_of_one_receiver(data, kind):
    dataset = data[kind, "metres"]
    index = dataset.train[dataset.receiver_index[dataset.train] == 1][:5]
    batch = Batch(
        links=dataset.links(index),
        receiver=dataset.receiver(1),
        observations={name: jnp.asarray(values[index]) for name, values in dataset.observations.items()}
        | ({"pas": dataset.pas(index)} if dataset.has_spectra else {}),
        key=jax.random.key(0),
    )
    assert (np.asarray(batch.links.receiver_index) == 1).all()


def test_spectra_of_one_receiver_are_those_of_its_array():
    dataset, index = tiny_dataset(), np.array([3, 0, 17])
    expected = snapshot_to_pas(jnp.asarray(dataset.snapshots[index]), dataset.receiver().element_positions)
    np.testing.assert_array_equal(dataset.pas(index), expected)


def test_every_link_has_the_array_of_its_receiver(data):
    dataset = data["snapshot", "wavelengths"]
    arrays = [planar_array(), planar_array(2, 8), planar_array(spacing=0.4)]
    receivers = stack_receivers([make_receiver(p, element_positions=e) for p, e in zip(RECEIVERS, arrays, strict=True)])
    mixed, index = dataclasses.replace(dataset, receivers=receivers), np.arange(20)
    found = np.asarray(mixed.pas(index))
    for i, elements in enumerate(arrays):
        own = mixed.receiver_index[index] == i
        expected = snapshot_to_pas(jnp.asarray(dataset.snapshots[index][own]), jnp.asarray(elements, jnp.float32))
        np.testing.assert_array_equal(found[own], expected)
        np.testing.assert_allclose(select_receivers(mixed, [i]).pas(np.arange(3)), found[own][:3], atol=1e-6)
    assert np.abs(found - np.asarray(dataset.pas(index))).max() > 0.1


def test_an_array_of_fixed_size_grows_with_the_frequency(data):
    metres, wavelengths = data["snapshot", "metres"], data["snapshot", "wavelengths"]
    index = np.arange(len(metres))
    fixed, scaling = np.asarray(metres.pas(index)), np.asarray(wavelengths.pas(index))
    equal = metres.frequencies_hz == FIXED_ARRAY_HZ
    assert equal.any() and not equal.all()
    np.testing.assert_allclose(fixed[equal], scaling[equal], atol=2e-5)
    assert np.abs(fixed[~equal] - scaling[~equal]).max((1, 2)).min() > 0.1
    for frequency in FREQUENCIES_HZ:  # as positions in wavelengths, at one frequency at a time
        own = np.flatnonzero(metres.frequencies_hz == frequency)
        elements = metres.receiver(0).element_positions * np.float32(frequency / SPEED_OF_LIGHT)
        expected = snapshot_to_pas(jnp.asarray(metres.snapshots[own]), elements)
        np.testing.assert_allclose(fixed[own], expected, atol=1e-5 * max(1, frequency / FIXED_ARRAY_HZ))


@pytest.mark.parametrize("unit", ["wavelengths", "metres"])
def test_the_brightest_direction_is_that_of_the_transmitter(data, unit):
    """Also for turned receivers: the line of sight is the stronger of the two paths."""
    dataset, angles = data["snapshot", unit], []
    for i in range(3):
        receiver = dataset.receiver(i)
        index = np.flatnonzero((dataset.frequencies_hz == FIXED_ARRAY_HZ) & (dataset.receiver_index == i))
        brightest = pas_directions().reshape(-1, 3)[np.asarray(dataset.pas(index)).reshape(len(index), -1).argmax(-1)]
        local = to_local(dataset.query(index).tx_position - receiver.position, receiver.orientation)
        local = np.asarray(local / jnp.linalg.norm(local, axis=-1, keepdims=True))
        both = np.stack([brightest, brightest * [-1, 1, 1]])  # an array in the y-z plane cannot tell front from back
        angle = np.degrees(np.arccos(np.clip((both * local).sum(-1), -1, 1))).min(0)
        angles.extend(angle[local[:, 2] > 0.1])  # above the horizon
    assert len(angles) > 5 and np.median(angles) < 8


def test_images_are_spectra(data):
    index = np.array([1, 30, 53])
    for unit in ("wavelengths", "metres"):
        images, snapshots = (np.asarray(data[kind, unit].pas(index)) for kind in ("pas", "snapshot"))
        assert images.dtype == np.float32 and np.abs(images - snapshots).max() < 0.5 / 255 + 1e-6


@pytest.mark.parametrize("kind", ["snapshot", "pas"])
@pytest.mark.parametrize("unit", ["wavelengths", "metres"])
def test_no_links_no_spectra(data, kind, unit):
    assert data[kind, unit].pas(np.zeros(0, int)).shape == (0, 90, 360)


def test_power_has_no_angular_spectrum(data):
    with pytest.raises(UserError, match="box contains received powers, which have no angular spectrum; ") as error:
        data["power", "wavelengths"].pas(np.arange(2))
    assert "\n" not in str(error.value)


def test_inconsistent_data_sets_are_refused(data):
    dataset = data["snapshot", "wavelengths"]
    with pytest.raises(ValueError, match="box contains none of pas, snapshots, power_db, but must contain one"):
        dataset.with_observations()
    with pytest.raises(
        ValueError, match="box contains snapshots and power_db of pas, snapshots, power_db, but must contain one"
    ):
        dataset.with_observations(power_db=np.zeros(len(dataset)), snapshots=dataset.snapshots)
    with pytest.raises(ValueError, match="receiver_index must lie between 0 and 2"):
        dataclasses.replace(dataset, receiver_index=dataset.receiver_index + 1)
    broken = object.__new__(type(dataset))  # past the type checker, which the shapes would not pass: users run without it
    for field in dataclasses.fields(dataset):
        object.__setattr__(broken, field.name, getattr(dataset, field.name))
    object.__setattr__(broken, "tx_index", dataset.tx_index[:-1])
    with pytest.raises(ValueError, match="arrays of links have lengths"):
        broken.__post_init__()
