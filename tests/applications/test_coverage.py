"""Antennas are placed where closed forms say; powers with the ends exchanged are powers; aims."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import METAL, SPEED_OF_LIGHT, field_of, rectangle
from untrained import make_field, make_params

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.coverage import mean_power, place_antenna, power_at_users, soft_minimum, tenth_percentile
from wbgs_jax.types import make_query, make_receiver

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


def test_in_free_space_powers_are_friis_and_two_users_are_served_best_from_half_way(air, rng):
    users = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0]])
    powers = power_at_users(*air, users, HZ)
    places = rng.uniform(*BOX, (5, 3)).astype(np.float32)
    distances = np.linalg.norm(places[:, None] - users, axis=-1)
    np.testing.assert_allclose(powers(places, 0.0), friis(distances), atol=0.02)
    found = place_antenna(powers, BOX, soft_minimum, step=0.8, starts=2)
    assert abs(found.place[0, 0] - 2) < 0.05 and abs(found.place[0, 1]) < 0.15
    assert found.loss[0] <= -soft_minimum(powers(places, 0.02)).max() + 1e-3


def test_ends_may_be_exchanged_before_a_wall(mirror, rng):
    """What a user gets from the antenna is what the antenna gets from the user."""
    field, params = mirror
    antenna, user = rng.uniform(*BOX, (2, 3)).astype(np.float32)
    there = power_at_users(field, params, user, HZ)(jnp.asarray(antenna[None]), 0.0)[0, 0]
    back = field.render(
        params, field.plan(params, make_receiver(antenna, element_positions=np.zeros((1, 3)))), make_query(user, HZ)
    ).power_db[0]
    assert float(there) == pytest.approx(float(back), abs=0.02)


@pytest.mark.parametrize("aim", [mean_power, tenth_percentile])
def test_before_a_wall_a_place_is_found_that_no_other_beats(mirror, rng, aim):
    users = rng.uniform([0, -1, 0.5], [4, 1, 1.5], (2, 3))
    powers = power_at_users(*mirror, users, HZ)
    found = place_antenna(powers, BOX, aim, step=0.8, starts=2)
    others = rng.uniform(*BOX, (64, 3)).astype(np.float32)
    best = float(jnp.max(aim(jax.jit(powers)(others, 0.02))))
    assert -float(found.loss[0]) > best - 0.3
    assert (found.place >= BOX[0] - 1e-6).all() and (found.place <= BOX[1] + 1e-6).all()


def test_the_soft_minimum_lies_between_minimum_and_mean(rng):
    power = jnp.asarray(rng.uniform(-90, -40, (5, 7)), jnp.float32)
    for soft in (0.1, 3.0, 1e4):
        found = soft_minimum(power, soft)
        assert (found >= power.min(-1) - 1e-3).all() and (found <= power.mean(-1) + 1e-1).all()
    np.testing.assert_allclose(soft_minimum(power, 0.01), power.min(-1), atol=0.05)
    np.testing.assert_allclose(soft_minimum(power, 1e4), power.mean(-1), atol=0.1)


def test_slopes_of_the_power_are_differences(air):
    powers = power_at_users(*air, [0.0, 0.0, 1.0], HZ)
    place, aside = jnp.array([[2.0, 0.5, 1.0]]), jnp.array([[0.05, 0.0, 0.0]])
    slope = jax.grad(lambda x: powers(x, 0.0)[0, 0])(place)[0, 0]
    difference = (powers(place + aside, 0.0) - powers(place - aside, 0.0))[0, 0] / 0.1
    assert float(slope) == pytest.approx(float(difference), rel=0.02)


def test_a_field_that_holds_at_its_receiver_alone_places_nothing():
    with pytest.raises(UserError, match="no receivers but those"):
        power_at_users(make_field(), make_params(), [0, 0, 1], HZ)
