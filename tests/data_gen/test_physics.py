"""The simulator against wave propagation in closed form, written here in float64 from ITU-R P.2040 and from textbooks.

Tolerances: Sionna RT computes in float32. A delay has a relative error of a few 2^-24, and its phase grows with the number of
wavelengths along the path: half a degree at 100 GHz over 10 m.
"""

import dataclasses
import itertools

import numpy as np
import pytest
import trimesh
from scipy.special import fresnel

from data_gen.scenes import get_scene
from data_gen.scenes.base import Part, SceneSpec, part
from data_gen.scenes.geometry import box
from data_gen.settings import ArraySettings, SolverSettings
from wbgs_jax.radio.array import SPEED_OF_LIGHT

pytestmark = pytest.mark.usefixtures("simulator_backend")

ISOTROPIC = ArraySettings(rows=1, columns=1, pattern="iso")
QUICK = SolverSettings(max_depth=1, samples_per_src=5000, max_paths_per_src=20_000, diffraction=False)
PERMITTIVITY = 8.8541878128e-12
"""Of the vacuum, F/m."""
BAND = (1e9, 5.3e9, 28e9, 94e9, 100e9)

# a, c, d of table 3 of ITU-R P.2040 for 1-100 GHz, where b is 0; and a usual thickness in metres.
MATERIALS = {
    "concrete": (5.24, 0.0462, 0.7822, 0.2),
    "plasterboard": (2.73, 0.0085, 0.9395, 0.1),
    "wood": (1.99, 0.0047, 1.0718, 0.03),
    "glass": (6.31, 0.0036, 1.3394, 0.008),
    "ceiling_board": (1.48, 0.0011, 1.0750, 0.02),
    "chipboard": (2.58, 0.0217, 0.7800, 0.02),
    "metal": (1.0, 1e7, 0.0, 0.002),
}


def simulate(parts, rx, tx, frequencies, settings=QUICK):
    """The paths by frequency, then by transmitter; antennas are vertical and isotropic."""
    from data_gen.solve import Simulator

    spec = SceneSpec("test", tuple(parts), rx_position=tuple(map(float, rx)), tx_grid=np.zeros((0, 3)))
    return Simulator(spec, settings, ISOTROPIC).paths(np.atleast_2d(tx), frequencies)


def sheet(normal_axis, material, kind="partition", size=60.0):
    """A large square sheet through the origin."""
    mesh = trimesh.Trimesh([(-size, -size, 0), (size, -size, 0), (size, size, 0), (-size, size, 0)], [(0, 1, 2), (0, 2, 3)])
    mesh.vertices = np.roll(mesh.vertices, normal_axis + 1, axis=1)
    return Part("sheet", mesh, material, MATERIALS[material][3], kind)


def single(*values):
    """Numbers that float32 holds exactly, so that the positions are not rounded."""
    return np.array(values, np.float32).astype(np.float64)


def wave(frequency, distance):
    """What an isotropic antenna receives in free space (Friis), relative to what was sent."""
    wavelength = SPEED_OF_LIGHT / frequency
    return wavelength / (4 * np.pi * distance) * np.exp(-2j * np.pi * np.mod(distance / wavelength, 1))


def phase_error(frequency, distance):
    """Radians that a float32 delay leaves open."""
    return 2 * np.pi * frequency * distance / SPEED_OF_LIGHT * 4 * 2**-24


def slab(material, frequency, incidence):
    """Reflection and transmission (TE, TM each) of a slab (ITU-R P.2040): a piece of transmission line in another one.

    TE: the electric field is across the plane of incidence. Of TM the coefficients are those of the magnetic field.
    """
    a, c, d, thickness = MATERIALS[material]
    eta = a - 1j * c * (frequency / 1e9) ** d / (2 * np.pi * frequency * PERMITTIVITY)
    cosine, root = np.cos(incidence), np.sqrt(eta - np.sin(incidence) ** 2)
    # The electrical thickness, and the impedance relative to that of the air, both along the normal.
    q = 2 * np.pi * frequency * thickness / SPEED_OF_LIGHT * root
    impedance = np.array([cosine / root, root / (eta * cosine)])
    sign = np.array([1, -1])
    if q.imag < -100:  # nothing comes back from the other side
        return sign * (impedance - 1) / (impedance + 1), np.zeros(2)
    both = 2 * np.cos(q) + 1j * np.sin(q) * (impedance + 1 / impedance)
    return sign * 1j * np.sin(q) * (impedance - 1 / impedance) / both, 2 / both


