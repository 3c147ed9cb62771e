"""Received power, averaged over fading, as a function of the transmitter's place: a law of distance and walls, and what is left
of it as a Gaussian process.

    P_r(x) = a - 10 n log10 d - l sqrt(w) + u_r(x) + sqrt(w) v_r(x)

with d the distance to receiver r and w the number of walls in between. Later walls cost less than the first: what goes through
doors and around corners does not meet them (compare the multi-wall model of COST 231, final report, section 4.7, with its
falling loss of further floors). The law is the same for all receivers and found by least squares, readings of one square metre
counting as one, so that it holds where nobody has measured; u and v, what rooms and single walls are beside it, fade with the
distance from what was measured (exponential covariance; Rasmussen and Williams 2006, chapter 2).
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.data.floor_plan import NO_WALLS, Walls, crossings, namespace
from wbgs_jax.data.rssi_folder import Readings
from wbgs_jax.radio.array import EXACT

LAW = np.array([-45.0, 2.0, 6.0])
"""Power at one metre (dBm), exponent and loss of a wall (dB) before anything was measured, ..."""
LAW_WIDTH = np.array([30.0, 1.0, 4.0])
"""... and their standard deviations."""
ALIKE = 1.0
"""Metres: readings of a square of this size tell the law as much as one ..."""
APART = 5.0
"""... whose error has this standard deviation (dB)."""
NEAREST = 0.1
"""Metres: nearer transmitters are that far away."""
MAX_PLACES = 1500
"""Places that a map holds."""
MIN_POWERS = 10
"""Powers below which there is nothing to learn from."""
LENGTH = 1.0
"""Metres over which u and v fall to 1/e. It is not learned: what is most likely in one room is longer, and says wrong things
about the next."""
LOOKED_AT = 400
"""Places of every receiver by which scales are found."""
WIDTH, STEPS = 0.5, 15
"""Standard deviation of the logarithms of all scales before anything was measured, and steps of the search for them."""


@dataclass(frozen=True)
class Scales:
    """Standard deviations of what the law leaves, dB."""

    room: float = 4.0
    """Of u, ..."""
    wall: float = 4.0
    """... of v, ..."""
    place: float = 0.5
    """... of what is no function of the place, ..."""
    reading: float = 4.5
    """... and of a single reading (fading)."""


@pytree
class PowerMap:
    """What is known from N places at which R receivers were heard."""

    receivers: Float[Array, "r 3"]
    walls: Walls
    places: Float[Array, "n 3"]
    law: Float[Array, "3"]
    """Power at one metre (dBm), exponent, loss of the first wall (dB)."""
    law_covariance: Float[Array, "3 3"]
    scales: Float[Array, "4"]
    """Those of `Scales`, in their order."""
    features: Float[Array, "n r"]
    """sqrt(w) of the places."""
    weights: Float[Array, "r n"]
    """(K + noise)^-1 (powers - law)."""
    inverse_root: Float[Array, "r n n"]
    """L^-1 of K + noise = L L^T."""


def learn_map(readings: Readings, walls: Walls = NO_WALLS, scales: Scales | None = None) -> PowerMap:
    """Returns the map that follows from means of readings (`rssi_folder.cell_means`), in float32.

    Args:
        readings: at most `MAX_PLACES` places.
        walls: of the floor plan.
        scales: of what the law leaves; by default they are learned.

    Raises:
        UserError: too few powers, or too many places.
    """
    heard = np.isfinite(readings.powers)
    if heard.sum() < MIN_POWERS:
        raise UserError(f"{int(heard.sum())} powers are too few to learn from; there must be {MIN_POWERS}")
    if len(readings.places) > MAX_PLACES:
        raise UserError(f"{len(readings.places)} places are more than a map can hold ({MAX_PLACES}); average over larger cells")
    law_features = _law_features(readings.places, readings.receivers, walls)
    law, covariance = _law(readings, law_features)
    left = np.where(heard, readings.powers - law_features @ law, 0)
    if scales is None:
        scales = learn_scales(readings, -law_features[..., 2], left)
    root_walls, n = -law_features[..., 2], len(readings.places)
    weights, roots = np.zeros((len(readings.receivers), n)), np.zeros((len(readings.receivers), n, n))
    for r in range(len(readings.receivers)):
        own = np.flatnonzero(heard[:, r])
        k = _covariance(scales, readings.places[own], root_walls[own, r])
        k[np.diag_indices(len(own))] += noise(scales, readings.counts[own, r])
        factor = np.linalg.cholesky(k)
        weights[r, own] = cho_solve((factor, True), left[own, r])
        roots[r][np.ix_(own, own)] = solve_triangular(factor, np.eye(len(own)), lower=True)
    arrays = readings.places, law, covariance, np.array([*vars(scales).values()]), root_walls, weights, roots
    return PowerMap(*jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (readings.receivers, walls, *arrays)))


def received_power(learned: PowerMap, tx_position: Float[Array, "b 3"]) -> tuple[Float[Array, "b r"], Float[Array, "b r"]]:
    """Returns the mean received power (dBm) of B transmitters at all receivers, and its standard deviation (dB): how far the
    mean may be off, not how far a single reading is. Pure; for `jit`, `vmap` and `grad`."""
    features = _law_features(tx_position, learned.receivers, learned.walls)
    room, wall = learned.scales[:2]
    walls = -features[..., 2]
    k = alike(tx_position, learned.places)[:, None] * (room**2 + wall**2 * walls[..., None] * learned.features.T)
    exact = partial(jnp.einsum, precision=EXACT)  # the variance is a difference of large numbers
    mean = exact("bri,i->br", features, learned.law) + exact("brn,rn->br", k, learned.weights)
    known = jnp.sum(exact("rmn,brn->brm", learned.inverse_root, k) ** 2, -1)
    of_law = exact("bri,ij,brj->br", features, learned.law_covariance, features)
    variance = room**2 + wall**2 * walls**2 - known + of_law
    return mean, jnp.sqrt(jnp.maximum(variance, 0))


def distances(a: Any, b: Any) -> Any:
    """Returns how far places (n, 3) are from others (m, 3): (n, m), metres, with a gradient where it is none."""
    return namespace(a).sqrt(namespace(a).sum((a[:, None] - b) ** 2, -1) + 1e-12)


def alike(a: Any, b: Any) -> Any:
    """Returns the correlation (n, m) of what the law leaves at places (n, 3) and at others (m, 3)."""
    return namespace(a).exp(-distances(a, b) / LENGTH)


def noise(scales: Scales, counts: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Returns the variance (dB^2) of means of so many readings around what is a function of the place."""
    return scales.place**2 + scales.reading**2 / counts


