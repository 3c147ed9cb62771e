"""Which paths the simulator's ray launching misses, and which kinds the coherent field does not search for:
`python -m experiments.studies.missing_paths --scenes 2 4`, experiments/results/missing_paths.json.

Training transmitters of a released scene are traced by the simulator as for the data, and by the coherent field with the true
materials, nothing trained. Paths of both are matched by their kinds of interactions and lengths. Where only the field has a
path, ray casts through the triangles, which share no code with it, confirm the line of every segment and the number of surfaces
that it crosses. Every pair of the two snapshots, the data of the scene and the union of both sets of paths is then compared.
"""

import dataclasses
import itertools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro
from jaxtyping import Bool, Complex, Float, Int

from data_gen.ceilings import scaled_images
from data_gen.llvm import ensure_backend
from data_gen.scenes import get_scene
from data_gen.settings import SolverSettings
from experiments.bench.tracers import Ours
from experiments.results import FOLDER
from wbgs_jax import coherent
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.files import write_json
from wbgs_jax.data import Dataset, load_dataset
from wbgs_jax.evaluation.report import environment
from wbgs_jax.metrics import ssim
from wbgs_jax.propagation.paths import InteractionType
from wbgs_jax.propagation.transport import element_voltages
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.radio.channel import Paths

LETTERS = {one.sionna: one.name[0] for one in InteractionType}
"""First letters of the kinds of interactions, by the simulator's numbers."""
TOLERANCE_M = 2e-4
"""Difference of the lengths of two paths that count as the same."""


class PathSet(NamedTuple):
    """The paths of one transmitter at one frequency."""

    voltages: Complex[np.ndarray, "k elements"]
    length_m: Float[np.ndarray, " k"]
    kinds: list[str]
    """Letters of the interactions in order: T(ransmitted), R(eflected), D(iffracted)."""
    points: Float[np.ndarray, "k 5 3"] | None = None
    """Points of the field's paths, metres (`PathGeometry.points`)."""

    @property
    def power(self) -> Float[np.ndarray, " k"]:
        """Power of every path, summed over the elements."""
        return np.sum(np.abs(self.voltages) ** 2, -1)


class Matched(NamedTuple):
    """Two sets of paths compared."""

    partner: Int[np.ndarray, " k"]
    """Index of the field's path for every traced one; -1: the field lacks it."""
    extra: Bool[np.ndarray, " n"]
    """Which of the field's paths the simulator lacks."""


def without_transmissions(kinds: str) -> str:
    """Returns the reflections and diffractions of a path."""
    return kinds.replace("T", "")


def match(traced: PathSet, found: PathSet) -> Matched:
    """Returns pairs of paths with the same reflections and diffractions and the same length: of several, those whose voltages
    are most alike, the strongest first."""
    partner, free = np.full(len(traced.kinds), -1), np.ones(len(found.kinds), bool)
    names = np.array([without_transmissions(kinds) for kinds in found.kinds])
    for k in np.argsort(-traced.power):
        alike = np.abs(found.length_m - traced.length_m[k]) < TOLERANCE_M
        near = np.flatnonzero(alike & free & (names == without_transmissions(traced.kinds[k])))
        if len(near):
            own = found.voltages[near]
            products = np.abs(own.conj() @ traced.voltages[k]) / np.maximum(np.linalg.norm(own, axis=-1), 1e-30)
            partner[k] = near[np.argmax(products)]
            free[partner[k]] = False
    return Matched(partner, free)


class Room:
    """A released scene in the coherent field with the true materials."""

    def __init__(self, dataset: Dataset) -> None:
        config = coherent.WaveConfig(diffracted_tried=4096, diffracted_kept=1024)  # none is left out for lack of room
        self.field = Ours(dataset, config, dataset.receiver())
        nothing = jnp.zeros_like(self.field.params.excess_loss)
        self.field.params = dataclasses.replace(self.field.params, excess_loss=nothing)
        self.mesh = trimesh.Trimesh(dataset.vertices, dataset.faces, process=False)

    def paths(self, position: Float[np.ndarray, "3"], frequencies_hz: Sequence[float]) -> list[PathSet]:
        """Returns the paths of a transmitter, traced once, at every frequency."""
        arrived = self.field.fields(position[None], np.asarray(frequencies_hz))
        return [self._at(jax.tree.map(lambda leaf, i=i: leaf[0, i], arrived), hz) for i, hz in enumerate(frequencies_hz)]

    def _at(self, arrived: Paths, frequency_hz: float) -> PathSet:
        voltages = np.asarray(element_voltages(arrived, self.field.plan.receiver, jnp.float32(frequency_hz)))
        there = np.flatnonzero(np.abs(voltages).max(-1) > 0)
        kinds = ["".join(InteractionType(int(k)).name[0] for k in row if k) for row in np.asarray(arrived.interaction)[there]]
        lengths, points = (np.asarray(of, np.float64)[there] for of in (arrived.length, arrived.points))
        return PathSet(voltages[there], lengths, kinds, points)

    def crossed(self, points: Float[np.ndarray, "5 3"]) -> int:
        """Returns the number of surfaces between the points of a path, by ray casts through the triangles."""
        count, aside = 0, 1e-3
        for start, end in itertools.pairwise(points):
            length = np.linalg.norm(end - start)
            if length < 2 * aside:
                continue
            ray = (end - start) / length
            places = self.mesh.ray.intersects_location([start + aside * ray], [ray], multiple_hits=True)[0]
            along = np.sort(np.linalg.norm(places - start, axis=-1))
            along = along[along < length - aside]
            count += len(along) - int(np.sum(np.diff(along) < 1e-6))  # once where two triangles meet
        return count


