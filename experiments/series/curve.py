"""Models against the number of spectra seen, by today's presets: one, five and ten times 8,000, on the held-out transmitters.

WRF-GS as the paper has it, a model a frequency which shares that number with the others, and pooled: one model for all
frequencies. Scene 4 has the whole curve, the other scenes its first point. The costliest points have one seed.
"""

from experiments.jobs import SEEDS, Job
from experiments.paper import SCENES
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "Spectra seen"
PROFILE, SCENE = "quick", "4"
OTHERS = tuple(scene for scene in SCENES if scene != SCENE)
SERIES = (
    Series("Wideband", "wideband", ("", "long"), PROFILE, (SCENE,), seeds=SEEDS),
    Series("Wideband, ten times as many", "wideband", ("longest",), PROFILE, (SCENE,)),
    Series("WRF-GS, pooled", "wideband", ("pooled", "pooled_long"), PROFILE, (SCENE,), seeds=SEEDS),
    Series("WRF-GS, pooled, ten times as many", "wideband", ("pooled_longest",), PROFILE, (SCENE,)),
    Series("WRF-GS, a model a frequency", "wrfgs", ("", "long"), PROFILE, (SCENE,), seeds=SEEDS),
    Series("WRF-GS, a model a frequency, ten times as many", "wrfgs", ("longest",), PROFILE, (SCENE,)),
    Series("NeRF2", "nerf2", ("",), PROFILE, (SCENE,), seeds=SEEDS),
    Series("NeRF2, five times as many", "nerf2", ("long",), PROFILE, (SCENE,)),
    Series("Wideband, other scenes", "wideband", ("",), PROFILE, OTHERS, seeds=SEEDS),
    Series("WRF-GS, a model a frequency, other scenes", "wrfgs", ("",), PROFILE, OTHERS, seeds=SEEDS),
    Series("WRF-GS, pooled, other scenes", "wideband", ("pooled",), PROFILE, OTHERS),
)


def jobs() -> list[Job]:
    """Returns a job a model, number of spectra and seed."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a model."""
    return render_all(SERIES, results)
