"""What simple methods give for a spectrum, and their mixture with a trained field, by the distance to the data.

    simple(x) = sum_m w_m(d) s_m(x)                  w = softmax(bias + slope u)
    answer(x) = share(d) f(x) + (1 - share(d)) simple(x),      share = sigmoid(bias + slope u)

u is the logarithm of d, the distance to the nearest known transmitter, within what has been observed. The simple methods: the
mean spectrum, the nearest one, inverse distances, ordinary kriging (Cressie 1993, section 3.2) with the kernel
exp(-|x - x_j| / L), and line of sight. All but the mean and the last look at the same frequency alone. Weights and share are
found by cross-validation (training/fit_mixture.py).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float, UInt8

from wbgs_jax._util.pytree import pytree
from wbgs_jax.radio.array import EXACT, SPEED_OF_LIGHT, snapshot_to_pas, steering_vector
from wbgs_jax.radio.geometry import to_local
from wbgs_jax.types import Query

MEMBERS = ("mean", "nearest", "inverse_distance", "kriging", "line_of_sight")
"""The simple methods, in the order of the weights."""
SAME_FREQUENCY = 1e-4
"""Relative difference of two frequencies that are the same."""
NEAREST = 32
"""Known spectra that a query looks at."""
LOG_METRE = 1e-3
"""Metres below which distances are alike."""


@pytree
class Mixture:
    """M known spectra of one receiver, and how simple methods and a field share an answer."""

    rx_position: Float[Array, "3"]
    """Metres, world frame."""
    rx_orientation: Float[Array, "4"]
    """Quaternion (wxyz)."""
    elements: Float[Array, "e 3"]
    """Of the array, in its local frame, in wavelengths or ... None at all where line of sight has no weight."""
    metres: Float[Array, ""]
    """... metres: 1 if so, else 0."""
    tx_position: Float[Array, "m 3"]
    """Metres, world frame."""
    frequency_hz: Float[Array, " m"]
    images: UInt8[Array, "m 90 360"]
    """255 times the spectra."""
    mean: Float[Array, "90 360"]
    """Of all of them."""
    length: Float[Array, ""]
    """L of the kriging, metres ..."""
    nugget: Float[Array, ""]
    """... and the variance of what is no function of the position, beside 1."""
    log_distance: Float[Array, "4"]
    """Mean, standard deviation, lowest and highest value (logarithms of metres) at which weights were found."""
    members: Float[Array, "5 2"]
    """Bias and slope of every member's logit."""
    field: Float[Array, "2"]
    """Bias and slope of the logit of the field's share."""


def answer(mixture: Mixture, pas: Float[Array, "b 90 360"], query: Query) -> Float[Array, "b 90 360"]:
    """Returns a field's spectra mixed with those of the simple methods; at frequencies that were never observed the field's."""

    def one(asked: Any) -> Float[Array, "90 360"]:
        position, frequency_hz, own = asked
        everything = jnp.ones(len(mixture.frequency_hz), bool)
        spectra, distance = member_spectra(mixture, mixture.mean, position, frequency_hz, everything)
        simple = jnp.tensordot(member_weights(mixture, distance), spectra, 1, precision=EXACT)
        share = field_share(mixture, distance)
        return jnp.where(jnp.isfinite(distance), jnp.clip(share * own + (1 - share) * simple, 0, 1), own)

    return jax.lax.map(one, (query.tx_position, query.frequency_hz, pas))


def member_weights(mixture: Mixture, distance: Float[Array, "*b"]) -> Float[Array, "*b 5"]:
    """Returns the weight of every simple method among them."""
    return jax.nn.softmax(mixture.members[:, 0] + mixture.members[:, 1] * scaled(mixture, distance)[..., None], -1)


