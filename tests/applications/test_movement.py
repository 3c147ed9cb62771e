"""Channels over time: against fields that are built anew, knife edges, and the Doppler shift of a moving mirror."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from builders.mirrors import trained
from builders.rooms import METAL, SPEED_OF_LIGHT, box, field_of, rectangle, room
from builders.untrained import make_field, make_params
from scipy.signal import stft as scipy_stft
from scipy.special import fresnel

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.movement import (
    add_body,
    doppler_spectrogram,
    make_movement,
    paths_over_time,
    person,
    plan_movement,
)
from wbgs_jax.fields.coherent import channels
from wbgs_jax.fields.coherent_model import moved_plan
from wbgs_jax.propagation.displacement import Motion
from wbgs_jax.propagation.mechanisms import sizes_of, trace_paths
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.types import make_query, make_receiver

HZ = 60e9
SMALL = {"mirror_areas": (0.0, 0.5), "specular_tried": 64, "specular_kept": 32, "diffracted_tried": 64, "diffracted_kept": 32}
PARTS = [*room(), box((3.0, 2.6, 0.0), (3.6, 3.2, 1.0))]
WHOLE = {"return_onesided": False, "boundary": None, "padded": False}
RX, TX = np.array([0.8, 1.9, 1.1]), np.array([5.2, 2.2, 1.3])


def narrowband(paths):
    """The channel at the carrier."""
    return np.asarray(paths.amplitude).sum(-1)


def half_plane(edge=0.0, size=40.0, depth=0.02):
    """A wide and tall prism with a rhombus as its cross-section: an opaque half-plane y > edge at x = 0."""
    across = np.array([[0, edge], [depth, edge + size / 2], [0, edge + size], [-depth, edge + size / 2]])
    corners = np.concatenate([np.column_stack([across, np.full(4, z)]) for z in (-size / 2, size / 2)])
    return trimesh.Trimesh(corners).convex_hull


def knife_edge_db(excess):
    """ITU-R P.526: the power behind a half-plane whose edge is `excess` (in Fresnel's parameter) above the line of sight."""
    s, c = fresnel(excess)
    return 10 * np.log10(((0.5 - c) ** 2 + (0.5 - s) ** 2) / 2)


@pytest.mark.heavy
def test_every_instant_is_that_of_a_field_built_there(rng):
    """Bodies turn and shift, both ends move."""
    field, params, _ = field_of(PARTS, RX, **SMALL)
    field, params, body = add_body(field, params, person([2.5, 1.5, 0.0], azimuth=0.3))
    steps = np.linspace(0, 1, 9)[:, None]
    shift = {body: steps * [0.6, 0.4, 0.0], 6: steps * [-0.3, -0.5, 0.1]}
    turn = {body: steps * [0.0, 0.0, 0.8], 6: steps * [0.05, 0.0, -0.4]}
    ends = steps * [0.3, -0.4, 0.1], steps * [0.0, 0.1, 0.3]
    places, receiver = TX + steps * [-0.5, 0.3, -0.2], make_receiver(RX, pattern="tr38901")
    motion = make_movement(field, 9, shift, turn, *ends)
    plan = plan_movement(field, params, receiver, places, motion)
    found = paths_over_time(params, plan, make_query(places, 5e9), motion)
    for instant in (0, 3, 4, 8):
        now = jax.tree.map(lambda leaf, i=instant: np.asarray(leaf)[i], motion)
        there = field.moved(Motion(now.shift, now.turn, np.zeros((0, 3)), np.zeros((0, 3))))
        here = moved_plan(plan, now).receiver
        expected = channels(params, there.plan(params, here), make_query(places[instant], 5e9))
        one, other = (np.sort_complex(np.round(np.asarray(a), 9)) for a in (found.amplitude[instant], expected.amplitude[0]))
        alive = np.abs(other) > 0
        assert alive.sum() > 15 and (np.abs(one) > 0).sum() == alive.sum()
        total = narrowband(found)[instant]
        assert abs(total - narrowband(expected)[0]) < 0.01 * np.abs(other).max()
        lengths = (
            np.sort(np.asarray(p.length)[np.abs(np.asarray(p.amplitude)) > 0])
            for p in (jax.tree.map(lambda leaf, i=instant: leaf[i], found), jax.tree.map(lambda leaf: leaf[0], expected))
        )
        np.testing.assert_allclose(*lengths, atol=2e-5)


@pytest.mark.heavy
@pytest.mark.parametrize("hz", [6e9, HZ])
def test_a_half_plane_that_crosses_a_link_is_a_knife_edge(hz):
    """From the lit side into 15 dB of shadow."""
    settings = SMALL | {"mirror_areas": (), "conductivity": METAL}
    field, params, _ = field_of([half_plane()], (3.0, 0.0, 0.0), **settings)
    wavelength, excess = SPEED_OF_LIGHT / hz, np.linspace(-2.0, 1.4, 60)
    edge = -excess / np.sqrt(2 / wavelength * (1 / 2 + 1 / 3))  # of the line of sight at y = 0 of a link of 2 m and 3 m
    motion = make_movement(field, 60, {0: edge[:, None] * [0, 1, 0]})
    tx = np.array([-2.0, 0.0, 0.0])
    plan = plan_movement(field, params, make_receiver([3.0, 0.0, 0.0]), tx, motion)
    found = paths_over_time(params, plan, make_query(np.broadcast_to(tx, (60, 3)), hz), motion)
    free = 20 * np.log10(wavelength / (4 * np.pi * 5))
    power = 20 * np.log10(np.abs(narrowband(found))) - free
    np.testing.assert_allclose(power, knife_edge_db(excess), atol=1.0)
    assert np.ptp(power) > 14


@pytest.mark.heavy
def test_a_moving_mirror_shifts_by_two_v_over_lambda():
    """Approaching: positive; and half of that where the transmitter moves instead."""
    wall = rectangle((4.0, -5, -5), (0, 10, 0), (0, 0, 10))
    field, params, _ = field_of([wall], (0, 0, 0), conductivity=METAL, **SMALL | {"mirror_areas": (0.0,)})
    rate, speed, count = 2000.0, 1.7, 512
    seconds = np.arange(count)[:, None] / rate
    tx = np.array([0.0, 0.1, 0.0])
    motion = make_movement(field, count, {0: seconds * [-speed, 0, 0]})
    plan = plan_movement(field, params, make_receiver([0, 0, 0]), tx, motion)
    found = paths_over_time(params, plan, make_query(np.broadcast_to(tx, (count, 3)), HZ), motion)
    hertz, times, power = doppler_spectrogram(jnp.asarray(narrowband(found)), rate, 256)
    spectrum = np.mean(10 ** (np.asarray(power) / 10), -1)
    spectrum[np.abs(hertz) < 50] = 0  # the line of sight
    assert float(hertz[spectrum.argmax()]) == pytest.approx(2 * speed * HZ / SPEED_OF_LIGHT, abs=rate / 256)
    assert times.shape == power.shape[1:] and (np.diff(hertz) > 0).all()
    still = make_movement(field, count)
    places = tx + seconds * [speed, 0, 0]
    found = paths_over_time(
        params, plan_movement(field, params, make_receiver([0, 0, 0]), places, still), make_query(places, HZ), still
    )
    reflected = np.asarray(found.interaction)[:, :, 0] == 2
    phase = np.unwrap(np.angle(np.where(reflected, np.asarray(found.amplitude), 0).sum(-1)))
    shift = np.polyfit(seconds[:, 0], phase, 1)[0] / (2 * np.pi)
    assert shift == pytest.approx(speed * HZ / SPEED_OF_LIGHT, rel=2e-3)


@pytest.mark.heavy
def test_a_turning_mirror_flashes():
    """A small mirror far from both ends reflects for a few of all instants, in the midst of its turn."""
    plate = rectangle((0, -0.25, -0.25), (0, 0.5, 0), (0, 0, 0.5))
    rx, tx, count = np.array([5.0, 3.0, 0.0]), np.array([6.0, 2.0, 0.0]), 101
    field, params, _ = field_of([plate], rx, **SMALL | {"mirror_areas": (0.0,)})
    angle = np.linspace(0, 1, count)
    normal, across = (np.stack([np.cos(a), np.sin(a), 0 * a], -1) for a in (angle, angle + np.pi / 2))
    image = rx - 2 * (normal @ rx)[:, None] * normal
    share = normal @ tx / ((normal @ tx) - np.sum(normal * image, -1))
    expected = np.abs(np.sum((tx + share[:, None] * (image - tx)) * across, -1)) < 0.25
    motion = make_movement(field, count, turn={0: angle[:, None] * [0, 0, 1]})
    plan = plan_movement(field, params, make_receiver(rx), tx, motion)
    found = paths_over_time(params, plan, make_query(np.broadcast_to(tx, (count, 3)), 3e9), motion)
    reflected = (np.asarray(found.interaction)[:, :, 0] == 2) & (np.abs(np.asarray(found.amplitude)) > 0)
    assert 5 < expected.sum() < 12
    np.testing.assert_array_equal(reflected.any(-1), expected)


@pytest.mark.heavy
def test_nothing_jumps_while_paths_remain(rng):
    """A person walks across a link: the amplitude of no path jumps, and phases follow lengths."""
    field, params, _ = field_of(PARTS, RX, **SMALL)
    field, params, body = add_body(field, params, person([3.0, 1.4, 0.0]))
    count = 400
    motion = make_movement(field, count, {body: np.linspace(0, 1.2, count)[:, None] * [0.2, 1.0, 0.0]})
    plan = plan_movement(field, params, make_receiver(RX), TX, motion)
    found = paths_over_time(params, plan, make_query(np.broadcast_to(TX, (count, 3)), HZ), motion)

    @jax.jit
    def traced(motion):
        return jax.lax.map(
            lambda now: trace_paths(moved_plan(plan, now).surfaces, jnp.asarray(TX), sizes_of(plan.config)), motion
        )

    sets = traced(jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), motion)).sets
    names = np.concatenate([np.stack([np.asarray(s.interaction_type), np.asarray(s.interaction_facet)], -1) for s in sets], 1)
    amplitude, length = np.asarray(found.amplitude), np.asarray(found.length)
    known = [
        {name.tobytes(): (a, x) for name, a, x in zip(*one, strict=True) if abs(a) > 0}
        for one in zip(names, amplitude, length, strict=True)
    ]
    strongest, seen, changes = np.abs(amplitude).max(), 0, {len(one) for one in known}
    for before, after in itertools.pairwise(known):
        for name in before if before.keys() == after.keys() else ():  # diffraction makes up for paths that appear and vanish
            (a, x), (b, y) = before[name], after[name]
            if abs(a) > 1e-3 * strongest:
                seen += 1
                assert abs(20 * np.log10(abs(b / a))) < 0.5
                turned = np.angle(b / a * np.exp(2j * np.pi * (y - x) * HZ / SPEED_OF_LIGHT))
                assert abs(turned) < 0.2
    assert seen > 1000 and len(changes) > 3
    power = 10 * np.log10((np.abs(amplitude) ** 2).sum(-1))
    assert np.ptp(power) > 5  # the line of sight is blocked in between


