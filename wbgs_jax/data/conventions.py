"""Order of the pixels of spectra in published folders, which is not recorded in their files.

Two orders are in use, in folders with the same file names and images of the same size:

    zenith         rows are zenith angles, 0..90 degrees; azimuths -180..180 degrees; the array in the local y-z plane (the
                   paper's authors)
    elevation      rows are elevations, 0..89 degrees; azimuths 0..359 degrees; the array in the local x-y plane (NeRF2's
                   generator of spectra, also used by WRF-GS and WRF-GS+)

In both, the zenith is local +z and azimuths increase from local +x to +y; the receiver's quaternion rotates local vectors into
the world frame. The first order is that of `radio.array.pas_directions`. Pixels of the second are moved, never interpolated:
nothing is lost, and directions are off by at most one degree (rows near the zenith, columns near +180 degrees).
"""

from dataclasses import dataclass
from typing import Literal, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8
from scipy.special import stdtrit

from wbgs_jax._util.statistics import by_transmitter
from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH, planar_array
from wbgs_jax.radio.geometry import to_local
from wbgs_jax.types import Receiver

ConventionName = Literal["zenith", "elevation"]
"""Name of a pixel order."""
CONVENTIONS: tuple[ConventionName, ...] = get_args(ConventionName)


@dataclass(frozen=True)
class Evidence:
    """Convention inferred from spectra."""

    convention: ConventionName | None
    """None if undecided."""
    reason: str
    """Explanation for messages."""


def to_pas(images: UInt8[np.ndarray, "n 90 360"], convention: ConventionName) -> UInt8[np.ndarray, "n 90 360"]:
    """Returns spectra of a convention with their pixels in the order of `radio.array.pas_directions`."""
    return images if convention == "zenith" else np.roll(images[:, ::-1], PAS_WIDTH // 2, axis=2)


def array_of(convention: ConventionName) -> Float[np.ndarray, "elements 3"]:
    """Returns the element positions (wavelengths, local frame) of the array that belongs to a convention, 4x4 at half a
    wavelength."""
    elements = planar_array()
    return elements if convention == "zenith" else elements[:, [1, 2, 0]]


def find_convention(
    images: UInt8[np.ndarray, "n 90 360"],
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "n 3"],
    tx_index: Int[np.ndarray, " n"],
) -> Evidence:
    """Returns the convention of spectra, inferred from their geometry.

    The row at the zenith is (nearly) a single direction, so that its pixels are almost equal. If neither outer row is like
    this, lines of sight decide: the pixel towards the transmitter is bright in the right convention.

    Args:
        images: as stored in the folder.
        receiver: of the spectra.
        tx_positions: world frame, metres.
        tx_index: index of the transmitter.
    """
    if found := _by_the_zenith(images):
        return found
    local = _seen_from(receiver, receiver.orientation, tx_positions)
    above = (local[:, 2] > 0) & (np.linalg.norm(local, axis=1) > 0)
    if not above.any():
        return Evidence(None, "no transmitter is above the receiver's horizon")
    ranks = [_brighter(images[above], *_pixel(local[above], name)) for name in CONVENTIONS]
    first, second = (by_transmitter(rank, tx_index[above]) for rank in ranks)
    gain = second - first
    compared = (
        f"towards the transmitter, spectra are brighter than {100 * second.mean():.0f} % of their pixels read as elevations"
    )
    compared += f" and than {100 * first.mean():.0f} % read as zenith angles"
    fewest = 5  # transmitters
    if len(gain) < fewest or not _significant(gain):
        return Evidence(None, compared)
    return Evidence("elevation" if gain.mean() > 0 else "zenith", compared)


def turned(
    images: UInt8[np.ndarray, "n 90 360"],
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "n 3"],
    tx_index: Int[np.ndarray, " n"],
    convention: ConventionName,
) -> bool:
    """Returns whether lines of sight fit the spectra clearly better if the receiver's quaternion is w, x, y, z in the file.

    Args:
        images: as stored in the folder.
        receiver: whose quaternion was read as x, y, z, w.
        tx_positions: world frame, metres.
        tx_index: index of the transmitter.
        convention: of the images.
    """

    def brightness(orientation: Float[Array, "4"]) -> Float[np.ndarray, " t"]:
        local = _seen_from(receiver, orientation, tx_positions)
        rank = _brighter(images, *_pixel(local, convention))
        return by_transmitter(np.where(local[:, 2] > 0, rank, 0.5), tx_index)  # nothing is known below the horizon

    other = brightness(jnp.roll(receiver.orientation, -1))
    gain = other - brightness(receiver.orientation)
    # Transmitters, mean gain in the share of pixels that are less bright, and mean share for a frame that is right.
    fewest, clear, bright = 10, 0.1, 0.75
    return len(gain) >= fewest and float(gain.mean()) > clear and float(other.mean()) > bright and _significant(gain)


