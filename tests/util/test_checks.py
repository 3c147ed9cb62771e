"""The public door: wrong shapes, dtypes and units are refused with a message that says what was expected."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import wbgs_jax as wb


@pytest.fixture(scope="module")
def field():
    points = np.random.default_rng(0).uniform([-3, -3, 0], [3, 3, 3], (60, 3))
    params = wb.wideband.init(jax.random.key(0), wb.surface_from_points(points), wb.WidebandConfig(width=8, depth=2))
    return params, wb.wideband.plan(params, wb.make_receiver([0.0, 0.0, 1.0]))


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
        (np.full((1, 3), 3e6, np.float32), np.full(1, 1e9, np.float32), ValueError, "in metres"),
        (np.full((1, 3), np.nan, np.float32), np.full(1, 1e9, np.float32), ValueError, "in metres"),
    ],
)
def test_a_wrong_query_is_refused(field, tx, frequency, error, message):
    with pytest.raises(error, match=message):
        wb.wideband.render(*field, wb.Query(jnp.asarray(tx), jnp.asarray(frequency)))


def test_shapes_are_checked_under_jit_too(field):
    with pytest.raises(ValueError, match="tx_position has shape"):
        jax.jit(wb.wideband.render)(*field, wb.Query(jnp.zeros((4, 2)), jnp.full(4, 1e9)))


def test_a_wrong_receiver_is_refused(field):
    with pytest.raises(ValueError, match=r"receiver.position has shape \(2,\)"):
        wb.wideband.plan(field[0], wb.Receiver(jnp.zeros(2), jnp.ones(4), jnp.zeros((1, 3))))
    zero = wb.Receiver(jnp.zeros(3), jnp.zeros(4), jnp.zeros((1, 3)))
    with pytest.raises(ValueError, match="zero length"):
        wb.wideband.plan(field[0], zero)


def test_wrong_attenuation_is_refused(field):
    _, plan = field
    with pytest.raises(ValueError, match=r"attenuation has shape \(59, 1\); expected \(60, b\)"):
        wb.render_splats(plan.geometry, jnp.zeros((59, 1)), jnp.zeros((59, 1)))
    with pytest.raises(ValueError, match="signal has shape"):
        wb.render_splats(plan.geometry, jnp.zeros((60, 2)), jnp.zeros((60, 1)))


def test_make_query_broadcasts_one_frequency():
    query = wb.make_query([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], 28e9)
    assert query.tx_position.shape == (2, 3) and query.frequency_hz.tolist() == pytest.approx([28e9] * 2)
