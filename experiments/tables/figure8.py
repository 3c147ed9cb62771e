"""Figure 8: trained at some of 21 frequencies, asked at the others."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import pyplot as plt

from experiments.jobs import SEEDS, Job
from experiments.markdown import markdown
from experiments.paper import COMBINATIONS, DENSE_SCENE, FIGURE_8, GHZ_21
from experiments.results import Results
from experiments.tables.cells import NOT_RUN, SUMMARY, Scores, ceiling, cell, median_cell, scores, summary_cells
from experiments.tables.figure7 import jobs_of as all_frequencies
from experiments.tables.plots import save

TITLE = "Figure 8: unseen frequencies, combinations A-K of table 6 (scene 1)"
LETTERS = "ABCDEFGHIJK"
COMMON = ("new frequency", "new place")
"""Headings of `in_common`."""


def jobs() -> list[Job]:
    """All combinations with all transmitters; D, quoted in the headline, with held-out ones too; two of the coherent field."""
    letters = [job for letter in LETTERS for job in jobs_of(letter)]
    return letters + held_out() + [wave(letter, all_tx) for letter in "DG" for all_tx in (True, False)]


def jobs_of(letter: str) -> list[Job]:
    """One bar of the figure; D has several seeds."""
    seeds = SEEDS if letter == "D" else SEEDS[:1]
    return [Job(DENSE_SCENE, "wideband", letter, all_tx=True, seed=seed) for seed in seeds]


def held_out() -> list[Job]:
    """Returns the jobs of combination D at transmitters that are new as well."""
    return [Job(DENSE_SCENE, "wideband", "D", seed=seed) for seed in SEEDS]


def wave(letter: str, all_tx: bool) -> Job:
    """The coherent field in the same place."""
    return Job(DENSE_SCENE, "wave", letter, all_tx=all_tx)


def render(results: Results, images: Path) -> str:
    """Bars, and the numbers below."""
    values = {letter: scores(results, jobs_of(letter)) for letter in LETTERS}
    rows = [row(letter, values[letter], in_common(results, letter)) for letter in LETTERS]
    head = ["", "trained at (GHz)", *SUMMARY, "over frequencies", *COMMON, "ceiling"]
    others = [
        ["coherent, trained transmitters", *(median_cell(scores(results, [wave(letter, True)])) for letter in "DG")],
        ["wideband, held-out transmitters", median_cell(scores(results, held_out())), ""],
        ["coherent, held-out transmitters", *(median_cell(scores(results, [wave(letter, False)])) for letter in "DG")],
    ]
    note = (
        "All transmitters train, as in the paper, and scores are at frequencies not used in training. Over frequencies: lowest"
        " and highest median. The next two columns compare the cost of a new frequency with that of a new place: this field,"
        " and a field trained on all 21 frequencies but other transmitters, scored at the same transmitters."
    )
    parts = [note, markdown(head, rows), "The same unseen frequencies otherwise:", markdown(["field", "D", "G"], others)]
    if any(v is not None for v in values.values()):
        parts.insert(0, save(draw(values), images, "figure8", "median SSIM at unseen frequencies, combinations A to K"))
    return "\n\n".join(parts)


def in_common(results: Results, letter: str) -> list[str]:
    """A combination, and the field that has seen all frequencies, at the transmitters that both are scored at."""
    jobs = (jobs_of(letter), all_frequencies("wideband"))
    found = [results.all(some) for some in jobs]
    if not all(found):
        return [NOT_RUN, NOT_RUN]
    common = sorted(set(found[0][0].tx.tolist()) & set(found[1][0].tx.tolist()))
    return [median_cell(scores(results, some, unseen_ghz(letter), common)) for some in jobs]


def row(letter: str, values: Scores | None, common: list[str]) -> list[str]:
    """One combination."""
    trained, unseen = COMBINATIONS[letter], unseen_ghz(letter)
    text = ", ".join(f"{f:g}" for f in trained) if len(trained) < 12 else f"all but {', '.join(f'{f:g}' for f in unseen)}"
    spread = ""
    if values is not None:
        medians = by_frequency(values)
        spread = f"{medians.min():.3f}-{medians.max():.3f}"
    summary = summary_cells(values, FIGURE_8.get(letter))
    return [letter, text, *summary, spread, *common, cell(ceiling(DENSE_SCENE, unseen))]


def unseen_ghz(letter: str) -> list[float]:
    """The test frequencies of a combination."""
    return [float(f) for f in GHZ_21 if f not in COMBINATIONS[letter]]


def by_frequency(values: Scores) -> Float[np.ndarray, " ghz"]:
    """Median over transmitters, then over seeds."""
    return np.median(np.median(values, 1), 0)


def draw(values: dict[str, Scores | None]) -> plt.Figure:
    """A bar a combination, a dot a frequency, the paper's value where its text gives one."""
    figure, axis = plt.subplots(figsize=(8.5, 3.8), layout="constrained")
    for i, (letter, v) in enumerate(values.items()):
        if v is None:
            axis.text(i, 0.02, NOT_RUN, rotation=90, ha="center", va="bottom", fontsize=8, color="0.4")
        else:
            medians = by_frequency(v)
            axis.bar(i, medians.mean(), color="C0", alpha=0.45, width=0.65, label="average" if letter == "D" else None)
            axis.plot([i] * len(medians), medians, ".", color="C0", ms=4)
        if letter in FIGURE_8:
            label = "paper" if letter == "D" else None
            axis.plot([i - 0.33, i + 0.33], [FIGURE_8[letter]] * 2, color="C3", lw=1.5, label=label)
    axis.set(xticks=range(len(values)), xticklabels=list(values), ylabel="median SSIM", ylim=(0, 1))
    axis.grid(axis="y", alpha=0.3)
    axis.legend(fontsize=8, loc="lower right", framealpha=0.95)
    return figure
