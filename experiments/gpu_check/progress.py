"""Figures of a training that may not be finished, from its run folder; JAX is not needed for them."""

import itertools
from pathlib import Path
from statistics import median
from typing import Any

from experiments.gpu_check.record import rounded
from wbgs_jax.training import curves

LAST = 200
"""Epochs whose median is the time of a step: programs that are compiled meanwhile do not count."""


def figures_of(run: Path) -> dict[str, Any]:
    """Returns steps, seconds, milliseconds a step, loss and sizes of a run folder; nothing before the first step."""
    entries = [entry for entry in curves.read(run / "metrics.jsonl") if "loss" in entry]
    if not entries:
        return {}
    saved = [int(path.name) for path in (run / "checkpoints").glob("*") if path.name.isdigit()]
    last, watched = entries[-1], [entry["held_out_ssim"] for entry in entries if "held_out_ssim" in entry]
    pace = paces(entries)
    figures = {
        "steps": last["step"],
        "saved_step": max(saved, default=0),
        "seconds": round(last["seconds"], 1),
        "ms_per_step_overall": rounded(1e3 * last["seconds"] / last["step"]),
    }
    figures |= {
        name: rounded(value) if isinstance(value, float) else value for name, value in last.items() if name not in figures
    }
    figures |= {"ms_per_step": rounded(median(pace[-LAST:]))} if pace else {}
    figures |= {"validation_ssim": rounded(watched[-1])} if watched else {}
    return {name: value for name, value in figures.items() if name not in ("step", "held_out_ssim")}


def paces(entries: list[dict[str, Any]]) -> list[float]:
    """Returns milliseconds a step from one entry to the next."""
    pairs = [(b["step"] - a["step"], b["seconds"] - a["seconds"]) for a, b in itertools.pairwise(entries)]
    return [1e3 * seconds / steps for steps, seconds in pairs if steps > 0]
