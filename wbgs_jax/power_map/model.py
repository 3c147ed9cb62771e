"""Received power, averaged over fading, as a function of the transmitter's position: a path loss law with distance, walls and
storeys, and a Gaussian process for its residuals.

    P_r(x) = a - 10 n log10 d - l sqrt(w) - s L(k) + g_r + u_r(x) + sqrt(w) v_r(x)

with d the distance to receiver r, w the number of walls and k the number of ceilings in between. Further walls and ceilings
cost less than the first one, since waves through doors, around corners and along facades do not cross them: L(k) is the
decreasing loss of further floors of the multi-wall model (COST 231, final report, section 4.7), and sqrt(w) its counterpart for
walls; if walls have classes, l is a mean over those in between. The law is common to all receivers and fitted by least squares,
in which the readings of one cubic metre count as one, so that it holds where nothing was measured. The residuals are the gain
g of a receiver, u, due to rooms and furniture, and v, due to individual walls. A part of u decays within a metre, as v does,
another one over rooms (exponential covariances; Rasmussen and Williams 2006, chapter 2). Its length and all shares follow from
the data (`learn_scales`): they are the most probable ones for the residuals (section 5.4).
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.data.floor_plan import NO_WALLS, Walls, crossed, namespace
from wbgs_jax.data.rssi_folder import Readings
from wbgs_jax.radio.array import EXACT

LENGTH = 1.0
"""Correlation length of the residuals near a place and of those behind walls, metres."""
Scale = float | Float[Array, ""]


@dataclass(frozen=True)
class Scales:
    """Standard deviations of the residuals of the law (dB), and a length. The defaults are prior medians: receivers of one kind
    differ by about a decibel, the shadows of rooms and furniture by a few."""

    near: Scale = 3.0
    """Standard deviation of the part of u that decays within a metre, ..."""
    far: Scale = 3.0
    """... of the part that decays over rooms, ..."""
    wall: Scale = 4.0
    """... of v (walls), ..."""
    gain: Scale = 1.0
    """... of the gains of receivers, ..."""
    place: Scale = 0.5
    """... of the part that is not a function of the position, ..."""
    reading: Scale = 4.5
    """... and of a single reading (fading)."""
    length_m: Scale = 5.0
    """Correlation length of the part that decays over rooms, metres."""


WIDTHS = Scales(near=0.7, far=0.7, wall=0.7, gain=1.0, place=0.5, reading=0.5, length_m=0.7)
"""Prior standard deviations of the logarithms of all scales."""


def distances(a: Any, b: Any) -> Any:
    """Returns the distances (metres) of positions (n, 3) from others (m, 3) as (n, m), with a finite gradient at 0."""
    return namespace(a).sqrt(namespace(a).sum((a[:, None] - b) ** 2, -1) + 1e-12)


def alike(apart: Any) -> Any:
    """Returns the correlation of nearby residuals whose positions are `apart`, metres."""
    return namespace(apart).exp(-apart / LENGTH)


def covariance(scales: Scales, apart: Any, shared: Any, root_walls: Any, others: Any) -> Any:
    """Returns the covariance (dB^2) of residuals at one receiver.

    Args:
        scales: standard deviations and length.
        apart: distances between the two positions of each pair, metres.
        shared: `in_one_room` of each pair.
        root_walls: sqrt(w) of the first position of each pair, ...
        others: ... and of the second.
    """
    near = (scales.near**2 + scales.wall**2 * root_walls * others) * alike(apart)
    return near + scales.far**2 * shared * namespace(apart).exp(-apart / scales.length_m) + scales.gain**2


def in_one_room(crossed: Any, others: Any) -> Any:
    """Returns the correlation (b, n) of residuals by what is crossed towards all receivers, which marks a room, because rooms
    have shadows of their own: the smaller, the more the numbers of walls and ceilings differ, in the mean over receivers.

    Args:
        crossed: sqrt(w) and L(k) of the links from positions to all receivers (b, r, 2), ...
        others: ... and from others (n, r, 2).
    """
    fall = 10.0  # anything between 3 and 30 scores alike
    first, second = (marks.reshape(len(marks), -1) for marks in (crossed, others))
    if namespace(crossed) is np:
        differences = cdist(first, second, "cityblock")
    else:
        differences = abs(first[:, None] - second).sum(-1)
    return namespace(crossed).exp(-fall * differences / crossed.shape[1])


def noise(scales: Scales, counts: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Returns the variance (dB^2) of means of `counts` readings around the part that is a function of the position."""
    return float(scales.place) ** 2 + float(scales.reading) ** 2 / counts


