"""Sionna RT as this project drives it: free space in closed form for any array and orientation, and twice the same bits."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from data_gen.scenes import get_scene
from data_gen.scenes.base import IDENTITY, SceneSpec
from data_gen.settings import ArraySettings, SolverSettings
from wbgs_jax._util.errors import UserError
from wbgs_jax.radio.array import SPEED_OF_LIGHT, lag_basis, pas_directions, planar_array, snapshot_to_pas

pytestmark = pytest.mark.usefixtures("simulator_backend")

QUICK = SolverSettings(max_depth=2, samples_per_src=2000, max_paths_per_src=20_000, tx_per_call=4)
RX = (0.3, -0.2, 1.1)
FREQUENCIES = (1e9, 28e9, 94e9)
BOTH = (10e9, 94e9)
"""Of the room: the simulator compiles anew for every frequency."""
HALF = np.sqrt(0.5)
LOOKS_UP = (HALF, 0.0, -HALF, 0.0)
LOOKS_UP_TURNED = (HALF * np.cos(0.35), HALF * np.sin(0.35), -HALF * np.cos(0.35), HALF * np.sin(0.35))


def free_space(array=None, orientation=IDENTITY):
    from data_gen.solve import Simulator

    spec = SceneSpec("void", parts=(), rx_position=RX, tx_grid=np.zeros((0, 3)), rx_orientation=orientation)
    return Simulator(spec, QUICK, array)


@pytest.fixture(scope="module")
def room(simulator_backend):
    from data_gen.solve import Simulator

    return Simulator(get_scene(1), QUICK)


@pytest.fixture(scope="module")
def tx():
    return get_scene(1).accessible_tx()[[5, 300, 600, 870]]


def rotation(quaternion):
    """Matrix of a unit quaternion (wxyz), local to world."""
    w, *v = quaternion
    x, y, z = v
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def spherical(k):
    """Unit vectors of growing zenith angle and of growing azimuth at the direction k."""
    azimuth = np.array([-k[1], k[0], 0]) / np.hypot(k[0], k[1])
    return np.cross(azimuth, k), azimuth


def amplitude_pattern(pattern, k):
    """Amplitude gain of one element: isotropic, a dipole (Balanis 4-26, 4-84), or of table 7.3-1 of 3GPP TR 38.901."""
    zenith, azimuth = np.arccos(k[2]), np.arctan2(k[1], k[0])
    if pattern == "tr38901":
        vertical = min(12 * (np.degrees(zenith - np.pi / 2) / 65) ** 2, 30)
        horizontal = min(12 * (np.degrees(azimuth) / 65) ** 2, 30)
        return 10 ** ((8 - min(vertical + horizontal, 30)) / 20)
    half_wave = np.sqrt(1.643) * np.cos(np.pi / 2 * np.cos(zenith)) / np.sin(zenith)
    return {"iso": 1.0, "dipole": np.sqrt(1.5) * np.sin(zenith), "hw_dipole": half_wave}[pattern]


def closed_form(offset, frequency, array, orientation):
    """Snapshot of a vertical isotropic transmitter `offset` metres away: Friis, the carrier phase, the polarisation."""
    distance = np.linalg.norm(offset)
    world = offset / distance
    turn = rotation(orientation)
    k = turn.T @ world
    element = turn @ spherical(k)[array.polarization == "H"]
    gain = amplitude_pattern(array.pattern, k) * (spherical(-world)[0] @ element)
    wavelength = SPEED_OF_LIGHT / frequency
    elements = array.element_positions() / (wavelength if array.unit == "metres" else 1)
    phase = -2 * np.pi * np.mod(distance / wavelength, 1) + 2 * np.pi * elements @ k
    return wavelength / (4 * np.pi * distance) * gain * np.exp(1j * phase)


def random_direction(rng):
    k = rng.normal(size=3)
    return k / np.linalg.norm(k)


@pytest.mark.parametrize(
    ("array", "orientation"),
    [
        (ArraySettings(), IDENTITY),
        (ArraySettings(), "random"),
        (ArraySettings(pattern="iso"), LOOKS_UP),
        (ArraySettings(), LOOKS_UP_TURNED),
        (ArraySettings(rows=8, columns=8, plane="xy", pattern="iso"), "random"),
        (ArraySettings(rows=3, columns=5, spacing=0.4, plane="xz", pattern="dipole", polarization="H"), "random"),
        (ArraySettings(rows=2, columns=1, pattern="hw_dipole"), "random"),
        (ArraySettings(spacing=0.015, unit="metres"), "random"),
    ],
)
def test_free_space_equals_the_closed_form(array, orientation, rng):
    if orientation == "random":
        quaternion = rng.normal(size=4)
        orientation = tuple((quaternion / np.linalg.norm(quaternion)).tolist())
    offsets = np.array([distance * random_direction(rng) for distance in (3.0, 5.5, 7.25)])
    tx = (np.array(RX) + offsets).astype(np.float32).astype(np.float64)
    for frequency, found in zip(FREQUENCIES, free_space(array, orientation).paths(tx, FREQUENCIES), strict=True):
        for position, paths in zip(tx, found, strict=True):
            offset = position - np.float32(RX)
            distance = np.linalg.norm(offset)
            assert paths.order.tolist() == [0]
            np.testing.assert_allclose(paths.delays, distance / SPEED_OF_LIGHT, rtol=1e-6)
            # 94 GHz over 7 m is 2,300 turns; float32 delays leave a thousandth of a turn.
            one = SPEED_OF_LIGHT / frequency / (4 * np.pi * distance)
            expected = closed_form(offset, frequency, array, orientation)
            np.testing.assert_allclose(paths.snapshot(), expected, atol=0.01 * max(one, np.abs(expected).max()))


def test_a_far_transmitter_peaks_at_its_direction():
    pixels = [(60, 200), (30, 250), (80, 120)]
    directions = np.array([pas_directions()[p] for p in pixels])
    (found,) = free_space().paths(np.array(RX) + 200 * directions, (5e9,))
    for wanted, paths in zip(directions, found, strict=True):
        image = np.array(snapshot_to_pas(jnp.asarray(paths.snapshot()), jnp.asarray(planar_array())))
        peak = pas_directions()[np.unravel_index(image.argmax(), image.shape)].copy()
        peak[0] = np.copysign(peak[0], wanted[0])  # an array in the y-z plane cannot tell +x from -x
        assert np.degrees(np.arccos(np.clip(peak @ wanted, -1, 1))) < 1.5


@pytest.mark.parametrize("orientation", [IDENTITY, (0.5, 0.5, -0.1, 0.7)])
def test_a_horizontal_array_sees_the_zenith(orientation):
    orientation = tuple((np.array(orientation) / np.linalg.norm(orientation)).tolist())
    array = ArraySettings(rows=8, columns=8, plane="xy", pattern="iso")
    wanted = pas_directions()[12, 77]  # in the receiver's frame, 12 degrees from its zenith
    tx = np.array(RX) + 200 * rotation(orientation) @ wanted
    ((paths,),) = free_space(array, orientation).paths(tx[None], (5e9,))
    image = np.array(snapshot_to_pas(jnp.asarray(paths.snapshot()), jnp.asarray(array.element_positions())))
    peak = pas_directions()[np.unravel_index(image.argmax(), image.shape)]
    assert np.degrees(np.arccos(np.clip(peak @ wanted, -1, 1))) < 1.0


def test_equal_solves_are_bit_identical(room, tx):
    import drjit as dr

    from data_gen.solve import Simulator

    first = room.paths(tx, BOTH)
    again = [room.paths(tx, BOTH), Simulator(get_scene(1), QUICK).paths(tx, BOTH)]
    threads = dr.thread_count()
    try:
        for count in (1, 2):
            dr.set_thread_count(count)
            again.append(room.paths(tx, BOTH))
    finally:
        dr.set_thread_count(threads)
    for other in again:
        for a, b in zip(itertools.chain(*first), itertools.chain(*other), strict=True):
            assert a.snapshot().dtype == np.complex64
            assert a.snapshot().tobytes() == b.snapshot().tobytes()
            assert np.array_equal(a.delays, b.delays) and np.array_equal(a.order, b.order)


def test_paths_are_physical(room, tx):
    for position, paths in zip(tx, room.paths(tx, (10e9,))[0], strict=True):
        assert (np.diff(paths.delays) >= 0).all()
        assert paths.order.min() >= 0 and paths.order.max() == QUICK.max_depth
        shortest = np.linalg.norm(position - get_scene(1).rx_position) / SPEED_OF_LIGHT
        assert paths.delays[0] > shortest * (1 - 1e-6)
        direct = paths.order == 0
        assert direct.sum() <= 1 and np.allclose(paths.delays[direct], shortest, rtol=1e-6)


def test_squared_images_lie_in_the_space_of_the_array(room, tx):
    basis = lag_basis(planar_array())
    snapshots = np.stack([paths.snapshot() for row in room.paths(tx, BOTH) for paths in row])
    scaled = snapshots / np.abs(snapshots).max(-1, keepdims=True)
    squared = np.asarray(snapshot_to_pas(jnp.asarray(scaled), jnp.asarray(planar_array())), np.float64).reshape(8, -1) ** 2
    residual = np.linalg.norm(squared - squared @ basis @ basis.T, axis=1)
    assert (residual < 1e-5 * np.linalg.norm(squared, axis=1)).all()


def test_a_full_path_buffer_is_an_error(tx):
    from data_gen.solve import Simulator

    simulator = Simulator(get_scene(1), dataclasses.replace(QUICK, max_paths_per_src=20))
    with pytest.raises(UserError, match="--max-paths"):
        simulator.paths(tx, (10e9,))


def test_frequency_is_read_back_and_checked():
    simulator, tx = free_space(), np.array([[1.0, 1.0, 1.0]])
    simulator.paths(tx, FREQUENCIES)
    assert list(simulator.read_back_hz) == list(FREQUENCIES)
    for asked, reported in simulator.read_back_hz.items():
        assert abs(reported / asked - 1) < 1e-6
    with pytest.raises(UserError, match="140 GHz"):
        simulator.paths(tx, (10e9, 140e9))


def test_faint_paths_are_left_out():
    """What is left of a wave after a long way: as much as behind twenty walls of concrete."""
    from data_gen.solve import FAINT

    simulator, wavelength = free_space(), SPEED_OF_LIGHT / FREQUENCIES[0]
    limit = wavelength / (4 * np.pi) / FAINT  # metres, at a gain of 0 dBi
    near, far = (simulator.paths(np.array([[limit * share, 0.0, 0.0]]), FREQUENCIES[:1])[0][0] for share in (0.01, 100.0))
    assert len(near.delays) == 1
    assert len(far.delays) == 0 and far.delay_spread() == 0 and not far.snapshot().any()
