"""The default field on data and meshes in which something is wrong, beside the splatting field and what learns nothing."""

import statistics

from experiments.jobs import BASELINES
from experiments.markdown import markdown
from experiments.results import Result, Results
from experiments.series.series import NOT_RUN, Experiment, Series
from experiments.variants import FAULTS, UNCORRECTED, uncorrected

SCENES = ("4", "1", "2")
OF_DATA = ("", "receiver_off", "array_off", "snr_30", "snr_20", "snr_10", "tx_20", "tx_100", "images")
"""Faults that a field without a look at the mesh's details notices too."""
SAME = {**{name: name for name in OF_DATA}, "all_together": "snr_20"}
"""Fault: the one that such a field notices of it; of others none."""
SEEDS = (0, 1, 2)
HYBRID = Series("The hybrid field", "hybrid", ("", *FAULTS), "robustness", SCENES, seeds=SEEDS)
UNCORRECTED_WAVE = Series("The coherent field without corrections", "wave", (*UNCORRECTED,), "robustness", SCENES, seeds=SEEDS)
SPLATTING = Series("The splatting field alone", "wideband", OF_DATA, "robustness", SCENES, seeds=SEEDS)
NOTHING = Series("What learns nothing", BASELINES, OF_DATA, "robustness", SCENES, seeds=SEEDS)
SERIES = (HYBRID, UNCORRECTED_WAVE, SPLATTING)
LEARN_NOTHING = {"nearest_tx": "nearest TX", "inverse_distance": "1/d² weighting"}
NOTE = (
    "Scene {scene}: averages over ten frequencies of the median SSIM, profile `{profile}`, of one seed (which also draws the"
    " faults), or the median and range of several. *Hybrid*: one training with default settings. *Coherent, no corrections*:"
    " the coherent field alone, without the searches for absent bodies, displaced surfaces, the receiver's pose, absorption"
    " grid and array gains. *Ahead by*: hybrid minus the best of wideband, nearest TX and 1/d². These three do not use the"
    " mesh's details: where only the mesh is wrong, they are those of the fault-free data (cells left empty), and for *all"
    " together* those at 20 dB SNR. Only seeds that all of them share count there. *Missing* and *added* are shares of"
    " the mesh's connected pieces below 3 m: boards, legs, doors and panes, of which an object has several."
)
WORST = (
    "The hybrid field's smallest lead over the best of the others, among the {count} faults with which all were run, is"
    " {ahead:+.3f}, with *{fault}*."
)


def render(results: Results) -> str:
    """Returns a table a scene: a row a fault; the hybrid field, the coherent field without corrections,
    the wideband field alone, what learns nothing, and how far the hybrid field is ahead of the best of the latter."""
    parts = []
    for scene in sorted(SCENES):
        found = {variant: scores(results, scene, variant) for variant in HYBRID.variants}
        head = ["fault", "hybrid", "coherent, no corrections", "wideband alone", *LEARN_NOTHING.values(), "ahead by"]
        alone = {variant: uncorrected_scores(results, scene, variant) for variant in found}
        rows = [_row(variant, alone[variant], scores) for variant, scores in found.items()]
        parts += [NOTE.format(scene=scene, profile=HYBRID.profile), markdown(head, rows)]
        if ahead := {variant: _ahead(scores) for variant, scores in found.items() if variant and all(scores)}:
            worst = min(ahead, key=lambda variant: ahead[variant])
            parts += [WORST.format(count=len(ahead), fault=_words(worst), ahead=ahead[worst])]
    return "\n\n".join(parts)


BySeed = dict[int, float]
Scores = list[BySeed]
"""Scores of the hybrid field, of the splatting field and of the predictors without learning, of the seeds that were run."""


def scores(results: Results, scene: str, variant: str) -> Scores:
    """Returns what was scored with a fault; of models that do not notice it, without it."""
    same = SAME.get(variant, "")
    nothing = {seed: found.values["baselines"] for seed, found in _known(results, NOTHING, scene, same).items()}
    learn_nothing = [{seed: statistics.fmean(of[name].values()) for seed, of in nothing.items()} for name in LEARN_NOTHING]
    return [_averages(results, HYBRID, scene, variant), _averages(results, SPLATTING, scene, same), *learn_nothing]


def uncorrected_scores(results: Results, scene: str, variant: str) -> BySeed:
    """Returns those of the coherent field without corrections."""
    return _averages(results, UNCORRECTED_WAVE, scene, uncorrected(variant))


def _ahead(scores: Scores) -> float:
    """Returns how far the first are ahead of the best of the others, in the median over the seeds that all of them have; over
    those of each, where there is no such seed."""
    shared = set.intersection(*map(set, scores))
    ours, *others = (statistics.median(value for seed, value in of.items() if seed in shared or not shared) for of in scores)
    return ours - max(others)


def _row(variant: str, alone: BySeed, scores: Scores) -> list[str]:
    ours, *others = map(_cell, scores)
    of_others = others if variant in OF_DATA else [""] * len(others)
    return [_words(variant), ours, _cell(alone), *of_others, f"{_ahead(scores):+.3f}" if all(scores) else ""]


def _cell(by_seed: BySeed) -> str:
    known = list(by_seed.values())
    if len(known) < 2:
        return f"{known[0]:.3f}" if known else NOT_RUN
    return f"{statistics.median(known):.3f} ({min(known):.3f} to {max(known):.3f}, {len(known)} seeds)"


def _words(variant: str) -> str:
    return variant.replace("_", " ") or "(nothing wrong)"


def _averages(results: Results, series: Series, scene: str, variant: str) -> BySeed:
    return {seed: found.values["average_of_medians"] for seed, found in _known(results, series, scene, variant).items()}


def _known(results: Results, series: Series, scene: str, variant: str) -> dict[int, Result]:
    return {job.seed: found for job in series.jobs_of(scene, variant) if (found := results.get(job))}


EXPERIMENT = Experiment("Faults", SERIES, tuple(NOTHING.jobs()), tables=render)
