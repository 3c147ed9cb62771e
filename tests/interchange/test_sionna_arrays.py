"""Snapshots of the arrays in paths of Sionna RT: against sums over plane waves, and against Sionna's own channels."""

from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.drawn_paths import bounced_paths
from scipy.spatial.transform import Rotation

from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.ray_paths import read_paths
from wbgs_jax.interchange.sionna_arrays import cir_of_paths, scene_of_sionna
from wbgs_jax.propagation.transport import snapshots_from_paths
from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array
from wbgs_jax.radio.channel import Paths
from wbgs_jax.types import make_receiver

CASES = Path(__file__).parents[3] / "shared" / "cases"
FREQUENCY = 3.5e9
WAVELENGTH = SPEED_OF_LIGHT / FREQUENCY
RX = np.array([2.0, -1.0, 5.0])
COUNT, PATHS = 9, 5


def angles(direction):
    return np.arccos(np.clip(direction[..., 2], -1, 1)), np.arctan2(direction[..., 1], direction[..., 0])


class Traced:
    """Waves from random transmitters and their mirror images at a turned array, as Sionna stores them."""

    def __init__(self, rng, shape=(4, 4), turn=None, synthetic=True, gains=(1.0,), tx=COUNT):
        self.turn = Rotation.random(random_state=rng) if turn is None else turn
        self.elements = planar_array(*shape)
        self.sources = RX + rng.uniform(5, 60, (tx, 3)) * rng.choice([-1, 1], (tx, 3))
        images = self.sources[:, None] + rng.uniform(5, 30, (tx, PATHS, 3)) * np.array([1, 1, 0])
        images[:, 0] = self.sources
        offset = images - RX
        longer = np.maximum(1, 1.1 * np.linalg.norm(self.sources - RX, axis=-1)[:, None] / np.linalg.norm(offset, axis=-1))
        longer[:, 0] = 1
        length = np.linalg.norm(offset, axis=-1) * longer
        direction = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
        gain = WAVELENGTH / (4 * np.pi * length) * np.exp(2j * np.pi * rng.random((tx, PATHS)))
        places = self.turn.apply(self.elements) * WAVELENGTH
        ahead = np.einsum("ei,tki->etk", places, direction)  # metres
        self.channel = np.stack([
            (g * gain * np.exp(2j * np.pi * (ahead - length) / WAVELENGTH)).sum(-1) for g in gains
        ])  # fmt: skip
        theta, phi = angles(direction)
        away = angles(-direction)
        shared = {"theta_r": theta[None], "phi_r": phi[None], "theta_t": away[0][None], "phi_t": away[1][None]}
        if synthetic:
            a = np.concatenate([g * gain * np.exp(2j * np.pi * ahead / WAVELENGTH) for g in gains])
            shared |= {"tau": (length / SPEED_OF_LIGHT)[None]}
            targets = RX[None]
        else:
            a = np.concatenate([g * np.broadcast_to(gain, ahead.shape) for g in gains])
            own = {name: np.broadcast_to(values, (len(places), *values.shape[1:])) for name, values in shared.items()}
            own |= {"tau": (length - ahead) / SPEED_OF_LIGHT}
            shared = {name: values[None, :, :, None] for name, values in own.items()}
            targets = RX + places
        self.arrays = shared | {
            "a": a[None, :, :, None], "sources": self.sources, "targets": targets, "frequency_hz": np.array(FREQUENCY)
        }  # fmt: skip


def alike(a, b):
    return abs(np.vdot(a, b)) / np.linalg.norm(a) / np.linalg.norm(b)


