"""Scores of one command on few spectra (experiments/few.py): a row per case, worst and median over its seeds."""

from pathlib import Path

import numpy as np

from experiments.few import SIMPLE, Row, below, coverage, rows_of
from experiments.markdown import markdown
from experiments.results import Results
from experiments.tables.cells import NOT_RUN, cell

TITLE = "Few spectra: one command beside every simple method"
NOTE = (
    "`wbgs-jax train` with its defaults on parts of data sets, drawn at random or along a track; median SSIM on the test"
    " transmitters of the data, worst and median over seeds. Field alone: without the simple methods that share its answers."
    " Below: rows that score lower by more than 0.02 than the best simple method on the very same test spectra; that"
    " method is not known beforehand. Hold: share of the scores in 90 % intervals, of rows that have such."
)
OTHERS = [name.replace("_", " ") for name in SIMPLE]
HEAD = ["case", "spectra", "seeds", "worst", "median", "field alone", *OTHERS, "below", "hold"]


def render(results: Results, images: Path) -> str:
    """One table, and what it comes to."""
    rows = rows_of(results.folder / "few.jsonl")
    if not rows:
        return f"{NOTE}\n\n{NOT_RUN}"
    names = list(dict.fromkeys(row["case"] for row in rows))
    table = [_line([row for row in rows if row["case"] == name]) for name in names]
    worse = sum(below(row) for row in rows)
    hold = coverage(rows)
    total = f"{worse} of {len(rows)} rows are below the best simple method by more than 0.02."
    if hold is not None:
        total += f" 90 % intervals hold {100 * hold:.0f} % of all scores."
    return "\n\n".join([NOTE, markdown(HEAD, table), total])


def _line(rows: list[Row]) -> list[str]:
    scores = [row["median_ssim"] for row in rows]
    hold = coverage(rows)
    return [
        rows[0]["case"].replace("_", " "),
        str(rows[0]["spectra"]),
        str(len(rows)),
        cell(min(scores)),
        cell(float(np.median(scores))),
        cell(float(np.median([row["alone"] for row in rows]))),
        *(cell(float(np.median([row["simple"][name] for row in rows]))) for name in SIMPLE),
        str(sum(below(row) for row in rows)),
        "" if hold is None else f"{100 * hold:.0f} %",
    ]
