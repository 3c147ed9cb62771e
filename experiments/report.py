"""Markdown tables for the pages that quote them: `python -m experiments.report` (quality files, and all series)."""

from typing import Any

from experiments.catalogue import SERIES
from experiments.markdown import markdown
from experiments.results import FOLDER, Results
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.files import read_json


def pair(result: dict[str, Any]) -> str:
    """Returns median / mean SSIM."""
    return f"{result['median_ssim']:.3f} / {result['mean_ssim']:.3f}"


def quality_table(results: list[dict[str, Any]]) -> str:
    """Returns a table with one row a quality file, the baselines beside the field."""
    names = list(results[0]["baselines"])
    head = ["dataset", "field", *(name.replace("_", " ") for name in names), "preset, device", "training", "ms per PAS"]
    rows = []
    for r in results:
        origin = r["provenance"]
        others = [pair(r["baselines"][name]) for name in names]
        device = f"{origin['preset']}, {origin['device'].split()[0]}"
        times = [f"{origin['training_seconds'] / 60:.1f} min", f"{r['ms_per_pas']:.2f}"]
        rows.append([r["scene"], f"**{pair(r)}**", *others, device, *times])
    return markdown(head, rows)


def main() -> None:
    """Entry point."""
    if quality := [read_json(path) for path in sorted(FOLDER.glob("quality_*.json"))]:
        print(quality_table(quality))
    for experiment in SERIES.values():
        print(f"\n## {experiment.title}\n\n{experiment.render(Results('quick'))}")


if __name__ == "__main__":
    run_command(main)
