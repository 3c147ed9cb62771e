"""Measured spectra used together with a field: residual kriging where there are many, a mixture with simple methods where few.

Residual kriging corrects predicted spectra by measured ones, with simple kriging over the transmitter's position:

    k_j = exp(-|x - x_j| / L) over the nearest measured transmitters at the same frequency,   a = (K + noise)^-1 k
    residuals:  f(x) + w a . (y - f)
    spectra:    f(x) + w a . (y - f(x))

The first form interpolates the residuals of the field; the second interpolates the measured spectra themselves, which helps
if the field is overfitted to them, so that their residuals are zero. The form, the correlation length L and the weight w are
selected on the validation part (training/fit_kriging.py), where no correction at all is one of the options. Only the nearest
measurements are used: they screen the others, and a dataset may have thousands. If few transmitters have a frequency in common,
all frequencies may count as the same.

The mixture has weights that depend on the distance to the measurements:

    simple(x) = sum_m w_m(d) s_m(x)                  w = softmax(bias + slope u)
    answer(x) = share(d) f(x) + (1 - share(d)) simple(x),      share = sigmoid(bias + slope u)

u is the standardised logarithm of d, the distance to the nearest measured transmitter, clipped to the range of the data. The
simple methods are the mean spectrum, the nearest spectrum, inverse distance weighting, ordinary kriging (Cressie 1993, section
3.2) with the kernel exp(-|x - x_j| / L), and line of sight. All except the mean and the line of sight use only measurements at
the same frequency, with the same exception. The weights are found by cross-validation (training/fit_mixture.py).
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float, Int, Num, UInt8

from wbgs_jax._util.files import read_tree, write_tree
from wbgs_jax._util.pytree import AnyArray, pytree
from wbgs_jax.radio.array import EXACT, SPEED_OF_LIGHT, snapshot_to_pas, steering_vector
from wbgs_jax.radio.geometry import to_local
from wbgs_jax.types import Query, Receiver

SAME_PLACE_M = 1e-3
"""Distance below which two receivers count as the same, metres."""
NOISE = 1e-2
"""Variance of the part that is not a function of the position, relative to a variance of 1 of the other part."""
MEMBERS = ("mean", "nearest", "inverse_distance", "kriging", "line_of_sight")
"""The simple methods, in the order of the weights."""
SAME_FREQUENCY = 1e-4
"""Relative difference below which two frequencies count as the same."""
NEAREST = 32
"""Maximum number of measured spectra used for a query."""
LOG_METRE = 1e-3
"""Lower bound on distances, metres."""
FILE = "neighbours.npz"


@pytree
class Neighbours:
    """Residual kriging with M measured spectra of one receiver."""

    rx_position: Float[Array, "3"]
    rx_orientation: Float[Array, "4"]
    """Quaternion (wxyz); NaN in older files, which do not hold it."""
    tx_position: Float[Array, "m 3"]
    """Metres, world frame."""
    frequency_hz: Float[Array, " m"]
    """NaN if spectra of all frequencies are used together."""
    images: Num[Array, "m 90 360"]
    """y - f in half precision, or 255 y as bytes."""
    scale: Float[Array, ""]
    """Factor of the images."""
    weight: Float[Array, ""]
    """Weight w."""
    own: Float[Array, ""]
    """Form of the correction: 1 for spectra, 0 for residuals."""
    length: Float[Array, ""]
    """Correlation length L, metres."""


@pytree
class Mixture:
    """M measured spectra of one receiver, and the mixture weights of the simple methods and of the field."""

    rx_position: Float[Array, "3"]
    """Metres, world frame."""
    rx_orientation: Float[Array, "4"]
    """Quaternion (wxyz)."""
    elements: Float[Array, "e 3"]
    """Element positions in the local frame, in wavelengths or metres; empty if the line of sight has no weight."""
    metres: Float[Array, ""]
    """Unit of `elements`: 1 for metres, 0 for wavelengths."""
    tx_position: Float[Array, "m 3"]
    """Metres, world frame."""
    frequency_hz: Float[Array, " m"]
    """NaN if spectra of all frequencies are used together."""
    images: UInt8[Array, "m 90 360"]
    """255 times the spectra."""
    mean: Float[Array, "90 360"]
    """Mean of all measured spectra."""
    length: Float[Array, ""]
    """Correlation length L of the kriging, metres, ..."""
    nugget: Float[Array, ""]
    """... and the variance of the part that is not a function of the position, relative to 1."""
    log_distance: Float[Array, "4"]
    """Mean, standard deviation, minimum and maximum of log d (d in metres) in the fit of the weights."""
    members: Float[Array, "5 2"]
    """Bias and slope of the logit of every simple method."""
    field: Float[Array, "2"]
    """Bias and slope of the logit of the field's weight."""


Beside = Neighbours | Mixture | None
"""Use of measured spectra together with a field: kriging with many measurements, a mixture with few; None: not used."""


