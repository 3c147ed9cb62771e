"""The default field on data and meshes in which something is wrong, beside the splatting field and what learns nothing."""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all
from experiments.variants import FAULTS

TITLE = "Faults"
SCENES = ("4", "1", "2")
OF_DATA = ("", "receiver_off", "array_off", "snr_30", "snr_20", "snr_10", "tx_20", "tx_100", "images")
"""Faults that a field without a look at the mesh's details notices too."""
SERIES = (
    Series("What one command gives", "hybrid", ("", *FAULTS), "robustness", SCENES),
    Series("The splatting field alone", "wideband", OF_DATA, "robustness", SCENES),
)


def jobs() -> list[Job]:
    """Returns a job a scene and fault."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a field."""
    return render_all(SERIES, results)
