"""An array of fixed size in metres, as receivers are built: its beams narrow with the frequency, and spectra change with it."""

from experiments.jobs import FIXED_SCENE, GHZ_FIXED, SEEDS
from experiments.markdown import markdown
from experiments.results import Results
from experiments.series.series import Experiment, Series
from experiments.tables.cells import cell, median_cell, scores
from wbgs_jax.data import released_scenes
from wbgs_jax.data.scene_file import load_scene

SERIES = (
    Series("wideband (ours)", "wideband", ("",), "quick", (FIXED_SCENE,), seeds=SEEDS),
    Series("wideband, without the frequency", "wideband", ("pooled",), "quick", (FIXED_SCENE,), seeds=SEEDS),
    Series("WRF-GS, a model a frequency", "wrfgs", ("",), "quick", (FIXED_SCENE,), seeds=SEEDS),
    Series("coherent (ours)", "wave", ("",), "quick", (FIXED_SCENE,)),
)
NAMES_OF_BASELINES = {
    "mean_image": "mean image",
    "nearest_tx": "nearest TX",
    "inverse_distance": "1/d² weighting",
    "phase_blind": "phase-blind ceiling",
}


def render(results: Results) -> str:
    """Returns a table by frequency: every model, what learns nothing, and the ceiling."""
    rows = []
    for series in SERIES:
        values = scores(results, series.jobs(), GHZ_FIXED)
        each = [median_cell(None if values is None else values[..., i : i + 1]) for i in range(len(GHZ_FIXED))]
        rows.append([series.title, *each, median_cell(values), "" if values is None else f"{len(values)}"])
    known = {row["frequency_ghz"]: row for row in load_scene(released_scenes()[FIXED_SCENE]).meta["ceilings"]}
    for key, name in NAMES_OF_BASELINES.items():
        learned_nothing = [float(known[f][key]) for f in GHZ_FIXED]
        average = sum(learned_nothing) / len(learned_nothing)
        rows.append([name, *map(cell, learned_nothing, [None] * len(GHZ_FIXED)), cell(average), ""])
    head = ["model", *(f"{f:g}" for f in GHZ_FIXED), "average", "seeds"]
    return f"Median SSIM of held-out transmitters by frequency (GHz), profile `{SERIES[0].profile}`:\n\n{markdown(head, rows)}"


EXPERIMENT = Experiment("An array of fixed size", SERIES, tables=render)
