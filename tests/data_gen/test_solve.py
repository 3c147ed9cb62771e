"""Sionna RT as this project drives it, against closed forms; and twice the same bits."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from data_gen.scenes import get_scene
from data_gen.scenes.base import SceneSpec
from data_gen.settings import SolverSettings
from wbgs_jax.array import SPEED_OF_LIGHT, pas_directions, planar_array, snapshot_to_pas
from wbgs_jax.errors import UserError

pytestmark = pytest.mark.usefixtures("simulator_backend")

QUICK = SolverSettings(max_depth=2, samples_per_src=2000, max_paths_per_src=2000, tx_per_call=4)
RX = (0.3, -0.2, 1.1)


@pytest.fixture(scope="module")
def free_space(simulator_backend):
    from data_gen.solve import Simulator

    spec = SceneSpec(name="void", parts=(), rx_position=RX, tx_grid=np.zeros((0, 3)), frequencies_hz=())
    return Simulator(spec, QUICK)


@pytest.fixture(scope="module")
def room(simulator_backend):
    from data_gen.solve import Simulator

    simulator = Simulator(get_scene(1), QUICK)
    simulator.set_frequency(10e9)
    return simulator


@pytest.fixture(scope="module")
def tx():
    return get_scene(1).accessible_tx()[[5, 300, 600, 870]]


def amplitude_pattern(direction):
    """Amplitude gain of the directional element of 3GPP TR 38.901 (table 7.3-1), boresight +x, without the array."""
    zenith, azimuth = np.degrees(np.arccos(direction[2])), np.degrees(np.arctan2(direction[1], direction[0]))
    vertical = min(12 * ((zenith - 90) / 65) ** 2, 30)
    horizontal = min(12 * (azimuth / 65) ** 2, 30)
    return 10 ** ((8 - min(vertical + horizontal, 30)) / 20)


@pytest.mark.parametrize("frequency", [2.4e9, 94e9])
def test_free_space_equals_the_closed_form(free_space, frequency):
    free_space.set_frequency(frequency)
    directions = np.array([[1, 0, 0], [0.8, 0.36, 0.48], [0.6, -0.64, 0.48]])
    distances = np.array([3.0, 5.5, 7.25])
    tx = (np.array(RX) + distances[:, None] * directions).astype(np.float32).astype(np.float64)
    for position, paths in zip(tx, free_space.paths(tx), strict=True):
        offset = position - np.float32(RX)
        d = np.linalg.norm(offset)
        k = offset / d
        amplitude = SPEED_OF_LIGHT / frequency / (4 * np.pi * d) * amplitude_pattern(k)
        phase = -2 * np.pi * np.mod(frequency * d / SPEED_OF_LIGHT, 1) + 2 * np.pi * planar_array() @ k
        expected = amplitude * np.exp(1j * phase)
        assert paths.order.tolist() == [0]
        np.testing.assert_allclose(paths.delays, d / SPEED_OF_LIGHT, rtol=1e-6)
        # 94 GHz over 7 m is 2,300 turns; float32 delays leave a thousandth of a turn.
        np.testing.assert_allclose(paths.snapshot(), expected, atol=0.01 * amplitude)


def test_a_far_transmitter_peaks_at_its_direction(free_space):
    free_space.set_frequency(5e9)
    pixels = [(60, 200), (30, 250), (80, 120)]
    directions = np.array([pas_directions()[p] for p in pixels])
    for wanted, paths in zip(directions, free_space.paths(np.array(RX) + 200 * directions), strict=True):
        image = np.array(snapshot_to_pas(jnp.asarray(paths.snapshot()), jnp.asarray(planar_array())))
        peak = pas_directions()[np.unravel_index(image.argmax(), image.shape)].copy()
        peak[0] = np.copysign(peak[0], wanted[0])  # an array in the y-z plane cannot tell +x from -x
        assert np.degrees(np.arccos(np.clip(peak @ wanted, -1, 1))) < 1.5


def test_two_solves_are_bit_identical(room, tx):
    from data_gen.solve import Simulator

    other = Simulator(get_scene(1), QUICK)
    other.set_frequency(10e9)
    for first, second, third in zip(room.paths(tx), room.paths(tx), other.paths(tx), strict=True):
        for again in (second, third):
            assert first.snapshot().tobytes() == again.snapshot().tobytes()
            assert np.array_equal(first.delays, again.delays) and np.array_equal(first.order, again.order)
        assert first.snapshot().dtype == np.complex64


def test_paths_are_physical(room, tx):
    for position, paths in zip(tx, room.paths(tx), strict=True):
        assert (np.diff(paths.delays) >= 0).all()
        assert paths.order.min() >= 0 and paths.order.max() == QUICK.max_depth
        shortest = np.linalg.norm(position - get_scene(1).rx_position) / SPEED_OF_LIGHT
        assert paths.delays[0] > shortest * (1 - 1e-6)
        direct = paths.order == 0
        assert direct.sum() <= 1 and np.allclose(paths.delays[direct], shortest, rtol=1e-6)


def test_a_full_path_buffer_is_an_error(tx):
    from data_gen.solve import Simulator

    simulator = Simulator(get_scene(1), dataclasses.replace(QUICK, max_paths_per_src=20))
    simulator.set_frequency(10e9)
    with pytest.raises(UserError, match="--max-paths"):
        simulator.paths(tx)


def test_frequency_is_read_back_and_checked(room):
    assert abs(room.set_frequency(24.25e9) / 24.25e9 - 1) < 1e-6
    with pytest.raises(UserError, match="GHz"):
        room.set_frequency(140e9)
    room.set_frequency(10e9)
