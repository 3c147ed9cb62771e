"""The coherent field on meshes whose bodies and walls all stand in a wrong place, taken as they are and put right."""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "Wrong meshes"
MESHES = (
    "mesh_moved_3mm",
    "mesh_put_right_3mm",
    "mesh_moved_1cm",
    "mesh_put_right_1cm",
    "mesh_moved_3cm",
    "mesh_put_right_3cm",
)
SERIES = (
    Series("As they are, and put right by the training", "wave", MESHES, "robustness", scenes=("4",)),
    Series("Without a look at the mesh's details", "wideband", ("",), "robustness", scenes=("4",)),
)


def jobs() -> list[Job]:
    """Returns a job a displacement and way."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a field."""
    return render_all(SERIES, results)