@pytest.mark.parametrize("synthetic", [True, False])
@pytest.mark.parametrize("shape", [(4, 4), (2, 3), (1, 8)])
def test_snapshots_are_the_channels_of_the_array(rng, synthetic, shape):
    """Any orientation; and the scene's own array, turned as the scene records it, steers as the simulated one."""
    traced = Traced(rng, shape, synthetic=synthetic)
    scene = scene_of_sionna(traced.arrays, "street", shape=shape)
    np.testing.assert_allclose(scene.snapshots[:, 0, 0], traced.channel[0].T, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(scene.rx_position, RX[None], atol=1e-6)
    w, x, y, z = scene.rx_orientation[0]
    own = Rotation.from_quat([x, y, z, w]).apply(scene.element_positions[0])
    if 1 not in shape or not synthetic:  # a single row leaves the turn about it open
        np.testing.assert_allclose(own, traced.turn.apply(traced.elements), atol=1e-3)
    else:
        np.testing.assert_allclose(own, traced.turn.apply(traced.elements), atol=1e-2)


def test_objects_hold_places_as_columns_and_coefficients_in_two_parts(rng):
    traced = Traced(rng)
    arrays = traced.arrays
    simulated = SimpleNamespace(**arrays | {
        "a": (arrays["a"].real, arrays["a"].imag), "sources": arrays["sources"].T, "targets": arrays["targets"].T
    })  # fmt: skip
    scene = scene_of_sionna(simulated, "street")
    np.testing.assert_allclose(scene.snapshots[:, 0, 0], traced.channel[0].T, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("synthetic", [True, False])
def test_of_two_polarisations_one_is_chosen(rng, synthetic):
    traced = Traced(rng, synthetic=synthetic, gains=(1e-3, 1.0))
    with pytest.raises(UserError, match=r"two polarisations of 16 .* choose --port 1 or --port 2"):
        scene_of_sionna(traced.arrays, "street", shape=(4, 4))
    for port in (1, 2):
        scene = scene_of_sionna(traced.arrays, "street", shape=(4, 4), port=port)
        np.testing.assert_allclose(scene.snapshots[:, 0, 0], traced.channel[port - 1].T, rtol=1e-4, atol=1e-9)


def test_a_single_antenna_becomes_an_array_of_plane_waves(rng):
    traced = Traced(rng, (1, 1))
    scene = scene_of_sionna(traced.arrays, "street", shape=(2, 2))
    assert scene.snapshots.shape == (COUNT, 1, 1, 4)
    both = Traced(rng, (1, 1), gains=(1e-3, 1.0))
    with pytest.raises(UserError, match="2 antennas: two polarisations of 1"):
        scene_of_sionna(both.arrays, "street", shape=(4, 4))
    strong, weak = (scene_of_sionna(both.arrays, "street", port=port).snapshots for port in (2, 1))
    np.testing.assert_allclose(strong, 1e3 * weak, rtol=1e-4)


def test_the_other_side(rng):
    """Swapped, the arrays are the transmitters'."""
    arrays = Traced(rng).arrays
    other = {"sources": "targets", "targets": "sources", "theta_t": "theta_r", "theta_r": "theta_t", "phi_t": "phi_r"}
    other |= {"phi_r": "phi_t"}
    turned = {"a": np.transpose(arrays["a"], (2, 3, 0, 1, 4)), "frequency_hz": arrays["frequency_hz"]}
    for name, values in arrays.items():
        if name not in ("a", "frequency_hz"):
            turned[other.get(name, name)] = values if name in ("sources", "targets") else np.swapaxes(values, 0, 1)
    one, two = scene_of_sionna(arrays, "street"), scene_of_sionna(turned, "street", swap=True)
    np.testing.assert_allclose(one.snapshots, two.snapshots)
    with pytest.raises(UserError, match=r"transmitters of street have 16 antennas; choose one: --tx-antenna 1 to 16"):
        scene_of_sionna(turned, "street")


def joined_receivers(*every):
    """The arrays of several receivers of the same transmitters in one file."""
    names = [name for name in every[0] if name not in ("sources", "frequency_hz")]
    return every[0] | {name: np.concatenate([one[name] for one in every]) for name in names}


@pytest.mark.parametrize("without", ["coefficients", "valid paths"])
def test_a_receiver_without_paths_is_oriented_as_the_others(rng, without):
    turn = Rotation.random(random_state=rng)
    one = Traced(rng, turn=turn).arrays
    silent = one | ({"a": 0 * one["a"]} if without == "coefficients" else {"tau": np.full_like(one["tau"], -1)})
    scene = scene_of_sionna(joined_receivers(one, silent), "street")
    np.testing.assert_allclose(scene.rx_orientation, scene_of_sionna(one, "street").rx_orientation[[0, 0]], atol=1e-6)
    assert not scene.snapshots[:, 1].any() and scene.snapshots[:, 0].all()
    turned = Traced(np.random.default_rng(1), turn=turn * Rotation.from_euler("z", 90, degrees=True)).arrays
    turned |= {"sources": np.full((COUNT, 3), np.nan)}
    with pytest.raises(UserError, match="receiver 2 of street has no path"):
        scene_of_sionna(joined_receivers(turned, silent, one), "street")


def test_the_recorded_frequency_is_the_one_of_the_paths(rng):
    arrays = Traced(rng).arrays
    assert scene_of_sionna(arrays, "street", FREQUENCY * (1 + 1e-6)).frequencies_hz.tolist() == [FREQUENCY]
    with pytest.raises(UserError, match=r"street is for 3\.5 GHz, not 2\.8; leave out --ghz"):
        scene_of_sionna(arrays, "street", 2.8e9)
    for several in ([FREQUENCY, 60e9], np.array([FREQUENCY, FREQUENCY, 60e9])):
        with pytest.raises(UserError, match=r"street is for several frequencies, 3\.5 to 60 GHz"):
            scene_of_sionna(arrays | {"frequency_hz": several}, "street")
    with pytest.raises(UserError, match="the frequency of street is nan Hz"):
        scene_of_sionna(arrays | {"frequency_hz": np.array("28 GHz")}, "street")


def test_vertices_of_the_other_side_are_in_the_other_order(rng):
    """Also in the raw arrays of several bounces, whose lengths are compared with their vertices."""
    paths = bounced_paths(rng, direct=False)
    turned = scene_of_sionna(paths.as_sionna(), "room", swap=True)
    expected = scene_of_sionna(paths.reversed().as_sionna(), "room")
    np.testing.assert_allclose(turned.snapshots, expected.snapshots)
    np.testing.assert_allclose(turned.tx_positions, paths.targets)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda arrays: {"tau": 1e9 * arrays["tau"]}, "give delays in seconds"),
        (lambda arrays: {"tau": arrays["tau"] - arrays["tau"].min(-1, keepdims=True)}, "normalize_delays=False"),
        (lambda arrays: {"theta_r": np.degrees(arrays["theta_r"])}, "theta_r is .*; give radians, not degrees"),
        (lambda arrays: {"phi_t": np.degrees(arrays["phi_t"])}, "phi_t is .*; give radians, not degrees"),
        (lambda arrays: {"a": 20 * np.log10(np.abs(arrays["a"])) + 0j}, "give amplitudes, not decibels"),
        (lambda arrays: {"a": arrays["a"][..., None]}, "6 axes, including time, as that of paths.cir.*; give `paths.a`"),
        (lambda arrays: {"a": arrays["a"][:, :7]}, "have 7 antennas|do not fit"),
        (lambda arrays: {"sources": 1e3 * arrays["sources"]}, "positions in metres"),
        (lambda arrays: {"theta_t": np.abs(np.pi / 2 - arrays["theta_t"])}, "theta_t, phi_t of lines of sight"),
        (lambda arrays: {"sources": arrays["sources"][:, [0, 2, 1]]}, "are .* apart|degrees from the other end"),
        (lambda arrays: {"a": arrays["a"][:, [*range(8), *range(15, 7, -1)]]}, "do not fit a 4x4 array"),
    ],
)
def test_contradictions_are_refused(rng, change, words):
    arrays = Traced(rng).arrays
    with pytest.raises(UserError, match=words):
        scene_of_sionna(arrays | change(arrays), "street", shape=(4, 4))


