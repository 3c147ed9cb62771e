"""Inputs, networks, density control and batch of the wideband field (docs/history.md, docs/performance.md).

The profiles are the `cpu` preset as it was when the choices were made, with and without octaves of the frequency.
"""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "Choices"
INPUTS = ("paper_inputs", "raw_gigahertz", "sphere", "area", "octaves_10", "frequency_octaves_0", "frequency_octaves_1")
SIZES = ("octaves_3_2", "gaussians_1000", "gaussians_4000", "width_128", "lr_3e-3", "weight_decay_0.1", "fixed_means")
SERIES = (
    Series(
        "Inputs, projection, starting points, density control",
        "wideband",
        ("", *INPUTS, "no_density_control", "density_with_reset"),
        "choices_octaves4",
        seeds=(0, 1),
    ),
    Series(
        "Frequencies that were not trained, with four octaves",
        "wideband",
        ("", "raw_gigahertz", "no_frequency", "frequency_octaves_0", "frequency_octaves_1"),
        "choices_octaves4",
        combination="C3",
    ),
    Series(
        "Frequencies that were not trained, without octaves",
        "wideband",
        ("", "frequency_octaves_4", "no_frequency"),
        "choices",
        combination="C3",
    ),
    Series(
        "The layer at which the query enters",
        "wideband",
        ("fusion_0", "fusion_1", "fusion_2", "fusion_3"),
        "choices",
        scenes=("1", "2", "4"),
        seeds=(0, 1),
    ),
    Series("Batches, with steps that take equal time", "wideband", ("batch_4", "batch_8", "batch_16"), "choices"),
    Series("Sizes, rates and what is trained", "wideband", ("", *SIZES), "choices"),
)


def jobs() -> list[Job]:
    """Returns a job a change, scene and seed."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a series."""
    return render_all(SERIES, results)
