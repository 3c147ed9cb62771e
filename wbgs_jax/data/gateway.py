"""The receiver of a folder of the published layout: gateway_info.yml."""

import warnings
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import safe_name
from wbgs_jax._util.yaml_files import read_yaml
from wbgs_jax.data.conventions import CONVENTIONS, ConventionName
from wbgs_jax.types import HIGHEST_FREQUENCY_HZ, LARGEST_COORDINATE_M, LOWEST_FREQUENCY_HZ

SHORTEST, LONGEST = 1e-6, 1e6
"""Of quaternions that have a direction."""


class Gateway(NamedTuple):
    """What gateway_info.yml holds; None where it does not."""

    name: str | None
    position: list[float]
    orientation: tuple[float, float, float, float]
    """w x y z."""
    frequency_hz: float | None
    convention: ConventionName | None


def read_gateway(path: Path) -> Gateway:
    """Returns what is known of the data set and of its first gateway."""
    wanted = "write 'gateway1:' with position [x, y, z] and orientation [x, y, z, w]"
    if not path.exists():
        raise UserError(f"{path} is missing, which says where the receiver stands; {wanted}")
    content = read_yaml(path)
    entries = content if isinstance(content, dict) else {}
    gateways = {str(k): v for k, v in entries.items() if isinstance(v, dict) and "position" in v}
    if not gateways:
        raise UserError(f"{path} names no gateway; {wanted}")
    first, gateway = next(iter(gateways.items()))
    if len(gateways) > 1:
        warnings.warn(f"{path} names {len(gateways)} gateways; the first, {first!r}, is taken for the receiver", stacklevel=3)
    position = vector(gateway.get("position"), 3, f"{path}: position")
    x, y, z, w = vector(gateway.get("orientation"), 4, f"{path}: orientation (quaternion x, y, z, w)")
    if not SHORTEST < np.linalg.norm(np.array([x, y, z, w]) / LONGEST) * LONGEST < LONGEST:
        raise UserError(
            f"{path}: orientation is all zeros, or beyond all measure; write the quaternion [0, 0, 0, 1] for no rotation"
        )
    frequency = entries.get("frequency", gateway.get("frequency"))
    name, convention = entries.get("dataset_name"), entries.get("convention", gateway.get("convention"))
    if convention not in (None, *CONVENTIONS):
        raise UserError(f"{path}: convention is {str(convention)[:40]!r}; it must be {' or '.join(CONVENTIONS)}")
    return Gateway(
        name=None if name is None else safe_name(str(name)),
        position=position,
        orientation=(w, x, y, z),
        frequency_hz=None if frequency is None else ghz_to_hz(str(frequency), path),
        convention=convention,
    )


def vector(value: Any, length: int, what: str) -> list[float]:
    """Returns so many numbers, or raises a `UserError` that names what they are."""
    try:
        vector = [float(v) for v in value] if isinstance(value, list) else []  # YAML gives 1e-3 as text
    except (TypeError, ValueError, OverflowError):
        vector = []
    if len(vector) != length or not (np.abs(vector) <= LARGEST_COORDINATE_M).all():
        unit = " metres from a place on the site" if length == 3 else ""
        raise UserError(f"{what} is {repr(value)[:80]}; it must be {length} numbers of at most {LARGEST_COORDINATE_M:g}{unit}")
    return vector


def ghz_to_hz(word: str, where: Path) -> float:
    """Returns hertz, through decimals, not by a factor of 1e9: rounding must not part a frequency from itself elsewhere."""
    try:
        hertz = float(Decimal(word).scaleb(9))
    except (ArithmeticError, ValueError):
        hertz = np.nan
    if not LOWEST_FREQUENCY_HZ <= hertz <= HIGHEST_FREQUENCY_HZ:
        raise UserError(f"{where}: the frequency {word[:40]!r} is no number of GHz from 0.3 to 100; write 0.92 for 920 MHz")
    return hertz
