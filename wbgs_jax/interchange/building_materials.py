"""The building materials a scene may be made of: where they are defined and how thick a builder makes them.

They are those of ITU-R P.2040 that Sionna RT knows, and materials of a user's own (`own_material`). Sionna tells only in the
middle of a run that a material ends below the frequency asked for (brick at 40 GHz, say); the checks here tell before it.
"""

import math
import re
from collections.abc import Iterable
from typing import NamedTuple

from wbgs_jax._util.errors import UserError

VALID_HZ = (1e9, 100e9)
"""Lowest and highest frequency (hertz, both included) of a scene, and of every material in `THICKNESS`."""


class Material(NamedTuple):
    """What this project knows about a material of ITU-R P.2040; the electrical constants are the simulator's."""

    thickness: float
    """Usual thickness of a slab in metres."""
    low_ghz: float
    high_ghz: float
    """Ends of the band, both included. There are more bands above 100 GHz, where no scene is."""


ITU = {
    "concrete": Material(0.20, 1, 100),
    "brick": Material(0.11, 1, 40),
    "plasterboard": Material(0.10, 1, 100),
    "wood": Material(0.03, 0.001, 100),
    "glass": Material(0.008, 0.1, 100),
    "clear_acrylic": Material(0.005, 110, 330),
    "ceiling_board": Material(0.02, 1, 100),
    "chipboard": Material(0.02, 1, 100),
    "plywood": Material(0.018, 1, 40),
    "marble": Material(0.02, 1, 59.999),  # in the simulator's single precision, 60 GHz is just beyond its end
    "floorboard": Material(0.02, 50, 100),
    "vinyl_tile": Material(0.003, 1, 40),
    "carpet_tile": Material(0.006, 1, 40),
    "asphalt_concrete": Material(0.10, 1, 40),
    "metal": Material(0.002, 1, 100),
    "very_dry_ground": Material(0.50, 1, 10),
    "medium_dry_ground": Material(0.50, 1, 10),
    "wet_ground": Material(0.50, 1, 10),
}
"""By name all but vacuum, of which nothing is built."""

THICKNESS = {
    name: material.thickness
    for name, material in ITU.items()
    if material.low_ghz * 1e9 <= VALID_HZ[0] and material.high_ghz * 1e9 >= VALID_HZ[1]
}
"""Default slab thickness (metres) of the materials that are defined over all of `VALID_HZ`: those of the released scenes."""


class Law(NamedTuple):
    """Relative permittivity a f^b and conductivity c f^d (S/m), with f in GHz, as in ITU-R P.2040."""

    a: float
    b: float
    c: float
    d: float


MAX_EXPONENT = 10.0
_NUMBER = r"[-+\d.e]+"
_OWN = re.compile(rf"[\w-]+\(({_NUMBER}), ({_NUMBER}), ({_NUMBER}), ({_NUMBER})\)")


def own_material(name: str, law: Law) -> str:
    """Returns the name under which a part of a material of a user's own carries its law, as in `clay(3.9, 0, 0.024, 0.16)`.

    Raises:
        UserError: the name is taken or has odd characters, or no passive medium follows the law from 1 to 100 GHz.
    """
    if name in ITU or not re.fullmatch(r"[\w-]+", name):
        raise UserError(f"material {name!r} needs another name: letters, digits, _ and -, and none of ITU-R P.2040")
    gentle = math.isfinite(law.a) and math.isfinite(law.c) and max(abs(law.b), abs(law.d)) <= MAX_EXPONENT
    if not gentle or law.c < 0 or min(law.a * ghz**law.b for ghz in (1.0, 100.0)) < 1:
        raise UserError(f"material {name!r} needs a relative permittivity of 1 or more and a conductivity of 0 S/m or more")
    return f"{name}({', '.join(f'{value:.9g}' for value in law)})"


def own_law(material: str) -> Law | None:
    """Returns the law in the name of a part's material; None for one of ITU-R P.2040, whose law the simulator knows."""
    found = _OWN.fullmatch(material)
    return Law(*map(float, found.groups())) if found else None


def check_material(name: str) -> str:
    """Returns `name`, or raises a `UserError` that lists the materials there are over all of `VALID_HZ`."""
    if name not in THICKNESS:
        raise UserError(f"unknown material {name!r}; choose among {', '.join(sorted(THICKNESS))}")
    return name


def check_frequency(frequency_hz: float) -> float:
    """Returns `frequency_hz`, or raises a `UserError` when the materials are not defined there."""
    low, high = VALID_HZ
    if not low <= frequency_hz <= high:
        band = f"{low / 1e9:g}-{high / 1e9:g} GHz"
        raise UserError(f"{frequency_hz / 1e9:g} GHz is outside {band}, where the materials are defined; choose another")
    return frequency_hz


def check_material_frequencies(materials: Iterable[str], frequencies_hz: Iterable[float]) -> None:
    """Raises a `UserError` when a material (one of `ITU` or of a user's own) is not defined at one of the frequencies."""
    frequencies = [check_frequency(frequency) for frequency in frequencies_hz]
    for name in sorted(name for name in set(materials) if own_law(name) is None):
        _, low, high = ITU[name]
        missing = [f"{frequency / 1e9:g}" for frequency in frequencies if not low <= frequency / 1e9 <= high]
        if missing:
            others = ", ".join(sorted(THICKNESS))
            raise UserError(
                f"{name} is defined for {low:g}-{high:g} GHz, not at {', '.join(missing)} GHz; leave these frequencies out, "
                f"choose a material that is defined everywhere ({others}), or define your own"
            )