TE, TM = 0, 1


@pytest.mark.parametrize("polarisation", [TE, TM], ids=["TE", "TM"])
@pytest.mark.parametrize("material", MATERIALS)
def test_a_sheet_is_the_slab_of_p2040(material, polarisation, rng):
    from data_gen.solve import FAINT

    # Vertical antennas: an upright wall (normal y) and a horizontal way are TE, a floor (normal z) is TM.
    axis = 1 + polarisation
    height = float(single(rng.uniform(1, 3))[0])
    rx = np.eye(3)[axis] * height
    angles = rng.uniform(np.radians([2, 25, 50, 70]), np.radians([25, 50, 70, 80]))
    same_side, depth = rng.uniform(0.5, 3, (2, 4))
    normal = np.concatenate([same_side, -depth])
    along = np.concatenate([np.tan(angles) * (height + same_side), np.tan(angles) * (height + depth)])
    tx = single(*along)[:, None] * np.eye(3)[0] + single(*normal)[:, None] * np.eye(3)[axis]
    for frequency, found in zip(BAND, simulate([sheet(axis, material)], rx, tx, BAND), strict=True):
        for position, paths in zip(tx, found, strict=True):
            reflection = position[axis] > 0
            # The sheet is a plane: a path through it is straight, one back comes from the image behind it.
            end = rx * np.where(np.arange(3) == axis, -1, 1) if reflection else rx
            length = np.linalg.norm(position - end)
            incidence = np.arccos(abs(position[axis] - end[axis]) / length)
            expected = slab(material, frequency, incidence)[0 if reflection else 1][polarisation]
            amplitude = abs(expected * wave(frequency, length))
            if amplitude < 2 * FAINT:  # left out, or on the border
                assert amplitude > FAINT / 2 or not paths.order.any()
                continue
            (one,) = np.flatnonzero(paths.order == 1)
            np.testing.assert_allclose(paths.delays[one], length / SPEED_OF_LIGHT, rtol=1e-6)
            error = abs(paths.coefficients[one, 0] / wave(frequency, length) - expected)
            where = f"{frequency / 1e9:g} GHz, incidence {np.degrees(incidence):.1f} degrees"
            assert error < (1e-3 + phase_error(frequency, length)) * (1 if reflection else abs(expected)), where


def test_two_rays_fade_as_the_closed_form():
    tx, rx = np.array([0, 0, 3.0]), np.array([25.0, 1, 2])
    frequencies = (*np.linspace(1e9, 3e9, 21).tolist(), 10e9, 37e9, 60e9)
    direct, reflected = np.linalg.norm(tx - rx), np.linalg.norm(tx - rx * [1, 1, -1])
    incidence = np.arccos((tx[2] + rx[2]) / reflected)
    scale = np.array([wave(f, direct) for f in frequencies])
    floor = [slab("concrete", f, incidence)[0][TM] * wave(f, reflected) for f in frequencies]
    found = [paths.coefficients.sum() for (paths,) in simulate([sheet(2, "concrete")], rx, tx, frequencies)]
    fading = np.abs(found / scale)[:21]
    assert fading.max() > 1.3 and fading.min() < 0.7
    np.testing.assert_allclose(found / scale, 1 + floor / scale, atol=2e-3 + phase_error(max(frequencies), reflected))


def images(size, tx, rx, max_order):
    """Order, length, and shortest segment of every way between two points in an empty box from the origin to `size`.

    Image m along an axis is |m| reflections away: at m L + x for even m, at m L + (L - x) for odd m. On the straight way to
    it, the walls are the planes at whole multiples of L.
    """
    for m in map(np.array, itertools.product(range(-max_order, max_order + 1), repeat=3)):
        if abs(m).sum() > max_order:
            continue
        way = m * size + np.where(m % 2, size - tx, tx) - rx
        planes = [(axis, k * size[axis]) for axis in range(3) for k in range(min(0, m[axis] + 1), max(1, m[axis] + 1))]
        crossed = [(plane - rx[axis]) / way[axis] for axis, plane in planes]
        inside = sorted(t for t in crossed if 0 < t < 1)
        assert len(inside) == abs(m).sum()
        yield len(inside), np.linalg.norm(way), np.diff([0, *inside, 1]).min() * np.linalg.norm(way)


