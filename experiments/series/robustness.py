"""The default field on data and meshes in which something is wrong, beside the splatting field and what learns nothing."""

import statistics

from experiments.jobs import BASELINES, Job
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
NOTHING = Series("What learns nothing", BASELINES, OF_DATA, "robustness", SCENES)
SERIES = (HYBRID, SPLATTING)
LEARN_NOTHING = {"nearest_tx": "nearest TX", "inverse_distance": "1/d² weighting"}
NOTE = (
    "Scene {scene}: averages over ten frequencies of the median SSIM, profile `{profile}`, one seed. The last column is the"
    " first minus the best of the others; where a fault is of the mesh alone, the others are those of data in which nothing is"
    " wrong."
)


def jobs() -> list[Job]:
    """Returns a job a scene and fault."""
    return jobs_of_all(SERIES) + NOTHING.jobs()


def render(results: Results) -> str:
    """Returns a table a scene: a row a fault, the field of one command, the splatting field alone, what learns nothing, and
    how far one command is ahead of the best of these."""
    parts = []
    for scene in sorted(SCENES):
        rows = [_row(results, scene, variant) for variant in HYBRID.variants]
        head = ["fault", "one command", "splatting field alone", *LEARN_NOTHING.values(), "ahead by"]
        parts += [NOTE.format(scene=scene, profile=HYBRID.profile), markdown(head, rows)]
    return "\n\n".join(parts)


def _row(results: Results, scene: str, variant: str) -> list[str]:
    same = variant if variant in OF_DATA else ""
    ours = _average(results, HYBRID, scene, variant)
    splatting = _average(results, SPLATTING, scene, same)
    found = results.get(NOTHING.jobs_of(scene, same)[0])
    nothing = [statistics.fmean(found.values["baselines"][name].values()) if found else None for name in LEARN_NOTHING]
    others = [score for score in (splatting, *nothing) if score is not None]
    ahead = f"{ours - max(others):+.3f}" if ours is not None and len(others) == 1 + len(LEARN_NOTHING) else ""
    shown = [ours, *((splatting, *nothing) if variant in OF_DATA else [""] * 3)]
    cells = [score if isinstance(score, str) else NOT_RUN if score is None else f"{score:.3f}" for score in shown]
    return [variant.replace("_", " ") or "(nothing wrong)", *cells, ahead]


def _average(results: Results, series: Series, scene: str, variant: str) -> float | None:
    """Returns the average over frequencies of the median SSIM, the median over seeds; None if it was not run."""
    known = [result.values["average_of_medians"] for job in series.jobs_of(scene, variant) if (result := results.get(job))]
    return statistics.median(known) if known else None
