"""A metal plate against its mirror image, the radar equation of a flat plate, and a field whose mesh holds the same plate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.mirrors import Blind
from builders.rooms import METAL, SPEED_OF_LIGHT, field_of, rectangle

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.antenna_placement import power_at_users
from wbgs_jax.applications.reflector import make_reflector, place_reflector, plate_axes, straight_powers

HZ = 10e9
WAVELENGTH = SPEED_OF_LIGHT / HZ
TX, USER = np.array([0.0, 0.0, 1.5]), np.array([4.0, 0.0, 1.5])
BOX = np.array([[0.5, 1.0, 1.2], [3.5, 3.0, 1.8]])
SMALL = {"mirror_areas": (0.0,), "specular_tried": 16, "specular_kept": 16, "diffracted_tried": 4, "diffracted_kept": 4}


def friis(metres):
    return -20 * np.log10(4 * np.pi * metres / WAVELENGTH)


def pose(*numbers):
    return jnp.asarray([numbers], jnp.float32)


FACING = pose(2, 2, 1.5, -np.pi / 2, 0)
"""Half way between the ends, 2 m aside, and looking back at them."""


def test_a_large_plate_is_a_mirror():
    plate = make_reflector(TX, USER, (4.0, 4.0), HZ)
    assert float(plate.power_db(FACING)[0, 0]) == pytest.approx(friis(np.hypot(4, 4)), abs=0.02)


def test_a_small_plate_obeys_the_radar_equation():
    plate = make_reflector(TX, USER, (0.02, 0.015), HZ)
    leg, cosine = np.hypot(2, 2), np.sqrt(0.5)
    expected = 20 * np.log10(0.02 * 0.015 * cosine / (4 * np.pi * leg**2))
    assert float(plate.power_db(FACING)[0, 0]) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("degrees", [0, 45, 60, 75])
@pytest.mark.parametrize("turn", [0, 30, 45, 90])
def test_of_slanted_waves_a_small_plate_reflects_its_projected_area(degrees, turn):
    """Relative to a large plate in its place, A cos(theta) / (wavelength times the focal length); whichever way it is slanted,
    and of whichever shape."""
    legs, theta, phi = np.array([3.0, 2.0]), np.radians(degrees), np.radians(turn)
    normal, level, up = (np.asarray(axis) for axis in plate_axes(jnp.zeros(2)))
    aside = np.sin(theta) * (np.cos(phi) * level + np.sin(phi) * up)
    tx, user = legs[0] * (np.cos(theta) * normal + aside), legs[1] * (np.cos(theta) * normal - aside)
    expected = 20 * np.log10(0.02 * 0.015 * np.cos(theta) / WAVELENGTH / (legs.prod() / legs.sum()))
    small, turned, large = (
        float(make_reflector(tx, user, size, HZ).power_db(jnp.zeros((1, 5)))[0, 0])
        for size in ((0.02, 0.015), (0.015, 0.02), (40.0, 40.0))
    )
    assert small - large == pytest.approx(expected, abs=0.1) == turned - large


def test_at_the_edge_of_a_plate_half_of_the_amplitude_is_left_and_behind_it_nothing():
    plate = make_reflector(TX, USER, (2.0, 4.0), HZ)
    over = plate.power_db(jnp.concatenate([FACING, FACING.at[:, 0].add(1.0), FACING.at[:, 0].add(2.0)]))[:, 0]
    assert float(over[0] - over[1]) == pytest.approx(20 * np.log10(2), abs=0.05) and over[2] < over[1] - 60
    between = make_reflector(TX, USER, (2.0, 4.0), HZ).power_db(pose(2, 0, 1.5, 0, 0))  # the ends on either side
    assert float(between[0, 0]) < -200


def test_aimed_plates_send_the_wave_to_their_user(rng):
    users = rng.uniform([3, -1, 0.5], [5, 1, 2], (3, 3))
    plate, centres = make_reflector(TX, users, (3.0, 3.0), HZ), jnp.asarray(rng.uniform(*BOX, (4, 3)), jnp.float32)
    poses = plate.aimed(centres)
    for k in range(4):
        for user in range(3):
            normal, level, up = (np.asarray(axis) for axis in plate_axes(poses[k, user, 3:]))
            np.testing.assert_allclose(np.array([normal, level, up]) @ np.array([normal, level, up]).T, np.eye(3), atol=1e-5)
            ways = [(end - centres[k]) / np.linalg.norm(end - centres[k]) for end in (TX, users[user])]
            np.testing.assert_allclose(ways[0] @ normal, ways[1] @ normal, atol=1e-4)


@pytest.mark.heavy
def test_slopes_are_differences(rng):
    plate = make_reflector(TX, np.array([USER, [3.5, 0.5, 1.0]]), (0.5, 0.4), HZ)
    near = FACING[0] + jnp.asarray(rng.uniform(-0.03, 0.03, 5), jnp.float32)
    way = jnp.asarray(rng.normal(size=5), jnp.float32)
    for blur in (0.0, 0.2):
        slope = jax.grad(lambda x, blur=blur: plate.power_db(x[None], blur).sum())(near) @ way
        ahead, behind = (plate.power_db((near + h * way)[None], blur).sum() for h in (2e-3, -2e-3))
        assert float(slope) == pytest.approx(float(ahead - behind) / 4e-3, rel=0.03, abs=0.5)


@pytest.mark.heavy
def test_the_best_plate_halves_the_angle(rng):
    """For one user the law of reflection; and no other pose of thousands serves it better."""
    plate = make_reflector(TX, USER, (0.5, 0.4), HZ)
    found = place_reflector(plate, [-150.0], BOX, step=0.8)
    best = found.place[0]
    normal = np.asarray(plate_axes(best[3:])[0])
    ways = [(end - best[:3]) / np.linalg.norm(end - best[:3]) for end in (TX, USER)]
    halfway = (ways[0] + ways[1]) / np.linalg.norm(ways[0] + ways[1])
    assert np.degrees(np.arccos(normal @ halfway)) < 2
    others = plate.aimed(jnp.asarray(rng.uniform(*BOX, (3_000, 3)), jnp.float32))[:, 0]
    others = others.at[1_000:, 3:].add(jnp.asarray(rng.normal(0, 0.05, (2_000, 2)), jnp.float32))
    assert -float(found.loss[0]) > float(plate.power_db(others, 0.02).max()) - 0.1
    assert (jnp.diff(found.loss) >= 0).all()


@pytest.mark.heavy
def test_a_plate_is_what_a_field_with_the_same_plate_in_its_mesh_says():
    """Around a screen of metal, by a plate that looks back at both ends; straight through the screen next to nothing goes."""
    screen, plate = rectangle((2, -1, 0), (0, 2, 0), (0, 0, 3)), rectangle((1.2, 2, 0.7), (1.6, 0, 0), (0, 0, 1.6))
    fields = [field_of(parts, (0, 0, 1), conductivity=METAL, **SMALL)[:2] for parts in ([screen], [screen, plate])]
    powers = [float(jax.jit(power_at_users(*field, USER, HZ))(TX[None], 0.05)[0, 0]) for field in fields]
    ours = make_reflector(TX, USER, (1.6, 1.6), HZ, *fields[0])
    alone = 10 * np.log10(10 ** (powers[1] / 10) - 10 ** (powers[0] / 10))
    assert float(jax.jit(ours.power_db)(FACING)[0, 0]) == pytest.approx(alone, abs=0.3)
    assert powers[1] > powers[0] + 10
    straight = jax.jit(straight_powers(*fields[0], [USER], HZ))(np.array([[4.0, 1.0, 1.0], TX]))
    assert float(straight[0, 0]) == pytest.approx(friis(np.hypot(1, 0.5)), abs=0.05) and straight[1, 0] < friis(4) - 60


def test_what_cannot_reflect_or_tell_is_refused():
    with pytest.raises(UserError, match="two sides above 0"):
        make_reflector(TX, USER, (0.0, 1.0), HZ)
    field = Blind()
    with pytest.raises(UserError, match="predicts no paths"):
        make_reflector(TX, USER, (1.0, 1.0), HZ, field, field.init(jax.random.key(0)))
