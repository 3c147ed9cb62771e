"""Paths that Sionna RT traces and people save: snapshots against its own frequency responses at the carrier."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from builders.conformance.by_mitsuba import sionna
from builders.conformance.entries import entries
from wbgs_jax.interchange.ray_paths import read_paths
from wbgs_jax.interchange.sionna_arrays import scene_of_sionna
from wbgs_jax.radio.array import SPEED_OF_LIGHT

GHZ = 3.5
SENDERS = np.array([[-25 + 7 * i, (-1) ** i * 4 + 0.37 * i, 1.5 + 0.3 * i] for i in range(8)])
RECEIVERS = np.array([[0.3, 0.2, 6.0], [14.0, -2.0, 3.0], [-19.0, 1.0, 8.5], [7.0, 3.0, 5.0], [-8.0, -1.5, 4.0]])
RECIPE = ("tau", "theta_t", "phi_t", "theta_r", "phi_r", "interactions", "vertices", "valid")
PLACED = 0.02
"""Wavelengths by which an antenna may be off its place: what float32 leaves of 1e-3 of a place in the street."""

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Setup:
    """What is traced."""

    shape: tuple[int, int] = (4, 4)
    pattern: str = "iso"
    polarization: str = "V"
    synthetic: bool = True
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    receivers: int = 1
    sending: tuple[int, int] = (1, 1)
    depth: int = 2
    refraction: bool = False
    diffraction: bool = False


@dataclass
class Channels:
    """A file of paths."""

    path: Path
    truth: np.ndarray
    """Transmitter, receiver, element."""
    places: np.ndarray
    """Of the elements of the first receiver's array beside its centre, wavelengths, in the world; nothing of a single row."""
    options: dict[str, Any]
    tolerance: float = 1e-3
    measure: str = field(default="channels", init=False)

    def difference(self) -> float:
        """Returns the largest distance of a snapshot from the truth, by its length; infinity for antennas elsewhere."""
        scene = scene_of_sionna(read_paths(self.path), "street", source=str(self.path), **self.options)
        assert scene.snapshots is not None
        found = scene.snapshots[:, :, 0]
        if found.shape != self.truth.shape:
            return float("inf")
        if len(self.places):
            turn = Rotation.from_quat(np.roll(scene.rx_orientation[0], -1))
            own = turn.apply(scene.element_positions[0]) - self.places
            if np.abs(own - own.mean(0)).max() > PLACED:
                return float("inf")
        length = np.linalg.norm(self.truth, axis=-1)
        received = length > 1e-3 * length.max()
        return float((np.linalg.norm(found - self.truth, axis=-1)[received] / length[received]).max())


@functools.cache
def trace(setup: Setup) -> tuple[Any, Any]:
    """Returns the paths of a street canyon, and its scene."""
    rt = sionna()
    scene = rt.load_scene(rt.scene.simple_street_canyon)
    scene.frequency = GHZ * 1e9
    how = {"vertical_spacing": 0.5, "horizontal_spacing": 0.5, "pattern": setup.pattern, "polarization": setup.polarization}
    scene.rx_array = rt.PlanarArray(num_rows=setup.shape[0], num_cols=setup.shape[1], **how)
    sent = {**how, "pattern": "iso", "polarization": "V"}
    scene.tx_array = rt.PlanarArray(num_rows=setup.sending[0], num_cols=setup.sending[1], **sent)
    for number, place in enumerate(SENDERS):
        scene.add(rt.Transmitter(f"tx{number}", position=place.tolist()))
    for number, place in enumerate(RECEIVERS[: setup.receivers]):
        scene.add(rt.Receiver(f"rx{number}", position=place.tolist(), orientation=list(setup.turn)))
    paths = rt.PathSolver()(
        scene,
        max_depth=setup.depth,
        samples_per_src=20_000,
        synthetic_array=setup.synthetic,
        refraction=setup.refraction,
        diffraction=setup.diffraction,
        seed=1,
    )
    return paths, scene