@pytest.mark.parametrize("material", ["metal", "concrete"])
def test_a_closed_room_has_the_images_of_a_shoebox(material, rng):
    size = np.array([5.0, 4.0, 3.0])
    while True:
        tx, rx = single(*rng.uniform(0.5, size - 0.5)), single(*rng.uniform(0.5, size - 0.5))
        order, lengths, shortest = np.array(list(images(size, tx, rx, 3))).T
        if (
            shortest.min() > 0.011
        ):  # Sionna RT drops paths with a segment below a centimetre: 1 in 200 here, beside the room's edges
            break
    assert [int((order == n).sum()) for n in range(4)] == [1, 6, 18, 38]
    room = part("room", box((0, 0, 0), (5, 4, 3)), material, kind="shell")
    ((paths,),) = simulate([room], rx, tx, (5e9,), dataclasses.replace(QUICK, max_depth=3, samples_per_src=50_000))
    for n in range(4):
        found, expected = paths.delays[paths.order == n] * SPEED_OF_LIGHT, np.sort(lengths[order == n])
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def swapped(parts, ends, others, frequency, settings):
    """Paths from every one of `others` to `ends`, and back."""
    (there,) = simulate(parts, ends, others, (frequency,), settings)
    back = [simulate(parts, other, ends, (frequency,), settings)[0][0] for other in others]
    return zip(there, back, strict=True)


def test_sender_and_receiver_can_be_exchanged_in_a_furnished_room():
    spec = get_scene(1)
    settings = dataclasses.replace(QUICK, max_depth=2, samples_per_src=50_000)
    for there, back in swapped(spec.parts, single(*spec.rx_position), spec.accessible_tx()[[100, 333, 700]], 2.4e9, settings):
        assert len(there.delays) == len(back.delays) > 15
        np.testing.assert_allclose(there.delays, back.delays, rtol=1e-6)
        strength = np.linalg.norm(there.coefficients)
        assert abs(there.coefficients.sum() - back.coefficients.sum()) < 2e-3 * strength


# Diffraction. The wedge is a filled quarter of space, u > 0 and v < 0; its edge is u = v = 0. Angles are counted from the face
# u = 0 round through free space to the face v = 0 at 270 degrees.

OPENING = 1.5
"""Of the free space, in half turns."""


def around(radius, degrees):
    """(u, v) of a point at an angle."""
    return -radius * np.sin(np.radians(degrees)), -radius * np.cos(np.radians(degrees))


def utd(frequency, source, observer, hard, rise=0.0):
    """Field behind a perfectly conducting wedge (Kouyoumjian and Pathak 1974), relative to what an isotropic source sent.

    `source` and `observer` are (radius, degrees), `rise` their distance along the edge. The hard field is the magnetic one.
    """
    k = 2 * np.pi * frequency / SPEED_OF_LIGHT
    radii = source[0] + observer[0]
    length = np.hypot(radii, rise)
    sine = radii / length  # of the angle between the ray and the edge
    near, far = source[0] / sine, observer[0] / sine
    distance = near * far / length * sine**2

    def term(sign, beta):
        turns = np.round((sign * np.pi + beta) / (2 * np.pi * OPENING))
        x = k * distance * 2 * np.cos((2 * np.pi * OPENING * turns - beta) / 2) ** 2
        sine_integral, cosine_integral = fresnel(np.sqrt(2 * x / np.pi))
        tail = np.sqrt(np.pi / 2) * (0.5 - cosine_integral - 1j * (0.5 - sine_integral))
        return 2j * np.sqrt(x) * np.exp(1j * x) * tail / np.tan((np.pi + sign * beta) / (2 * OPENING))

    minus, plus = (np.radians(observer[1] - source[1]), np.radians(observer[1] + source[1]))
    terms = term(1, minus) + term(-1, minus) + (1 if hard else -1) * (term(1, plus) + term(-1, plus))
    coefficient = -np.exp(-1j * np.pi / 4) / (2 * OPENING * np.sqrt(2 * np.pi * k) * sine) * terms
    return wave(frequency, length) * length / near * coefficient * np.sqrt(near / (far * length))


def wedge(material, hard):
    """The wedge, 20 m long: upright for vertical antennas to be parallel to its edge (soft), lying for hard."""
    low, high = ((0, -10, -6), (6, 10, 0)) if hard else ((0, -6, -10), (6, 0, 10))
    return part("wedge", box(low, high), material)


def places(points, hard):
    """World positions of points (radius, degrees) around the edge."""
    u, v = np.transpose([around(*point) for point in points])
    return np.float32(np.stack([u, 0 * u, v] if hard else [u, v, 0 * u], -1)).astype(np.float64)


DIFFRACTION = dataclasses.replace(QUICK, diffraction=True, samples_per_src=20_000)


