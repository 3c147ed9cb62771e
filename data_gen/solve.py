"""Traces a scene with Sionna RT and converts paths to snapshots that are bit-identical between runs.

This module takes care of what the simulator leaves to its user:
* Rays are traced once for all frequencies: the geometry of paths does not depend on the frequency, only their amplitudes do.
* `scene.frequency` stays at 3.5 GHz unless set: it is set and read back.
* `paths.a` does not contain exp(-j 2 pi f tau): the carrier phase is applied here, with f * tau in float64.
* Equal solves return equal paths in different orders: paths are sorted before they are summed in complex128.
* A full path buffer silently drops candidates: they are counted for every transmitter, and a full buffer is an error.

Import this module only after `data_gen.llvm.ensure_backend()`.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import sionna.rt as rt
from jaxtyping import Complex, Float, Int

from data_gen.public_solver import PublicTracer, public_material
from data_gen.rays import RayLauncher
from data_gen.scenes.base import SceneSpec
from data_gen.settings import ArraySettings, SolverSettings
from data_gen.trace import BalancedMaterial, DiffuseTracer, PathTracer
from wbgs_jax.interchange.rooms import check_frequency

FAINT = 1e-15
"""Amplitude (-300 dB) below which a path is dropped. The simulator keeps a path of subnormal power at random, because some of
its threads flush such numbers to zero: a sum with it could differ in its last bit, and so would the checksum."""
FREQUENCY_TOLERANCE = 1e-6
"""Largest relative difference of the frequency read back; Sionna stores it in float32."""


@dataclass(frozen=True)
class TxPaths:
    """The paths of one transmitter at one frequency, in a reproducible order (by delay, then magnitude)."""

    coefficients: Complex[np.ndarray, "paths elements"]
    """complex128, including the carrier phase, one column per receiver element."""
    delays: Float[np.ndarray, " paths"]
    """Seconds."""
    kinds: Int[np.ndarray, "paths depth"]
    """`sionna.rt.InteractionType` of every interaction from the transmitter on; 0 beyond the last."""

    @property
    def order(self) -> Int[np.ndarray, " paths"]:
        """Number of interactions; 0 is the line of sight."""
        return (self.kinds != rt.InteractionType.NONE).sum(-1)

    def snapshot(self) -> Complex[np.ndarray, " elements"]:
        """Returns the coherent sum of the paths, complex64."""
        return self.coefficients.sum(0).astype(np.complex64)

    def delay_spread(self) -> float:
        """Returns the r.m.s. delay spread in seconds, weighted by power; 0 without a path."""
        power = (np.abs(self.coefficients) ** 2).sum(-1)
        if not power.sum() > 0:
            return 0.0
        mean = np.average(self.delays, weights=power)
        return float(np.sqrt(np.average((self.delays - mean) ** 2, weights=power)))


class Simulator:
    """A scene loaded into Sionna RT."""

    def __init__(self, spec: SceneSpec, settings: SolverSettings, array: ArraySettings | None = None) -> None:
        self.settings = settings
        self.array = array or ArraySettings()
        self.read_back_hz: dict[float, float] = {}
        """Frequencies (hertz) reported by the simulator, float32 internally, by requested frequency."""
        self._scene = _load(spec, self.array, settings)
        self._tracers = _tracers(self._scene, spec, settings)

    @property
    def scene(self) -> rt.Scene:
        """The simulator's scene."""
        return self._scene

    def paths(self, tx_positions: Float[np.ndarray, "tx 3"], frequencies_hz: Sequence[float]) -> list[list[TxPaths]]:
        """Returns all paths from every transmitter (world frame, metres) to the receiver: by frequency, then by transmitter.

        Random numbers depend on the position in the batch: the same batch gives the same bits, other batches almost the same.

        Raises:
            UserError: materials are not defined at a frequency, or the path buffer is full.
        """
        for name in list(self._scene.transmitters):
            self._scene.remove(name)
        for i, position in enumerate(tx_positions):
            self._scene.add(rt.Transmitter(f"tx{i}", position=[float(value) for value in position]))
        self._set_frequency(frequencies_hz[0])
        traced = [tracer.trace() for tracer in self._tracers]
        result = []
        for frequency in frequencies_hz:
            self._set_frequency(frequency)
            found = [tracer.fields(geometry) for tracer, geometry in zip(self._tracers, traced, strict=True)]
            shape = self.array.rows * self.array.columns, self.settings.max_depth
            result.append(_by_transmitter([paths for paths in found if paths], frequency, len(tx_positions), shape))
        return result

    def _set_frequency(self, frequency_hz: float) -> None:
        # Opaque to the compiler: a literal would recompile every kernel for every frequency.
        self._scene.frequency = dr.opaque(mi.Float, check_frequency(frequency_hz))
        read_back = float(np.array(self._scene.frequency).item())
        if abs(read_back / frequency_hz - 1) > FREQUENCY_TOLERANCE:
            raise RuntimeError(f"requested {frequency_hz} Hz from Sionna RT, which reports {read_back} Hz")
        elements = self.array.element_wavelengths(frequency_hz)  # Sionna's "normalized" positions
        self._scene.rx_array.normalized_positions = mi.Point3f(np.asarray(elements, np.float32).T)
        self.read_back_hz[frequency_hz] = read_back


