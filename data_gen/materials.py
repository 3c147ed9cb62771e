"""Building materials of ITU-R P.2040 that are defined over all of 1-100 GHz, with the thickness a builder would use.

Sionna RT knows more names (brick, marble, plywood, ...), but those end at 10 to 60 GHz, and it says so only in the middle of a
run. This table is the one place that decides what a scene may use.
"""

from wbgs_jax.errors import UserError

VALID_HZ = (1e9, 100e9)
"""Lowest and highest frequency (hertz, both included) of every material here."""

THICKNESS = {
    "concrete": 0.20,
    "plasterboard": 0.10,
    "wood": 0.03,
    "glass": 0.008,
    "ceiling_board": 0.02,
    "chipboard": 0.02,
    "metal": 0.002,
}
"""Default slab thickness in metres by material name."""


def check_material(name: str) -> str:
    """Return `name`, or raise a `UserError` that lists the materials there are."""
    if name not in THICKNESS:
        raise UserError(f"unknown material {name!r}; choose among {', '.join(sorted(THICKNESS))}")
    return name


def check_frequency(frequency_hz: float) -> float:
    """Return `frequency_hz`, or raise a `UserError` when the materials are not defined there."""
    low, high = VALID_HZ
    if not low <= frequency_hz <= high:
        band = f"{low / 1e9:g}-{high / 1e9:g} GHz"
        raise UserError(f"{frequency_hz / 1e9:g} GHz is outside {band}, where the materials are defined; choose another")
    return frequency_hz