@pytest.mark.parametrize("count", [1, 2, 3, 4, 9])
def test_spectrograms_of_short_channels_and_windows_are_those_of_scipy(rng, count):
    """Neighbouring windows are at least one sample apart."""
    response = rng.normal(size=count) + 1j * rng.normal(size=count)
    for window in range(1, count + 1):
        hertz, times, power = doppler_spectrogram(jnp.asarray(response, jnp.complex64), 10.0, window)
        overlap = window - max(window // 4, 1)
        known = scipy_stft(response, 10.0, nperseg=window, noverlap=overlap, **WHOLE)
        np.testing.assert_allclose(hertz, np.fft.fftshift(known[0]), atol=1e-5)
        np.testing.assert_allclose(times, known[1], rtol=1e-5)
        np.testing.assert_allclose(10 ** (power / 10), np.fft.fftshift(np.abs(known[2]) ** 2, 0), rtol=1e-3, atol=1e-6)


def test_a_person_is_a_closed_body_with_its_measures():
    corners = person([1.0, 2.0, 0.5], azimuth=np.pi / 2)
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.5, 0.24, 1.75], atol=1e-12)
    np.testing.assert_allclose(corners.mean(0), [1, 2, 0.5 + 0.875], atol=1e-12)


def test_a_body_is_as_thick_as_its_smallest_width_however_it_is_turned():
    field, params, _ = field_of([box((0, 0, 0), (1, 1, 1))], (3, 0, 0), **SMALL)
    bodies = [add_body(field, params, person([2.0, 2.0, 0.0], azimuth=angle))[0] for angle in (0.0, np.pi / 4, 1.2)]
    thickness = [float(own.known_thickness[-1]) for own in bodies]
    np.testing.assert_allclose(thickness, thickness[0], rtol=1e-5)


