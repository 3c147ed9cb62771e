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
SAME = {**{name: name for name in OF_DATA}, "all_together": "snr_20"}
"""Fault: the one that such a field notices of it; of others none."""
HYBRID = Series("What one command gives", "hybrid", ("", *FAULTS), "robustness", SCENES)
SPLATTING = Series("The splatting field alone", "wideband", OF_DATA, "robustness", SCENES)
NOTHING = Series("What learns nothing", BASELINES, OF_DATA, "robustness", SCENES)
SERIES = (HYBRID, SPLATTING)
LEARN_NOTHING = {"nearest_tx": "nearest TX", "inverse_distance": "1/d² weighting"}
NOTE = (
    "Scene {scene}: averages over ten frequencies of the median SSIM, profile `{profile}`, one seed. The last column is the"
    " first minus the best of the others; where a fault is of the mesh alone, the others are those of data in which nothing is"
    " wrong, and of all together they notice the noise."
)
WORST = "One command is least ahead at *{fault}*, by {ahead:+.3f}, of the faults for which all columns are known ({count})."


def jobs() -> list[Job]:
    """Returns a job a scene and fault."""
    return jobs_of_all(SERIES) + NOTHING.jobs()


def render(results: Results) -> str:
    """Returns a table a scene: a row a fault, the field of one command, the splatting field alone, what learns nothing, and
    how far one command is ahead of the best of these."""
    parts = []
    for scene in sorted(SCENES):
        found = {variant: _scores(results, scene, variant) for variant in HYBRID.variants}
        head = ["fault", "one command", "splatting field alone", *LEARN_NOTHING.values(), "ahead by"]
        rows = [_row(variant, scores) for variant, scores in found.items()]
        parts += [NOTE.format(scene=scene, profile=HYBRID.profile), markdown(head, rows)]
        if ahead := {variant: _ahead(scores) for variant, scores in found.items() if None not in scores}:
            worst = min(ahead, key=lambda variant: ahead[variant])
            parts += [WORST.format(count=len(ahead), fault=_words(worst), ahead=ahead[worst])]
    return "\n\n".join(parts)


_Scores = list[float | None]


def _scores(results: Results, scene: str, variant: str) -> _Scores:
    """Returns the scores of one command, of the splatting field and of what learns nothing; None: not run."""
    same = SAME.get(variant, "")
    nothing = results.get(NOTHING.jobs_of(scene, same)[0])
    learn_nothing = [
        statistics.fmean(nothing.values["baselines"][name].values()) if nothing else None for name in LEARN_NOTHING
    ]
    return [_average(results, HYBRID, scene, variant), _average(results, SPLATTING, scene, same), *learn_nothing]


def _ahead(scores: _Scores) -> float:
    ours, *others = (score for score in scores if score is not None)
    return ours - max(others)


def _row(variant: str, scores: _Scores) -> list[str]:
    cells = [NOT_RUN if score is None else f"{score:.3f}" for score in scores]
    of_others = cells[1:] if variant in OF_DATA else [""] * len(cells[1:])
    return [_words(variant), cells[0], *of_others, "" if None in scores else f"{_ahead(scores):+.3f}"]


def _words(variant: str) -> str:
    return variant.replace("_", " ") or "(nothing wrong)"


def _average(results: Results, series: Series, scene: str, variant: str) -> float | None:
    """Returns the average over frequencies of the median SSIM, the median over seeds; None if it was not run."""
    known = [result.values["average_of_medians"] for job in series.jobs_of(scene, variant) if (result := results.get(job))]
    return statistics.median(known) if known else None
