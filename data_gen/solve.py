"""Traces one scene with Sionna RT and turns paths into snapshots that are bit-identical between runs.

What the simulator leaves to its user, and this module does:
* `scene.frequency` stays at 3.5 GHz unless set: it is set and read back.
* `paths.a` carries no exp(-j 2 pi f tau): the carrier phase is applied here, with f * tau in float64.
* Equal solves return equal paths in another order: paths are sorted before they are summed in complex128.
* A full path buffer drops candidates silently: candidates are counted for every transmitter and a full buffer is an error.

Import this module only after `data_gen.llvm.ensure_backend()`.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import sionna.rt as rt
from jaxtyping import Complex, Float, Int
from sionna.rt.path_solvers.sb_deterministic import SBDeterministicCandidateGenerator

from data_gen.materials import check_frequency
from data_gen.scenes.base import IDENTITY, SceneSpec
from data_gen.settings import SolverSettings
from wbgs_jax.array import planar_array
from wbgs_jax.errors import UserError

RX_ROWS = RX_COLUMNS = 4
SPACING = 0.5
"""Element spacing in wavelengths: the array follows the frequency."""
FREQUENCY_TOLERANCE = 1e-6
"""Sionna holds the frequency in float32; more than this relative difference is a mistake."""


@dataclass(frozen=True)
class TxPaths:
    """The paths of one transmitter at one frequency, in a reproducible order (by delay, then magnitude)."""

    coefficients: Complex[np.ndarray, "paths elements"]
    """complex128, carrier phase included, one column a receiver element."""
    delays: Float[np.ndarray, "paths"]
    """Seconds."""
    order: Int[np.ndarray, "paths"]
    """Number of interactions; 0 is the line of sight."""

    def snapshot(self) -> Complex[np.ndarray, "elements"]:
        """Coherent sum of the paths, complex64."""
        return self.coefficients.sum(0).astype(np.complex64)


class Simulator:
    """A scene loaded into Sionna RT. Set a frequency first: a new one recompiles, so loop over frequencies outside."""

    def __init__(self, spec: SceneSpec, settings: SolverSettings) -> None:
        if spec.rx_orientation != IDENTITY:
            raise UserError(f"scene {spec.name}: a turned receiver is not supported; use the identity orientation")
        self.settings = settings
        self.frequency_hz = 0.0
        self._scene = _load(spec)
        self._solver = rt.PathSolver(deterministic=True)
        # The cap acts on candidates, which only the generator knows; `paths` keeps those that turned out to exist.
        self._candidates = _CountingGenerator()
        if not hasattr(self._solver, "_candidate_generator"):
            raise UserError("full path buffers would go unseen with this sionna-rt; install 2.1 or 2.2")
        self._solver._candidate_generator = self._candidates

    def set_frequency(self, frequency_hz: float) -> float:
        """Set the carrier (hertz) of scene and materials; returns the value read back from the scene (float32 inside)."""
        self._scene.frequency = check_frequency(frequency_hz)
        read_back = float(np.array(self._scene.frequency).item())
        if abs(read_back / frequency_hz - 1) > FREQUENCY_TOLERANCE:
            raise RuntimeError(f"asked Sionna RT for {frequency_hz} Hz, it reports {read_back} Hz")
        self.frequency_hz = frequency_hz
        return read_back

    def paths(self, tx_positions: Float[np.ndarray, "tx 3"]) -> list[TxPaths]:
        """All paths from every transmitter (world frame, metres) to the receiver at the frequency that was set.

        Random numbers belong to the place in the batch: the same batch gives the same bits, another grouping almost the same.
        """
        if self.frequency_hz == 0:
            raise RuntimeError("set a frequency first")
        self._place_transmitters(tx_positions)
        options = self.settings
        found = self._solver(
            self._scene, max_depth=options.max_depth, samples_per_src=options.samples_per_src, seed=options.seed,
            max_num_paths_per_src=options.max_paths_per_src, synthetic_array=True, los=True, specular_reflection=True,
            diffuse_reflection=False, refraction=True, diffraction=options.diffraction, edge_diffraction=False,
        )  # fmt: skip
        full = np.flatnonzero(self._candidates.per_source >= options.max_paths_per_src)
        if len(full):
            where = f"transmitter {full[0]} of the batch and {len(full) - 1} more"
            raise UserError(f"more than {options.max_paths_per_src} candidate paths at {where}; raise --max-paths")
        return _by_transmitter(found, self.frequency_hz, len(tx_positions))

    def _place_transmitters(self, positions: Float[np.ndarray, "tx 3"]) -> None:
        for name in list(self._scene.transmitters):
            self._scene.remove(name)
        for i, position in enumerate(positions):
            self._scene.add(rt.Transmitter(f"tx{i}", position=[float(value) for value in position]))


class _CountingGenerator(SBDeterministicCandidateGenerator):
    """Sionna's deterministic candidate generator, which also tells how many candidates every transmitter got."""

    per_source: Int[np.ndarray, "tx"]

    def __call__(self, mi_scene: Any, src_positions: Any, *args: Any, **kwargs: Any) -> Any:
        paths = super().__call__(mi_scene, src_positions, *args, **kwargs)
        paths.schedule()
        dr.eval()
        stored = int(np.array(paths.paths_counter).item())
        sources = np.array(paths.source_indices)[:stored]
        self.per_source = np.bincount(sources, minlength=dr.width(src_positions))
        return paths