def test_lines_of_sight_have_the_length_of_the_line(rng):
    """Places that are no row each may be nearer to each other than a path is long."""
    arrays = Traced(rng).arrays
    met = np.zeros((1, *arrays["tau"].shape), int)
    met[..., 1:] = 1
    known = arrays | {"interactions": met, "vertices": np.full((*met.shape, 3), np.nan)}
    assert len(scene_of_sionna(known, "street").tx_positions) == COUNT
    nearer = {"sources": RX + 0.8 * (arrays["sources"] - RX)}
    with pytest.raises(UserError, match=r"a path from transmitter 1 to receiver 1 is .* m long, but .* m through its vertices"):
        scene_of_sionna(known | nearer, "street")
    del known["frequency_hz"]
    with pytest.raises(UserError, match="street does not record its frequency; give --ghz"):
        scene_of_sionna(known, "street")


@pytest.mark.parametrize("shape", [(4, 4), (1, 1)])
@pytest.mark.parametrize("synthetic", [True, False])
@pytest.mark.parametrize("sign", [-1, 1])
def test_coefficients_that_contain_the_carrier_are_refused(rng, shape, synthetic, sign):
    """Of `paths.cir()`, and with the other sign of time; the true coefficients of lines of sight agree."""
    arrays = Traced(rng, shape, synthetic=synthetic).arrays
    pair = arrays["a"][:, :1, ..., :1] * arrays["a"][:, -1:, ..., :1]
    centre = np.exp(-0.5j * np.angle(pair))  # lines of sight then have the phase 0 or pi at the centre
    a = arrays["a"].copy()
    a[..., :1] *= centre
    arrays |= {"a": a}
    scene_of_sionna(arrays, "street", shape=(4, 4))
    tau = arrays["tau"][:, None, :, None] if synthetic else arrays["tau"]
    turned = arrays | {"a": arrays["a"] * np.exp(2j * np.pi * sign * FREQUENCY * tau)}
    with pytest.raises(UserError, match=r"street: a contains the phase of the carrier, .* give paths\.a"):
        scene_of_sionna(turned, "street", shape=(4, 4))


