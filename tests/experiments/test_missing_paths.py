"""Paths of two programs compared: pairs, what either lacks, and crossings confirmed by ray casts."""

from types import SimpleNamespace

import numpy as np
import pytest

from experiments.studies.missing_paths import PathSet, Room, account, group, match, summary
from wbgs_jax.data import load_dataset
from wbgs_jax.data.load import RELEASED
from wbgs_jax.radio.array import SPEED_OF_LIGHT


@pytest.fixture(scope="module")
def dataset():
    return load_dataset(RELEASED / "scene1.npz")


@pytest.fixture(scope="module")
def room(dataset):
    return Room(dataset)


def paths(*rows):
    """Returns paths of two elements: amplitude, phase between the elements, length and kinds of each."""
    voltages = np.array([[a, a * np.exp(1j * phase)] for a, phase, _, _ in rows], complex)
    return PathSet(voltages, np.array([length for _, _, length, _ in rows]), [kinds for *_, kinds in rows])


def test_paths_match_by_kinds_length_and_voltages():
    traced = paths((1, 0.0, 3.0, "TR"), (0.5, 1.0, 3.0, "R"), (0.2, 0.0, 4.0, "D"), (0.1, 0.0, 5.0, "RRD"))
    found = paths((0.5, 1.0, 3.0001, "RT"), (1, 0.0, 3.0001, "R"), (0.2, 0.0, 4.001, "D"), (0.3, 0.0, 5.0, "RD"))
    pairs = match(traced, found)
    assert pairs.partner.tolist() == [1, 0, -1, -1]  # transmissions are not compared, voltages decide, 1 mm is another path
    assert pairs.extra.tolist() == [False, False, True, True]


@pytest.mark.parametrize(
    ("kinds", "name"),
    [
        ("RTRRR", "4 or more reflections"),
        ("RRT", "up to 3 reflections"),
        ("TTD", "diffraction, up to 1 reflection"),
        ("DTR", "diffraction, up to 1 reflection"),
        ("RTDR", "diffraction between 2 reflections"),
        ("DRTR", "diffraction before or after 2 reflections"),
        ("RRDR", "diffraction, 3 or more reflections"),
    ],
)
def test_groups(kinds, name):
    assert group(kinds) == name


@pytest.mark.heavy
def test_crossings_are_those_of_the_field(dataset, room):
    """Ray casts through the triangles count the same transmissions as the field, on every path of one transmitter."""
    (own,) = room.paths(dataset.tx_positions[dataset.train[0]], [10e9])
    strong = np.argsort(-own.power)[:40]
    assert len({own.kinds[k].count("T") for k in strong}) > 1
    assert [room.crossed(own.points[k]) for k in strong] == [own.kinds[k].count("T") for k in strong]


def test_a_path_that_is_taken_away_is_found_again(dataset, room):
    """The field's own paths, without the strongest, as if a simulator had traced them: exactly that one is missing."""
    link = dataset.train[0]
    (own,) = room.paths(dataset.tx_positions[link], [10e9])
    numbers = {"T": 4, "R": 1, "D": 8}
    kinds = np.zeros((len(own.kinds), 5), int)
    for row, letters in zip(kinds, own.kinds, strict=True):
        row[: len(letters)] = [numbers[letter] for letter in letters]
    left = np.arange(len(own.kinds)) != np.argmax(own.power)
    traced = SimpleNamespace(coefficients=own.voltages[left], delays=own.length_m[left] / SPEED_OF_LIGHT, kinds=kinds[left])
    row = account(dataset, room, own, traced, int(dataset.tx_index[link]), 10e9)
    expected = own.power.max() / own.power[left].sum()
    assert row["matched"] == pytest.approx(1, abs=1e-6) and row["error_of_matched"] < 1e-9
    assert row["simulator_lacks"] == pytest.approx(expected, rel=1e-5)
    assert row["of_these_confirmed"] == pytest.approx(expected, rel=1e-5)
    assert row["ssim_field_all_paths"] == pytest.approx(1, abs=1e-4)
    found = summary([row])[f"{'in' if row['in_sight'] else 'out_of'}_sight_10_ghz"]
    assert found["transmitters"] == 1 and found["simulator_lacks"] == row["simulator_lacks"]