def account(dataset: Dataset, room: Room, own: PathSet, traced: Any, tx: int, frequency_hz: float) -> dict[str, Any]:
    """Returns what is matched and what is missing for one transmitter, as shares of the traced power, and the SSIM between the
    spectra of the data, of the field, and of all paths of either."""
    link = int(np.flatnonzero((dataset.tx_index == tx) & np.isclose(dataset.frequencies_hz, frequency_hz, rtol=1e-4))[0])
    kinds = ["".join(LETTERS[int(k)] for k in row if k) for row in traced.kinds]
    truth = PathSet(traced.coefficients, traced.delays * SPEED_OF_LIGHT, kinds)
    pairs, total = match(truth, own), truth.power.sum()
    known = pairs.partner >= 0
    error = np.sum(np.abs(truth.voltages[known] - own.voltages[pairs.partner[known]]) ** 2)
    lacking: dict[str, float] = defaultdict(float)
    for k in np.flatnonzero(~known):
        lacking[group(kinds[k])] += float(truth.power[k] / total)
    strong = np.flatnonzero(pairs.extra & (own.power > 1e-3 * total))
    assert own.points is not None, "of the field"
    confirmed = np.array([room.crossed(own.points[k]) == own.kinds[k].count("T") for k in strong], bool)
    union = truth.voltages.sum(0) + own.voltages[pairs.extra].sum(0)
    elements = np.asarray(dataset.receiver().element_wavelengths(jnp.float32(frequency_hz)))
    images = scaled_images(np.stack([own.voltages.sum(0), union]), elements)
    data = np.asarray(dataset.pas(np.array([link])))[0]
    against = ssim(np.stack([images[0], images[1], images[0]]), np.stack([data, data, images[1]]))
    return {
        "tx": tx,
        "ghz": round(frequency_hz / 1e9, 2),
        "in_sight": "" in kinds,
        "matched": float(truth.power[known].sum() / total),
        "error_of_matched": float(error / truth.power[known].sum()),
        "field_lacks": dict(sorted(lacking.items(), key=lambda item: -item[1])),
        "simulator_lacks": float(own.power[pairs.extra].sum() / total),
        "of_these_tested": float(own.power[strong].sum() / total),
        "of_these_confirmed": float(own.power[strong][confirmed].sum() / total),
        "ssim_field_data": float(against[0]),
        "ssim_all_paths_data": float(against[1]),
        "ssim_field_all_paths": float(against[2]),
    }


def group(kinds: str) -> str:
    """Returns the kind of a path that the field lacks."""
    reflections, diffracted = kinds.count("R"), "D" in kinds
    if not diffracted:
        return "4 or more reflections" if reflections > 3 else "up to 3 reflections"
    if reflections < 2:
        return "diffraction, up to 1 reflection"
    if reflections > 2:
        return "diffraction, 3 or more reflections"
    middle = without_transmissions(kinds) == "RDR"
    return "diffraction between 2 reflections" if middle else "diffraction before or after 2 reflections"


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns medians (of SSIM and shares) and means (of what the field lacks), by sight and frequency."""
    found: dict[str, Any] = {}
    for sight in (True, False):
        for ghz in sorted({row["ghz"] for row in rows}):
            some = [row for row in rows if row["in_sight"] is sight and row["ghz"] == ghz]
            if not some:
                continue
            names = [name for name, value in some[0].items() if isinstance(value, float) and name != "ghz"]
            groups = sorted({name for row in some for name in row["field_lacks"]})
            found[f"{'in' if sight else 'out_of'}_sight_{ghz:g}_ghz"] = {
                "transmitters": len(some),
                **{name: float(np.median([row[name] for row in some])) for name in names},
                "field_lacks": {
                    name.replace(" ", "_").replace(",", ""): float(np.mean([row["field_lacks"].get(name, 0) for row in some]))
                    for name in groups
                },
            }
    return found


@dataclass(frozen=True)
class Command:
    """Trace transmitters with the simulator and with the coherent field, and compare their paths."""

    scenes: tuple[int, ...] = (2, 4)
    tx: int = 24
    """Training transmitters of each, drawn at random with a fixed seed."""
    ghz: tuple[float, ...] = (1.0, 2.4, 10.0)
    out: Path = FOLDER / "missing_paths.json"


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.studies.missing_paths")
    ensure_backend()
    from data_gen.solve import Simulator

    use_compilation_cache()
    frequencies, found = [ghz * 1e9 for ghz in command.ghz], dict[str, Any]()
    for scene in command.scenes:
        dataset = load_dataset(str(scene))
        room, simulator, rows = Room(dataset), Simulator(get_scene(scene), SolverSettings()), list[dict[str, Any]]()
        tx = np.random.default_rng(3).permutation(np.unique(dataset.tx_index[dataset.train]))[: command.tx]
        size = simulator.settings.tx_per_call
        for some in (tx[i : i + size] for i in range(0, len(tx), size)):
            positions = np.stack([dataset.tx_positions[dataset.tx_index == number][0] for number in some])
            traced = simulator.paths(positions, frequencies)
            for i, number in enumerate(some):
                own = room.paths(positions[i], frequencies)
                rows += [account(dataset, room, own[k], traced[k][i], int(number), hz) for k, hz in enumerate(frequencies)]
            say(f"scene {scene}: {len(rows) // len(frequencies)} of {len(tx)} transmitters")
        found[f"scene{scene}"] = {"summary": summary(rows), "rows": rows}
        write_json(command.out, found | environment())


if __name__ == "__main__":
    run_command(main)
