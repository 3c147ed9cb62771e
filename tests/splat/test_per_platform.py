"""A function that is another one on some platforms: what lowers the code decides, and nothing else is traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.splat.per_platform import per_platform


def same_shape(trees, *_):
    return [jax.ShapeDtypeStruct(trees["x"].shape, trees["x"].dtype)]


def never(*_):
    raise AssertionError("traced for a platform that nobody lowers for")


plain = per_platform("test_plain", same_shape, lambda trees, y: [trees["x"] + y], cuda=lambda trees, y: [trees["x"] - y])
guarded = per_platform("test_guarded", same_shape, lambda trees, y: [trees["x"] * y], cuda=never)


def test_it_is_what_the_platform_needs():
    x, y = jnp.arange(3.0), jnp.ones(3)
    traced = jax.jit(lambda x, y: plain({"x": x}, y)[0]).trace(x, y)
    programs = {name: traced.lower(lowering_platforms=(name,)).as_text() for name in ("cpu", "cuda")}
    assert "stablehlo.add" in programs["cpu"] and "stablehlo.subtract" not in programs["cpu"]
    assert "stablehlo.subtract" in programs["cuda"] and "stablehlo.add" not in programs["cuda"]


def test_other_platforms_are_not_traced():
    x = jnp.arange(3.0)
    np.testing.assert_array_equal(guarded({"x": x}, x)[0], x * x)  # outside of a jitted function too
    traced = jax.jit(lambda x: guarded({"x": x}, x)[0]).trace(x)
    traced.lower(lowering_platforms=("cpu",))
    with pytest.raises(AssertionError, match="traced"):
        traced.lower(lowering_platforms=("cuda",))


def test_it_is_mapped_over_row_by_row(rng):
    x, y = jnp.asarray(rng.normal(size=(4, 3))), jnp.asarray(rng.normal(size=3))
    mapped = jax.jit(jax.vmap(lambda x, y: plain({"x": x}, y)[0], in_axes=(0, None)))(x, y)
    np.testing.assert_allclose(mapped, x + y, rtol=1e-6)
    columns = jax.vmap(lambda y, x: plain({"x": x}, y)[0], in_axes=(None, 1), out_axes=1)(jnp.ones(4), x)
    np.testing.assert_allclose(columns, x + 1, rtol=1e-6)
