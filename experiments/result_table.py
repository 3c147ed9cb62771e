"""All results as one table, results.csv, which `make tables` writes and any table tool reads: a row a job and frequency.

    pandas.read_csv("experiments/results/results.csv").query("profile == 'quick' and current")

Where only the scores of all frequencies together were kept there is one row, without a frequency. The predictors that learn
nothing have `baselines` for their field and their name for the variant.
"""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from experiments.jobs import BASELINES, Job
from experiments.profiles import PROFILES
from experiments.results import FOLDER, Result, read_rows
from experiments.variants import VARIANTS
from wbgs_jax._util.files import atomic_write

NAME = "results.csv"
OF_JOB = ("profile", "job", "scene", "field", "variant", "combination", "all_tx", "seed", "current")
"""`current`: the settings are those that the job has today; others count as not run."""
OF_FREQUENCY = ("ghz", "n", "median_ssim", "mean_ssim", "psnr_db")
"""`n`: spectra, of as many transmitters. `psnr_db`: the median."""
OF_RUN = ("models", "steps", "samples", "gaussians", "training_seconds", "version", "commit", "device", "jax")
"""Columns of the whole job."""
COLUMNS = OF_JOB + OF_FREQUENCY + OF_RUN
DIGITS = 4
NO_JOBS = {"smoke", "few"}
"""Files of rows that are no results of jobs: what proves that everything works, few spectra."""


def rows(folder: Path = FOLDER) -> Iterator[dict[str, Any]]:
    """Yields the rows of all results of jobs; what is not known is missing."""
    for path in sorted(folder.glob("*.jsonl")):
        if path.stem not in NO_JOBS:
            for name, values in read_rows(path).items():
                yield from rows_of(path.stem, name, values)


def rows_of(profile: str, name: str, values: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yields the rows of a result."""
    known = values["job"] | {"profile": profile}
    own = {key: value for key, value in known.items() if key in OF_JOB} | {"job": name}
    own |= {"current": is_current(Result(values), Job(**known))}
    run = {key: value for key, value in (values | values["environment"]).items() if key in OF_RUN}
    for scores in by_frequency(values):
        yield own | scores | run


def is_current(result: Result, job: Job) -> bool:
    """Whether a result counts as run."""
    return job.profile in PROFILES and job.variant in VARIANTS and result.belongs_to(job)


def by_frequency(values: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yields the scores of a result."""
    for name, medians in values.get(BASELINES, {}).items():
        for ghz, median in medians.items():
            yield {"variant": name, "ghz": ghz, "median_ssim": median}
    for ghz, scores in values.get("ssim", {}).items():
        middle, mean = np.round([np.median(scores), np.mean(scores)], DIGITS).tolist()
        both = {"median_ssim": middle, "mean_ssim": mean}
        yield {"ghz": ghz, "n": len(scores), **both, "psnr_db": values.get("psnr_db", {}).get(ghz)}
    if not values.keys() & {"ssim", BASELINES}:
        yield {name: value for name, value in values.items() if name in OF_FREQUENCY}


def write(folder: Path = FOLDER) -> Path:
    """Write the table; returns where it is."""
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, restval="", lineterminator="\n")
    table.writeheader()
    table.writerows(rows(folder))
    with atomic_write(folder / NAME) as stream:
        stream.write(text.getvalue().encode())
    return folder / NAME
