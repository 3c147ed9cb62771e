"""The default field on data and meshes in which something is wrong, beside the splatting field, seed by seed."""

import statistics

from experiments.jobs import Job
from experiments.markdown import markdown
from experiments.results import Results
from experiments.series.series import NOT_RUN, Series, jobs_of_all
from experiments.variants import FAULTS

TITLE = "Faults"
SCENES = ("4", "1", "2")
OF_DATA = ("", "receiver_off", "array_off", "snr_30", "snr_20", "snr_10", "tx_20", "tx_100", "images")
"""Faults that a field without a look at the mesh's details notices too."""
HYBRID = Series("What one command gives", "hybrid", ("", *FAULTS), "robustness", SCENES)
SPLATTING = Series("The splatting field alone", "wideband", OF_DATA, "robustness", SCENES)
SERIES = (HYBRID, SPLATTING)


def jobs() -> list[Job]:
    """Returns a job a scene and fault."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table: a row a fault, and in each scene the field of one command and the splatting field alone."""
    rows = []
    for variant in HYBRID.variants:
        cells = [_cell(results, series, scene, variant) for scene in sorted(SCENES) for series in SERIES]
        rows.append([variant.replace("_", " ") or "(nothing wrong)", *cells])
    head = ["fault", *(f"scene {scene}: {series.field}" for scene in sorted(SCENES) for series in SERIES)]
    return f"Median / mean SSIM, profile `{HYBRID.profile}`, one seed:\n\n{markdown(head, rows)}"


def _cell(results: Results, series: Series, scene: str, variant: str) -> str:
    """Returns the medians over seeds of the scores of a job; nothing where a field does not notice the fault."""
    if variant not in series.variants:
        return ""
    known = [result.values for job in series.jobs_of(scene, variant) if (result := results.get(job))]
    scores = [statistics.median(values[name] for values in known) for name in ("median_ssim", "mean_ssim") if known]
    return " / ".join(f"{score:.3f}" for score in scores) or NOT_RUN
