"""The quantities for which a trained field can be queried: the one table that commands, files, pictures and the viewer read.

Free of JAX: `--help` and mistakes on the command line do not wait for it. `evaluate_quantities` holds the functions.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

Form = Literal["scalar", "array", "table"]
"""Of an answer: a number or two a query, an array a query, or a table with several rows a query."""


class Quantity(NamedTuple):
    """One of them."""

    name: str
    """As `--what` has it."""
    outputs: tuple[str, ...]
    """Names of the arrays that answer it, units included; the first is the quantity, the others its prediction intervals."""
    label: str
    """Of an axis or a colour bar, with the unit in which it is drawn."""
    needs: tuple[str, ...]
    """Outputs of a field (`fields.base.Output`), one of which is enough."""
    form: Form = "scalar"
    commands: tuple[str, ...] = ("predict", "map")
    scale: float = 1.0
    """Drawn units in one unit of the answer."""
    colors: str = "viridis"
    """Name of a Matplotlib colormap."""


class Options(NamedTuple):
    """What some quantities depend on beside the link."""

    tx_velocity: Float[np.ndarray, "3"] = np.zeros(3)
    """Metres a second, world frame."""
    rx_velocity: Float[np.ndarray, "3"] = np.zeros(3)
    band_hz: float = 100e6
    """Width of the band of frequency responses."""
    points: int = 64
    """Frequencies in the band."""
    tx_array: tuple[int, int] = (1, 1)
    """Rows and columns of a MIMO matrix's transmitters."""


_ALL = (
    Quantity("spectra", ("pas", "expected"), "normalised amplitude", ("pas",), "array", ("predict",)),
    Quantity("snapshot", ("snapshots",), "snapshot", ("snapshots", "paths"), "array", ("predict",)),
    Quantity(
        "power",
        ("power_db", "expected_error_db", "within_db"),
        "received power [dB of the transmitted]",
        ("power", "paths"),
    ),
    Quantity("beamforming-gain", ("beamforming_gain_db",), "beamforming gain [dB]", ("paths",), commands=("predict",)),
    Quantity("k-factor", ("k_factor_db",), "K-factor [dB]", ("paths",)),
    Quantity("angular-spread", ("angular_spread_deg",), "spread of the azimuth of arrival [deg]", ("paths",)),
    Quantity("delay-spread", ("delay_spread_s",), "r.m.s. delay spread [ns]", ("paths",), scale=1e9),
    Quantity("best-beam", ("best_beam",), "azimuth of the best beam [deg]", ("pas",), commands=("map",), colors="twilight"),
    Quantity("paths", ("tx",), "paths", ("paths",), "table", ("predict",)),
    Quantity("frequency-response", ("frequency_response",), "frequency response", ("paths",), "array", ("predict",)),
    Quantity("mimo", ("mimo",), "MIMO matrix", ("paths",), "array", ("predict",)),
)
QUANTITIES: dict[str, Quantity] = {quantity.name: quantity for quantity in _ALL}
"""By name, in the order in which `--help` lists them."""
INTERVALS = tuple(name for quantity in _ALL for name in quantity.outputs[1:])
"""Arrays that hold expected scores and prediction intervals: NaN where there are none."""


def names_for(command: str) -> tuple[str, ...]:
    """Returns the names of the quantities of a command."""
    return tuple(quantity.name for quantity in _ALL if command in quantity.commands)
