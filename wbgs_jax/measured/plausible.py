"""What numbers of readings may mean: values that stand for "not received", and numbers that are no metres and no dBm."""

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from wbgs_jax._util.errors import UserError

POWERS_DBM = (-200.0, 50.0)
"""Beyond it numbers are no powers."""
SENTINELS = (
    0.0,
    1.0,
    100.0,
    127.0,
    255.0,
    -100.0,
    -110.0,
    -120.0,
    -127.0,
    -128.0,
    -140.0,
    -150.0,
    -174.0,
    -199.0,
    -200.0,
    -999.0,
)
"""Numbers that devices write where they received nothing ..."""
APART_DB = 8.0
"""... if all others lie so far to one side of them ..."""
OFTEN = 0.2
"""... or so many readings are exactly the lowest."""
FURTHEST = 1e4
"""Metres."""
DEGREES, TINY, FAR = (180.0, 90.0), 0.3, 20.0
"""Largest longitude and latitude; extent of a site in degrees; and how many times as far it lies from the origin."""
FEWEST, ELSEWHERE = 5, 50.0
"""Places that may be degrees, powers of a receiver that may lack their sign; and how many times the extent of such places lies
between them and the nearest receiver, if that is in metres."""


def not_received(where: Path, powers: Float[np.ndarray, "n r"]) -> Float[np.ndarray, "n r"]:
    """Returns powers with NaN where a number stands for nothing; a note names the number."""
    powers = np.where(np.isneginf(powers), np.nan, powers)
    for number in SENTINELS:
        is_it = powers == number
        others = powers[~np.isnan(powers) & ~is_it]
        if not is_it.any() or not len(others):
            continue
        apart = number > others.max() + APART_DB or number < others.min() - APART_DB
        floor = number < others.min() and is_it.sum() >= OFTEN * len(others)
        if apart or floor:
            share = is_it.sum() / powers.size
            warnings.warn(f"{where}: {number:g} stands for nothing received ({100 * share:.0f} % of its powers)", stacklevel=2)
            powers = np.where(is_it, np.nan, powers)
    return powers


def check_powers(where: Path, powers: Float[np.ndarray, "n r"]) -> None:
    """Raises a `UserError` for numbers that are no powers in dBm."""
    heard = powers[~np.isnan(powers)]
    if not len(heard):
        raise UserError(f"{where}: nothing was received anywhere")
    if heard.min() >= 0:
        raise UserError(
            f"{where}: powers are {heard.min():g} to {heard.max():g}, which no receiver has in dBm; convert milliwatts "
            "(10 log10), give magnitudes their sign, leave cells empty where nothing was received"
        )
    for number, column in enumerate(powers.T, 1):
        own = column[~np.isnan(column)]
        if len(own) >= FEWEST and own.min() >= 0:
            raise UserError(f"{where}: the powers of receiver {number} are all positive; give magnitudes their sign (dBm)")
    if not ((heard >= POWERS_DBM[0]) & (heard <= POWERS_DBM[1])).all():
        span = " to ".join(f"{power:g}" for power in POWERS_DBM)
        raise UserError(f"{where}: powers must be dBm, {span}; leave cells empty where nothing was received")


def check_positions(what: str, positions: Float[np.ndarray, "*n k"]) -> None:
    """Raises a `UserError` for positions that are none."""
    if not (np.abs(positions) < FURTHEST).all():
        raise UserError(f"{what} must be numbers of metres, each nearer than {FURTHEST:g} m to the origin")


def check_metres(what: str, positions: Float[np.ndarray, "n k"]) -> None:
    """Raises a `UserError` for positions whose first two coordinates are longitudes and latitudes."""
    plane = positions[:, :2]
    extent, offset = np.ptp(plane, axis=0).max(), np.abs(plane.mean(0)).max()
    ranged = (np.abs(plane) <= DEGREES).all() or (np.abs(plane) <= DEGREES[::-1]).all()
    if len(plane) > 1 and ranged and extent < TINY and offset > FAR * max(extent, 1e-12):
        raise UserError(
            f"{what} all lie within {extent:.2g}, {offset:.3g} from the origin: degrees of longitude and latitude; project "
            "them to metres (UTM, say), from an origin on the site"
        )


def check_frame(what: str, places: Float[np.ndarray, "n 3"], receivers: Float[np.ndarray, "r 3"]) -> None:
    """Raises a `UserError` for places in degrees around receivers in metres."""
    plane = np.unique(places[:, :2], axis=0)
    extent = np.ptp(plane, axis=0).max()
    nearest = np.linalg.norm(receivers[:, :2] - plane.mean(0), axis=1).min()
    if len(plane) >= FEWEST and extent < TINY and nearest > ELSEWHERE * extent and (np.abs(plane) <= max(DEGREES)).all():
        raise UserError(
            f"{what} all lie within {extent:.2g}, {nearest:.3g} m from the nearest receiver: degrees of longitude and "
            "latitude; project them to metres (UTM, say), from the origin of the receivers"
        )