@pytest.mark.skipif(not CASES.exists(), reason="the small inputs are not beside the repository")
@pytest.mark.parametrize("mode", ["syn", "full"])
def test_real_coefficients_with_the_carrier_are_refused(mode):
    arrays = read_paths(CASES / "sionna_arrays" / f"paths_{mode}.npz")
    tau = arrays["tau"][:, None, :, None] if arrays["tau"].ndim == 3 else arrays["tau"]
    turned = arrays | {"a": arrays["a"] * np.exp(-2j * np.pi * arrays["frequency_hz"] * tau)}
    with pytest.raises(UserError, match=r"street: a contains the phase of the carrier, .* give paths\.a"):
        scene_of_sionna(turned, "street")


@pytest.mark.skipif(not CASES.exists(), reason="the small inputs are not beside the repository")
@pytest.mark.parametrize("mode", ["syn", "full"])
def test_against_sionnas_own_channels(mode):
    scene = scene_of_sionna(read_paths(CASES / "sionna_arrays" / f"paths_{mode}.npz"), "street")
    own = np.load(CASES / "sionna_arrays" / f"paths_{mode}_cfr.npy")[0, :, :, 0, 0, 0].T
    for ours, theirs in zip(scene.snapshots[:, 0, 0], own, strict=True):
        assert alike(ours, theirs) > 0.99999
    assert np.abs(np.angle(np.vdot(own, scene.snapshots[:, 0, 0]))) < 1e-3


def test_impulse_responses_have_the_form_of_sionna_phy(rng):
    """Axes are batch, receiver, antenna, transmitter, antenna, path, time; the sum over paths is the snapshot at the carrier,
    and over a band the response is Sionna's sum of a exp(-2 pi j f tau)."""
    towards = rng.normal(size=(2, 5, 3))
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    gain = rng.normal(size=(2, 5)) + 1j * rng.normal(size=(2, 5))
    gain[1, 3:] = 0  # padding
    arrays = np.complex64(gain), np.float32(towards), np.float32(rng.uniform(3, 30, (2, 5)))
    paths, receiver = Paths(*map(jnp.asarray, arrays)), make_receiver(RX)
    a, tau = (np.asarray(part) for part in cir_of_paths(paths, receiver, FREQUENCY))
    elements = len(np.asarray(receiver.element_positions))
    assert a.shape == (2, 1, elements, 1, 1, 5, 1) and tau.shape == (2, 1, 1, 5)
    for link in range(2):
        one = jax.tree.map(lambda leaf, link=link: leaf[link], paths)
        snapshot = snapshots_from_paths(one, receiver, jnp.asarray(FREQUENCY))
        np.testing.assert_allclose(a[link].sum(-2).ravel(), snapshot, atol=1e-5)
    offsets = np.linspace(-1e7, 1e7, 9)
    waves = np.exp(-2j * np.pi * offsets * tau[:, 0, 0, :, None])
    steered = np.exp(2j * np.pi * towards @ np.asarray(receiver.element_positions)[0])
    seen = np.einsum("bp,bpf->bf", a[:, 0, 0, 0, 0, :, 0], waves)
    np.testing.assert_allclose(seen, np.einsum("bp,bpf->bf", gain * steered, waves), atol=2e-4)
    assert (tau >= 0).all() and (tau[0].min() == 0) and (a[1, ..., 3:, :] == 0).all()
