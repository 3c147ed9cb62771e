"""Truths that do not share the coherent field's formulas: a cabin by full wave, the simulator's own solver, rough surfaces."""

import statistics

from experiments.jobs import BASELINES, OUTSIDE_SCENES, Job
from experiments.markdown import markdown
from experiments.results import Results
from experiments.series.series import NOT_RUN, Experiment, Series

SERIES = tuple(
    Series(title, field, ("",), "robustness", OUTSIDE_SCENES)
    for title, field in (("hybrid", "hybrid"), ("coherent alone", "wave"), ("wideband alone", "wideband"))
)
NOTE = (
    "Median / mean SSIM of test transmitters, profile `{profile}`, one seed; for the two baselines (nearest TX, 1/d² weighting)"
    " the mean over frequencies of the median SSIM:"
)
LEARN_NOTHING = {"nearest_tx": "nearest TX", "inverse_distance": "1/d² weighting"}


def render(results: Results) -> str:
    """Returns a table: a row a data set, every model and what learns nothing."""
    rows = []
    for scene in OUTSIDE_SCENES:
        trained = [_scores(results, one.jobs_of(scene, "")[0]) for one in SERIES]
        found = results.get(_baselines(scene))
        nothing = [f"{statistics.fmean(found.values['baselines'][key].values()):.3f}" for key in LEARN_NOTHING] if found else []
        rows.append([f"`{scene}`", *trained, *(nothing or [NOT_RUN] * len(LEARN_NOTHING))])
    head = ["data", *(one.title for one in SERIES), *LEARN_NOTHING.values()]
    return f"{NOTE.format(profile=SERIES[0].profile)}\n\n{markdown(head, rows)}"


def _baselines(scene: str) -> Job:
    return Job(scene, BASELINES, profile=SERIES[0].profile)


def _scores(results: Results, job: Job) -> str:
    result = results.get(job)
    return f"{result.values['median_ssim']:.3f} / {result.values['mean_ssim']:.3f}" if result else NOT_RUN


EXPERIMENT = Experiment("Truths from outside", SERIES, tuple(_baselines(scene) for scene in OUTSIDE_SCENES), tables=render)
