"""Explanation of the published sample by the coherent field: `python -m experiments.studies.sample_account FOLDER`.

Nothing is trained: every surface is plasterboard of 0.1 m, paths are taken away one kind at a time. The array sees directions
above its horizon; of a line of sight from below only side lobes are in the picture. Writes
experiments/results/sample_account.json; docs/wave.md quotes it.
"""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float

from experiments.results import FOLDER
from wbgs_jax import coherent, make_mesh, metrics
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.files import write_json
from wbgs_jax.config import CalibrationConfig
from wbgs_jax.data import Dataset, load_dataset
from wbgs_jax.data.scene import in_sight
from wbgs_jax.evaluation.report import environment
from wbgs_jax.fields import Observation
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.propagation.paths import REFLECTED, TRANSMITTED, TracedPaths
from wbgs_jax.radio import pas_directions
from wbgs_jax.radio.geometry import to_local
from wbgs_jax.training.batches import training_data
from wbgs_jax.training.calibration.antennas import AntennaReport, search_antennas
from wbgs_jax.training.calibration.objective import make_scores
from wbgs_jax.types import Links

CONFIG = coherent.WaveConfig(
    diffracted_tried=1, diffracted_kept=1, mirror_areas=(0.01, 0.2), permittivity=2.73, conductivity=0.0085, slope=0.94
)
AT_ONCE = 50
"""Spectra."""
SEARCHED = 96
"""Training spectra that the antennas are found in."""


@dataclass(frozen=True)
class Command:
    """Score predictions of a sample from the mesh alone, with isotropic antennas and with those estimated from its spectra."""

    data: tyro.conf.Positional[str]
    """Folder of the published layout."""
    out: Path = FOLDER


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.studies.sample_account")
    dataset = load_dataset(command.data)
    field = coherent.make_field(make_mesh(dataset), CONFIG)
    prepared = field.prepare(dataset.links(np.arange(len(dataset))), dataset.receivers)
    _, first = np.unique(dataset.tx_index, return_index=True)
    kind = np.asarray(prepared.paths.specular.interaction_type)
    reflections, passes = (kind == REFLECTED).sum(-1), (kind == TRANSMITTED).sum(-1)
    kept = {"line_of_sight": reflections == 0, "one_reflection": reflections <= 1, "two_reflections": reflections <= 2}
    kept |= {"nothing_passes": (reflections <= 2) & (passes == 0), "no_line_of_sight": reflections > 0}
    isotropic = field.init(jax.random.key(0))
    scores = {name: ssim(dataset, field, keep(prepared, mask), isotropic) for name, mask in kept.items()}
    local = directions_to_tx(dataset)
    sine, sight = local[:, 2], power_in_sight(dataset, local)
    horizon = [
        round(float(np.median(sight[dataset.tx_index == tx])), 3) for tx in np.unique(dataset.tx_index[np.abs(sine) < 0.01])
    ]
    seen = in_sight(dataset, first)
    assert seen is not None  # the field has been made of its mesh
    found, params = antennas(dataset, field, prepared)
    scores["antennas_found"] = ssim(dataset, field, keep(prepared, kept["two_reflections"]), params)
    report: dict[str, Any] = {
        "dataset": dataset.name,
        "antennas": found.taken,
        "groups": by_group(dataset, sine, scores),
        "obstructed_transmitters": np.flatnonzero(~seen).tolist(),
        "power_in_sight_on_the_horizon": horizon,
    }
    write_json(command.out / "sample_account.json", report | environment())
    for name, row in (report.pop("groups") | report).items():
        print(f"{name:28}", row, file=sys.stderr)


def keep(prepared: coherent.PreparedPaths, mask: np.ndarray) -> coherent.PreparedPaths:
    """Returns the paths of a mask alone."""
    specular = prepared.paths.specular
    specular = dataclasses.replace(specular, alive=specular.alive & jnp.asarray(mask))
    return dataclasses.replace(prepared, paths=TracedPaths((specular, *prepared.paths.sets[1:])))


@jax.jit
def observe(field: Calibratable, params: Any, plan: Any, links: Links) -> Observation:
    """Returns the field's prediction for links whose paths are given."""
    return field.render(params, plan, links)._replace(paths=None)


def antennas(dataset: Dataset, field: Calibratable, prepared: coherent.PreparedPaths) -> tuple[AntennaReport, Any]:
    """Returns the antennas that explain the training spectra best, and parameters that hold them."""
    data, params = training_data(dataset), field.init(jax.random.key(0))
    some = np.random.default_rng(0).permutation(dataset.train)[:SEARCHED]
    score = make_scores(field, prepared, data, jnp.asarray(some, jnp.int32))
    params, report = search_antennas(params, score, dataset.tx_index[some], CalibrationConfig(), known_elements=False)
    return report, params


def ssim(dataset: Dataset, field: Calibratable, prepared: coherent.PreparedPaths, params: Any) -> Float[np.ndarray, " n"]:
    """Returns the score of every spectrum."""
    found = []
    plan = field.plan(params, dataset.receiver(), prepared)
    for start in range(0, len(dataset), AT_ONCE):
        index = np.arange(start, min(start + AT_ONCE, len(dataset)))
        seen = observe(field, params, plan, dataset.links(index))
        found.append(metrics.ssim(np.asarray(seen.pas), np.asarray(dataset.pas(index))))
    return np.concatenate(found)


def directions_to_tx(dataset: Dataset) -> Float[np.ndarray, "n 3"]:
    """Returns the unit vector to every spectrum's transmitter in the receiver's frame; its third component is above the array's
    horizon."""
    receiver = dataset.receiver()
    offset = dataset.tx_positions - np.asarray(receiver.position, np.float64)
    local = np.asarray(to_local(jnp.asarray(offset, jnp.float32), receiver.orientation))
    return local / np.linalg.norm(local, axis=-1, keepdims=True)


def power_in_sight(dataset: Dataset, local: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Returns the power of every observed spectrum at the pixel nearest to the transmitter's direction, relative to its
    largest."""
    nearest = np.argmax(np.asarray(pas_directions(), np.float32).reshape(-1, 3) @ local.T, 0)
    spectra = (np.asarray(dataset.pas(np.array([i]))).reshape(-1) for i in range(len(dataset)))
    return np.array([spectrum[pixel] ** 2 for spectrum, pixel in zip(spectra, nearest, strict=True)])


def by_group(dataset: Dataset, sine: Float[np.ndarray, " n"], scores: dict[str, np.ndarray]) -> dict[str, dict[str, Any]]:
    """Returns the median SSIM of training and test transmitters, above the horizon, and at it or below."""
    test = np.isin(np.arange(len(dataset)), dataset.test)
    groups = {}
    for role, members in (("training", ~test), ("test", test)):
        for place, there in (("above", sine > 0.05), ("below", sine <= 0.05)):
            chosen = members & there
            if not chosen.any():
                continue
            count = {"transmitters": len(np.unique(dataset.tx_index[chosen]))}
            groups[f"{role}_{place}"] = count | {name: round(float(np.median(s[chosen])), 3) for name, s in scores.items()}
    return groups


if __name__ == "__main__":
    run_command(main)