def without_queried(neighbours: Beside, query: Query) -> Beside:
    """Returns the measurements without those of the queried links (host); None if none remain."""
    if neighbours is None:
        return None
    near = nearness(neighbours.tx_position, neighbours.frequency_hz, query.tx_position, query.frequency_hz, SAME_PLACE_M)
    return some_of(neighbours, np.flatnonzero(np.asarray(near).max(1, initial=0) < np.exp(-1)))


def some_of(neighbours: Neighbours | Mixture, kept: Int[np.ndarray, " k"]) -> Beside:
    """Returns some of the measurements, given by their indices (host); None if none remain."""
    if not len(kept):
        return None
    taken = {name: getattr(neighbours, name)[kept] for name in ("tx_position", "frequency_hz", "images")}
    if isinstance(neighbours, Mixture):
        taken["mean"] = jnp.asarray(np.asarray(taken["images"]).mean(0) / 255, jnp.float32)
    return dataclasses.replace(neighbours, **taken)


def nearness(
    tx_position: Float[Array, "b 3"],
    frequency_hz: Float[Array, " b"],
    known_position: Float[Array, "m 3"],
    known_frequency: Float[Array, " m"],
    length: Any,
) -> Float[Array, "b m"]:
    """Returns the kernel: exp(-distance / length) at equal frequencies, else 0."""
    offset = tx_position[:, None] - known_position[None]
    distance = jnp.sqrt(jnp.sum(offset**2, -1) + 1e-12)  # differentiable at a measured position
    same = same_frequency(frequency_hz[:, None], known_frequency[None])
    return jnp.where(same, jnp.exp(-distance / length), 0)


def same_frequency(a: Float[Array, "*#b"], b: Float[Array, "*#b"]) -> Bool[Array, "*b"]:
    """Returns whether frequencies count as the same; NaN is the same as all others."""
    return ~(jnp.abs(jnp.log(a / b)) >= SAME_FREQUENCY)


def correct(neighbours: Beside, pas: Float[Array, "b 90 360"], query: Query) -> Float[Array, "b 90 360"]:
    """Returns corrected spectra of a field; far from all measurements in position or frequency, they remain unchanged."""
    if neighbours is None:
        return pas
    if isinstance(neighbours, Mixture):
        return mixed_spectra(neighbours, pas, query)
    queried = query.tx_position, query.frequency_hz, pas
    return jax.lax.map(lambda one: _corrected(neighbours, *one), queried)


def _corrected(
    neighbours: Neighbours, position: Float[Array, "3"], frequency_hz: Float[Array, ""], own: Float[Array, "90 360"]
) -> Float[Array, "90 360"]:
    known, length = (neighbours.tx_position, neighbours.frequency_hz), neighbours.length
    near = nearness(position[None], frequency_hz[None], *known, length)[0]
    k, index = jax.lax.top_k(near, min(NEAREST, len(near)))
    places = known[0][index], known[1][index]
    kernel = nearness(*places, *places, length) + NOISE * jnp.eye(len(k), dtype=k.dtype)
    shares = neighbours.weight * solve(kernel, k)
    interpolated = jnp.tensordot(shares, neighbours.scale * neighbours.images[index].astype(own.dtype), 1, precision=EXACT)
    corrected = own + interpolated - neighbours.own * jnp.sum(shares) * own
    return jnp.where(k[0] > 0, jnp.clip(corrected, 0, 1), own)


def for_receiver(learned: Any, receiver: Receiver) -> Any:
    """Returns what was learned (`Neighbours`, `Mixture`, `Confidence`) restricted to one receiver; None if it was learned
    for other receivers, or from spectra in the frame of another orientation (host)."""
    if learned is None:
        return None
    distance = np.linalg.norm(np.asarray(receiver.position) - np.atleast_2d(learned.rx_position), axis=-1)
    near = int(distance.argmin())
    if distance[near] >= SAME_PLACE_M:
        return None
    turned = isinstance(learned, Neighbours | Mixture) and not same_orientation(receiver.orientation, learned.rx_orientation)
    if turned:
        return None
    return learned if learned.rx_position.ndim == 1 else dataclasses.replace(learned, rx_position=learned.rx_position[near])


def same_orientation(a: Float[AnyArray, "4"], b: Float[AnyArray, "4"]) -> bool:
    """Returns whether two quaternions (wxyz) of any length are the same rotation, or one of them is unknown (host)."""
    least_cosine = 1 - 1e-6  # of half the angle between two orientations that count as the same: a sixth of a degree
    first, second = (np.asarray(one, np.float64) / np.linalg.norm(one) for one in (a, b))
    return not abs(np.dot(first, second)) < least_cosine


def write_neighbours(folder: Path, neighbours: Beside) -> None:
    """Writes the measurements to a run folder; None writes no file."""
    write_tree(folder / FILE, neighbours)