def response(paths: Any) -> np.ndarray:
    """Returns Sionna's own response at the carrier: receivers, their antennas, transmitters, their antennas."""
    found = paths.cfr(frequencies=np.array([0.0], np.float32), normalize_delays=False, out_type="numpy")
    return np.asarray(found)[..., 0, 0].astype(np.complex128)


def saved(paths: Any) -> Arrays:
    """Returns what docs/interchange.md saves."""
    a_real, a_imag = paths.a
    ends = {"sources": paths.sources.numpy().T, "targets": paths.targets.numpy().T}
    own = {name: getattr(paths, name).numpy() for name in RECIPE}
    return {"a_real": a_real.numpy(), "a_imag": a_imag.numpy(), "frequency_hz": np.array(GHZ * 1e9), **ends, **own}


def antennas(scene: Any, setup: Setup, swap: bool) -> np.ndarray:
    """Returns the places of a receiver's elements beside its centre, in wavelengths; nothing of a row, whose turn is open."""
    shape, array = (setup.sending, scene.tx_array) if swap else (setup.shape, scene.rx_array)
    if 1 in shape:
        return np.zeros((0, 3))
    wavelength = SPEED_OF_LIGHT / (GHZ * 1e9)
    places = array.positions(wavelength).numpy().T[: shape[0] * shape[1]]
    return Rotation.from_euler("ZYX", (0, 0, 0) if swap else setup.turn).apply(places) / wavelength


def street(
    setup: Setup, change: Callable[[Arrays], Arrays] | None = None, pick: Any = slice(None), sender: int = 0, **options: Any
) -> Callable[[Path], Channels]:
    """Returns a maker of a file of paths.

    Args:
        setup: that is traced.
        change: of the arrays before they are saved.
        pick: antennas of the receivers that are read.
        sender: antenna of the transmitters that is read.
        options: of the reader.
    """

    def make(folder: Path) -> Channels:
        paths, scene = trace(setup)
        arrays = saved(paths)
        np.savez(folder / "paths.npz", **(change(arrays) if change else arrays))
        swap = "swap" in options
        truth = response(paths)[:, 0] if swap else np.moveaxis(response(paths)[:, pick][:, :, :, sender], 2, 0)
        return Channels(folder / "paths.npz", truth, antennas(scene, setup, swap), options)

    return make


def as_complex(arrays: Arrays) -> Arrays:
    """Returns coefficients as one array."""
    return {**arrays, "a": arrays["a_real"] + 1j * arrays["a_imag"], "a_real": None, "a_imag": None}


def without_nothing(arrays: Arrays) -> Arrays:
    """Returns what is there."""
    return {name: values for name, values in arrays.items() if values is not None}


def columns(arrays: Arrays) -> Arrays:
    """Returns places as Sionna's objects hold them."""
    return {**arrays, "sources": arrays["sources"].T, "targets": arrays["targets"].T}


def in_time(arrays: Arrays) -> Arrays:
    """Returns coefficients with an axis of time."""
    return {**arrays, "a_real": arrays["a_real"][..., None], "a_imag": arrays["a_imag"][..., None]}


def normalised(arrays: Arrays) -> Arrays:
    """Returns delays behind the first path of every link."""
    tau = arrays["tau"]
    first = np.where(tau >= 0, tau, np.inf).min(-1, keepdims=True)
    return {**arrays, "tau": np.where(tau >= 0, tau - first, tau)}


def degrees(arrays: Arrays) -> Arrays:
    """Returns angles in degrees."""
    return arrays | {name: np.degrees(arrays[name]) for name in ("theta_r", "phi_r", "theta_t", "phi_t")}


def elevations(arrays: Arrays) -> Arrays:
    """Returns angles from the horizon instead of the zenith."""
    return arrays | {name: np.pi / 2 - arrays[name] for name in ("theta_r", "theta_t")}


def exchanged(arrays: Arrays) -> Arrays:
    """Returns places with y for z, beside paths that are not turned."""
    return arrays | {name: arrays[name][:, [0, 2, 1]] for name in ("sources", "targets")}


def few(arrays: Arrays) -> Arrays:
    """Returns what has to be there."""
    return {name: arrays[name] for name in arrays if name not in ("interactions", "vertices", "valid")}


