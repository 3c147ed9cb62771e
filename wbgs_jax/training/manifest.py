"""`manifest.json` of a run folder: a summary of data, model, training, versions, device and scores in one file."""

import contextlib
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.evaluation.report import provenance
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.training.run_folder import MANIFEST

FORMAT = 1
PACKAGES = ("jax", "jaxlib", "numpy", "flax", "optax")


def write_manifest(folder: Path, trained: TrainedField, report: dict[str, Any] | None = None) -> None:
    """Writes or updates the manifest of a run folder.

    Args:
        folder: run folder.
        trained: its field.
        report: result of an evaluation (`evaluation.score.evaluate`) whose scores are added; earlier scores are kept unless the
            run has been trained further since.
    """
    path = folder / MANIFEST
    known: dict[str, Any] = {}
    if path.exists():
        before = read_json(path)
        with contextlib.suppress(AttributeError, TypeError, ValueError):  # a file that is not a manifest has no scores
            known = dict(before.get("scores", {})) if before.get("training", {}).get("steps") == trained.step else {}
    config, origin = trained.config, provenance(trained)
    scores = known | ({} if report is None else {report["part"]: _figures(report)})
    write_json(
        path,
        {
            "format": FORMAT,
            "data": {"source": config.source, "sha256": trained.data},
            "model": {"field": config.field, "preset": config.preset, **trained.field.inspect(trained.params).sizes},
            "training": {
                "command": origin["command"],
                "seed": config.seed,
                "steps": trained.step,
                "seconds": round(trained.seconds, 1),
                "settings": origin["settings"],
            },
            "versions": {"wbgs_jax": origin["version"], "commit": origin["commit"], "python": platform.python_version()}
            | {name: _version(name) for name in PACKAGES},
            "device": origin["device"],
            "scores": scores,
        },
    )


def _figures(report: dict[str, Any]) -> dict[str, Any]:
    """Returns the scalar entries of a report."""
    return {name: value for name, value in report.items() if isinstance(value, int | float) and not isinstance(value, bool)}


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