def learn_scales(
    readings: Readings,
    root_walls: Float[np.ndarray, "n r"],
    shared: Float[np.ndarray, "n n"],
    left: Float[np.ndarray, "n r"],
) -> Scales:
    """Returns the scales of maximum posterior probability, with the values of `Scales` as prior medians.

    Args:
        readings: positions and numbers of readings.
        root_walls: sqrt(w) of every link.
        shared: `in_one_room` of all positions.
        left: residuals of the law, dB.
    """
    first, widths = np.log([*vars(Scales()).values()]), np.array([*vars(WIDTHS).values()])
    received = np.isfinite(readings.powers)
    shuffled = np.random.default_rng(0).permutation(len(received))  # a part has to contain neighbours and distant places
    looked_at = int(min(400, 400 * (8 / max(received.any(0).sum(), 1)) ** (1 / 3)))  # positions of every receiver that are used
    chosen = []
    for r in np.flatnonzero(received.any(0)):
        own = shuffled[received[shuffled, r]][:looked_at]
        apart = distances(readings.places[own], readings.places[own])
        by_walls = alike(apart) * np.outer(root_walls[own, r], root_walls[own, r])
        chosen.append((apart, by_walls, shared[np.ix_(own, own)], 1 / readings.counts[own, r], left[own, r]))

    def negative_log_posterior(logs: np.ndarray) -> tuple[float, np.ndarray]:
        away = (logs - first) / widths
        total, gradient = 0.5 * np.sum(away**2), away / widths
        near, far, wall, gain, place, reading, _ = np.exp(2 * logs)
        length = np.exp(logs[-1])
        for apart, by_walls, in_room, shares, values in chosen:
            close, wide = alike(apart), in_room * np.exp(-apart / length)
            k = near * close + far * wide + wall * by_walls + gain
            k[np.diag_indices(len(values))] += place + reading * shares
            factor = cho_factor(k, lower=True)
            weights, inverse = cho_solve(factor, values), cho_solve(factor, np.eye(len(values)))
            total += 0.5 * values @ weights + np.sum(np.log(np.diag(factor[0])))
            slope = inverse - np.outer(weights, weights)  # twice the derivative by K
            diagonal, of_far = np.diag(slope), slope * wide
            by_scale = [np.sum(slope * close), np.sum(of_far), np.sum(slope * by_walls), np.sum(slope)]
            by_noise = [diagonal.sum(), diagonal @ shares]
            parts = [*by_scale, *by_noise, 0.5 * np.sum(of_far * apart) / length]
            gradient = gradient + np.array([near, far, wall, gain, place, reading, far]) * parts
        return float(total), gradient

    bounds = [(x - 2.3, x + 2.3) for x in first]
    found = minimize(negative_log_posterior, first, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 30})
    return Scales(*(float(x) for x in np.exp(found.x)))


LAW = np.array([-45.0, 2.0, 6.0, 15.0])
"""Prior means of the power at one metre (dBm), the exponent, the loss of a wall and of a ceiling (dB), ..."""
LAW_WIDTH = np.array([30.0, 1.0, 4.0, 8.0])
"""... and their prior standard deviations."""
APART = 5.0
"""Standard deviation of the error of the law where readings within a metre count as one, dB."""
NEAREST = 0.1
"""Metres: lower bound on distances."""
MAX_PLACES = 1500
"""Maximum number of positions of a map."""
MIN_POWERS = 10
"""Minimum number of received powers to learn from."""