def nanoseconds(arrays: Arrays) -> Arrays:
    """Returns delays in another unit."""
    return {**arrays, "tau": 1e9 * arrays["tau"]}


TURNED = (0.7, 0.3, -0.4)
PLAIN = Setup()
SINGLE = Setup((1, 1))
FULL = Setup(synthetic=False)
FILES: dict[tuple[str, str], Any] = {
    ("npz", "4x4, synthetic"): street(PLAIN),
    ("npz", "4x4, every antenna traced"): street(FULL),
    ("npz", "4x4, turned"): street(Setup(turn=TURNED)),
    ("npz", "4x4, turned, every antenna traced"): street(Setup(turn=TURNED, synthetic=False)),
    ("npz", "directional elements"): street(Setup(pattern="tr38901", turn=(2.0, 0.0, 0.0))),
    ("npz", "dipoles, horizontal"): street(Setup(pattern="hw_dipole", polarization="H")),
    ("npz", "two polarisations, the first"): street(Setup(polarization="VH"), pick=slice(0, 16), port=1),
    ("npz", "two polarisations, the second"): street(Setup(polarization="VH"), pick=slice(16, 32), port=2),
    ("npz", "slanted polarisations, every antenna traced"): street(
        Setup(polarization="cross", synthetic=False), pick=slice(16, 32), port=2
    ),
    ("npz", "2x3"): street(Setup((2, 3), turn=TURNED), shape=(2, 3)),
    ("npz", "2x3, every antenna traced"): street(Setup((2, 3), turn=TURNED, synthetic=False), shape=(2, 3)),
    ("npz", "1x8"): street(Setup((1, 8)), shape=(1, 8)),
    ("npz", "8x2"): street(Setup((8, 2)), shape=(8, 2)),
    ("npz", "two receivers"): street(Setup(receivers=2, turn=TURNED)),
    ("npz", "three receivers"): street(Setup(receivers=3)),
    ("npz", "three receivers, every antenna traced"): street(Setup(receivers=3, synthetic=False)),
    ("npz", "transmitters of four antennas"): street(Setup(sending=(2, 2)), sender=2, tx_antenna=3),
    ("npz", "arrays of the transmitters, turned round"): street(Setup((1, 1), receivers=5, sending=(4, 4)), swap=True),
    ("npz", "refraction and diffraction"): street(Setup(refraction=True, diffraction=True, depth=3)),
    ("npz", "complex coefficients"): street(PLAIN, lambda arrays: without_nothing(as_complex(arrays))),
    ("npz", "what has to be there"): street(PLAIN, few),
    ("npz", "places as columns"): street(PLAIN, columns),
    ("npz", "three receivers, places as columns"): (street(Setup(receivers=3), columns), "refused"),
    ("npz", "two polarisations, none chosen"): (street(Setup(polarization="VH")), "refused"),
    ("npz", "transmitters of four antennas, none chosen"): (street(Setup(sending=(2, 2))), "refused"),
    ("npz", "an axis of time"): (street(PLAIN, in_time), "refused"),
    ("npz", "normalised delays"): (street(PLAIN, normalised), "refused"),
    ("npz", "nanoseconds"): (street(PLAIN, nanoseconds), "refused"),
    ("npz", "degrees"): (street(PLAIN, degrees), "refused"),
    ("npz", "angles from the horizon"): (street(PLAIN, elevations), "refused"),
    ("npz", "angles from the horizon, single antennas"): (street(SINGLE, elevations), "refused"),
    ("npz", "places with y for z"): (street(PLAIN, exchanged), "refused"),
    ("npz", "places with y for z, single antennas"): (street(SINGLE, exchanged), "refused"),
    ("npz", "three receivers of single antennas, places as columns"): (street(Setup((1, 1), receivers=3), columns), "refused"),
    ("npz", "without a frequency"): (
        street(PLAIN, lambda arrays: {name: values for name, values in arrays.items() if name != "frequency_hz"}), "refused"
    ),
}  # fmt: skip
ENTRIES = entries("Sionna RT", FILES, ("sionna",), "sionna-rt", heavy=True)
