"""Snapshots with phases of the other sign, or quaternions in another order, are noted; magnitudes and silence are refused."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wbgs_jax._util.errors import UserError
from wbgs_jax.data import load_dataset
from wbgs_jax.data.load import scene_dataset
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.data.snapshot_frames import CONJUGATE, OTHER_ORDER, OTHER_UNIT, POINT, REORDERED, SHUFFLED
from wbgs_jax.interchange.scenes import scene_of_snapshots
from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array

HERTZ = np.array([2.4e9, 5e9])


def measured(rng, turn, count=24):
    """Snapshots of lines of sight in free space (transmitter, receiver, frequency, element), and places."""
    places, receiver = rng.uniform([1, -3, 0.5], [8, 3, 2.5], (count, 3)), np.array([[0, 0, 1.2]])
    offset = places - receiver
    distance = np.linalg.norm(offset, axis=1)
    steering = np.exp(2j * np.pi * turn.inv().apply(offset / distance[:, None]) @ planar_array(4, 4).T)
    delay = np.exp(-2j * np.pi * HERTZ * distance[:, None] / SPEED_OF_LIGHT) / distance[:, None]
    return (steering[:, None] * delay[:, :, None])[:, None], places, receiver


def notes_of(snapshots, places, receiver, quaternion, elements=None, unit="wavelengths"):
    elements = planar_array(4, 4) if elements is None else elements
    scene = scene_of_snapshots(snapshots, places, HERTZ, receiver, np.array([quaternion]), elements, "hall")
    scene = replace(scene, element_unit=unit)
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        scene_dataset(scene)
    return [str(note.message) for note in notes]


@pytest.mark.parametrize("turn", [Rotation.identity(), Rotation.from_euler("zy", [0.4, 0.2])])
def test_snapshots_in_another_convention_are_noted(rng, turn):
    snapshots, places, receiver = measured(rng, turn)
    x, y, z, w = turn.as_quat()
    assert notes_of(snapshots, places, receiver, (w, x, y, z)) == []
    assert notes_of(snapshots.conj(), places, receiver, (w, x, y, z)) == [f"hall: {CONJUGATE}"]
    assert notes_of(snapshots, places, receiver, (x, y, z, w)) == [f"hall: {REORDERED}"]
    noise = rng.normal(size=(*snapshots.shape, 2)).view(complex)[..., 0]
    assert notes_of(noise, places, receiver, (w, x, y, z)) == []


LEVEL = (1.0, 0.0, 0.0, 0.0)


def test_elements_in_another_unit_or_order_are_noted(rng):
    snapshots, places, receiver = measured(rng, Rotation.identity(), count=80)
    assert notes_of(snapshots, places, receiver, LEVEL, unit="metres") == [f"hall: {OTHER_UNIT['metres']}"]
    by_metres = planar_array(4, 4) * SPEED_OF_LIGHT / HERTZ[0]
    first = np.repeat(snapshots[:, :, :1], 2, 2)  # at both frequencies what an array of fixed size measures at the first
    first[:, :, 1] = fixed_size(places, receiver, by_metres, HERTZ[1])
    assert notes_of(first, places, receiver, LEVEL, by_metres, "metres") == []
    assert notes_of(first, places, receiver, LEVEL, by_metres) == [f"hall: {OTHER_UNIT['wavelengths']}"]
    grid = snapshots.reshape(*snapshots.shape[:3], 4, 4)
    for values, note in ((grid.swapaxes(-1, -2), OTHER_ORDER), (grid[..., ::-1], OTHER_ORDER)):
        assert notes_of(values.reshape(snapshots.shape), places, receiver, LEVEL) == [f"hall: {note}"]


def fixed_size(places, receiver, elements, hertz):
    offset = places - receiver
    return np.exp(2j * np.pi * hertz / SPEED_OF_LIGHT * (offset / np.linalg.norm(offset, axis=1)[:, None]) @ elements.T)[
        :, None
    ]


def test_snapshots_of_other_transmitters_are_noted(rng):
    snapshots, places, receiver = measured(rng, Rotation.identity(), count=60)
    assert notes_of(snapshots, places, receiver, LEVEL) == []
    assert notes_of(snapshots, rng.permutation(places), receiver, LEVEL) == [f"hall: {SHUFFLED}"]
    beyond = places + np.array([300, 0, 0])  # all in one direction, in which no order can be recognised
    assert notes_of(measured(rng, Rotation.identity(), 60)[0], beyond, receiver, LEVEL) == []


def test_an_array_at_one_point_is_noted(rng):
    snapshots, places, receiver = measured(rng, Rotation.identity())
    assert notes_of(snapshots[..., :1], places, receiver, LEVEL, np.zeros((1, 3))) == [f"hall: {POINT}"]
    assert notes_of(snapshots, places, receiver, LEVEL, np.zeros((16, 3))) == [f"hall: {POINT}"]


def test_the_released_scenes_are_in_the_convention():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_dataset(1)


def test_magnitudes_and_silence_are_refused(rng, tmp_path):
    snapshots, places, receiver = measured(rng, Rotation.identity())
    for values, words in ((np.abs(snapshots) + 0j, "real numbers"), (0 * snapshots, "only 0: nothing was received")):
        scene = scene_of_snapshots(values, places, HERTZ, receiver, np.array([[1.0, 0, 0, 0]]), planar_array(4, 4), "hall")
        with pytest.raises(UserError, match=rf"hall\.npz: snapshots contains {words}"):
            save_scene(tmp_path / "hall.npz", scene)
