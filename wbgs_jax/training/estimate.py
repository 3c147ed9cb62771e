"""About how long a training will take on this machine: what it takes on a known one (`Field.seconds`), and how this one
compares."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from wbgs_jax.fields import Field

PROBE_SECONDS = 0.0095
"""What `_probe` takes there: two cores of an AMD EPYC."""
SIZE, PRODUCTS, TRIALS = 512, 8, 15


def expected_seconds(field: type[Field], preset: str, share: float = 1.0) -> float | None:
    """Returns about how long a training takes here; None where no training like it has been timed.

    Args:
        field: what is trained.
        preset: by name.
        share: of the preset's steps that are still to do.
    """
    known = field.seconds.get(preset)
    return None if known is None or jax.default_backend() != "cpu" else known * share * _probe() / PROBE_SECONDS


def duration_words(seconds: float) -> str:
    """Returns "about 12 minutes"."""
    if seconds < 90:
        return "about a minute"
    minutes = seconds / 60
    return f"about {minutes:.0f} minutes" if minutes < 90 else f"about {minutes / 60:.1f} hours"


def _probe() -> float:
    """Returns the median time of a few matrix products: other programs that run count too."""

    def products(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, PRODUCTS, lambda _, y: jnp.tanh(y @ x) / SIZE, x)

    run, x, times = jax.jit(products), jnp.ones((SIZE, SIZE)), []
    run(x).block_until_ready()
    for _ in range(TRIALS):
        start = time.perf_counter()
        run(x).block_until_ready()
        times.append(time.perf_counter() - start)
    return float(np.median(times))
