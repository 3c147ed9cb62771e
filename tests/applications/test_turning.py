"""Elements are turned where one wave comes from; a turned receiver of a field hears what the closed form says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.mirrors import Blind
from builders.rooms import METAL, field_of, rectangle

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.antenna_placement import (
    boresight_quaternion,
    power_when_rotated,
    predict_isotropic_paths,
    rotate_array,
)
from wbgs_jax.radio.channel import Paths
from wbgs_jax.radio.geometry import rotation_matrix
from wbgs_jax.types import Query, make_receiver

HZ = 10e9
RX = np.array([0.0, 0.0, 1.0])
SMALL = {"mirror_areas": (0.0,), "specular_tried": 8, "specular_kept": 8, "diffracted_tried": 4, "diffracted_kept": 4}


def looking(angles):
    azimuth, elevation = angles
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def waves(directions, powers):
    """Waves from unit directions, vertically polarised, to one transmitter each."""
    k = jnp.asarray(directions, jnp.float32)[:, None]
    amplitude = jnp.sqrt(jnp.asarray(powers, jnp.float32))[:, None].astype(jnp.complex64)
    polarised = jnp.stack([amplitude, jnp.zeros_like(amplitude)], -1)
    return Paths(amplitude, k, jnp.ones(amplitude.shape), polarised=polarised)


def test_elements_look_where_the_angles_say_and_stay_level(rng):
    for angles in rng.uniform([-3, -1.5], [3, 1.5], (5, 2)):
        turn = rotation_matrix(boresight_quaternion(jnp.asarray(angles, jnp.float32)))
        np.testing.assert_allclose(turn[:, 0], looking(angles), atol=1e-5)
        assert abs(float(turn[2, 1])) < 1e-6


def test_orientations_of_many_and_of_lists_are_those_of_each(rng):
    for shape in ((2, 2), (3, 4, 2)):
        angles = rng.uniform(-1.5, 1.5, shape)
        each = [boresight_quaternion(one) for one in angles.reshape(-1, 2)]
        np.testing.assert_allclose(boresight_quaternion(angles.tolist()).reshape(-1, 4), each, atol=1e-6)
    with pytest.raises(ValueError, match="azimuth and elevation"):
        boresight_quaternion([0.1, 0.2, 0.3])


@pytest.mark.heavy
def test_one_wave_is_heard_best_by_elements_that_look_at_it(rng):
    for angles in rng.uniform([-3, -0.9], [3, 0.9], (3, 2)):
        found = rotate_array(power_when_rotated(waves(looking(angles)[None], [1e-6])))
        assert np.linalg.norm(looking(np.asarray(found.place[0], float)) - looking(angles)) < 0.03
        assert -float(found.loss[0]) == pytest.approx(-60 + 8, abs=0.02)


def test_two_equal_waves_are_heard_best_from_between():
    angles = np.array([[-0.4, 0.0], [0.6, 0.0]])
    found = rotate_array(power_when_rotated(waves(np.array([looking(a) for a in angles]), [1e-6, 1e-6])))
    np.testing.assert_allclose(found.place[0], [0.1, 0.0], atol=0.03)


@pytest.mark.heavy
def test_slopes_are_differences(rng):
    powers = power_when_rotated(waves(np.array([looking(a) for a in rng.uniform(-0.5, 0.5, (3, 2))]), [1e-6, 2e-6, 1e-7]))
    angles, way = (jnp.asarray(rng.uniform(-0.3, 0.3, 2), jnp.float32) for _ in range(2))
    slope = jax.grad(lambda x: powers(x[None]).sum())(angles) @ way
    ahead, behind = (powers((angles + h * way)[None]).sum() for h in (0.01, -0.01))
    assert float(slope) == pytest.approx(float(ahead - behind) / 0.02, rel=0.01, abs=0.01)


@pytest.mark.heavy
@pytest.mark.parametrize("pattern", ["tr38901", "dipole"])
def test_a_turned_receiver_of_a_field_hears_the_same(rng, pattern):
    """Before a wall of metal, with the powers of both waves added."""
    field, params, _ = field_of([rectangle((-5, 2, -5), (15, 0, 0), (0, 0, 15))], RX, conductivity=METAL, **SMALL)
    tx, angles = rng.uniform([1, -1, 0.5], [3, 1, 2], (2, 3)), np.array([0.3, 0.2])
    turned = power_when_rotated(predict_isotropic_paths(field, params, RX, tx, HZ), pattern)(
        jnp.asarray(angles[None], jnp.float32)
    )
    orientation = boresight_quaternion(jnp.asarray(angles, jnp.float32))
    plan = field.plan(params, make_receiver(RX, orientation, np.zeros((1, 3)), pattern=pattern))
    query = Query(jnp.asarray(tx, jnp.float32), jnp.full(2, HZ, jnp.float32))
    said = jax.jit(field.render)(field.smoothed(params, 0.5), plan, query).power_db
    np.testing.assert_allclose(turned[0], said, atol=0.05)


def test_a_frequency_in_gigahertz_is_refused():
    field, params, _ = field_of([rectangle((-5, 2, -5), (15, 0, 0), (0, 0, 15))], RX, conductivity=METAL, **SMALL)
    with pytest.raises(ValueError, match="in hertz"):
        predict_isotropic_paths(field, params, RX, [[1.0, 0, 0]], 28.0)


def test_a_field_without_paths_turns_nothing():
    field = Blind()
    with pytest.raises(UserError, match="predicts no paths"):
        predict_isotropic_paths(field, field.init(jax.random.key(0)), RX, [[1.0, 0, 0]], HZ)
