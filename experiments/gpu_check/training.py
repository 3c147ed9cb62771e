"""Trainings to their last step, and their scores on all test transmitters: the paper's form, WRF-GS, and the default.

Each is a `wbgs-jax train` command in a run folder: a call continues at the newest checkpoint there. Scores are SSIM of the
held-out transmitters at the frequencies of the training (`seen`) and at others (`unseen`).

* The paper's form is the preset `paper` with all of its 200,000 steps, without residual kriging, which the paper does not have.
  In scene 1 unseen frequencies are those of the data set `1_21f`, whose test transmitters are those of scene 1. Scene 4 has no
  such set: two of its ten frequencies are left out of the training. Tables that train with all ten (docs/results.md) therefore
  compare with the seen frequencies of scene 1, not of scene 4.
* WRF-GS is the same form without a frequency: one model for one frequency, which both paper trainings know, so that their
  scores at this frequency compare with it.
* The default training is what a user gets who names a scene alone.

The stand-in trains tiny networks for a few steps, the default as well with the wideband field.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.gpu_check.progress import figures_of
from experiments.gpu_check.record import Record
from experiments.paper import GHZ_10
from wbgs_jax.commands import train
from wbgs_jax.data import Dataset, load_dataset
from wbgs_jax.fields import get_field
from wbgs_jax.inference.predictor import observe
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.metrics import ssim
from wbgs_jax.training import checkpoint
from wbgs_jax.training.batches import limited
from wbgs_jax.training.run_folder import MANIFEST, load_trained

WRFGS_GHZ = 37
"""The frequency of WRF-GS: near the 28 GHz of mobile networks, and in both scenes among the trained frequencies."""
LEFT_OUT_GHZ = (24.25, 77)
"""Unseen frequencies of scene 4."""
PAPER = ("--field", "wideband", "--preset", "paper", "--no-neighbours")
WRFGS = (*PAPER, "--wideband.no-attenuation-frequency", "--wideband.no-radiance-frequency", "--train-ghz", f"{WRFGS_GHZ}")
"""`fields.wrfgs.without_frequency` of the paper's settings; the field `wrfgs` itself has no preset `paper`."""
TRAINED_GHZ = tuple(f"{ghz:g}" for ghz in GHZ_10 if ghz not in LEFT_OUT_GHZ)
SMALL = (
    *("--train-tx", "12", "--optim.steps", "40", "--optim.batch", "1", "--loop.epoch-steps", "2"),
    *("--loop.checkpoint-every", "40", "--loop.evaluate-every", "40", "--validation", "0", "--density.every", "0"),
    *("--wideband.gaussians", "60", "--wideband.width", "8", "--wideband.depth", "2", "--wideband.skip", "1"),
    *("--wideband.radiance-widths", "8"),
)
"""Options of the stand-in ..."""
SMALL_DEFAULT = ("--field", "wideband", "--preset", "smoke")
"""... also where a piece names no field ..."""
SMALL_TX = 2
"""... and its test transmitters."""
BLOCK = 256
"""Spectra that are scored at a time."""


@dataclass(frozen=True)
class Training:
    """A training and its data."""

    scene: str
    options: tuple[str, ...] = ()
    """Options of `wbgs-jax train`, besides the scene and the folder."""
    unseen: str = ""
    """Data set with frequencies that the training does not know; none: seen frequencies alone are scored."""

    def arguments(self, stand_in: bool) -> list[str]:
        """Returns the arguments of `wbgs-jax train`."""
        small = (*(SMALL_DEFAULT if not self.options else ()), *SMALL) if stand_in else ()
        return ["--scene", self.scene, *self.options, *small]


TRAININGS = {
    "paper_scene1": Training("1", PAPER, unseen="1_21f"),
    "paper_scene4": Training("4", (*PAPER, "--train-ghz", *TRAINED_GHZ), unseen="4"),
    "wrfgs_scene1": Training("1", WRFGS),
    "wrfgs_scene4": Training("4", WRFGS),
    "default_scene1": Training("1"),
    "default_scene4": Training("4"),
}


def train_and_score(name: str, record: Record, stand_in: bool, folder: Path) -> bool:
    """Trains, or continues, and scores what has no scores yet; Ctrl-C ends it in time. Returns True.

    Raises:
        Interrupted: Ctrl-C; the state is saved.
        KeyboardInterrupt: Ctrl-C when nothing is left to save.
    """
    piece = TRAININGS[name]
    arguments = piece.arguments(stand_in)
    command, settings = train.parse(arguments)
    config = train.run_config(command, settings)
    steps = limited(settings, config.dataset(), get_field(config.field)).optim.steps
    record.add("training", {"command": " ".join(["wbgs-jax train", *arguments]), "preset": config.preset, "of": steps})
    if not (folder / MANIFEST).exists():
        train.main([*arguments, "--out", str(folder), "--resume"])
    record.add("training", figures_of(folder))
    trained = load_trained(folder)
    saved = checkpoint.read(folder / "checkpoints", trained.step).metadata  # of the call that ended the training
    record.add("training", {f"epoch_{name}": saved[name] for name in ("compilations", "compile_seconds")})
    scene = load_dataset(piece.scene)
    known = trained.config.train_ghz or tuple(ghz_of(scene, np.arange(len(scene))).tolist())
    parts = {"seen": scene} | ({"unseen": load_dataset(piece.unseen)} if piece.unseen else {})
    for part, dataset in parts.items():
        if part not in record.figures:
            trained_at = np.isclose(ghz_of(dataset, dataset.test)[:, None], known, rtol=1e-6, atol=0).any(1)
            index = dataset.test[trained_at if part == "seen" else ~trained_at]
            record.add(part, scores(trained, dataset, some_transmitters(dataset, index) if stand_in else index))
    return True


def ghz_of(dataset: Dataset, index: np.ndarray) -> np.ndarray:
    """Returns the frequencies of links, GHz."""
    return dataset.frequencies_hz[index] / 1e9


def some_transmitters(dataset: Dataset, index: np.ndarray) -> np.ndarray:
    """Returns the links of the first transmitters alone."""
    return index[np.isin(dataset.tx_index[index], np.unique(dataset.tx_index[index])[:SMALL_TX])]


def scores(trained: TrainedField, dataset: Dataset, index: np.ndarray) -> dict[str, Any]:
    """Returns SSIM of some links: median and mean over all, and by frequency."""
    values = np.empty(len(index))
    predicted = np.asarray(observe(trained, dataset, index).pas)
    for start in range(0, len(index), BLOCK):
        block = slice(start, start + BLOCK)
        values[block] = ssim(predicted[block], np.asarray(dataset.pas(index[block])))
    ghz = ghz_of(dataset, index)
    by_ghz = {f"{f:g}": summary(values[np.isclose(ghz, f, rtol=1e-6, atol=0)]) for f in np.unique(ghz)}
    counts = {"spectra": len(index), "transmitters": len(np.unique(dataset.tx_index[index]))}
    return {"data": dataset.name, "step": trained.step} | summary(values) | counts | {"by_ghz": by_ghz}


def summary(values: np.ndarray) -> dict[str, float]:
    """Returns median and mean, four digits."""
    return {"median_ssim": round(float(np.median(values)), 4), "mean_ssim": round(float(np.mean(values)), 4)}