def read_neighbours(folder: Path) -> Beside:
    """Returns the measurements of a run folder; None if it has none. A damaged file is a `UserError`."""
    classes: tuple[type[Mixture | Neighbours], ...] = (Mixture, Neighbours)
    return read_tree(folder / FILE, classes, "use the field alone", {"rx_orientation": np.full(4, np.nan)})


def mixed_spectra(mixture: Mixture, pas: Float[Array, "b 90 360"], query: Query) -> Float[Array, "b 90 360"]:
    """Returns a field's spectra mixed with the simple methods; at frequencies without measurements, the field's alone."""

    def one(queried: Any) -> Float[Array, "90 360"]:
        position, frequency_hz, own = queried
        everything = jnp.ones(len(mixture.frequency_hz), bool)
        spectra, distance = member_spectra(mixture, mixture.mean, position, frequency_hz, everything)
        simple = jnp.tensordot(member_weights(mixture, distance), spectra, 1, precision=EXACT)
        share = field_share(mixture, distance)
        return jnp.where(jnp.isfinite(distance), jnp.clip(share * own + (1 - share) * simple, 0, 1), own)

    return jax.lax.map(one, (query.tx_position, query.frequency_hz, pas))


def member_weights(mixture: Mixture, distance: Float[Array, "*b"]) -> Float[Array, "*b 5"]:
    """Returns the weights of the simple methods, which sum to 1."""
    return jax.nn.softmax(mixture.members[:, 0] + mixture.members[:, 1] * scaled_distance(mixture, distance)[..., None], -1)


def field_share(mixture: Mixture, distance: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns the weight of the field, 0 to 1."""
    return jax.nn.sigmoid(mixture.field[0] + mixture.field[1] * scaled_distance(mixture, distance))


def scaled_distance(mixture: Mixture, distance: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns the standardised logarithm of distances (metres), clipped to the range of the fit."""
    mean, scale, low, high = mixture.log_distance
    return (jnp.clip(jnp.log(jnp.maximum(distance, LOG_METRE)), low, high) - mean) / scale


def member_spectra(
    mixture: Mixture,
    mean: Float[Array, "90 360"],
    position: Float[Array, "3"],
    frequency_hz: Float[Array, ""],
    known: Bool[Array, " m"],
) -> tuple[Float[Array, "5 90 360"], Float[Array, ""]]:
    """Returns the spectra of the simple methods for one query, and its distance (metres) to the nearest measured transmitter,
    which is infinite without measurements at the frequency.

    Args:
        mixture: the measured spectra; its weights are not used.
        mean: mean of the spectra that may be used.
        position: position of the transmitter, world frame, metres.
        frequency_hz: frequency of the query.
        known: mask of the spectra that may be used.
    """
    known &= same_frequency(mixture.frequency_hz, frequency_hz)
    offset = position - mixture.tx_position
    distance = jnp.where(known, jnp.sqrt(jnp.sum(offset**2, -1) + 1e-12), jnp.inf)  # differentiable at a measured position
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
    k = jnp.where(
        there, jnp.exp((near[0] - near) / mixture.length), 0
    )  # relative to the nearest: far away, squares would underflow
    simple, ones = (solve(kernel, side) for side in (k, there.astype(k.dtype)))
    simple *= jnp.exp(-near[0] / mixture.length)
    return simple + (1 - jnp.sum(simple)) * _normalised(ones)


def solve(kernel: Float[Array, "k k"], side: Float[Array, " k"]) -> Float[Array, " k"]:
    """Returns the solution of the kriging equations for up to `NEAREST` spectra.

    Conjugate gradients can be exported for all platforms, unlike a factorisation; they converge within as many steps as there
    are unknowns, up to rounding.
    """
    solution, _ = cg(lambda v: jnp.matmul(kernel, v, precision=EXACT), side, tol=1e-7, maxiter=2 * NEAREST)
    return solution


def _normalised(weights: Float[Array, " k"]) -> Float[Array, " k"]:
    total = jnp.sum(weights)
    return weights / jnp.where(total == 0, 1, total)


def _line_of_sight(mixture: Mixture, position: Float[Array, "3"], frequency_hz: Float[Array, ""]) -> Float[Array, "90 360"]:
    """Returns the spectrum of a plane wave from the transmitter; zeros for an array without elements."""
    if not len(mixture.elements):
        return jnp.zeros_like(mixture.mean)
    offset = position - mixture.rx_position
    direction = offset / jnp.sqrt(jnp.sum(offset**2) + 1e-12)
    elements = mixture.elements * jnp.where(mixture.metres > 0, frequency_hz / SPEED_OF_LIGHT, 1)
    phases = steering_vector(elements, to_local(direction[None], mixture.rx_orientation))
    return snapshot_to_pas(phases, elements)[0]
