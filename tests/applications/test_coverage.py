"""Antennas are placed where closed forms say; powers with the ends exchanged are powers; aims."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import METAL, SPEED_OF_LIGHT, field_of, rectangle
from builders.untrained import make_field, make_params

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.antenna_placement import (
    mean_power,
    place_antenna,
    power_at_users,
    predict_isotropic_paths,
    soft_minimum,
    tenth_percentile,
)
from wbgs_jax.applications.reflector import straight_powers
from wbgs_jax.radio.antenna import upright

HZ = 2.4e9
BOX = np.array([[0.5, -1.0, 0.9], [3.5, 1.0, 1.1]])
SMALL = {"mirror_areas": (0.0,), "specular_tried": 4, "specular_kept": 4, "diffracted_tried": 4, "diffracted_kept": 4}
WALL = rectangle((-5, 2, -5), (15, 0, 0), (0, 0, 15))


def friis(distances):
    return -20 * np.log10(4 * np.pi * distances * HZ / SPEED_OF_LIGHT)


@pytest.fixture(scope="module")
def air():
    """A wall of next to nothing: free space."""
    return field_of([WALL], (0, 0, 1), permittivity=1 + 1e-6, conductivity=1e-9, **SMALL)[:2]


@pytest.fixture(scope="module")
def mirror():
    return field_of([WALL], (0, 0, 1), conductivity=METAL, **SMALL)[:2]


def mirrored(users, reflection):
    """Powers in closed form: the direct wave and the one off the wall at y = 2, added as powers; dB."""
    images = users * [1, -1, 1] + [0, 4, 0]

    def powers(places, blur):
        squares = [jnp.sum((places[:, None] - jnp.asarray(ends, jnp.float32)) ** 2, -1) for ends in (users, images)]
        return 10 * jnp.log10(1 / squares[0] + reflection**2 / squares[1])

    return powers


@pytest.mark.heavy
def test_in_free_space_powers_and_their_slopes_are_those_of_friis(air, rng):
    powers = power_at_users(*air, [0.0, 0.0, 1.0], HZ)
    place = rng.uniform(*BOX, 3).astype(np.float32)
    away = place - np.array([0.0, 0.0, 1.0])
    distance = np.linalg.norm(away)
    found, slope = jax.jit(jax.value_and_grad(lambda x: powers(x[None], 0.0)[0, 0]))(jnp.asarray(place))
    assert float(found) == pytest.approx(friis(distance), abs=0.02)
    np.testing.assert_allclose(slope, -20 / np.log(10) * away / distance**2, atol=0.02)


@pytest.mark.heavy
def test_users_are_isotropic_whatever_the_elements_of_the_data_are(air):
    field, params = air
    place = np.array([[1.0, 0.5, 1.2], [-1.0, 0.5, 1.2]])
    directional = dataclasses.replace(params, element=upright(jnp.array([2.0, 1.0])))
    isotropic = power_at_users(field, params, [0.0, 0.0, 1.0], HZ)(place, 0.0)
    np.testing.assert_allclose(power_at_users(field, directional, [0.0, 0.0, 1.0], HZ)(place, 0.0), isotropic, atol=1e-4)
    straight = [straight_powers(field, one, [[0.0, 0.0, 1.0]], HZ)(place) for one in (params, directional)]
    np.testing.assert_allclose(straight[1], straight[0], atol=1e-4)
    paths = [predict_isotropic_paths(field, one, [0.0, 0.0, 1.0], place, HZ) for one in (params, directional)]
    np.testing.assert_allclose(paths[1].amplitude, paths[0].amplitude, atol=1e-9)


@pytest.mark.heavy
def test_ends_may_be_exchanged_before_a_wall(mirror, rng):
    """What a user gets from the antenna is what the antenna gets from the user."""
    field, params = mirror
    antenna, user = rng.uniform(*BOX, (2, 3)).astype(np.float32)
    there, back = (power_at_users(field, params, a, HZ)(b[None], 0.0)[0, 0] for a, b in ((user, antenna), (antenna, user)))
    assert float(there) == pytest.approx(float(back), abs=0.02)


def test_two_users_in_free_space_are_served_best_from_half_way():
    users = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0]])
    found = place_antenna(mirrored(users, 0.0), BOX, soft_minimum)
    np.testing.assert_allclose(found.place[0], [2, 0, 1], atol=0.03)
    assert (jnp.diff(found.loss) >= 0).all()


@pytest.mark.parametrize("aim", [mean_power, tenth_percentile, soft_minimum])
def test_before_a_wall_a_place_is_found_that_no_other_beats(rng, aim):
    powers = mirrored(rng.uniform([0, -1, 0.0], [4, 1, 0.4], (7, 3)), 0.8)
    found = place_antenna(powers, BOX, aim, starts=6)
    others = jnp.asarray(rng.uniform(*BOX, (5_000, 3)), jnp.float32)
    assert -float(found.loss[0]) > float(jnp.max(aim(powers(others, 0.02)))) - 0.1
    assert (found.place >= BOX[0] - 1e-6).all() and (found.place <= BOX[1] + 1e-6).all()


def test_the_soft_minimum_lies_between_minimum_and_mean(rng):
    power = jnp.asarray(rng.uniform(-90, -40, (5, 7)), jnp.float32)
    for soft in (0.1, 3.0, 1e4):
        found = soft_minimum(power, soft)
        assert (found >= power.min(-1) - 1e-3).all() and (found <= power.mean(-1) + 1e-1).all()
    np.testing.assert_allclose(soft_minimum(power, 0.01), power.min(-1), atol=0.05)
    np.testing.assert_allclose(soft_minimum(power, 1e4), power.mean(-1), atol=0.1)


def test_a_field_that_holds_at_its_receiver_alone_places_nothing():
    with pytest.raises(UserError, match="predicts only the receivers"):
        power_at_users(make_field(), make_params(), [0, 0, 1], HZ)
