"""Whether snapshots are in the library's conventions, judged by their lines of sight: phases that fall with the delay, and
receivers' quaternions in the order w, x, y, z."""

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.spatial.transform import Rotation

from wbgs_jax._util.statistics import standard_error
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.radio.array import SPEED_OF_LIGHT

CONJUGATE = (
    "lines of sight fit the conjugate of the snapshots clearly better; give phases exp(-2j pi f tau), as baseband has them"
)
REORDERED = "lines of sight fit clearly better if receivers' orientations are x, y, z, w; write them as w, x, y, z"


def other_convention(dataset: Dataset) -> str:
    """Returns which other reading of the snapshots fits the directions of transmitters clearly better; empty without one or
    without snapshots. Test links are not used."""
    seen, values = np.sort(np.concatenate([dataset.train, dataset.validation])), dataset.snapshots
    most, fewest = 1000, 10  # links, and transmitters
    if values is None or len(np.unique(dataset.tx_index[seen])) < fewest:
        return ""
    seen = seen[np.linspace(0, len(seen) - 1, min(len(seen), most)).astype(int)]
    snapshots = np.asarray(values[seen], np.complex128)
    turn = np.asarray(dataset.receivers.orientation, np.float64)
    steering, reordered = (_steering(dataset, seen, orientation) for orientation in (turn, np.roll(turn, 1, -1)))
    own = _explained(snapshots, steering)
    others = {CONJUGATE: _explained(snapshots.conj(), steering), REORDERED: _explained(snapshots, reordered)}
    clear, errors = 0.12, 5.0  # mean gain in the share of power that is explained, and its distance from zero, standard errors
    gains = {reason: standard_error(other - own, dataset.tx_index[seen]) for reason, other in others.items()}
    best = max(gains, key=lambda reason: round(gains[reason][0], 3))
    gain, error = gains[best]
    return best if gain > max(clear, errors * error) else ""


def _steering(
    dataset: Dataset, links: Int[np.ndarray, " n"], orientations: Float[np.ndarray, "r 4"]
) -> Complex[np.ndarray, "n e"]:
    """Returns the phases of plane waves from the transmitters, with the receivers in some orientations."""
    receivers, which = dataset.receivers, dataset.receiver_index[links]
    offset = dataset.tx_positions[links] - np.asarray(receivers.position, np.float64)[which]
    turns = Rotation.from_quat(np.roll(orientations, -1, 1)).as_matrix()[which]
    local = np.einsum("nij,ni->nj", turns, offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9))
    elements = np.asarray(receivers.element_positions, np.float64)[which]
    if receivers.unit == "metres":
        elements = elements * (dataset.frequencies_hz[links] / SPEED_OF_LIGHT)[:, None, None]
    return np.exp(2j * np.pi * np.einsum("nek,nk->ne", elements, local))


def _explained(snapshots: Complex[np.ndarray, "n e"], steering: Complex[np.ndarray, "n e"]) -> Float[np.ndarray, " n"]:
    """Returns the share of the power of snapshots that one plane wave explains."""
    power = np.sum(np.abs(snapshots) ** 2, -1)
    return np.abs(np.sum(steering.conj() * snapshots, -1)) ** 2 / np.maximum(steering.shape[1] * power, 1e-300)