def _law_features(tx: Any, receivers: Any, walls: Walls) -> Any:
    """Returns (b, r, 3): what the law's three numbers are multiplied by."""
    xp = namespace(tx)
    distance = xp.maximum(distances(tx, receivers), NEAREST)
    between = crossings(walls, tx[:, None, :2], receivers[None, :, :2])
    root = xp.sqrt(xp.where(between > 0, between, 1.0)) * (between > 0)
    return xp.stack([xp.ones_like(distance), -10 * xp.log10(distance), -root], -1)


def _law(readings: Readings, features: Float[np.ndarray, "n r 3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Returns the law by least squares with a normal prior, and its covariance."""
    _, square = np.unique(np.floor(readings.places / ALIKE).astype(int), axis=0, return_inverse=True)
    heard = np.isfinite(readings.powers)
    weights = np.zeros(readings.powers.shape)
    for r in range(len(readings.receivers)):
        own = square.reshape(-1)[heard[:, r]]
        weights[heard[:, r], r] = 1 / (APART**2 * np.bincount(own, minlength=square.max() + 1)[own])
    left = np.where(heard, readings.powers - features @ LAW, 0)
    precision = np.einsum("nri,nr,nrj->ij", features, weights, features) + np.diag(LAW_WIDTH**-2.0)
    covariance = np.linalg.inv(precision)
    return LAW + covariance @ np.einsum("nri,nr,nr->i", features, weights, left), covariance


def _covariance(
    scales: Scales, places: Float[np.ndarray, "n 3"], root_walls: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n n"]:
    """Returns the covariance of what the law leaves at one receiver."""
    return alike(places, places) * (scales.room**2 + scales.wall**2 * np.outer(root_walls, root_walls))


def learn_scales(readings: Readings, root_walls: Float[np.ndarray, "n r"], left: Float[np.ndarray, "n r"]) -> Scales:
    """Returns the scales under which what the law leaves is most likely, those of `Scales` being what is expected before."""
    first = np.log(np.array(list(vars(Scales()).values())))
    heard = np.isfinite(readings.powers)
    outwards = np.argsort(np.linalg.norm(readings.places - readings.places[0], axis=-1), kind="stable")
    chosen = []
    for r in range(len(readings.receivers)):
        own = outwards[heard[outwards, r]][:LOOKED_AT]
        chosen.append((readings.places[own], root_walls[own, r], left[own, r], readings.counts[own, r]))

    def surprise(logs: np.ndarray) -> float:
        scales, total = Scales(*np.exp(logs)), 0.5 * np.sum(((logs - first) / WIDTH) ** 2)
        for places, walls, values, counts in chosen:
            k = _covariance(scales, places, walls) + np.diag(noise(scales, counts))
            factor = cho_factor(k, lower=True)
            total += 0.5 * values @ cho_solve(factor, values) + np.sum(np.log(np.diag(factor[0])))
        return float(total)

    found = minimize(surprise, first, method="L-BFGS-B", bounds=[(x - 2, x + 2) for x in first], options={"maxiter": STEPS})
    return Scales(*(float(x) for x in np.exp(found.x)))
