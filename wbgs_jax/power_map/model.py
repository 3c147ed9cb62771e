"""Received power, averaged over fading, as a function of the transmitter's position: a path loss law with distance and walls,
and a Gaussian process for its residuals.

    P_r(x) = a - 10 n log10 d - l sqrt(w) + u_r(x) + sqrt(w) v_r(x)

with d the distance to receiver r and w the number of walls in between. Further walls cost less than the first one, since waves
through doors and around corners do not cross them (compare the multi-wall model of COST 231, final report, section 4.7, with
its decreasing loss of further floors). The law is common to all receivers and fitted by least squares, in which the readings of
one square metre count as one, so that it holds where nothing was measured. The residuals u and v, due to rooms and individual
walls, decay with the distance from the measurements (exponential covariance; Rasmussen and Williams 2006, chapter 2).
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
"""Prior means of the power at one metre (dBm), the exponent and the loss of a wall (dB), ..."""
LAW_WIDTH = np.array([30.0, 1.0, 4.0])
"""... and their prior standard deviations."""
APART = 5.0
"""Standard deviation of the error of the law where readings within a metre count as one, dB."""
NEAREST = 0.1
"""Metres: lower bound on distances."""
MAX_PLACES = 1500
"""Maximum number of positions of a map."""
MIN_POWERS = 10
"""Minimum number of received powers to learn from."""
LENGTH = 1.0
"""Correlation length of u and v, metres. It is not learned: the maximum-likelihood value in one room is longer and gives wrong
predictions in the next."""


@dataclass(frozen=True)
class Scales:
    """Standard deviations of the residuals of the law, dB."""

    room: float = 4.0
    """Standard deviation of u (rooms), ..."""
    wall: float = 4.0
    """... of v (walls), ..."""
    place: float = 0.5
    """... of the part that is not a function of the position, ..."""
    reading: float = 4.5
    """... and of a single reading (fading)."""


@pytree
class PowerMap:
    """Map learned from N positions at R receivers."""

    receivers: Float[Array, "r 3"]
    walls: Walls
    places: Float[Array, "n 3"]
    law: Float[Array, "3"]
    """Power at one metre (dBm), exponent, loss of the first wall (dB)."""
    law_covariance: Float[Array, "3 3"]
    scales: Float[Array, "4"]
    """The values of `Scales`, in order."""
    features: Float[Array, "n r"]
    """sqrt(w) of the positions."""
    weights: Float[Array, "r n"]
    """(K + noise)^-1 (powers - law)."""
    inverse_root: Float[Array, "r n n"]
    """L^-1 of K + noise = L L^T."""


def learn_map(readings: Readings, walls: Walls = NO_WALLS, scales: Scales | None = None) -> PowerMap:
    """Returns the map learned from means of readings (`rssi_folder.cell_means`), in float32.

    Args:
        readings: at most `MAX_PLACES` positions.
        walls: of the floor plan.
        scales: standard deviations of the residuals; by default they are learned.

    Returns:
        The map, a pytree for `received_power`.

    Raises:
        UserError: too few powers, or too many positions.
    """
    received = np.isfinite(readings.powers)
    if received.sum() < MIN_POWERS:
        raise UserError(f"{int(received.sum())} powers are too few to learn from; at least {MIN_POWERS} are needed")
    if len(readings.places) > MAX_PLACES:
        raise UserError(f"{len(readings.places)} positions exceed the limit of a map ({MAX_PLACES}); average over larger cells")
    law_features = _law_features(readings.places, readings.receivers, walls)
    law, covariance = _law(readings, law_features)
    left = np.where(received, readings.powers - law_features @ law, 0)
    if scales is None:
        scales = learn_scales(readings, -law_features[..., 2], left)
    root_walls, n = -law_features[..., 2], len(readings.places)
    weights, roots = np.zeros((len(readings.receivers), n)), np.zeros((len(readings.receivers), n, n))
    for r in range(len(readings.receivers)):
        own = np.flatnonzero(received[:, r])
        k = _covariance(scales, readings.places[own], root_walls[own, r])
        k[np.diag_indices(len(own))] += noise(scales, readings.counts[own, r])
        factor = np.linalg.cholesky(k)
        weights[r, own] = cho_solve((factor, True), left[own, r])
        roots[r][np.ix_(own, own)] = solve_triangular(factor, np.eye(len(own)), lower=True)
    arrays = readings.places, law, covariance, np.array([*vars(scales).values()]), root_walls, weights, roots
    return PowerMap(*jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (readings.receivers, walls, *arrays)))


def received_power(learned: PowerMap, tx_position: Float[Array, "b 3"]) -> tuple[Float[Array, "b r"], Float[Array, "b r"]]:
    """Returns the mean received power (dBm) of B transmitters at all receivers, and its standard deviation (dB), which is the
    uncertainty of the mean, not the spread of a single reading. Pure; supports `jit`, `vmap` and `grad`.

    Args:
        learned: the map.
        tx_position: metres.

    Returns:
        Mean (b, r), dBm, and standard deviation (b, r), dB.
    """
    features = _law_features(tx_position, learned.receivers, learned.walls)
    room, wall = learned.scales[:2]
    walls = -features[..., 2]
    k = alike(tx_position, learned.places)[:, None] * (room**2 + wall**2 * walls[..., None] * learned.features.T)
    exact = partial(jnp.einsum, precision=EXACT)  # the variance is a difference of large numbers
    mean = exact("bri,i->br", features, learned.law) + exact("brn,rn->br", k, learned.weights)
    explained = jnp.sum(exact("rmn,brn->brm", learned.inverse_root, k) ** 2, -1)
    of_law = exact("bri,ij,brj->br", features, learned.law_covariance, features)
    variance = room**2 + wall**2 * walls**2 - explained + of_law
    return mean, jnp.sqrt(jnp.maximum(variance, 0))


def distances(a: Any, b: Any) -> Any:
    """Returns the distances (metres) of positions (n, 3) from others (m, 3) as (n, m), with a finite gradient at 0."""
    return namespace(a).sqrt(namespace(a).sum((a[:, None] - b) ** 2, -1) + 1e-12)


def alike(a: Any, b: Any) -> Any:
    """Returns the correlation (n, m) of the residuals at positions (n, 3) and at others (m, 3)."""
    return namespace(a).exp(-distances(a, b) / LENGTH)


def noise(scales: Scales, counts: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Returns the variance (dB^2) of means of `counts` readings around the part that is a function of the position."""
    return scales.place**2 + scales.reading**2 / counts


