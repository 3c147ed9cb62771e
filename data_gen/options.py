"""Command line options of the generator, and the checked job made from them."""

import dataclasses
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from data_gen.jobs import Job
from data_gen.own_scene import own_scene, parse_point, parse_transmitters
from data_gen.scenes import SceneSpec, get_scene
from data_gen.scenes.base import FREQUENCIES_21_HZ
from data_gen.scenes.changes import changed
from data_gen.settings import ArraySettings, Solver, SolverSettings
from wbgs_jax._util.errors import UserError
from wbgs_jax.data.load import RELEASED
from wbgs_jax.interchange.rooms import check_material_frequencies

HERE = Path(__file__).parent
SUBSET_SEED = 0
NAME = re.compile(r"[A-Za-z0-9_-]+")
"""Valid names of a dataset, which are also used for run folders."""
CEILING_TX = 50
"""Number of transmitters for which the ceilings are measured."""


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Choice of a scene: one of `data_gen/scenes` by its number, or a user's own file."""

    scene: str = "1"
    """Number of a scene of `data_gen/scenes`, or a file of your own: .glb, .obj, .ply or .xml (docs/own_scene.md)."""
    materials: Path | None = None
    """Own scene: materials of its objects (.toml)."""
    rx: str | None = None
    """Position of the receiver, x,y,z in metres; by default that of a numbered scene."""
    tx_grid: str | None = None
    """Transmitters, x0,y0,z0:x1,y1,z1:nx,ny,nz in metres, or a .csv file with the header x,y,z; by default those of a numbered
    scene."""
    moved: tuple[str, ...] = ()
    """Numbered scene: objects that are elsewhere, each as name:dx,dy or name:dx,dy,degrees (metres)."""
    removed: tuple[str, ...] = ()
    """Numbered scene: names of objects that are not there."""
    up: Literal["y", "z"] | None = None
    """Own scene: the file's vertical axis."""
    scale: float | None = None
    """Own scene: metres per unit of the file; by default 1, and implausible sizes are rejected."""
    rx_orientation: tuple[float, float, float, float] | None = None
    """Quaternion w x y z from the receiver's local frame to the world; by default that of the scene."""

    @property
    def own(self) -> bool:
        """Whether the scene is a user's own file."""
        return not self.scene.isdecimal()

    def spec(self, frequencies_hz: tuple[float, ...] = ()) -> SceneSpec:
        """Returns the checked scene at the given frequencies (hertz) or at its own.

        Raises:
            UserError: a mistake in the scene, the receiver, the transmitters or the materials.
        """
        spec = self._own_spec(frequencies_hz) if self.own else self._numbered_spec()
        return spec if self.rx_orientation is None else dataclasses.replace(spec, rx_orientation=_unit(self.rx_orientation))

    def _numbered_spec(self) -> SceneSpec:
        if self.materials or self.up or self.scale is not None:
            raise UserError("--materials, --up and --scale are for your own scene; give its file with --scene")
        spec = changed(get_scene(int(self.scene)), self.moved, self.removed)
        if self.tx_grid is not None:
            spec = dataclasses.replace(spec, tx_grid=parse_transmitters(self.tx_grid))
        return spec if self.rx is None else dataclasses.replace(spec, rx_position=parse_point(self.rx, "--rx"))

    def _own_spec(self, frequencies_hz: tuple[float, ...]) -> SceneSpec:
        if self.rx is None or self.tx_grid is None:
            raise UserError("your own scene needs a receiver and transmitters: --rx x,y,z --tx-grid x0,y0,z0:x1,y1,z1:nx,ny,nz")
        if self.moved or self.removed:
            raise UserError("--moved and --removed are for a numbered scene; change the file of your own scene instead")
        return own_scene(
            Path(self.scene), self.materials, rx=self.rx, tx_grid=self.tx_grid, frequencies_hz=frequencies_hz, up=self.up,
            scale=self.scale,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(SceneOptions):
    """Generate a scene file with Sionna RT. The same command continues an interrupted run."""

    out: Path | None = None
    """Scene file to write; by default wbgs_jax/data/released/scene<N>.npz or <name of your file>.npz."""
    name: str | None = None
    """Name of the dataset; by default the scene's name."""
    frequencies: tuple[float, ...] = ()
    """GHz; by default those of the frequency set."""
    frequency_set: Literal["10", "21"] = "10"
    """The ten frequencies of the paper's Table 4, or 1, 5, 10, ..., 100 GHz."""
    array: ArraySettings = field(default_factory=ArraySettings)
    samples: int = SolverSettings.samples_per_src
    """Uniform rays for the path search from every transmitter, in addition to those aimed at edges."""
    max_tx: int | None = None
    """Use only this many of the transmitters, drawn at random with a fixed seed."""
    depth: int = SolverSettings.max_depth
    """Maximum number of interactions of a path."""
    diffraction: bool = True
    """First-order diffraction."""
    solver: Solver = SolverSettings.solver
    """The project's own path search, materials and diffraction, or those of the simulator."""
    scattering: tuple[float, float] = SolverSettings.scattering
    """Scattering coefficients of walls, floor and ceiling, and of furniture; 0 0 is smooth."""
    seed: int = SolverSettings.seed
    """Seed of all random numbers in the path search."""
    ceilings: bool = True
    """Measure the ceilings of truncated and phase-blind predictors."""
    max_paths: int = SolverSettings.max_paths_per_src
    """Capacity for candidate paths of one transmitter."""
    workers: int | None = None
    """Number of processes, of about 2.5 GB each; by default half the number of cores but at most four, and one with a GPU."""
    threads: int | None = None
    """Threads of each process; by default as many as keep all cores busy."""
    cluster: str | None = None
    """Compute on a Dask cluster: "local" for --workers processes on this machine, as by default, or the address of a scheduler
    (tcp://host:8786), whose workers need access to the work folder."""
    work: Path = HERE / "work"
    """Folder for unfinished work."""

    def default_out(self) -> Path:
        """Returns the default path of the scene file. Results with other settings must not replace a released scene."""
        if self.own:
            return Path(f"{Path(self.scene).stem}.npz")
        usual = Options()
        same = (
            "frequencies", "rx", "rx_orientation", "array", "samples", "max_tx", "depth", "diffraction", "solver", "scattering",
            "seed", "ceilings", "tx_grid", "moved", "removed",
        )  # fmt: skip
        if any(getattr(self, name) != getattr(usual, name) for name in same):
            raise UserError("with other settings the released file must not be replaced; give another one with --out")
        suffix = "_21f" if self.frequency_set == "21" else ""
        return RELEASED / f"scene{self.scene}{suffix}.npz"


def make_job(options: Options) -> Job:
    """Returns the job, checked before hours are spent on it.

    Raises:
        UserError: a mistake in the scene, the receiver, the transmitters, the materials, the array or the frequencies.
    """
    _check_numbers(options)
    if options.frequencies and options.frequency_set != "10":
        raise UserError("--frequencies and --frequency-set exclude each other; give one of them")
    frequencies = tuple(ghz * 1e9 for ghz in options.frequencies) or (
        FREQUENCIES_21_HZ if options.frequency_set == "21" else ()
    )
    spec = options.spec(frequencies)
    suffix = "_21f" if options.frequency_set == "21" else ""  # another dataset of the same room
    spec = dataclasses.replace(spec, name=options.name or f"{spec.name}{suffix}")
    frequencies = frequencies or spec.frequencies_hz
    check_material_frequencies([p.material for p in spec.parts], frequencies)
    settings = SolverSettings(
        max_depth=options.depth, samples_per_src=options.samples, diffraction=options.diffraction,
        max_paths_per_src=options.max_paths, solver=options.solver, scattering=options.scattering, seed=options.seed,
    )  # fmt: skip
    tx = spec.accessible_tx()
    if options.max_tx is not None and options.max_tx < len(tx):
        tx = tx[np.sort(np.random.default_rng(SUBSET_SEED).permutation(len(tx))[: options.max_tx])]
    chosen = np.unique(np.linspace(0, len(tx) - 1, CEILING_TX).round().astype(int)) if options.ceilings else ()
    return Job(spec, settings, tx, frequencies, options.array, tuple(int(i) for i in chosen))


def _check_numbers(options: Options) -> None:
    numbers = {
        name: getattr(options, name) for name in ("samples", "depth", "max_paths", "workers", "threads", "max_tx", "scale")
    }
    array = options.array
    if options.name is not None and not NAME.fullmatch(options.name):
        raise UserError(f"--name {options.name!r} is not a valid name; use only letters, digits, - and _")
    numbers |= {"array.rows": array.rows, "array.columns": array.columns}
    for name, value in numbers.items():
        if value is not None and not value >= (1 if isinstance(value, int) else 1e-9):
            raise UserError(
                f"--{name.replace('_', '-')} is {value}; it must be {'at least 1' if isinstance(value, int) else 'positive'}"
            )
    if options.seed < 0:
        raise UserError(f"--seed is {options.seed}; it must not be negative")
    if not all(0 <= value <= 1 for value in options.scattering):
        raise UserError(f"--scattering is {options.scattering}; both coefficients must be from 0 to 1")
    if array.spacing <= 0:
        raise UserError(f"--array.spacing is {array.spacing} {array.unit}; it must be positive")


def _unit(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    length = float(np.linalg.norm(quaternion))
    if not length > 0:
        raise UserError("--rx-orientation is zero; give a quaternion w x y z, 1 0 0 0 for no rotation")
    w, x, y, z = (value / length for value in quaternion)
    return w, x, y, z