def _load(spec: SceneSpec) -> rt.Scene:
    scene = rt.load_scene()
    objects = []
    with tempfile.TemporaryDirectory() as folder:
        for part in spec.parts:
            file = Path(folder) / f"{part.name}.ply"
            part.mesh.export(file)
            material = rt.ITURadioMaterial(f"{part.name}-material", part.material, thickness=part.thickness)
            objects.append(rt.SceneObject(fname=str(file), name=part.name, radio_material=material))
        scene.edit(add=objects)
    spacing = {"vertical_spacing": SPACING, "horizontal_spacing": SPACING, "polarization": "V"}
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", **spacing)
    scene.rx_array = rt.PlanarArray(num_rows=RX_ROWS, num_cols=RX_COLUMNS, pattern="tr38901", **spacing)
    scene.add(rt.Receiver("rx", position=list(spec.rx_position), orientation=[0.0, 0.0, 0.0]))
    elements = np.array(scene.rx_array.normalized_positions).T
    if not np.array_equal(elements, planar_array(RX_ROWS, RX_COLUMNS, SPACING)):
        raise RuntimeError("Sionna RT numbers the elements of its PlanarArray differently from wbgs_jax.array.planar_array")
    return scene


def _by_transmitter(found: rt.Paths, frequency_hz: float, n_tx: int) -> list[TxPaths]:
    # a: (receiver, element, tx, tx element, path); tau, valid: (receiver, tx, path); interactions: (depth, receiver, tx, path).
    if found.tau.shape[-1] == 0:
        return [_sorted_paths(np.zeros((0, RX_ROWS * RX_COLUMNS), complex), np.zeros(0), np.zeros(0, int))] * n_tx
    real, imaginary = (np.array(x)[0, :, :, 0].astype(np.float64) for x in found.a)
    delays = np.array(found.tau)[0].astype(np.float64)
    carrier = np.exp(-2j * np.pi * np.mod(frequency_hz * delays, 1.0))
    coefficients = np.moveaxis(real + 1j * imaginary, 0, -1) * carrier[..., None]
    valid = np.array(found.valid)[0]
    order = (np.array(found.interactions)[:, 0] != rt.InteractionType.NONE).sum(0)
    return [_sorted_paths(coefficients[i, valid[i]], delays[i, valid[i]], order[i, valid[i]]) for i in range(n_tx)]


def _sorted_paths(
    coefficients: Complex[np.ndarray, "paths elements"], delays: Float[np.ndarray, "paths"], order: Int[np.ndarray, "paths"]
) -> TxPaths:
    # Two elements break the ties of mirrored paths, which arrive at the same time and equally strong.
    first, last = coefficients[:, 0], coefficients[:, -1]
    keys = (last.imag, last.real, first.imag, first.real, np.abs(first), delays)  # lexsort: the last key counts most
    rank = np.lexsort(keys)
    return TxPaths(coefficients[rank], delays[rank], order[rank])
