"""Results with default settings: evaluations of the hybrid field on the released scenes and on others' data.

They are no jobs of the runner but files that `wbgs-jax eval --results experiments/results` wrote, each with its command.
"""

import statistics
from pathlib import Path
from typing import Any

from experiments.markdown import markdown
from experiments.paper import SCENES
from experiments.results import Results
from experiments.tables.cells import NOT_RUN, cell
from wbgs_jax._util.files import read_json

TITLE = "The default field: what one command gives"
DATA = {
    **{f"scene {scene}": f"scene{scene}" for scene in SCENES},
    "published sample (Wideband 3DGS)": "example1",
    "RFID sample": "s23",
}
HEAD = ["data", "SSIM median", "mean", "5 %", "10 %", "in sight", "out of sight", "truth against itself",
        "angle (degrees)", "best beam (dB)", "best of 3", "power (dB)", "90 % intervals hold", "training (min)"]  # fmt: skip
NOTE = (
    "`wbgs-jax train` and `eval`, the `cpu` preset, default settings; one seed. SSIM of all held-out transmitters: median,"
    " mean, 5th and 10th percentile, medians in and out of sight of the receiver, and the truth's own repeatability. Angle:"
    " median error of the strongest direction; beams: mean loss of received power when the predicted best beam of a codebook is"
    " used, or the best of the three predicted best; power: mean absolute error of the received power."
    " All but scene 2 were trained before the absorption grid was added."
)


def render(results: Results, images: Path) -> str:
    """All figures of every data set."""
    rows = [[name, *_figures(report(results.folder, file))] for name, file in DATA.items()]
    return f"{NOTE}\n\n{markdown(HEAD, rows)}"


def report(folder: Path, name: str) -> dict[str, Any] | None:
    """Returns the evaluation of a data set; None where it was not run."""
    path = folder / f"quality_{name}_hybrid_cpu_cpu.json"
    return read_json(path) if path.exists() else None


def average_of_medians(folder: Path, scene: str) -> float | None:
    """Returns the average over frequencies of the median SSIM of a released scene; None where it was not run."""
    found = report(folder, f"scene{scene}")
    return None if found is None else statistics.fmean(row["median_ssim"] for row in found["per_frequency"])


def _figures(report: dict[str, Any] | None) -> list[str]:
    if report is None:
        return [NOT_RUN] + [""] * (len(HEAD) - 2)
    sight = [(report.get(part) or {}).get("median_ssim") for part in ("in_sight", "out_of_sight")]
    scores = [report["median_ssim"], report["mean_ssim"], report["p5_ssim"], report["p10_ssim"], *sight]
    sure = report.get("confidence")
    return [
        *(cell(value) if value is not None else "" for value in (*scores, report.get("truth_repeats"))),
        f"{report['angle_error_deg']:.1f}",
        f"{report['beam_loss_db']:.2f}",
        f"{report['beam_loss_top3_db']:.2f}",
        f"{report['power']['power_mae_db']:.2f}" if "power" in report else "",
        f"{100 * sure['coverage']:.0f} %" if sure else "",
        f"{report['provenance']['training_seconds'] / 60:.0f}",
    ]