def _law_features(tx: Any, receivers: Any, walls: Walls) -> Any:
    """Returns the factors (b, r, 3) of the law's three parameters."""
    xp = namespace(tx)
    distance = xp.maximum(distances(tx, receivers), NEAREST)
    between = crossings(walls, tx[:, None, :2], receivers[None, :, :2])
    root = xp.sqrt(xp.where(between > 0, between, 1.0)) * (between > 0)
    return xp.stack([xp.ones_like(distance), -10 * xp.log10(distance), -root], -1)


def _law(readings: Readings, features: Float[np.ndarray, "n r 3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Returns the law by least squares with a normal prior, and its covariance."""
    side = 1.0  # metres: the readings within a square of this size count as one reading in the fit of the law
    _, square = np.unique(np.floor(readings.places / side).astype(int), axis=0, return_inverse=True)
    received = np.isfinite(readings.powers)
    weights = np.zeros(readings.powers.shape)
    for r in range(len(readings.receivers)):
        own = square.reshape(-1)[received[:, r]]
        weights[received[:, r], r] = 1 / (APART**2 * np.bincount(own, minlength=square.max() + 1)[own])
    left = np.where(received, readings.powers - features @ LAW, 0)
    precision = np.einsum("nri,nr,nrj->ij", features, weights, features) + np.diag(LAW_WIDTH**-2.0)
    covariance = np.linalg.inv(precision)
    return LAW + covariance @ np.einsum("nri,nr,nr->i", features, weights, left), covariance


def _covariance(
    scales: Scales, places: Float[np.ndarray, "n 3"], root_walls: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n n"]:
    """Returns the covariance of the residuals at one receiver."""
    return alike(places, places) * (scales.room**2 + scales.wall**2 * np.outer(root_walls, root_walls))


def learn_scales(readings: Readings, root_walls: Float[np.ndarray, "n r"], left: Float[np.ndarray, "n r"]) -> Scales:
    """Returns the scales of maximum posterior probability, with the values of `Scales` as prior medians."""
    first = np.log(np.array(list(vars(Scales()).values())))
    received = np.isfinite(readings.powers)
    outwards = np.argsort(np.linalg.norm(readings.places - readings.places[0], axis=-1), kind="stable")
    chosen = []
    looked_at = 400  # positions of every receiver that are used to learn the scales
    for r in range(len(readings.receivers)):
        own = outwards[received[outwards, r]][:looked_at]
        close = alike(readings.places[own], readings.places[own])
        by_walls = close * np.outer(root_walls[own, r], root_walls[own, r])
        chosen.append((close, by_walls, 1 / readings.counts[own, r], left[own, r]))

    width, steps = 0.5, 15  # prior standard deviation of the logarithms of all scales, and the number of optimisation steps

    def negative_log_posterior(logs: np.ndarray) -> tuple[float, np.ndarray]:
        away = (logs - first) / width
        total, gradient = 0.5 * np.sum(away**2), away / width
        room, wall, place, reading = np.exp(2 * logs)
        for close, by_walls, shares, values in chosen:
            k = room * close + wall * by_walls
            k[np.diag_indices(len(values))] += place + reading * shares
            factor = cho_factor(k, lower=True)
            weights, inverse = cho_solve(factor, values), cho_solve(factor, np.eye(len(values)))
            total += 0.5 * values @ weights + np.sum(np.log(np.diag(factor[0])))
            slope = inverse - np.outer(weights, weights)  # twice the derivative by K
            own = np.diag(slope)
            gradient = gradient + np.exp(2 * logs) * [np.sum(slope * close), np.sum(slope * by_walls), own.sum(), own @ shares]
        return float(total), gradient

    bounds = [(x - 2, x + 2) for x in first]
    options = {"maxiter": steps}
    found = minimize(negative_log_posterior, first, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return Scales(*(float(x) for x in np.exp(found.x)))