@pytest.mark.parametrize("hard", [False, True], ids=["soft", "hard"])
def test_a_metal_edge_diffracts_as_utd(hard, rng):
    rx = (3.0, rng.uniform(40, 60))
    # Clear of the boundaries at 120 to 140 and 220 to 240 degrees, where another path is as long.
    windows = [(20, 60), (60, 110), (145, 180), (180, 215), (245, 255), (255, 265)]
    tx = list(zip(rng.uniform(2, 5, len(windows)), rng.uniform(*np.transpose(windows)), strict=True))
    frequencies = (1e9, 28e9)
    found = simulate([wedge("metal", hard)], *places([rx], hard), places(tx, hard), frequencies, DIFFRACTION)
    for frequency, by_tx in zip(frequencies, found, strict=True):
        for point, paths in zip(tx, by_tx, strict=True):
            length = rx[0] + point[0]
            (one,) = np.flatnonzero((paths.order == 1) & (abs(paths.delays * SPEED_OF_LIGHT / length - 1) < 1e-6))
            # Where the wave turns back along x, its upright electric field has the other sign than its magnetic field.
            sign = -1 if hard and point[1] < 180 else 1
            expected = sign * utd(frequency, point, rx, hard)
            error = abs(paths.coefficients[one, 0] - expected)
            assert error < 0.01 * abs(expected) + 1e-4 * abs(wave(frequency, length)), (frequency, point, rx)


@pytest.mark.parametrize(
    ("material", "hard", "boundary"),
    [
        ("metal", False, 1),
        ("metal", True, 1),
        ("metal", False, -1),
        ("metal", True, -1),
        ("concrete", False, -1),
    ],
)
def test_the_field_is_continuous_where_rays_end(material, hard, boundary, rng):
    # The direct ray ends 180 degrees past the source, the reflected one 180 degrees past its image.
    rx = (3.0, rng.uniform(40, 60))
    tx = [(4.0, 180 + boundary * rx[1] + side) for side in (-0.002, 0.002)]
    ((before, after),) = simulate([wedge(material, hard)], *places([rx], hard), places(tx, hard), (1e9,), DIFFRACTION)
    lost = np.abs(before.coefficients).sum() - np.abs(after.coefficients).sum()
    assert lost > 0.1 * np.abs(before.coefficients).max()  # a ray does end
    # Half a millimetre apart: the phases differ by a hundredth.
    assert abs(before.coefficients.sum() - after.coefficients.sum()) < 0.02 * np.abs(before.coefficients).max()


@pytest.mark.parametrize("depth", [2, 4])
@pytest.mark.parametrize("turned", [False, True], ids=["reflection-first", "diffraction-first"])
def test_an_edge_over_a_floor_diffracts_to_the_image(depth, turned):
    floor = sheet(2, "metal", "shell")
    floor.mesh.apply_translation((0, 0, -1))
    ends = [(3.6, 34.0), (3.2, 252.0)]
    (tx, rx), heights = places(ends, False), np.array([0.0, 0.25])
    tx[2], rx[2] = heights
    expected = utd(1e9, *ends, False, rise=heights.sum() + 2)
    if turned:
        tx, rx = rx, tx
    # The room for more interactions than the path has must not matter.
    ((paths,),) = simulate([wedge("metal", False), floor], rx, tx, (1e9,), dataclasses.replace(DIFFRACTION, max_depth=depth))
    (one,) = np.flatnonzero(paths.order == 2)
    # Behind an edge, Sionna RT starts its rays a millimetre away from it.
    assert abs(paths.coefficients[one, 0] / expected - 1) < 0.01


def test_sender_and_receiver_can_be_exchanged_around_a_corner():
    room = part("room", box((0, 0, 0), (6, 5, 3)), "concrete", kind="shell")
    cabinet = part("cabinet", box((2.5, 1.5, 0.01), (3.3, 3.2, 1.9)), "metal")
    others = np.array([single(*p) for p in [(1.1, 2.3, 1.0), (0.7, 1.2, 2.2), (1.9, 3.9, 1.6), (1.6, 0.6, 0.7)]])
    settings = dataclasses.replace(DIFFRACTION, max_depth=2, samples_per_src=50_000)
    for there, back in swapped([room, cabinet], single(5.1, 3.9, 1.2), others, 2.4e9, settings):
        strength = np.linalg.norm(there.coefficients)
        assert abs(there.coefficients.sum() - back.coefficients.sum()) < 0.01 * strength