@pytest.mark.heavy
def test_bodies_of_the_default_field_move_too():
    field = load_trained().field
    motion = make_movement(field, 3, {0: np.ones((3, 3))})
    np.testing.assert_array_equal(motion.shift[:, 0], 1)


def test_what_cannot_move():
    field, params, _ = field_of([box((0, 0, 0), (1, 1, 1))], (3, 0, 0), **SMALL)
    with pytest.raises(ValueError, match="no body 1; the field has 1"):
        make_movement(field, 4, {1: np.zeros((4, 3))})
    with pytest.raises(ValueError, match=r"expected \(4, 3\)"):
        make_movement(field, 4, {0: np.zeros((3, 3))})
    for permittivity, conductivity in ((0.9, 0.1), (1.0, 0.1), (np.nan, 0.1), (5.0, -1.0), (5.0, np.nan)):
        with pytest.raises(UserError, match="is no material"):
            add_body(field, params, person([2, 2, 0]), permittivity, conductivity)
    with pytest.raises(UserError, match="one plane"):
        add_body(field, params, np.eye(3))
    with pytest.raises(UserError, match="predicts only the receivers"):
        add_body(make_field(), make_params(), person([0, 0, 0]))
    with pytest.raises(UserError, match="traces no paths"):
        plan_movement(trained().field, trained().params, make_receiver(RX), TX, make_movement(field, 2))
