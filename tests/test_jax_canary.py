"""Does this jaxlib compute what it is told? A miscompilation that hits the quadratic forms of splatting.

jaxlib 0.10.2 on the CPU: https://github.com/jax-ml/jax/issues/39103. The requirement in pyproject.toml excludes it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest


@pytest.mark.parametrize("shape", [(2, 3), (3, 3)])  # there the last row came out wrong; (2, 2) and (4, 4) were right
def test_jitted_quadratic_forms_equal_numpys(rng, shape):
    n = 32769  # one more than a power of two
    rows, matrix = (rng.normal(size=size).astype(np.float32) for size in ((n, shape[1]), shape))
    expected = np.sum((rows.astype(np.float64) @ matrix.astype(np.float64).T) ** 2, -1)

    def forms(rows):
        return jax.vmap(lambda row: jnp.sum((jnp.asarray(matrix) @ row) ** 2))(rows)

    np.testing.assert_allclose(jax.jit(forms)(rows), expected, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(forms(rows), expected, rtol=1e-3, atol=1e-3)
