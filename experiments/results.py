"""Result files: written by the runner, read by tables and series. One small JSON a job, with where it comes from."""

import dataclasses
import functools
import json
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from experiments.jobs import BASELINES, PICTURED_GHZ, Job
from experiments.old_names import EDITION, todays
from experiments.settings import differences, unlike_preset
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_json

FOLDER = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Result:
    """What is known of a job that was run."""

    values: dict[str, Any]

    @cached_property
    def ghz(self) -> list[float]:
        """Frequencies that were asked for, ascending."""
        return [float(f) for f in self.values["ssim"]]

    @cached_property
    def tx(self) -> Int[np.ndarray, " tx"]:
        """Transmitters that were scored."""
        return np.array(self.values["tx"])

    @cached_property
    def ssim(self) -> Float[np.ndarray, "tx ghz"]:
        """Of every scored spectrum."""
        return np.array(list(self.values["ssim"].values())).T

    @property
    def seconds(self) -> float:
        """Of training and evaluation, as far as they are known."""
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
        return unlike_preset(job, todays(self.values, job.field)) == differences(job)


@dataclass(frozen=True)
class Results:
    """The results of all jobs, those of the tables in one profile."""

    profile: str
    folder: Path = FOLDER

    def path(self, job: Job) -> Path:
        """Returns where a job's result is or will be."""
        return self.folder / job.sized(self.profile).profile / f"{job.name}.json"

    def pictures_path(self, job: Job) -> Path:
        """Returns where its pictures are."""
        return self.path(job).with_suffix(".png")

    def get(self, job: Job) -> Result | None:
        """Returns a job's result; None if it has not been run yet, or with other settings."""
        path = self.path(job)
        if not path.exists():
            return None
        result = _read(path, path.stat().st_mtime_ns)
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
        """Keep a result; the JSON is written last, so that it stands for everything."""
        job = job.sized(self.profile)
        if pictures is not None:
            with atomic_write(self.pictures_path(job)) as stream:
                Image.fromarray(pictures.reshape(-1, pictures.shape[-1])).save(stream, format="png", optimize=True)
        whole = {"job": dataclasses.asdict(job)} | values | {"presets": EDITION, "settings": differences(job)}
        text = json.dumps(whole, indent=2, allow_nan=False)
        with atomic_write(self.path(job)) as stream:
            stream.write((one_line_lists(text) + "\n").encode())


@functools.lru_cache(maxsize=1000)
def _read(path: Path, modified_ns: int) -> Result:
    """Returns the content of a file, read once for each time that it was written; what is no result is a `UserError`."""
    values = read_json(path)
    if not _is_result(values):
        raise UserError(f"{path} is no result of an experiment; remove it, and the runner makes it again")
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


def one_line_lists(text: str) -> str:
    """Returns indented JSON with lists of plain values on one line each: a tenth of the size, and a line a frequency in a
    diff."""
    return re.sub(r"\[[^\[\]{}]*\]", lambda found: re.sub(r"\s+", " ", found[0]).replace("[ ", "[").replace(" ]", "]"), text)
