"""Markdown tables of the result files, for README.md and docs/decisions.md: `python -m experiments.report`."""

import statistics
from pathlib import Path
from typing import Any

from wbgs_jax._util.files import read_json

RESULTS = Path(__file__).parent / "results"


def pair(result: dict[str, Any]) -> str:
    """Median / mean SSIM."""
    return f"{result['median_ssim']:.3f} / {result['mean_ssim']:.3f}"


def quality_table(results: list[dict[str, Any]]) -> str:
    """One row a quality file, the references beside the field."""
    names = list(results[0]["references"])
    head = ["dataset", "field", *(name.replace("_", " ") for name in names), "preset, device", "training", "ms a PAS"]
    rows = []
    for r in results:
        origin = r["provenance"]
        references = [pair(r["references"][name]) for name in names]
        device = f"{origin['preset']}, {origin['device'].split()[0]}"
        times = [f"{origin['training_seconds'] / 60:.1f} min", f"{r['ms_per_pas']:.2f}"]
        rows.append([r["scene"], f"**{pair(r)}**", *references, device, *times])
    return markdown(head, rows)


def choices_table(name: str, report: dict[str, Any]) -> str:
    """One row a change: median SSIM of every seed, their median, and the mean SSIM's median."""
    seeds = sorted({run["seed"] for change in report["changes"].values() for run in change["runs"]})
    rows = []
    for label, change in report["changes"].items():
        by_seed = {run["seed"]: run for run in change["runs"]}
        each = [f"{by_seed[seed]['median_ssim']:.3f}" if seed in by_seed else "" for seed in seeds]
        mean = statistics.median(run["mean_ssim"] for run in change["runs"])
        rows.append([label, *each, f"**{change['median_of_medians']:.3f}**", f"{mean:.3f}"])
    head = ["change", *(f"seed {seed}" for seed in seeds), "median", "mean SSIM"]
    return f"`{name}`, {report['steps']} steps:\n\n" + markdown(head, rows)


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """A table; the first column is left-aligned."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    """Entry point."""
    if quality := [read_json(path) for path in sorted(RESULTS.glob("quality_*.json"))]:
        print(quality_table(quality))
    for path in sorted(RESULTS.glob("*choices_*.json")):
        print("\n" + choices_table(path.stem, read_json(path)))


if __name__ == "__main__":
    main()
