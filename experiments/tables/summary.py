"""The few numbers that pages quote of many results: averages over scenes, as a file (`headline.json`) that marks can name."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper import GHZ_10, SCENES
from experiments.results import Results
from experiments.statistics import gain, level
from experiments.tables import default_field, headline, table1
from experiments.tables.cells import ceiling, scores
from wbgs_jax._util.files import write_json

FILE = "headline.json"


def summary(results: Results) -> dict[str, Any]:
    """Returns averages over the six scenes, and the gains along the curve; what was not run everywhere is left out."""
    models = {"wideband": headline.WIDEBAND, "wrfgs": headline.BY_FREQUENCY, "pooled": headline.POOLED}
    known: dict[str, float | None] = {
        name: _average([_level(headline.found(results, scene, *model)) for scene in SCENES]) for name, model in models.items()
    }
    known["coherent"] = _average([_level(scores(results, table1.jobs_of(scene, "wave"), GHZ_10)) for scene in SCENES])
    known["default"] = _average([default_field.average_of_medians(results.folder, scene) for scene in SCENES])
    known["ceiling"] = _average([ceiling(scene, GHZ_10) for scene in SCENES])
    ours, theirs = known["wideband"], known["wrfgs"]
    known["gain_percent"] = None if ours is None or theirs is None else 100 * (ours / theirs - 1)
    for name, variant in (("5x", "long"), ("10x", "longest")):
        pair = (headline.found(results, headline.SCENE_OF_CURVE, field, variant) for field in ("wideband", "wrfgs"))
        ratio = gain(*pair)
        known[f"gain_percent_{name}"] = None if ratio is None else 100 * ratio
    return {name: round(value, 4) for name, value in known.items() if value is not None}


def write(results: Results) -> Path:
    """Writes the summary beside the results; returns its path."""
    path = results.folder / FILE
    write_json(path, summary(results))
    return path


def _level(values: Any) -> float | None:
    return None if values is None else level(values)


def _average(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) else None