@pytree
class PowerMap:
    """Map learned from N positions at R receivers."""

    receivers: Float[Array, "r 3"]
    walls: Walls
    ceilings: Float[Array, " c"]
    """Heights of the ceilings between storeys, metres."""
    places: Float[Array, "n 3"]
    law: Float[Array, " k"]
    """Power at one metre (dBm), exponent, loss of the first wall and of the first ceiling (dB), and the additional loss of the
    first wall of each class (dB)."""
    law_covariance: Float[Array, "k k"]
    scales: Float[Array, "7"]
    """The values of `Scales`, in order."""
    crossed: Float[Array, "n r 2"]
    """sqrt(w) and L(k) of the links from the positions."""
    weights: Float[Array, "r n"]
    """(K + noise)^-1 (powers - law)."""
    inverse_root: Float[Array, "r n n"]
    """L^-1 of K + noise = L L^T."""


def learn_map(readings: Readings, walls: Walls = NO_WALLS, scales: Scales | None = None) -> PowerMap:
    """Returns the map learned from means of readings (`rssi_folder.cell_means`), in float32.

    Args:
        readings: at most `MAX_PLACES` positions.
        walls: of the floor plan.
        scales: standard deviations of the residuals and their length; by default they are learned.

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
    ceilings = find_ceilings(readings.places[:, 2])
    features = law_features(readings.places, readings.receivers, walls, ceilings)
    law, law_covariance = fit_law(readings, features)
    crossed, left = -features[..., 2:4], residuals(readings, features, law)
    root_walls, shared = crossed[..., 0], in_one_room(crossed, crossed)
    if scales is None:
        scales = learn_scales(readings, root_walls, shared, left)
    n = len(readings.places)
    weights, roots = np.zeros((len(readings.receivers), n)), np.zeros((len(readings.receivers), n, n))
    for r in range(len(readings.receivers)):
        own = np.flatnonzero(received[:, r])
        factor = np.linalg.cholesky(covariance_of_powers(scales, readings, root_walls, shared, own, r))
        weights[r, own] = cho_solve((factor, True), left[own, r])
        roots[r][np.ix_(own, own)] = solve_triangular(factor, np.eye(len(own)), lower=True)
    numbers = np.array([*vars(scales).values()])
    arrays = ceilings, readings.places, law, law_covariance, numbers, crossed, weights, roots
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
    features = law_features(tx_position, learned.receivers, learned.walls, learned.ceilings)
    scales, crossed = Scales(*learned.scales), -features[..., 2:4]
    root_walls = crossed[..., 0]
    apart, shared = distances(tx_position, learned.places), in_one_room(crossed, learned.crossed)
    k = covariance(scales, apart[:, None], shared[:, None], root_walls[..., None], learned.crossed[..., 0].T)
    exact = partial(jnp.einsum, precision=EXACT)  # the variance is a difference of large numbers
    mean = exact("bri,i->br", features, learned.law) + exact("brn,rn->br", k, learned.weights)
    explained = jnp.sum(exact("rmn,brn->brm", learned.inverse_root, k) ** 2, -1)
    of_law = exact("bri,ij,brj->br", features, learned.law_covariance, features)
    variance = covariance(scales, 0.0, 1.0, root_walls, root_walls) - explained + of_law
    least = 1e-6  # dB^2: with a finite gradient where rounding leaves nothing
    return mean, jnp.sqrt(jnp.maximum(variance, least))


def find_ceilings(heights: Float[np.ndarray, " n"]) -> Float[np.ndarray, " c"]:
    """Returns the heights of the ceilings between transmitters of several storeys, metres: below each storey's lowest
    transmitter by the height above the floor at which it is carried, but not below the middle to the storey underneath. That
    height is the one of the lowest transmitter above z = 0, if it is at most 1.3 m, and 1.3 m otherwise. A few transmitters
    between storeys, on stairs, do not count."""
    storey, usual = 1.8, 1.3  # metres: smallest step of heights between storeys, and height at which people carry transmitters
    around, few = 0.3, 0.02  # metres, and the least fraction of transmitters within these of a level
    ordered = np.sort(heights)
    near = np.searchsorted(ordered, ordered + around, "right") - np.searchsorted(ordered, ordered - around)
    levels = np.unique(ordered[near >= few * len(ordered)])
    if not len(levels):
        return levels
    carried = levels[0] if 0 < levels[0] < usual else usual
    below, above = levels[:-1], levels[1:]
    return np.maximum(above - carried, (below + above) / 2)[above - below > storey]


def storeys_of(positions: Any, ceilings: Any) -> Any:
    """Returns the number of ceilings below each position (n, 3)."""
    return namespace(positions).sum(positions[:, 2, None] > ceilings, -1)


def law_features(tx: Any, receivers: Any, walls: Walls, ceilings: Any) -> Any:
    """Returns the factors (b, r, 4 + c) of the law's parameters: four of all walls, and the additional loss of each class."""
    xp = namespace(tx)
    distance = xp.maximum(distances(tx, receivers), NEAREST)
    each = crossed(walls, tx[:, None, :2], receivers[None, :, :2])
    between = xp.sum(each, -1)
    root = xp.sqrt(xp.where(between > 0, between, 1.0)) * (between > 0)
    storeys = xp.abs(storeys_of(tx, ceilings)[:, None] - storeys_of(receivers, ceilings))
    decrease = 0.46  # b of COST 231, section 4.7
    further = xp.maximum(storeys, 1) ** ((storeys + 2) / (storeys + 1) - decrease) * (storeys > 0)
    law = xp.stack([xp.ones_like(distance), -10 * xp.log10(distance), -root, -further], -1)
    if walls.of_class is None:
        return law
    # -sqrt(w) times the fraction of the class.
    of_class = -(each @ walls.of_class) / xp.where(between > 0, root, 1.0)[..., None]
    return xp.concatenate([law, of_class], -1)


