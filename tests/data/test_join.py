"""Data sets of one scene as one: every link keeps what was observed on it, and no transmitter is on two sides of the split."""

import dataclasses

import numpy as np
import pytest
from builders.synthetic import tiny_dataset, tiny_scene

from wbgs_jax._util.errors import UserError
from wbgs_jax.data import load_dataset, save_scene
from wbgs_jax.data.dataset import select_receivers
from wbgs_jax.data.load import join


@pytest.fixture
def parts():
    """A room seen by three receivers, in two data sets."""
    whole = tiny_dataset(9, n_rx=3)
    return whole, select_receivers(whole, [0, 2]), select_receivers(whole, [1])


def links_of(dataset, index):
    """What there is to know of links, in an order of their own."""
    rx = np.round(dataset.rx_positions(index), 6)
    rows = np.column_stack([dataset.tx_positions[index], rx, dataset.frequencies_hz[index], np.abs(dataset.snapshots[index])])
    return rows[np.lexsort(rows.T[::-1])]


def test_what_was_taken_apart_is_whole_again(parts):
    whole, *apart = parts
    joined = join(apart)
    assert joined.n_receivers == 3 and joined.name == "box_rx0-2+box_rx1"
    assert len(np.unique(joined.tx_index)) == len(np.unique(whole.tx_index))
    for part in ("train", "validation", "test"):
        np.testing.assert_array_equal(links_of(joined, getattr(joined, part)), links_of(whole, getattr(whole, part)))
    np.testing.assert_array_equal(joined.faces, whole.faces)
    for number in range(3):
        own = np.flatnonzero(joined.receiver_index == number)
        np.testing.assert_allclose(
            joined.rx_positions(own), np.asarray(joined.receiver(number).position)[None].repeat(len(own), 0)
        )


def test_a_transmitter_that_one_of_them_tests_is_trained_by_none(parts, rng):
    _, first, second = parts
    tested = rng.choice(np.unique(second.tx_index[second.train]))
    own = second.tx_index == tested
    everything = np.arange(len(second))
    second = dataclasses.replace(second, train=everything[~own], validation=everything[:0], test=everything[own])
    joined = join([first, second])
    sides = [set(joined.tx_index[index]) for index in (joined.train, joined.validation, joined.test)]
    assert not (sides[0] & sides[2] or sides[1] & sides[2]) and len(sides[2]) == len(set(first.tx_index[first.test]) | {tested})
    assert len(joined.train) + len(joined.validation) + len(joined.test) == len(joined)


def test_links_of_no_part_stay_in_none(parts):
    _, first, second = parts
    kept = first.train[2:]
    joined = join([dataclasses.replace(first, train=kept), second])
    assert not {int(link) for link in first.train[:2]} & {int(link) for link in joined.train}
    assert len(joined.train) + len(joined.validation) + len(joined.test) == len(joined) - 2


def thicker(dataset):
    return dataclasses.replace(dataset.materials, thickness=2 * dataset.materials.thickness)


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda one: tiny_dataset(6, kind="pas"), "contains snapshots, the other spectra"),
        (lambda one: tiny_dataset(6, unit="metres"), "their arrays differ"),
        (lambda one: dataclasses.replace(one, vertices=one.vertices + 1), "their surfaces differ"),
        (lambda one: dataclasses.replace(one, materials=thicker(one)), "materials or thicknesses of their surfaces differ"),
        (lambda one: dataclasses.replace(one, convention="elevation"), "have the conventions zenith and elevation"),
    ],
)
def test_what_does_not_belong_together_is_refused_by_name(parts, change, said):
    first = dataclasses.replace(parts[1], convention="zenith")
    for others in ([], [dataclasses.replace(parts[2], materials=None, convention=None)]):
        with pytest.raises(UserError, match=said):
            join([first, *others, change(parts[2])])


def test_materials_and_convention_of_one_hold_for_all(parts):
    _, first, second = parts
    unnamed = dataclasses.replace(first, materials=None)
    joined = join([unnamed, dataclasses.replace(second, convention="elevation")])
    assert joined.materials is second.materials and joined.convention == "elevation"
    assert join([unnamed, dataclasses.replace(second, materials=None)]).materials is None


def test_names_with_commas_between_them_are_joined(tmp_path):
    for name in ("a", "b"):
        save_scene(tmp_path / f"{name}.npz", tiny_scene())
    joined = load_dataset(f"{tmp_path}/a.npz,{tmp_path}/b.npz")
    assert joined.n_receivers == 2 and len(joined) == 2 * len(tiny_dataset())
    with pytest.raises(UserError, match="no scene 'c'"):
        load_dataset(f"{tmp_path}/a.npz,c")
