"""Result files: written by the runner, read by tables and series. A file of JSON lines a profile, a line a job, with where it
comes from.

Several processes may add rows to one file: it is written anew with every row, whole, by one process at a time.
"""

import contextlib
import dataclasses
import fcntl
import functools
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from experiments.jobs import BASELINES, PICTURED_GHZ, Job
from experiments.settings import differences, unlike_preset
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_text
from wbgs_jax.config import present_name

FOLDER = Path(__file__).parent / "results"
SHARED = Path("..") / "shared" / "data"
"""Where published samples lie, beside the repository."""
EDITION = 3
"""Edition of the presets that a row's settings are differences from. Who changes a preset raises it, and gives the settings of
the rows that still count anew."""
NAME = re.compile(r'\{"name": "([^"\\]+)"')
"""Beginning of every line of a file of rows."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Result:
    """Record of a job that was run."""

    values: dict[str, Any]

    @cached_property
    def ghz(self) -> list[float]:
        """Test frequencies, ascending."""
        return [float(f) for f in self.values["ssim"]]

    @cached_property
    def tx(self) -> Int[np.ndarray, " tx"]:
        """Transmitters that were scored."""
        return np.array(self.values["tx"])

    @cached_property
    def ssim(self) -> Float[np.ndarray, "tx ghz"]:
        """SSIM of every scored spectrum."""
        return np.array(list(self.values["ssim"].values())).T

    @property
    def seconds(self) -> float:
        """Duration of training and evaluation, as far as it is known."""
        return self.values.get("training_seconds", 0) + self.values.get("evaluation_seconds", 0)

    def at(self, ghz: list[float], tx: list[int]) -> Float[np.ndarray, "tx ghz"]:
        """Returns the SSIM of some of the transmitters at some of the frequencies."""
        known = self.tx.tolist()
        return self.ssim[np.ix_([known.index(i) for i in tx], [self.ghz.index(float(f)) for f in ghz])]

    def belongs_to(self, job: Job) -> bool:
        """Whether it was made on the same data, with the settings that the job has today."""
        scene = self.values.get("job", {}).get("scene", "")
        if not job.is_released and Path(scene).absolute() != Path(job.scene).absolute():
            return False
        made = {present_name(name): value for name, value in self.values.get("settings", {}).items()}
        own = unlike_preset(job, made)
        return self.values.get("presets") == EDITION and own == differences(job)


@dataclass(frozen=True)
class Results:
    """The results of all jobs, those of the tables in one profile."""

    profile: str
    folder: Path = FOLDER

    def path(self, job: Job) -> Path:
        """Returns the file that a job's result is or will be a line of."""
        return self.folder / f"{job.sized(self.profile).profile}.jsonl"

    def pictures_path(self, job: Job) -> Path:
        """Returns where its pictures are."""
        return self.path(job).with_suffix("") / f"{job.name}.png"

    def get(self, job: Job) -> Result | None:
        """Returns a job's result; None if it has not been run yet, or with other settings."""
        path = self.path(job)
        line = read_lines(path).get(job.name)
        if line is None:
            return None
        result = _result(path, job.name, line)
        return result if result.belongs_to(job.sized(self.profile)) else None

    def all(self, jobs: list[Job]) -> list[Result]:
        """Returns those that there are."""
        return [result for result in map(self.get, jobs) if result is not None]

    def pictures(self, job: Job) -> UInt8[np.ndarray, "k 90 360"] | None:
        """Returns the kept pictures, one for each of `PICTURED_GHZ`."""
        path = self.pictures_path(job)
        if self.get(job) is None or not path.exists():
            return None
        with Image.open(path) as image:
            return np.asarray(image).reshape(len(PICTURED_GHZ), -1, image.width)

    def write(self, job: Job, values: dict[str, Any], pictures: UInt8[np.ndarray, "k 90 360"] | None = None) -> None:
        """Keep a result; the row is written last, so that it stands for everything."""
        job = job.sized(self.profile)
        if pictures is not None:
            with atomic_write(self.pictures_path(job)) as stream:
                Image.fromarray(pictures.reshape(-1, pictures.shape[-1])).save(stream, format="png", optimize=True)
        whole = {"job": dataclasses.asdict(job)} | values | {"presets": EDITION, "settings": differences(job)}
        add_rows(self.path(job), {job.name: whole})


def read_lines(path: Path) -> dict[str, str]:
    """Returns the lines of a file of rows by name, in its order; none of a file that is not there."""
    if not path.exists():
        return {}
    known = path.stat()
    return _lines(path, (known.st_ino, known.st_mtime_ns, known.st_size))


def read_row(path: Path, name: str) -> Row | None:
    """Returns a row of a file; None if there is none of that name."""
    line = read_lines(path).get(name)
    return None if line is None else _row(path, name, line)


def read_rows(path: Path) -> dict[str, Row]:
    """Returns the rows of a file by name.

    Raises:
        UserError: a line is no row.
    """
    return {name: _row(path, name, line) for name, line in read_lines(path).items()}


def add_rows(path: Path, rows: Mapping[str, Row]) -> None:
    """Adds rows to a file, or puts them in the place of those of the same names."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = {name: json.dumps({"name": name} | row, allow_nan=False) for name, row in rows.items()}
    with path.with_suffix(".lock").open("a") as lock:
        with contextlib.suppress(OSError):  # some clusters' file systems have no locks
            fcntl.flock(lock, fcntl.LOCK_EX)
        whole = read_lines(path) | lines
        with atomic_write(path) as stream:
            stream.write("".join(f"{whole[name]}\n" for name in sorted(whole)).encode())


@functools.lru_cache(maxsize=64)
def _lines(path: Path, written: tuple[int, int, int]) -> dict[str, str]:
    """Returns the lines of a file, read once for each time that it was written."""
    found = {}
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if (name := NAME.match(line)) is None:
            raise UserError(f"{path}, line {number}: this is no row; remove the line, and the same command makes it again")
        found[name[1]] = line
    return found


def _row(path: Path, name: str, line: str) -> Row:
    try:
        return json.loads(line)
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{path}: the row {name} is no JSON ({error}); remove it, and the same command makes it again"
        ) from None


@functools.lru_cache(maxsize=1000)
def _result(path: Path, name: str, line: str) -> Result:
    values = _row(path, name, line)
    if not _is_result(values):
        raise UserError(f"{path}: the row {name} is no result of an experiment; remove it, and the runner makes it again")
    return Result(values)


def _is_result(values: Any) -> bool:
    if not isinstance(values, dict) or not (BASELINES in values or "median_ssim" in values or {"ssim", "tx"} <= set(values)):
        return False
    kinds = {"job": dict, "settings": dict, "presets": int, "tx": list, "ssim": dict, "training_seconds": float | int}
    if any(name in values and not isinstance(values[name], kind) for name, kind in kinds.items()):
        return False
    if not isinstance(values.get("job", {}).get("scene", ""), str):
        return False
    scores = values.get("ssim", {})
    try:
        return np.array([*map(float, scores)]).shape == np.array([*scores.values()], float).shape[:1]
    except (TypeError, ValueError):
        return False
