"""Statistics of a scene in the meta of its file: its difficulty, and properties of its channels."""

import numpy as np

from data_gen.ceilings import NAMES
from data_gen.jobs import Results
from wbgs_jax.data import scene_dataset
from wbgs_jax.data.scene_file import TEST, SceneFile
from wbgs_jax.evaluation.baselines import baselines
from wbgs_jax.metrics import ssim

DIGITS = 4
"""Number of decimals: the last one is far below the spread over transmitters and far above rounding noise."""


def ceiling_table(scene: SceneFile, found: Results) -> list[dict[str, float]]:
    """Returns the median SSIM by frequency: of the ceilings, over the transmitters for which they were measured, and of the
    baselines (`wbgs_jax.evaluation.baselines`), over all test transmitters."""
    baseline_scores = _baselines(scene)
    rows = []
    for i, frequency in enumerate(scene.frequencies_hz):
        ceilings = zip(NAMES, np.nanmedian(found["ceilings"][:, i], 0), strict=True) if _measured(found) else ()
        row = dict(ceilings) | {name: np.median(values[i]) for name, values in baseline_scores.items()}
        rows.append({"frequency_ghz": float(frequency / 1e9), **{k: round(float(v), DIGITS) for k, v in row.items()}})
    return rows


def channel_table(scene: SceneFile, found: Results) -> list[dict[str, float]]:
    """Returns, by frequency, the number of paths and the r.m.s. delay spread (medians), the fraction of transmitters with line
    of sight, and the path gain to an element (5th, 50th and 95th percentile over transmitters, dB), for the first receiver."""
    gain_db = 10 * np.log10(np.mean(np.abs(scene.observations["snapshots"][:, 0].astype(np.complex128)) ** 2, -1))
    rows = []
    for i, frequency in enumerate(scene.frequencies_hz):
        p05, p50, p95 = np.percentile(gain_db[:, i], (5, 50, 95))
        row = {
            "median_paths": np.median(found["n_paths"][:, i]), "line_of_sight_share": found["line_of_sight"][:, i].mean(),
            "median_delay_spread_ns": 1e9 * np.median(found["delay_spread_s"][:, i]),
            "gain_db_p05": p05, "gain_db_p50": p50, "gain_db_p95": p95,
        }  # fmt: skip
        rows.append({"frequency_ghz": float(frequency / 1e9), **{k: round(float(v), DIGITS) for k, v in row.items()}})
    return rows


def _measured(found: Results) -> bool:
    return bool(np.isfinite(found["ceilings"]).any())


def _baselines(scene: SceneFile) -> dict[str, list[np.ndarray]]:
    """Returns the SSIM of every baseline on the test spectra, one array per frequency; empty if there is nothing to compare."""
    if not 0 < (scene.split == TEST).sum() < len(scene.split):
        return {}
    dataset = scene_dataset(scene)
    by_frequency = [dataset.test[dataset.frequencies_hz[dataset.test] == f] for f in scene.frequencies_hz]
    truths = [np.asarray(dataset.pas(chosen)) for chosen in by_frequency]
    return {
        name: [ssim(predict(chosen), truth) for chosen, truth in zip(by_frequency, truths, strict=True)]
        for name, predict in baselines(dataset).items()
    }
