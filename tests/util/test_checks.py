"""The public door: wrong shapes, dtypes and units are refused with a message that says what was expected."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import wbgs_jax as wb
from wbgs_jax.fields.coherent_model import WavePlan
from wbgs_jax.fields.networks import positional_encoding
from wbgs_jax.types import check_query, stack_receivers

CONFIG = wb.wideband.WidebandConfig(width=8, depth=2)
LIMITS = wb.splat.TileLimits(entries=4096, jobs=1024)


@pytest.fixture(scope="module")
def field():
    points = np.random.default_rng(0).uniform([-3, -3, 0], [3, 3, 3], (60, 3))
    return wb.wideband.make_field(wb.surface_from_points(points), CONFIG)


@pytest.fixture(scope="module")
def planned(field):
    """Parameters of 64 slots and their plan, by their shapes alone: the door is in front of everything that computes."""
    params = jax.eval_shape(field.init, jax.random.key(0))
    receiver = wb.make_receiver([0.0, 0.0, 1.0])
    return params, jax.eval_shape(lambda params: field.plan(params, receiver, capacity=LIMITS), params)


@pytest.fixture(autouse=True)
def no_type_checks():
    """The run-time type checks of the tests would refuse wrong arguments before the door does; users do not have them."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.parametrize(
    ("tx", "frequency", "error", "message"),
    [
        (
            np.zeros((2, 2), np.float32),
            np.full(2, 1e9, np.float32),
            ValueError,
            r"tx_position has shape \(2, 2\); expected \(b, 3\)",
        ),
        (
            np.zeros((2, 3), np.float32),
            np.full(3, 1e9, np.float32),
            ValueError,
            r"frequency_hz has shape \(3,\); expected \(2,\)",
        ),
        (np.zeros((1, 3), np.int32), np.full(1, 1e9, np.float32), TypeError, "tx_position has dtype int32"),
        (np.zeros((1, 3), np.complex64), np.full(1, 1e9, np.float32), TypeError, "complex64"),
        (np.zeros((1, 3), np.float32), np.full(1, 2.4, np.float32), ValueError, "in hertz"),
        (np.zeros((1, 3), np.float32), np.full(1, -1e9, np.float32), ValueError, "in hertz"),
        (np.zeros((1, 3), np.float32), np.full(1, np.nan, np.float32), ValueError, "in hertz"),
        (np.zeros((1, 3), np.float32), np.full(1, np.inf, np.float32), ValueError, "infinite"),
        (np.full((1, 3), 3e6, np.float32), np.full(1, 1e9, np.float32), ValueError, "in metres"),
        (np.full((1, 3), np.nan, np.float32), np.full(1, 1e9, np.float32), ValueError, "in metres"),
    ],
)
def test_a_wrong_query_is_refused(planned, tx, frequency, error, message):
    with pytest.raises(error, match=message):
        wb.wideband.render(*planned, wb.Query(jnp.asarray(tx), jnp.asarray(frequency)))


def test_the_other_fields_have_the_same_door(planned):
    """A wrong query is refused before anything of the field is looked at."""
    query = wb.Query(jnp.zeros((2, 3)), jnp.full(2, 2.4))
    plan = object.__new__(WavePlan)
    object.__setattr__(plan, "prepared", None)  # all that is looked at
    for field in (wb.coherent, wb.fields.nerf2):
        with pytest.raises(ValueError, match="in hertz"):
            field.render(None, plan, query)


def test_shapes_are_checked_under_jit_too(planned):
    with pytest.raises(ValueError, match="tx_position has shape"):
        jax.eval_shape(jax.jit(wb.wideband.render), *planned, wb.Query(jnp.zeros((4, 2)), jnp.full(4, 1e9)))


def test_a_wrong_receiver_is_refused(field, planned):
    params, _ = planned
    elements, isotropic = jnp.zeros((1, 3)), jnp.zeros(2)
    with pytest.raises(ValueError, match=r"receiver.position has shape \(2,\)"):
        field.plan(params, wb.Receiver(jnp.zeros(2), jnp.ones(4), elements, isotropic))
    with pytest.raises(ValueError, match="zero length"):
        field.plan(params, wb.Receiver(jnp.zeros(3), jnp.zeros(4), elements, isotropic))
    three = wb.Receiver(jnp.zeros((3, 3)), jnp.ones((3, 4)), jnp.zeros((3, 1, 3)), jnp.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"receiver.position has shape \(3, 3\); expected \(3,\)"):
        field.plan(params, three)


def test_a_transmitter_without_orientation_is_refused():
    """Also one of several, and as part of a query that was made by hand."""
    for orientation in ([0, 0, 0, 0], [[1, 0, 0, 0], [0, 0, 0, 0]], [np.nan, 0, 0, 0]):
        with pytest.raises(ValueError, match="orientation has zero length"):
            wb.make_query(jnp.zeros((2, 3)), 28e9, orientation=orientation)
    transmitter = wb.radio.Transmitter(jnp.zeros((1, 3)), jnp.zeros((1, 4)))
    with pytest.raises(ValueError, match=r"transmitter.orientation has zero length"):
        check_query(wb.Query(transmitter, jnp.full(1, 28e9)))
    made = jax.jit(lambda orientation: wb.make_query(jnp.zeros(3), 28e9, orientation=orientation))(jnp.zeros(4))
    assert made.transmitter.orientation.shape == (1, 4)


