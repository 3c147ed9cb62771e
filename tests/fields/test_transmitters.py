"""Properties of single transmitters in the coherent field: antenna, orientation and power."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import field_of, room
from builders.untrained import make_field, make_params
from scipy.spatial.transform import Rotation

from wbgs_jax.fields.base import pas
from wbgs_jax.radio.antenna import Antenna, tabulated
from wbgs_jax.types import Query, Transmitter, check_query, make_query, make_receiver

TX = np.array([[4.0, 2.5, 1.4], [2.0, 3.0, 2.0]])
HZ = 3e9


@pytest.fixture(scope="module")
def setup():
    field, params, plan = field_of(room(), (1.0, 1.0, 1.2), mirror_areas=(0.0,), specular_kept=8, diffracted_kept=1)
    return field, params, plan, jax.jit(lambda params, query: field.render(params, plan, query))


def antennas(rng):
    """Two directional antennas in their own frames."""
    quaternions = np.roll(Rotation.random(2, random_state=rng).as_quat(), 1, -1)
    return Antenna(jnp.asarray(quaternions, jnp.float32), jnp.array([[1.0, 0.0], [0.3, 0.8]]))


@pytest.mark.heavy
def test_each_transmitter_has_its_own_antenna(setup, rng):
    """As if the field had learned it for all of them."""
    _, params, _, render = setup
    both = antennas(rng)
    found = render(params, make_query(TX, HZ, antenna=both)).snapshots
    for number in range(2):
        learned = dataclasses.replace(params, transmitter=jax.tree.map(lambda leaf, i=number: leaf[i], both))
        expected = render(learned, make_query(TX, HZ)).snapshots[number]
        np.testing.assert_allclose(found[number], expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.heavy
def test_the_orientation_of_a_transmitter_rotates_its_antenna(setup, rng):
    _, params, _, render = setup
    both = antennas(rng)
    flat = dataclasses.replace(both, orientation=None)
    found = render(params, make_query(TX, HZ, antenna=flat, orientation=both.orientation)).snapshots
    expected = render(params, make_query(TX, HZ, antenna=both)).snapshots
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    learned = dataclasses.replace(params, transmitter=Antenna(jnp.array([1.0, 0, 0, 0]), jnp.array([1.0, 0.0])))
    turned = render(learned, make_query(TX, HZ, orientation=both.orientation[0])).snapshots[0]
    np.testing.assert_allclose(turned, expected[0], atol=1e-4 * np.abs(expected).max())


@pytest.mark.heavy
def test_a_tabulated_antenna_is_that_of_its_table(setup):
    """The table of the dipole."""
    _, params, _, render = setup
    gain = np.sqrt(1.5) * np.sin(np.linspace(0, np.pi, 91))[:, None] * np.ones(180)
    found = render(params, make_query(TX, HZ, antenna=tabulated(gain, None))).snapshots
    expected = render(params, make_query(TX, HZ, antenna=Antenna(None, jnp.array([0.0, 1.0])))).snapshots
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


def test_a_stack_of_antennas_is_of_as_many_transmitters():
    stack = Antenna(None, jnp.zeros((3, 2)))
    assert make_query([TX[0]] * 3, HZ, antenna=stack).transmitter.antenna is stack
    with pytest.raises(ValueError, match="a stack of 3 for 2 transmitters"):
        make_query(TX, HZ, antenna=stack)


def test_positions_alone_are_transmitters_without_further_properties():
    query = Query(jnp.asarray(TX, jnp.float32), jnp.full(2, HZ))
    assert jax.tree.structure(query) == jax.tree.structure(make_query(TX, HZ))
    assert len(jax.tree.leaves(query)) == 2


@pytest.mark.parametrize(
    ("name", "values"), [("orientation", jnp.zeros((2, 3))), ("velocity", jnp.zeros((3, 3))), ("power_dbm", jnp.zeros((2, 1)))]
)
def test_wrong_shapes_of_properties_are_named(name, values):
    transmitter = object.__new__(Transmitter)  # past the annotations
    for one in dataclasses.fields(Transmitter):
        object.__setattr__(transmitter, one.name, {"position": jnp.asarray(TX), name: values}.get(one.name))
    query = make_query(TX, HZ)
    object.__setattr__(query, "transmitter", transmitter)
    with pytest.raises(ValueError, match=f"transmitter.{name}"):
        check_query(query)


def test_frequencies_in_gigahertz_are_refused_outside_of_jit():
    """Inside, where spectra are compiled, there are no values to check."""
    query = make_query(TX, HZ)
    wrong = dataclasses.replace(query, frequency_hz=query.frequency_hz / 1e9)
    receiver = make_receiver([0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="are in hertz"):
        pas(make_field(), make_params(), receiver, wrong)


@pytest.mark.heavy
def test_two_polarisations_at_both_ends(setup):
    """A line of sight keeps them apart, reflections mix them, and slanted ports are sums of both."""
    _, params, _, render = setup
    angles = jnp.array([0.0, np.pi / 2, np.pi / 4, -np.pi / 4])
    ports = Antenna(None, jnp.zeros((4, 2)), slant=angles)
    paths = render(params, make_query(np.broadcast_to(TX[0], (4, 3)), HZ, antenna=ports)).paths
    matrix = np.moveaxis(np.asarray(paths.polarised), 0, -1)  # path, receiving theta and phi, transmitting port
    (sight,) = np.flatnonzero((np.asarray(paths.interaction[0]) == 0).all(-1) & (np.abs(matrix).max((1, 2)) > 0))
    strength = np.abs(matrix[sight, 0, 0])
    np.testing.assert_allclose(np.abs(matrix[sight, :, :2]), strength * np.eye(2), atol=1e-4 * strength)
    mixed = np.abs(matrix[:, 0, 1]).max()
    assert 1e-3 * strength < mixed < strength
    vertical, horizontal = matrix[..., 0], matrix[..., 1]
    np.testing.assert_allclose(matrix[..., 2], (vertical + horizontal) / np.sqrt(2), atol=1e-4 * strength)
    np.testing.assert_allclose(matrix[..., 3], (vertical - horizontal) / np.sqrt(2), atol=1e-4 * strength)


@pytest.mark.heavy
def test_a_slanted_receiver_takes_its_share_of_both_polarisations():
    angle = 0.6
    field, params, plan = field_of(room(), (1.0, 1.0, 1.2), mirror_areas=(0.0,), specular_kept=8, diffracted_kept=1)
    slanted = dataclasses.replace(plan.receiver, antenna=Antenna(None, jnp.zeros(2), slant=jnp.float32(angle)))
    paths = field.render(params, dataclasses.replace(plan, receiver=slanted), make_query(TX, HZ)).paths
    theta, phi = np.moveaxis(np.asarray(paths.polarised), -1, 0)
    expected = np.cos(angle) * theta + np.sin(angle) * phi
    np.testing.assert_allclose(paths.amplitude, expected, atol=1e-4 * np.abs(expected).max())
