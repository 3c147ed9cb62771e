"""What the coherent field explains of the published sample: `python -m experiments.sample_account FOLDER`.

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

from wbgs_jax.evaluation import metrics
from wbgs_jax.radio.array import pas_directions
from wbgs_jax.config import WaveConfig
from wbgs_jax.data import load_dataset
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.surface import make_mesh
from wbgs_jax._util.command import run_command
from wbgs_jax.eval import environment
from wbgs_jax.fields import wave
from wbgs_jax._util.files import write_json
from wbgs_jax.radio.geometry import to_local
from wbgs_jax.propagation.paths import REFLECTED, TRANSMITTED

RESULTS = Path(__file__).parent / "results"
CONFIG = WaveConfig(
    diffracted_tried=1, diffracted_kept=1, mirror_areas=(0.01, 0.2), permittivity=2.73, conductivity=0.0085, slope=0.94
)
AT_ONCE = 50
"""Spectra."""


@dataclass(frozen=True)
class Command:
    """Score what the mesh alone says about a sample."""

    data: tyro.conf.Positional[str]
    """Folder of the published layout."""
    out: Path = RESULTS


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.sample_account")
    dataset = load_dataset(command.data)
    params = wave.init(jax.random.key(0), make_mesh(dataset), CONFIG)
    _, first = np.unique(dataset.tx_index, return_index=True)
    plan, traced = wave.remember(params, dataset.receiver, jnp.asarray(dataset.tx_positions[first], jnp.float32))
    reflections = np.asarray((traced.plain.kind == REFLECTED).sum(-1))
    passes = np.asarray((traced.plain.kind == TRANSMITTED).sum(-1))
    kept = {"line of sight": reflections == 0, "one reflection": reflections <= 1, "two reflections": reflections <= 2}
    kept |= {"two reflections, nothing passes": (reflections <= 2) & (passes == 0), "no line of sight": reflections > 0}
    scores = {name: ssim(dataset, params, plan, keep(traced, mask)) for name, mask in kept.items()}
    local = in_sight(dataset)
    sine, sight = local[:, 2], power_in_sight(dataset, local)
    horizon = [
        round(float(np.median(sight[dataset.tx_index == tx])), 3) for tx in np.unique(dataset.tx_index[np.abs(sine) < 0.01])
    ]
    report: dict[str, Any] = {
        "dataset": dataset.name,
        "groups": by_group(dataset, sine, scores),
        "obstructed_transmitters": [i for i, tx in enumerate(dataset.tx_positions[first]) if obstructed(dataset, tx)],
        "power_in_sight_on_the_horizon": horizon,
    }
    write_json(command.out / "sample_account.json", report | environment())
    for name, row in (report.pop("groups") | report).items():
        print(f"{name:28}", row, file=sys.stderr)


def keep(traced: wave.Traced, mask: np.ndarray) -> wave.Traced:
    """The paths of a mask alone."""
    return dataclasses.replace(traced, plain=dataclasses.replace(traced.plain, alive=traced.plain.alive & jnp.asarray(mask)))


def ssim(dataset: Dataset, params: Any, plan: Any, traced: wave.Traced) -> Float[np.ndarray, "n"]:
    """Of every spectrum."""
    observe, found = jax.jit(wave.observe), []
    for start in range(0, len(dataset), AT_ONCE):
        index = np.arange(start, min(start + AT_ONCE, len(dataset)))
        seen = observe(params, (plan, traced), dataset.receiver, dataset.query(index), jnp.asarray(dataset.tx_index[index]))
        found.append(metrics.ssim(np.asarray(seen.pas), np.asarray(dataset.pas(index))))
    return np.concatenate(found)


def in_sight(dataset: Dataset) -> Float[np.ndarray, "n 3"]:
    """Unit vector to every spectrum's transmitter in the receiver's frame; its third component is above the array's horizon."""
    offset = dataset.tx_positions - np.asarray(dataset.receiver.position, np.float64)
    local = np.asarray(to_local(jnp.asarray(offset, jnp.float32), dataset.receiver.orientation))
    return local / np.linalg.norm(local, axis=-1, keepdims=True)


def power_in_sight(dataset: Dataset, local: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Of every observed spectrum: its power at the pixel nearest to the transmitter's direction, relative to its largest."""
    nearest = np.argmax(np.asarray(pas_directions(), np.float32).reshape(-1, 3) @ local.T, 0)
    spectra = (np.asarray(dataset.pas(np.array([i]))).reshape(-1) for i in range(len(dataset)))
    return np.array([spectrum[pixel] ** 2 for spectrum, pixel in zip(spectra, nearest, strict=True)])


def obstructed(dataset: Dataset, tx_position: Float[np.ndarray, "3"]) -> bool:
    """Whether any triangle of the whole mesh lies between a transmitter and the receiver (Moeller and Trumbore 1997)."""
    start = np.asarray(dataset.receiver.position, np.float64)
    a, b, c = (dataset.vertices[dataset.faces[:, i]].astype(np.float64) for i in range(3))
    along, offset = tx_position - start, start - a
    across = np.cross(along, c - a)
    volume = np.sum((b - a) * across, -1)
    scale = np.where(np.abs(volume) > 1e-12, 1 / np.where(volume == 0, 1, volume), 0)
    turned = np.cross(offset, b - a)
    u, v, t = np.sum(offset * across, -1) * scale, turned @ along * scale, np.sum((c - a) * turned, -1) * scale
    return bool(((scale != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6) & (t < 1 - 1e-6)).any())


def by_group(dataset: Dataset, sine: Float[np.ndarray, "n"], scores: dict[str, np.ndarray]) -> dict[str, dict[str, Any]]:
    """Median SSIM of training and test transmitters, above the horizon and not."""
    test = np.isin(np.arange(len(dataset)), dataset.test)
    groups = {}
    for role, members in (("training", ~test), ("test", test)):
        for place, there in (("above the horizon", sine > 0.05), ("at it or below", sine <= 0.05)):
            chosen = members & there
            if not chosen.any():
                continue
            count = {"transmitters": len(np.unique(dataset.tx_index[chosen]))}
            groups[f"{role}, {place}"] = count | {name: round(float(np.median(s[chosen])), 3) for name, s in scores.items()}
    return groups


if __name__ == "__main__":
    run_command(main)