def test_a_wrong_surface_is_refused():
    with pytest.raises(ValueError, match=r"surface.points has shape \(5, 2\)"):
        wb.wideband.make_field(wb.Surface(jnp.zeros((5, 2)), jnp.ones(5)), CONFIG)
    with pytest.raises(ValueError, match=r"surface.spacing has shape \(4,\); expected \(5,\)"):
        wb.wideband.make_field(wb.Surface(jnp.zeros((5, 3)), jnp.ones(4)), CONFIG)


def test_wrong_attenuation_is_refused(planned):
    _, plan = planned
    with pytest.raises(ValueError, match=r"attenuation has shape \(59, 1\); expected \(64, b\)"):
        wb.splat.render_splats(plan.geometry, jnp.zeros((59, 1)), jnp.zeros((59, 1)))
    with pytest.raises(ValueError, match="signal has shape"):
        wb.splat.render_splats(plan.geometry, jnp.zeros((64, 2)), jnp.zeros((64, 1)))


def test_make_query_broadcasts_one_frequency():
    query = wb.make_query([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], 28e9)
    assert query.tx_position.shape == (2, 3) and query.frequency_hz.tolist() == pytest.approx([28e9] * 2)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"unit": "m"}, "unit is 'm'; give one of: wavelengths, metres"),
        ({"position": [[0.0, 0.0, 0.0]]}, r"receiver.position has shape \(1, 3\); expected \(3,\)"),
        ({"element_positions": [0.0, 0.0, 0.0]}, r"receiver.element_positions has shape \(3,\)"),
        ({"orientation": [0.0, 0.0, 0.0, 0.0]}, "receiver.orientation has zero length"),
        ({"orientation": [0.0, 0.0, 1.0]}, r"receiver.orientation has shape \(3,\)"),
    ],
)
def test_no_receiver_is_made_of_wrong_values(given, message):
    with pytest.raises(ValueError, match=message):
        wb.make_receiver(**({"position": [0.0, 0.0, 0.0]} | given))


def test_only_receivers_of_one_kind_are_stacked():
    wavelengths, metres = (wb.make_receiver([0.0, 0.0, 0.0], unit=unit) for unit in ("wavelengths", "metres"))
    with pytest.raises(ValueError, match="receivers is empty"):
        stack_receivers([])
    for other in (metres, wb.make_receiver([0.0, 0.0, 0.0], element_positions=np.zeros((1, 3)))):
        with pytest.raises(ValueError, match="receivers differ in the unit"):
            stack_receivers([wavelengths, other])


def test_nothing_to_be_splatted_is_refused():
    none = wb.splat.Gaussians(jnp.zeros((0, 3)), jnp.zeros((0, 3)), jnp.zeros((0, 4)), jnp.zeros(0))
    for limits in (None, LIMITS):
        with pytest.raises(ValueError, match="there are no Gaussians"):
            wb.splat.geometry_plan(none, wb.make_receiver([0.0, 0.0, 0.0]), limits)
    with pytest.raises(ValueError, match="limits of 0 entries and 0 jobs"):
        wb.splat.TileLimits(0, 0)


def test_the_dense_reference_takes_numpy_arrays_of_fitting_shapes(rng):
    receiver = wb.make_receiver([0.0, 0.0, 0.0])
    gaussians = wb.splat.Gaussians(jnp.ones((2, 3)), jnp.full((2, 3), -2.0), jnp.ones((2, 4)), jnp.zeros(2))
    splats, attenuation = wb.splat.project(gaussians, receiver), np.full((2, 1), 0.5, np.float32)
    image = wb.splat.render_dense(splats, attenuation, attenuation)
    np.testing.assert_array_equal(image, wb.splat.render_dense(splats, *2 * [jnp.asarray(attenuation)]))
    with pytest.raises(ValueError, match=r"attenuation has shape \(3, 1\); expected \(2, b\)"):
        wb.splat.render_dense(splats, np.ones((3, 1), np.float32), attenuation)


def test_encodings_take_lists():
    np.testing.assert_array_equal(wb.fields.positional_encoding([0.0, 0, 1], 4), positional_encoding(jnp.array([0.0, 0, 1]), 4))
    assert wb.fields.frequency_encoding([1e9, 2e9], 2).shape == (2, 5)


def test_a_receiver_made_of_lists_is_refused():
    with pytest.raises(TypeError, match=r"receiver\.position is a list; pass an array"):
        wb.at_receiver(None, wb.Receiver([0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0], [[0.0, 0.0, 0.0]], [0.0, 0.0]))