def field_share(mixture: Mixture, distance: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns the share of the field."""
    return jax.nn.sigmoid(mixture.field[0] + mixture.field[1] * scaled(mixture, distance))


def scaled(mixture: Mixture, distance: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns the scaled logarithm of distances (metres), held within those at which weights were found."""
    mean, scale, low, high = mixture.log_distance
    return (jnp.clip(jnp.log(jnp.maximum(distance, LOG_METRE)), low, high) - mean) / scale


def member_spectra(
    mixture: Mixture,
    mean: Float[Array, "90 360"],
    position: Float[Array, "3"],
    frequency_hz: Float[Array, ""],
    known: Bool[Array, " m"],
) -> tuple[Float[Array, "5 90 360"], Float[Array, ""]]:
    """Returns what every simple method gives for one query, and its distance (metres) to the nearest known transmitter:
    infinite where none is known at the frequency.

    Args:
        mixture: known spectra; weights and share do not matter.
        mean: of those that may be used.
        position: of the transmitter, world frame, metres.
        frequency_hz: of the query.
        known: which spectra may be used.
    """
    known &= jnp.abs(jnp.log(mixture.frequency_hz / frequency_hz)) < SAME_FREQUENCY
    offset = position - mixture.tx_position
    distance = jnp.where(known, jnp.sqrt(jnp.sum(offset**2, -1) + 1e-12), jnp.inf)  # differentiable at a known transmitter
    negative, index = jax.lax.top_k(-distance, min(NEAREST, len(distance)))
    near, there = -negative, jnp.isfinite(negative)
    near = jnp.where(there, near, 1.0)
    weights = jnp.stack(
        [
            jnp.zeros_like(near).at[0].set(1),
            _normalised(jnp.where(there, 1 / near**2, 0)),
            _kriging(mixture, mixture.tx_position[index], near, there),
        ]
    )
    pixels = mixture.images[index].reshape(len(index), -1).astype(jnp.float32) / 255
    local = jnp.matmul(weights, pixels, precision=EXACT).reshape(3, *mean.shape)
    return jnp.concatenate([mean[None], local, _line_of_sight(mixture, position, frequency_hz)[None]]), distance[index[0]]


def _kriging(
    mixture: Mixture, places: Float[Array, "k 3"], near: Float[Array, " k"], there: Bool[Array, " k"]
) -> Float[Array, " k"]:
    """Returns the weights of ordinary kriging, which sum to 1."""
    apart = jnp.sqrt(jnp.sum((places[:, None] - places[None]) ** 2, -1) + 1e-12)
    both = there[:, None] & there[None]
    kernel = jnp.where(both, jnp.exp(-apart / mixture.length), 0) + (mixture.nugget + ~there) * jnp.eye(
        len(near), dtype=near.dtype
    )
    k = jnp.where(there, jnp.exp((near[0] - near) / mixture.length), 0)  # of the nearest 1: far away squares would vanish
    simple, ones = (solve(kernel, side) for side in (k, there.astype(k.dtype)))
    simple *= jnp.exp(-near[0] / mixture.length)
    return simple + (1 - jnp.sum(simple)) * _normalised(ones)


def solve(kernel: Float[Array, "k k"], side: Float[Array, " k"]) -> Float[Array, " k"]:
    """Returns the solution of the equations of kriging from up to `NEAREST` spectra.

    Conjugate gradients: exported for any platform, unlike a factorisation; as many steps as there are unknowns are enough.
    """
    solution, _ = cg(lambda v: jnp.matmul(kernel, v, precision=EXACT), side, tol=1e-7, maxiter=2 * NEAREST)
    return solution


def _normalised(weights: Float[Array, " k"]) -> Float[Array, " k"]:
    total = jnp.sum(weights)
    return weights / jnp.where(total == 0, 1, total)


def _line_of_sight(mixture: Mixture, position: Float[Array, "3"], frequency_hz: Float[Array, ""]) -> Float[Array, "90 360"]:
    """Returns the spectrum of one plane wave from the transmitter; nothing of an array without elements."""
    if not len(mixture.elements):
        return jnp.zeros_like(mixture.mean)
    offset = position - mixture.rx_position
    direction = offset / jnp.sqrt(jnp.sum(offset**2) + 1e-12)
    elements = mixture.elements * jnp.where(mixture.metres > 0, frequency_hz / SPEED_OF_LIGHT, 1)
    phases = steering_vector(elements, to_local(direction[None], mixture.rx_orientation))
    return snapshot_to_pas(phases, elements)[0]
