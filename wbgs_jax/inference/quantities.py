"""Table of the quantities for which a trained field can be queried, used by commands, files, figures and the viewer.

This module does not import JAX, so that `--help` and errors of the command line appear at once. `evaluate_quantities` contains
the functions.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

Form = Literal["scalar", "array", "table"]
"""Form of the result: one or two numbers per query, an array per query, or a table with several rows per query."""


class Quantity(NamedTuple):
    """A quantity that a field can predict."""

    name: str
    """Name as the value of `--what`."""
    outputs: tuple[str, ...]
    """Names of result arrays, including units: the quantity (of a table the column of the transmitter), and its prediction
    intervals. Further arrays, such as impulse responses and `results_file.SHARED`, come with them."""
    label: str
    """Label of an axis or a colour bar, with the unit of the figure."""
    needs: tuple[str, ...]
    """Outputs of a field (`fields.base.Output`), at least one of which is required."""
    form: Form = "scalar"
    commands: tuple[str, ...] = ("predict", "map")
    scale: float = 1.0
    """Factor from the unit of the result to the unit of the figure."""
    colors: str = "viridis"
    """Name of a Matplotlib colormap."""


class Options(NamedTuple):
    """Options of some quantities, in addition to the link."""

    tx_velocity: Float[np.ndarray, "3"] = np.zeros(3)
    """Metres per second, world frame."""
    rx_velocity: Float[np.ndarray, "3"] = np.zeros(3)
    band_hz: float = 100e6
    """Bandwidth of frequency responses, hertz."""
    points: int = 64
    """Number of frequencies in the band."""
    tx_array: tuple[int, int] = (1, 1)
    """Rows and columns of the transmitter's array for MIMO matrices."""


class Network(NamedTuple):
    """Settings of the quantities of `NETWORK`, besides the positions of the transmitters."""

    power_dbm: tuple[float, ...] = (20.0,)
    """Transmitted powers, one each or one for all."""
    load: tuple[float, ...] = (1.0,)
    """Mean activity of the transmitters as interferers, 0 to 1, one each or one for all."""
    bandwidth_hz: float = 100e6
    noise_figure_db: float = 7.0
    """Noise figure of the receivers."""


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
    Quantity("rsrp", ("rsrp_dbm",), "power of the best server [dBm]", ("power",), commands=("map",)),
    Quantity("sinr", ("sinr_db",), "SINR of the best server [dB]", ("power",), commands=("map",)),
    Quantity("best-server", ("best_server",), "best server", ("power",), commands=("map",), colors="tab10"),
    Quantity("throughput", ("throughput_bps",), "bound on the throughput [Mbit/s]", ("power",), commands=("map",), scale=1e-6),
)
QUANTITIES: dict[str, Quantity] = {quantity.name: quantity for quantity in _ALL}
"""Quantities by name, in the order of `--help`."""
NETWORK = ("rsrp", "sinr", "best-server", "throughput")
"""Quantities of several transmitters, mapped over receivers."""
COMPILED = ("spectra", "power", "snapshot")
"""Quantities that exported and cached fields provide: outputs of a field and their prediction intervals."""
INTERVALS = tuple(name for quantity in _ALL for name in quantity.outputs[1:])
"""Names of the arrays of expected scores and prediction intervals; NaN stands for an invalid one."""


def names_for(command: str) -> tuple[str, ...]:
    """Returns the names of the quantities of a command."""
    return tuple(quantity.name for quantity in _ALL if command in quantity.commands)