def _tracers(scene: rt.Scene, spec: SceneSpec, settings: SolverSettings) -> tuple[Any, ...]:
    """Returns the path finders: each has `trace() -> geometry` and `fields(geometry) -> rt.Paths`, or None without paths."""
    if settings.solver == "simulator":
        return (PublicTracer(scene, settings),)
    tracer = PathTracer(scene, RayLauncher(spec, settings), settings)
    return (tracer, DiffuseTracer(scene, spec, settings)) if settings.rough else (tracer,)


def _load(spec: SceneSpec, array: ArraySettings, settings: SolverSettings) -> rt.Scene:
    scene = rt.load_scene()
    material_of = public_material if settings.solver == "simulator" else BalancedMaterial
    objects = []
    with tempfile.TemporaryDirectory() as folder:
        for i, part in enumerate(spec.parts):  # numbered, because a user's object may have an invalid file name
            file = Path(folder) / f"{i}.ply"
            part.mesh.export(file)
            material = material_of(f"material-{i}", part, settings)
            objects.append(rt.SceneObject(fname=str(file), name=f"part-{i}", radio_material=material))
        scene.edit(add=objects)
    one = {"num_rows": 1, "num_cols": 1}
    scene.tx_array = rt.PlanarArray(**one, pattern="iso", polarization="V")
    scene.rx_array = rt.PlanarArray(**one, pattern=array.pattern, polarization=array.polarization)
    scene.add(
        rt.Receiver(
            "rx", position=[float(value) for value in spec.rx_position], orientation=_yaw_pitch_roll(spec.rx_orientation)
        )
    )
    return scene


def _yaw_pitch_roll(quaternion: Sequence[float]) -> list[float]:
    """Returns Sionna's orientation (radians; R = Rz Ry Rx) of a unit quaternion (wxyz, local to world)."""
    w, x, y, z = quaternion
    if np.hypot(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)) < 1e-6:  # gimbal lock: yaw and roll coincide
        return [float(2 * np.arctan2(z, w)), float(np.copysign(np.pi / 2, w * y - z * x)), 0.0]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return [float(yaw), float(pitch), float(roll)]


def _by_transmitter(found: Sequence[rt.Paths], frequency_hz: float, n_tx: int, shape: tuple[int, int]) -> list[TxPaths]:
    parts = [_arrays(paths, frequency_hz, n_tx, shape) for paths in found] or [_no_paths(*shape, n_tx)]
    return [_sorted_paths(*map(np.concatenate, zip(*(part[i] for part in parts), strict=True))) for i in range(n_tx)]


def _arrays(
    found: rt.Paths, frequency_hz: float, n_tx: int, shape: tuple[int, int]
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Returns the coefficients (paths, elements), delays and interactions (paths, depth) of every transmitter's paths; `shape`
    is (elements, depth)."""
    # a: (receiver, element, tx, tx element, path); tau, valid: (receiver, tx, path); interactions: (depth, receiver, tx, path).
    real, imaginary = (np.array(x)[0, :, :, 0].astype(np.float64) for x in found.a)
    if found.tau.shape[-1] == 0:
        return _no_paths(*shape, n_tx)
    delays = np.array(found.tau)[0].astype(np.float64)
    carrier = np.exp(-2j * np.pi * np.mod(frequency_hz * delays, 1.0))
    coefficients = np.moveaxis(real + 1j * imaginary, 0, -1) * carrier[..., None]
    valid = np.array(found.valid)[0]
    kinds = np.moveaxis(np.array(found.interactions)[:, 0], 0, -1).astype(np.int64)
    valid &= np.abs(coefficients).max(-1) > FAINT
    return [(coefficients[i, valid[i]], delays[i, valid[i]], kinds[i, valid[i]]) for i in range(n_tx)]


def _no_paths(elements: int, depth: int, n_tx: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    return [(np.zeros((0, elements), complex), np.zeros(0), np.zeros((0, depth), int))] * n_tx


def _sorted_paths(
    coefficients: Complex[np.ndarray, "paths elements"],
    delays: Float[np.ndarray, " paths"],
    kinds: Int[np.ndarray, "paths depth"],
) -> TxPaths:
    # Two elements resolve the ties of mirrored paths, which have equal delays and magnitudes.
    first, last = coefficients[:, 0], coefficients[:, -1]
    keys = (last.imag, last.real, first.imag, first.real, np.abs(first), delays)  # lexsort: the last key is the primary one
    rank = np.lexsort(keys)
    return TxPaths(coefficients[rank], delays[rank], kinds[rank])
