"""Snapshots in the conventions of other programs, recognised by their lines of sight: phases that rise with the delay,
receivers' quaternions in another order than w, x, y, z, elements in another unit or order, and rows that belong to other
transmitters.
"""

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
OTHER_UNIT = {
    "wavelengths": "lines of sight fit clearly better if element_positions are metres; set element_unit to 'metres'",
    "metres": "lines of sight fit clearly better if element_positions are wavelengths; set element_unit to 'wavelengths'",
}
OTHER_ORDER = (
    "lines of sight fit clearly better if the elements of the array are counted in another order, with rows and columns "
    "exchanged or one of them reversed; give element_positions in the order of the snapshots, and right-handed frames"
)
SHUFFLED = (
    "snapshots are waves from single directions, but fit the lines of sight to other transmitters no worse than those to their "
    "own; row k of tx_positions must belong to row k of the snapshots, in one frame with the receivers"
)
POINT = (
    "all elements of a receiver's array are at one point, so that its spectra are the same in all directions and only powers "
    "can be learned; give element_positions of an array, or power_db"
)


def other_convention(dataset: Dataset) -> str:
    """Returns which other reading of the snapshots fits the directions of transmitters clearly better, or that none can; empty
    if the given one fits or nothing is known. Test links are not used."""
    values, elements = dataset.snapshots, np.asarray(dataset.receivers.element_positions, np.float64)
    if values is None:
        return ""
    if (np.ptp(elements, axis=1) == 0).all(-1).any():
        return POINT
    seen = np.sort(np.concatenate([dataset.train, dataset.validation]))
    most, fewest = 1000, 10  # links, and transmitters
    if len(np.unique(dataset.tx_index[seen])) < fewest:
        return ""
    seen = seen[np.linspace(0, len(seen) - 1, min(len(seen), most)).astype(int)]
    snapshots = np.asarray(values[seen], np.complex128)
    turn, unit = np.asarray(dataset.receivers.orientation, np.float64), dataset.receivers.unit
    other_unit = "metres" if unit == "wavelengths" else "wavelengths"
    directions = _directions(dataset, seen, turn)

    def fit(local: Float[np.ndarray, "n 3"], elements: Float[np.ndarray, "r e 3"], unit: str) -> Float[np.ndarray, " n"]:
        return _explained(snapshots, _steering(dataset, seen, local, elements, unit))

    steering = _steering(dataset, seen, directions, elements, unit)
    own = _explained(snapshots, steering)
    others = {
        CONJUGATE: _explained(snapshots.conj(), steering),
        REORDERED: fit(_directions(dataset, seen, np.roll(turn, 1, -1)), elements, unit),
        OTHER_UNIT[unit]: fit(directions, elements, other_unit),
    }
    if orders := [fit(directions, listed, unit) for listed in _other_orders(elements)]:
        others[OTHER_ORDER] = max(orders, key=np.mean)
    clear, errors = 0.12, 5.0  # mean gain in the share of power that is explained, and its distance from zero, standard errors
    gains = {reason: standard_error(other - own, dataset.tx_index[seen]) for reason, other in others.items()}
    best = max(gains, key=lambda reason: round(gains[reason][0], 3))
    gain, error = gains[best]
    if gain > max(clear, errors * error):
        return best
    return SHUFFLED if _shuffled(dataset, seen, snapshots, directions) else ""


def _directions(dataset: Dataset, links: Int[np.ndarray, " n"], orientations: Float[np.ndarray, "r 4"]) -> np.ndarray:
    """Returns the directions of the transmitters (n, 3) in the frames of the receivers, in some orientations."""
    which = dataset.receiver_index[links]
    offset = dataset.tx_positions[links] - np.asarray(dataset.receivers.position, np.float64)[which]
    turns = Rotation.from_quat(np.roll(orientations, -1, 1)).as_matrix()[which]
    return np.einsum("nij,ni->nj", turns, offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9))


def _steering(
    dataset: Dataset,
    links: Int[np.ndarray, " n"],
    directions: Float[np.ndarray, "n 3"],
    elements: Float[np.ndarray, "r e 3"],
    unit: str,
) -> Complex[np.ndarray, "n e"]:
    """Returns the phases of plane waves from directions in the frames of the receivers."""
    own = elements[dataset.receiver_index[links]]
    if unit == "metres":
        own = own * (dataset.frequencies_hz[links] / SPEED_OF_LIGHT)[:, None, None]
    return np.exp(2j * np.pi * np.einsum("nek,nk->ne", own, directions))


def _explained(snapshots: Complex[np.ndarray, "*#n e"], steering: Complex[np.ndarray, "*#n e"]) -> Float[np.ndarray, "*n"]:
    """Returns the share of the power of snapshots that one plane wave explains; leading axes broadcast."""
    power = np.sum(np.abs(snapshots) ** 2, -1)
    return np.abs(np.sum(steering.conj() * snapshots, -1)) ** 2 / np.maximum(steering.shape[-1] * power, 1e-300)


def _other_orders(elements: Float[np.ndarray, "r e 3"]) -> list[Float[np.ndarray, "r e 3"]]:
    """Returns the elements of planar grids with rows and columns exchanged, or one of them reversed; nothing for other
    arrays. Both reversed is the conjugate."""
    receivers, count = elements.shape[:2]
    for n in range(2, count // 2 + 1):
        if count % n:
            continue
        grid = elements.reshape(receivers, n, -1, 3)
        offset = grid - grid[:, :1, :1]
        row, column = offset[:, 0], offset[:, :, 0]
        bent = np.abs(np.cross(row, row[:, 1:2])).max() + np.abs(np.cross(column, column[:, 1:2])).max()
        skew = np.abs(offset - row[:, None] - column[:, :, None]).max()
        if bent + skew < 1e-6 and np.cross(row[:, 1], column[:, 1]).any(-1).all():
            turned = [grid, grid[:, ::-1], grid[:, :, ::-1], grid[:, ::-1, ::-1]]
            orders = [*turned[1:3], *(own.swapaxes(1, 2) for own in turned)]
            return [own.reshape(elements.shape) for own in orders]
    return []


def _shuffled(
    dataset: Dataset,
    links: Int[np.ndarray, " n"],
    snapshots: Complex[np.ndarray, "n e"],
    directions: Float[np.ndarray, "n 3"],
) -> bool:
    """Returns whether snapshots are plane waves, but from the directions of other transmitters as much as from their own."""
    # Links and transmitters that are compared; random orders of them, and share of these that is exceeded.
    fewest, most, draws, better = 24, 200, 20, 0.9
    which, hertz = dataset.receiver_index[links], dataset.frequencies_hz[links]
    same = np.flatnonzero((which == which[0]) & (hertz == hertz[0]))[:most]
    if len(np.unique(dataset.tx_index[links[same]])) < fewest:
        return False
    elements = np.asarray(dataset.receivers.element_positions, np.float64)
    steering = _steering(dataset, links[same], directions[same], elements, dataset.receivers.unit)
    fits = _explained(snapshots[same][:, None], steering[None])  # (link, direction of a transmitter)
    # Mean share that the best direction explains if there are lines of sight (of noise: about 0.25), and minimum difference of
    # that of other transmitters if they are in different directions.
    single, apart = 0.5, 0.2
    rng, rows = np.random.default_rng(0), np.arange(len(same))
    others = [fits[rows, rng.permutation(len(rows))].mean() for _ in range(draws)]
    best = fits.max(1).mean()
    return bool(best > single and best - np.mean(others) > apart and np.diag(fits).mean() <= np.quantile(others, better))
