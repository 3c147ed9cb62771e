"""What paths carry, against closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import SPEED_OF_LIGHT, as_float64, box, field_of, rectangle, room

from wbgs_jax import channel, make_query
from wbgs_jax.array import planar_array
from wbgs_jax.fields import wave
from wbgs_jax.types import make_receiver
from wbgs_jax.wave.slab import complex_permittivity, slab_coefficients
from wbgs_jax.wave.transfer import element_gain

FREQUENCIES = [1e9, 10e9, 94e9]
BELOW = np.array([1, 1, -1])


def free_space(tx, rx, frequency, directivity=0.0):
    """Closed form for isotropic (or TR 38.901) vertical antennas."""
    offset = np.asarray(tx) - np.asarray(rx)
    distance, wavelength = np.linalg.norm(offset), SPEED_OF_LIGHT / frequency
    amplitude = wavelength / (4 * np.pi * distance) * np.exp(-2j * np.pi * distance / wavelength)
    if directivity:
        amplitude = amplitude * float(element_gain(jnp.asarray(offset / distance, jnp.float32)))
    return amplitude * np.exp(2j * np.pi * planar_array() @ (offset / distance))


def snapshot_of(params, plan, tx, frequency):
    return np.asarray(jax.jit(wave.snapshots)(params, plan, make_query(tx, frequency)))[0]


def assert_waves_equal(found, expected, amplitude=0.01, degrees=5.0):
    """The largest errors relative to the largest element: amplitude, and phase."""
    scale = np.abs(expected).max()
    assert np.abs(np.abs(found) - np.abs(expected)).max() < amplitude * scale
    strong = np.abs(expected) > 0.2 * scale
    assert np.abs(np.angle(found[strong] / expected[strong], deg=True)).max() < degrees


@pytest.mark.parametrize("directivity", [0.0, 1.0])
@pytest.mark.parametrize("frequency", FREQUENCIES)
def test_free_space(frequency, directivity, rng):
    rx, tx = rng.uniform(-1, 1, 3), rng.uniform(2, 4, 3)
    far = rectangle((100, 100, 100), (1, 0, 0), (0, 1, 0))  # a mesh needs a surface
    params, plan = field_of([far], rx, directivity=directivity, mirror_areas=())
    assert_waves_equal(snapshot_of(params, plan, tx, frequency), free_space(tx, rx, frequency, directivity), 1e-4, 2)


@pytest.mark.parametrize("frequency", FREQUENCIES)
@pytest.mark.parametrize("tiles", [1, 5])
def test_a_plate_of_tiles_is_a_mirror(frequency, tiles, rng):
    """Metal tiles reproduce the mirrored source in amplitude (<= 1 %) and phase (<= 5 degrees), wherever the seams are."""
    step = 40.0 / tiles
    corners = [(-20 + i * step, -20 + j * step, 0) for i in range(tiles) for j in range(tiles)]
    plate = [rectangle(corner, (step, 0, 0), (0, step, 0)) for corner in corners]
    rx, tx = (centre + rng.uniform(-1, 1, 3) for centre in np.array([[0, 0, 2], [3, 0, 2]]))
    params, plan = field_of(plate, rx, conductivity=1e7, mirror_areas=(0.0,))
    found = jax.tree.map(lambda leaf: leaf[0], jax.jit(wave.channels)(params, plan, make_query(tx, frequency)))
    mirrored = free_space(tx * BELOW, rx, frequency)
    # TM at a horizontal mirror with r = 1: theta-hat keeps its sense along the ray.
    (k,) = np.flatnonzero((np.abs(found.amplitude) > 0) & (np.asarray(found.length) > np.linalg.norm(tx - rx) * (1 + 1e-4)))
    only = jax.tree.map(lambda leaf: leaf[k : k + 1], found)
    assert_waves_equal(np.asarray(wave.snapshot(only, plan.receiver)), mirrored)


@pytest.mark.parametrize("frequency", FREQUENCIES)
def test_through_a_wall(frequency):
    wall = rectangle((1, -9, -9), (0, 18, 0), (0, 0, 18))
    params, plan = field_of([wall], (0, 0, 0), permittivity=2.73, conductivity=0.03, mirror_areas=())
    tx = np.array([3.0, 0.0, 0.0])  # normal incidence
    eps = complex_permittivity(jnp.array(2.73), jnp.array(0.03), jnp.array(frequency))
    through = slab_coefficients(jnp.array(1.0), eps, jnp.array(0.1), jnp.array(frequency)).transmit_te
    assert_waves_equal(snapshot_of(params, plan, tx, frequency), complex(through) * free_space(tx, np.zeros(3), frequency))


def test_two_rays_over_ground_follow_the_frequency():
    """The interference of the direct and the ground ray over the band: Fresnel for vertical polarisation."""
    ground = rectangle((-50, -50, 0), (100, 0, 0), (0, 100, 0))
    rx, tx = np.array([0, 0, 1.5]), np.array([4.0, 0.0, 1.0])
    params, plan = field_of([ground], rx, permittivity=5.0, conductivity=1.0, thickness=1.0, mirror_areas=(0.0,))
    for frequency in np.geomspace(1e9, 6e9, 7):
        cosine = 2.5 / np.linalg.norm(tx * BELOW - rx)
        eps = complex(complex_permittivity(jnp.array(5.0), jnp.array(1.0), jnp.array(frequency)))
        inner = np.sqrt(eps - 1 + cosine**2)
        r = (eps * cosine - inner) / (eps * cosine + inner)
        expected = free_space(tx, rx, frequency) + r * free_space(tx * BELOW, rx, frequency)
        assert_waves_equal(snapshot_of(params, plan, tx, frequency), expected)


def plain_only(params, plan, tx, frequency):
    traced = jax.tree.map(lambda leaf: leaf[0], wave.trace(params, plan, jnp.asarray(tx, jnp.float32)[None]))
    f = jnp.asarray(frequency, jnp.float32)
    search, slabs = plan.search, wave.slabs_at(params, plan, f)
    arrived = wave.arrivals(
        traced.plain, search.facets, search.edges, slabs, f, plan.receiver, params.directivity, diffracted=False
    )
    return np.asarray(wave.snapshot(arrived, plan.receiver))


def test_the_field_is_continuous_where_the_shadow_of_metal_begins():
    """Direct ray and diffraction together; without diffraction the sum jumps by the whole direct ray."""
    params, plan = field_of([box((1, -1, -3), (2, 1, 3))], (0, 0, 0), conductivity=1e7, mirror_areas=(0.0, 0.0))
    # The shadow of the front edge at x = y = 1 ends at y = x.
    below, above = (np.array([2.5, 2.5 + offset, 0.05]) for offset in (-2e-4, 2e-4))
    scale = np.abs(free_space(above, np.zeros(3), 5e9)).max()
    jumps = [np.abs(f(params, plan, above, 5e9) - f(params, plan, below, 5e9)).max() for f in (snapshot_of, plain_only)]
    assert jumps[0] < 0.03 * scale and jumps[1] > 0.8 * scale


def test_channels_are_reciprocal(rng):
    """One isotropic element each: both ends exchanged, the same voltage; reflections and walls included."""
    parts = [*room(), rectangle((3, 0, 0), (0, 2.5, 0), (0, 0, 3)), box((1, 1, 0.5), (2, 2, 1.2))]
    a, b = rng.uniform([0.3, 2.4, 1.4], [1.5, 3.6, 2.6]), rng.uniform([3.4, 0.4, 0.4], [5.6, 3.6, 2.6])
    voltages = []
    for rx, tx in ((a, b), (b, a)):
        params, _ = field_of(
            parts, rx, mirror_areas=(0.0, 0.0), plain_kept=512, diffracted_kept=1, diffracted_tried=1, survival=1e-9
        )
        plan = wave.plan(params, make_receiver(rx, element_positions=np.zeros((1, 3))))
        voltages.append(plain_only(params, plan, tx, 2.4e9)[0])
    np.testing.assert_allclose(voltages[0], voltages[1], rtol=1e-2)


def test_single_precision_is_enough_at_94_ghz(x64):
    """Paths of tens of metres are tens of thousands of radians."""
    params, plan = field_of(room((12.0, 9.0, 3.0)), (1, 1, 1.2))
    tx, frequency = jnp.asarray([[10.5, 7.5, 2.1]], jnp.float32), jnp.asarray([94e9], jnp.float32)
    single = wave.carry(params, plan, wave.trace(params, plan, tx), frequency)[0]
    wide, tx = as_float64((params, plan)), tx.astype(jnp.float64)
    precise = wave.carry(*wide, wave.trace(*wide, tx), frequency.astype(jnp.float64))[0]
    assert precise.dtype == jnp.complex128
    assert float(channel.correlation(single, precise)) > 0.999


@pytest.mark.parametrize("frequency", [1e9, 24e9, 100e9])
@pytest.mark.parametrize("height", [0.002, 0.5, 1.5])
def test_gradients_are_finite(frequency, height):
    """Over the band, and for transmitters close to a surface."""
    params, plan = field_of([*room(), box((2, 1, 0.5), (3, 2, 1.2))], (1, 1, 1.2))
    traced = wave.trace(params, plan, jnp.asarray([[4.0, 3.0, height]], jnp.float32))

    def loss(params):
        y = wave.carry(params, plan, traced, jnp.asarray([frequency], jnp.float32))
        return jnp.sum(wave.to_pas(y, plan.receiver) ** 2)

    gradients = jax.jit(jax.grad(loss))(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    assert np.abs(gradients.materials.log_susceptibility).max() > 0


def test_gradients_agree_with_finite_differences(x64):
    params, plan = as_float64(field_of([*room(), box((2, 1, 0.5), (3, 2, 1.2))], (1, 1, 1.2)))
    traced = wave.trace(params, plan, jnp.asarray([[4.0, 3.0, 1.0]]))

    def loss(materials):
        y = wave.carry(dataclasses.replace(params, materials=materials), plan, traced, jnp.asarray([3e9]))
        return 1e6 * jnp.sum(y.real**2 + 0.3 * y.imag * y.real)

    gradient = jax.grad(loss)(params.materials)
    for name in ("log_susceptibility", "log_conductivity", "slope", "log_thickness"):
        value, step = getattr(params.materials, name), 1e-6
        ends = [loss(dataclasses.replace(params.materials, **{name: value.at[0].add(sign * step)})) for sign in (1, -1)]
        np.testing.assert_allclose(getattr(gradient, name)[0], (ends[0] - ends[1]) / (2 * step), rtol=1e-4, atol=1e-7)
