"""The wave on paths, against closed forms."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import (
    METAL,
    SPEED_OF_LIGHT,
    arrivals_of,
    as_float64,
    box,
    rectangle,
    room,
    search_of,
    slabs_of,
    snapshot_of,
    snapshot_over,
    trace,
)

from wbgs_jax.propagation.materials import Slabs, complex_permittivity, slab_coefficients
from wbgs_jax.propagation.paths import TracedPaths
from wbgs_jax.propagation.transport import _across, element_voltages, snapshots_from_paths
from wbgs_jax.radio import channel
from wbgs_jax.radio.antenna import Antenna, element_gain
from wbgs_jax.radio.array import planar_array, snapshot_to_pas
from wbgs_jax.types import make_receiver

FREQUENCIES = [1e9, 10e9, 94e9]
BELOW = np.array([1, 1, -1])


def free_space(tx, rx, frequency, pattern="iso"):
    """Closed form for isotropic (or TR 38.901) vertical antennas."""
    offset = np.asarray(tx) - np.asarray(rx)
    distance, wavelength = np.linalg.norm(offset), SPEED_OF_LIGHT / frequency
    amplitude = wavelength / (4 * np.pi * distance) * np.exp(-2j * np.pi * distance / wavelength)
    if pattern == "tr38901":
        amplitude = amplitude * float(element_gain(jnp.asarray(offset / distance, jnp.float32)))
    return amplitude * np.exp(2j * np.pi * planar_array() @ (offset / distance))


def assert_waves_equal(found, expected, amplitude=0.01, degrees=5.0):
    """The largest errors relative to the largest element: amplitude, and phase."""
    scale = np.abs(expected).max()
    assert np.abs(np.abs(found) - np.abs(expected)).max() < amplitude * scale
    strong = np.abs(expected) > 0.2 * scale
    assert np.abs(np.angle(found[strong] / expected[strong], deg=True)).max() < degrees


@pytest.mark.heavy
@pytest.mark.parametrize("pattern", ["iso", "tr38901"])
@pytest.mark.parametrize("frequency", FREQUENCIES)
def test_free_space(frequency, pattern, rng):
    rx, tx = rng.uniform(-1, 1, 3), rng.uniform(2, 4, 3)
    far = rectangle((100, 100, 100), (1, 0, 0), (0, 1, 0))  # a mesh needs a surface
    search, receiver = search_of([far], rx, mirror_areas=()), make_receiver(rx, pattern=pattern)
    assert_waves_equal(snapshot_of(search, tx, frequency, receiver), free_space(tx, rx, frequency, pattern), 1e-4, 2)


@pytest.mark.heavy
@pytest.mark.parametrize("frequency", FREQUENCIES)
@pytest.mark.parametrize("tiles", [1, 5])
def test_a_plate_of_tiles_is_a_mirror(frequency, tiles, rng):
    """Metal tiles reproduce the mirrored source in amplitude (<= 1 %) and phase (<= 5 degrees), wherever the seams are."""
    step = 40.0 / tiles
    corners = [(-20 + i * step, -20 + j * step, 0) for i in range(tiles) for j in range(tiles)]
    plate = [rectangle(corner, (step, 0, 0), (0, step, 0)) for corner in corners]
    rx, tx = (centre + rng.uniform(-1, 1, 3) for centre in np.array([[0, 0, 2], [3, 0, 2]]))
    search, receiver = search_of(plate, rx, mirror_areas=(0.0,)), make_receiver(rx)
    slabs = slabs_of(search, frequency, conductivity=METAL)
    found = arrivals_of(search, trace(search, tx), slabs, receiver, jnp.float32(frequency))
    mirrored = free_space(tx * BELOW, rx, frequency)
    # TM at a horizontal mirror with r = 1: theta-hat keeps its sense along the ray.
    (k,) = np.flatnonzero((np.abs(found.amplitude) > 0) & (np.asarray(found.length) > np.linalg.norm(tx - rx) * (1 + 1e-4)))
    only = jax.tree.map(lambda leaf: leaf[k : k + 1], found)
    assert_waves_equal(np.asarray(snapshots_from_paths(only, receiver, jnp.float32(frequency))), mirrored)


@pytest.mark.parametrize("frequency", FREQUENCIES)
def test_through_a_wall(frequency):
    wall = rectangle((1, -9, -9), (0, 18, 0), (0, 0, 18))
    search = search_of([wall], (0, 0, 0), mirror_areas=())
    tx = np.array([3.0, 0.0, 0.0])  # normal incidence
    eps = complex_permittivity(jnp.array(2.73), jnp.array(0.03), jnp.array(frequency))
    through = slab_coefficients(jnp.array(1.0), eps, jnp.array(0.1), jnp.array(frequency)).transmit_te
    found = snapshot_of(search, tx, frequency, permittivity=2.73, conductivity=0.03)
    assert_waves_equal(found, complex(through) * free_space(tx, np.zeros(3), frequency))


def test_two_rays_over_ground_follow_the_frequency():
    """The interference of the direct and the ground ray over the band: Fresnel for vertical polarisation."""
    ground = rectangle((-50, -50, 0), (100, 0, 0), (0, 100, 0))
    rx, tx = np.array([0, 0, 1.5]), np.array([4.0, 0.0, 1.0])
    search = search_of([ground], rx, mirror_areas=(0.0,))
    for frequency in np.geomspace(1e9, 6e9, 7):
        cosine = 2.5 / np.linalg.norm(tx * BELOW - rx)
        eps = complex(complex_permittivity(jnp.array(5.0), jnp.array(1.0), jnp.array(frequency)))
        inner = np.sqrt(eps - 1 + cosine**2)
        r = (eps * cosine - inner) / (eps * cosine + inner)
        expected = free_space(tx, rx, frequency) + r * free_space(tx * BELOW, rx, frequency)
        found = snapshot_of(search, tx, frequency, permittivity=5.0, conductivity=1.0, thickness=1.0)
        assert_waves_equal(found, expected)


def specular_only(search, tx, frequency, receiver=None, kept=128, **slab):
    """The snapshot without diffraction."""
    traced = trace(search, tx, specular=(512, kept))
    dark = dataclasses.replace(traced.diffracted, alive=jnp.zeros_like(traced.diffracted.alive))
    return snapshot_over(search, TracedPaths((traced.specular, dark)), frequency, receiver, **slab)


@pytest.mark.heavy
def test_the_field_is_continuous_where_the_shadow_of_metal_begins():
    """Direct ray and diffraction together; without diffraction the sum jumps by the whole direct ray."""
    search = search_of([box((1, -1, -3), (2, 1, 3))], (0, 0, 0), mirror_areas=(0.0, 0.0))
    # The shadow of the front edge at x = y = 1 ends at y = x.
    below, above = (np.array([2.5, 2.5 + offset, 0.05]) for offset in (-2e-4, 2e-4))
    scale = np.abs(free_space(above, np.zeros(3), 5e9)).max()
    jumps = []
    for wave_at in (snapshot_of, specular_only):
        ends = [wave_at(search, tx, 5e9, conductivity=METAL) for tx in (above, below)]
        jumps.append(np.abs(ends[0] - ends[1]).max())
    assert jumps[0] < 0.03 * scale and jumps[1] > 0.8 * scale


@pytest.mark.heavy
def test_channels_are_reciprocal(rng):
    """One isotropic element each: both ends exchanged, the same voltage; reflections and walls included."""
    parts = [*room(), rectangle((3, 0, 0), (0, 2.5, 0), (0, 0, 3)), box((1, 1, 0.5), (2, 2, 1.2))]
    a, b = rng.uniform([0.3, 2.4, 1.4], [1.5, 3.6, 2.6]), rng.uniform([3.4, 0.4, 0.4], [5.6, 3.6, 2.6])
    voltages = []
    for rx, tx in ((a, b), (b, a)):
        search = search_of(parts, rx, mirror_areas=(0.0, 0.0))
        receiver = make_receiver(rx, element_positions=np.zeros((1, 3)))
        voltages.append(specular_only(search, tx, 2.4e9, receiver, kept=512)[0])
    np.testing.assert_allclose(voltages[0], voltages[1], rtol=1e-2)


@pytest.mark.heavy
def test_an_array_in_metres_is_one_in_wavelengths(rng):
    """At every frequency, and not the same array at two of them."""
    search = search_of(room(), (1, 1, 1.2), mirror_areas=(0.0,))
    elements, tx = planar_array(3, 2, 0.4) + rng.normal(0, 0.05, (6, 3)), rng.uniform([2, 2, 0.5], [5, 3, 2.5])
    metres = make_receiver((1, 1, 1.2), element_positions=elements * SPEED_OF_LIGHT / 5e9, unit="metres")
    for frequency in (2.5e9, 5e9, 28e9):
        wavelengths = make_receiver((1, 1, 1.2), element_positions=elements * frequency / 5e9)
        found, expected = (snapshot_of(search, tx, frequency, receiver) for receiver in (metres, wavelengths))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * np.abs(expected).max())
    same_wavelengths = snapshot_of(search, tx, 28e9, make_receiver((1, 1, 1.2), element_positions=elements))
    assert np.abs(same_wavelengths - expected).max() > 0.1 * np.abs(expected).max()


def test_a_transmitter_may_have_no_paths():
    """Behind six sheets: nothing arrives, and nothing of it is undefined."""
    search = search_of([rectangle((x, -9, -9), (0, 18, 0), (0, 0, 18)) for x in range(1, 7)], (0, 0, 0), mirror_areas=())
    assert np.array_equal(snapshot_of(search, (8, 0.1, 0.2), 1e9), np.zeros(16))


@pytest.mark.heavy
def test_single_precision_is_enough_at_94_ghz(x64):
    """Paths of tens of metres are tens of thousands of radians."""
    search, receiver = search_of(room((12.0, 9.0, 3.0)), (1, 1, 1.2)), make_receiver((1, 1, 1.2))
    single = snapshot_of(search, (10.5, 7.5, 2.1), 94e9, receiver)
    tx = np.asarray((10.5, 7.5, 2.1), np.float32)  # what single precision makes of it
    precise = snapshot_of(as_float64(search), tx, 94e9, as_float64(receiver))
    assert single.dtype == np.complex64 and precise.dtype == np.complex128
    assert float(channel.correlation(jnp.asarray(single), jnp.asarray(precise))) > 0.999


class Materials(NamedTuple):
    """What a field may learn of every material."""

    log_susceptibility: jax.Array
    log_conductivity: jax.Array
    slope: jax.Array
    log_thickness: jax.Array


FURNISHED = [*room(), box((2, 1, 0.5), (3, 2, 1.2))]


def materials_of(search):
    """Permittivity 4, 0.02 S/m at all frequencies, 0.1 m, of every material."""
    values = np.log(3.0), np.log(0.02), 0.0, np.log(0.1)
    return Materials(*(jnp.full(len(FURNISHED), value, search.receiver_position.dtype) for value in values))


def voltages(materials, search, traced, receiver, frequency):
    """The snapshot as a function of the materials."""
    sigma = jnp.exp(materials.log_conductivity + materials.slope * jnp.log(frequency / 1e9))
    eps = complex_permittivity(1 + jnp.exp(materials.log_susceptibility), sigma, frequency)
    slabs = Slabs(eps[search.facets.material], jnp.exp(materials.log_thickness)[search.facets.material])
    return snapshots_from_paths(arrivals_of(search, traced, slabs, receiver, frequency), receiver, frequency)


@jax.jit
@jax.grad
def gradients_of_a_spectrum(materials, search, traced, receiver, frequency):
    """Of the sum of its squares, with respect to the materials."""
    y = voltages(materials, search, traced, receiver, frequency)
    y = y / jnp.sqrt(jnp.sum(channel.squared_magnitude(y)) + 1e-30)
    return jnp.sum(snapshot_to_pas(y, receiver.element_positions) ** 2)


@pytest.mark.heavy
@pytest.mark.parametrize("frequency", [1e9, 24e9, 100e9])
@pytest.mark.parametrize("height", [0.002, 0.5, 1.5])
def test_gradients_are_finite(frequency, height):
    """Over the band, and for transmitters close to a surface."""
    search, receiver = search_of(FURNISHED, (1, 1, 1.2)), make_receiver((1, 1, 1.2))
    traced = trace(search, (4.0, 3.0, height))
    gradients = gradients_of_a_spectrum(materials_of(search), search, traced, receiver, jnp.float32(frequency))
    assert all(np.isfinite(leaf).all() for leaf in gradients)
    assert np.abs(gradients.log_susceptibility).max() > 0


@jax.jit
@jax.value_and_grad
def quadratic_form(materials, search, traced, receiver, frequency):
    """Of the voltages, and its gradient with respect to the materials."""
    y = voltages(materials, search, traced, receiver, frequency)
    return 1e6 * jnp.sum(y.real**2 + 0.3 * y.imag * y.real)


@pytest.mark.slow
def test_gradients_agree_with_finite_differences(x64):
    """Of the materials alone; `tests/fields/test_gradients.py` has all leaves of the field."""
    search, receiver = as_float64((search_of(FURNISHED, (1, 1, 1.2)), make_receiver((1, 1, 1.2))))
    rest, materials = (search, trace(search, (4.0, 3.0, 1.0)), receiver, jnp.asarray(3e9)), materials_of(search)
    _, gradient = quadratic_form(materials, *rest)
    for name in materials._fields:
        value, step = getattr(materials, name), 1e-6
        moved = [materials._replace(**{name: value.at[0].add(sign * step)}) for sign in (1, -1)]
        ends = [quadratic_form(one, *rest)[0] for one in moved]
        np.testing.assert_allclose(getattr(gradient, name)[0], (ends[0] - ends[1]) / (2 * step), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("frequency", FREQUENCIES[:1])
def test_free_space_between_turned_antennas(frequency, rng):
    """Friis, with the field of either antenna in the direction of the other."""
    rx, tx = rng.uniform(-1, 1, 3), rng.uniform(2, 4, 3)
    antennas = [
        Antenna(jnp.asarray(q, jnp.float32), jnp.asarray(e)) for q, e in zip(rng.normal(size=(2, 4)), np.eye(2), strict=True)
    ]
    search = search_of([rectangle((100, 100, 100), (1, 0, 0), (0, 1, 0))], rx, mirror_areas=())
    found = snapshot_of(search, tx, frequency, make_receiver(rx), antennas)
    towards = (tx - rx) / np.linalg.norm(tx - rx)
    sent, taken = (a.field(jnp.asarray(k, jnp.float32)) for a, k in zip(antennas, (-towards, towards), strict=True))
    isotropic = free_space(tx, rx, frequency)
    np.testing.assert_allclose(found, isotropic * float(jnp.dot(sent, taken)), atol=0.02 * np.abs(isotropic).max())


def test_curved_waves_are_those_of_a_point_source_and_plane_ones_their_limit(rng, x64):
    """Against exp(-jkr) / r at every element of an array half a metre wide."""
    frequency, elements = 1.3e9, rng.uniform(-0.25, 0.25, (16, 3))
    receiver = make_receiver((0.0, 0.0, 0.0), element_positions=elements, unit="metres")
    for far in (1.0, 3000.0):
        direction = rng.normal(size=(5, 3))
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        k = 2 * np.pi * frequency / SPEED_OF_LIGHT
        arrived = channel.Paths(*map(jnp.asarray, (np.exp(-1j * k * far) / far * np.ones(5), direction, np.full(5, far))))
        distance = np.linalg.norm(far * direction[:, None] - elements, axis=-1)
        exact = np.exp(-1j * k * distance) / distance
        curved = element_voltages(arrived, receiver, jnp.asarray(frequency), 1.0)
        plane = np.asarray(element_voltages(arrived, receiver, jnp.asarray(frequency)))
        np.testing.assert_allclose(curved, exact, atol=1e-5 * np.abs(exact).max())
        error = np.abs(plane - exact).max() / np.abs(exact).max()
        assert error > 0.2 if far < 10 else error < 2e-3


@pytest.mark.heavy
def test_gradients_on_the_line_of_an_edge_are_finite(rng):
    """Above the corner of a table at round coordinates; nothing is diffracted along its edge."""
    rx, frequency = (3.0, 0.4, 1.3), jnp.float32(5e9)
    search, receiver = search_of([box((0, 0, 0), (1, 1, 1))], rx), make_receiver(rx)

    @jax.jit
    @jax.value_and_grad
    def power(tx):
        found = arrivals_of(search, trace(search, tx, (8, 8), (32, 32)), slabs_of(search, frequency), receiver, frequency)
        return channel.received_power_db(snapshots_from_paths(found, receiver, frequency))

    for place in ([1.0, 1.0, 1.5], [0.0, 1.0, 2.0], [1.0, 2.0, 1.0], rng.uniform(1.5, 2.5, 3)):
        value, slope = power(jnp.asarray(place, jnp.float32))
        assert np.isfinite(value) and np.isfinite(slope).all() and slope.any(), place


def test_straight_through_a_plate_of_any_direction(rng):
    """Also where the normal is the same in x, y and z, in which no axis is any other."""
    for normal in (np.ones(3), rng.normal(size=3), np.eye(3)[rng.integers(3)]):
        normal = jnp.asarray(normal / np.linalg.norm(normal), jnp.float32)[None]
        across = _across(normal, normal)[0]
        assert float(jnp.linalg.norm(across)) == pytest.approx(1, abs=1e-5)
        assert float(across @ normal[0]) == pytest.approx(0, abs=1e-5)