def fit_law(
    readings: Readings, features: Float[np.ndarray, "n r k"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """Returns the law by least squares with a normal prior, and its covariance."""
    classes = features.shape[-1] - len(LAW)
    class_width = 4.0  # prior standard deviation of the additional loss of walls of a class, dB
    prior, width = np.append(LAW, np.zeros(classes)), np.append(LAW_WIDTH, np.full(classes, class_width))
    side = 1.0  # metres: the readings within a cube of this size count as one reading in the fit of the law
    _, cube = np.unique(np.floor(readings.places / side).astype(int), axis=0, return_inverse=True)
    received = np.isfinite(readings.powers)
    weights = np.zeros(readings.powers.shape)
    for r in range(len(readings.receivers)):
        own = cube.reshape(-1)[received[:, r]]
        weights[received[:, r], r] = 1 / (APART**2 * np.bincount(own, minlength=cube.max() + 1)[own])
    left = residuals(readings, features, prior)
    precision = np.einsum("nri,nr,nrj->ij", features, weights, features) + np.diag(width**-2.0)
    law_covariance = np.linalg.inv(precision)
    return prior + law_covariance @ np.einsum("nri,nr,nr->i", features, weights, left), law_covariance


def residuals(
    readings: Readings, features: Float[np.ndarray, "n r k"], law: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "n r"]:
    """Returns what a law leaves of the powers (dB); 0 where nothing was received."""
    return np.where(np.isfinite(readings.powers), readings.powers - features @ law, 0)


def covariance_of_powers(
    scales: Scales,
    readings: Readings,
    root_walls: Float[np.ndarray, "n r"],
    shared: Float[np.ndarray, "n n"],
    own: Int[np.ndarray, " m"],
    r: int,
) -> Float[np.ndarray, "m m"]:
    """Returns the covariance (dB^2) of the residuals of the mean powers of the places `own` at receiver r, with their noise."""
    places, walls = readings.places[own], root_walls[own, r]
    k = covariance(scales, distances(places, places), shared[np.ix_(own, own)], walls[:, None], walls)
    return np.asarray(k) + np.diag(noise(scales, readings.counts[own, r]))