def unrelated(
    images: UInt8[np.ndarray, "n 90 360"],
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "n 3"],
    tx_index: Int[np.ndarray, " n"],
    convention: ConventionName,
) -> bool:
    """Returns whether spectra are no brighter towards their own transmitters than towards those of other spectra, if there are
    enough transmitters in different directions.

    Args:
        images: as stored in the folder.
        receiver: of the spectra.
        tx_positions: world frame, metres.
        tx_index: index of the transmitter.
        convention: of the images.
    """
    fewest, most, draws, better = 24, 200, 20, 0.9  # transmitters, random orders of them, and share of these that is exceeded
    local = _seen_from(receiver, receiver.orientation, tx_positions)
    chosen = np.unique(tx_index, return_index=True)[1]
    chosen = chosen[local[chosen, 2] > 0]
    directions = local[chosen] / np.linalg.norm(local[chosen], axis=1, keepdims=True)
    alike = 0.9  # length of the mean direction of transmitters above which those of others do not differ enough
    if len(chosen) < fewest or np.linalg.norm(directions.mean(0)) > alike:
        return False
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), most)).astype(int)]
    rng = np.random.default_rng(0)
    orders = [chosen, *(rng.permutation(chosen) for _ in range(draws))]
    own, *others = (_brighter(images[chosen], *_pixel(local[order], convention)).mean() for order in orders)
    return bool(own <= np.quantile(others, better))


def contradiction(images: UInt8[np.ndarray, "n 90 360"], convention: ConventionName) -> str:
    """Returns why spectra show another convention than the named one; empty if they do not."""
    found = _by_the_zenith(images)
    return "" if found is None or found.convention == convention else found.reason


def _seen_from(
    receiver: Receiver, orientation: Float[Array, "4"], tx_positions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Returns transmitters relative to a receiver (metres), in the frame of an orientation."""
    towards = jnp.asarray(tx_positions - np.asarray(receiver.position, np.float64))
    return np.asarray(to_local(towards, orientation))


def _significant(gain: Float[np.ndarray, " t"]) -> bool:
    """Returns whether the mean of differences is not zero by chance."""
    chance = 1e-3
    error = gain.std(ddof=1) / np.sqrt(len(gain))
    return bool(abs(gain.mean()) > stdtrit(len(gain) - 1, 1 - chance / 2) * error)


def _by_the_zenith(images: UInt8[np.ndarray, "n 90 360"]) -> Evidence | None:
    # Distance in rows between an outer row and the inner row it is compared with: near the zenith, which is a single direction,
    # the variation of pixels increases from zero; at the horizon it is nearly constant.
    inward = 3
    outer, inner = (images[:, rows].std(2).mean(0) for rows in ([0, PAS_HEIGHT - 1], [inward, PAS_HEIGHT - 1 - inward]))
    share = outer / np.maximum(inner, 1e-9)
    visible = 0.3  # minimum variation of inner pixels in grey levels (of 255): an image without content is not conclusive
    # Maximum variation of the row at the zenith relative to that of the inner row; and minimum factor by which this ratio is
    # larger at the other end.
    uniform, apart = 0.5, 2.0
    for pole, convention, row in ((0, CONVENTIONS[0], "first"), (1, CONVENTIONS[1], "last")):
        if inner.min() >= visible and share[pole] <= uniform and share[1 - pole] >= apart * share[pole]:
            spread = f"grey levels vary by {outer[pole]:.1f}, {inward} rows further by {inner[pole]:.1f}"
            return Evidence(convention, f"the {row} row shows a single direction ({spread}), like the zenith")
    return None


def _pixel(local: Float[np.ndarray, "n 3"], convention: ConventionName) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Returns the rows and columns of directions in a folder's images."""
    zenith = np.degrees(np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2]))
    azimuth = np.degrees(np.arctan2(local[:, 1], local[:, 0]))
    if convention == "zenith":
        row, column = zenith * (PAS_HEIGHT - 1) / 90, (azimuth + 180) * (PAS_WIDTH - 1) / 360
    else:
        row, column = 90 - zenith, azimuth
    return np.clip(np.rint(row), 0, PAS_HEIGHT - 1).astype(int), np.rint(column).astype(int) % PAS_WIDTH


def _brighter(
    images: UInt8[np.ndarray, "n 90 360"], row: Int[np.ndarray, " n"], column: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Returns the fraction of its image that a pixel is brighter than; equally bright pixels count half."""
    pixel = images[np.arange(len(images)), row, column][:, None, None]
    return (images < pixel).mean((1, 2)) + 0.5 * (images == pixel).mean((1, 2))
