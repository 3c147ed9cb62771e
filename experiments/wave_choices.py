"""What the parts of the coherent field are worth: one changed at a time.

    python -m experiments.wave_choices --data SCENE [--steps 600] [--seeds 0 1] [--only order_1 phase_blind ...]

Trains the wave field, scores all held-out spectra, and writes experiments/results/wave_choices_<dataset>.json after every run;
what is there already is skipped. docs/wave.md quotes it.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import tyro

from experiments.choices import chosen_names, measure, run_series
from wbgs_jax.config import Settings, preset_settings
from wbgs_jax.data import load_dataset
from wbgs_jax.data.dataset import Dataset
from wbgs_jax._util.command import run_command
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json

RESULTS = Path(__file__).parent / "results"
Change = dict[str, Any]


@dataclass(frozen=True)
class Variant:
    """What differs from the `cpu` preset of the wave field."""

    wave: Change = field(default_factory=dict)
    optim: Change = field(default_factory=dict)
    search: Change = field(default_factory=dict)
    displacement: float = 0.0
    """Metres by which every part of the mesh stands in a wrong place (standard deviation along each axis)."""


NO_EDGES: Change = {"diffracted_tried": 1, "diffracted_kept": 1}
UNTRAINED: Change = {"materials_lr": 0.0, "thickness_lr": 0.0, "residual_lr": 0.0}

VARIANTS: dict[str, Variant] = {
    "default": Variant(),
    "phase_blind": Variant({"coherent": False}, search={"rounds": 0}),  # phases would name the materials
    "order_0": Variant({"mirror_areas": ()} | NO_EDGES),
    "order_1": Variant({"mirror_areas": (0.0,)} | NO_EDGES),
    "order_2": Variant({"mirror_areas": (0.0, 0.05)} | NO_EDGES),
    "order_3": Variant(NO_EDGES),
    "no_search": Variant(search={"rounds": 0}),
    "no_search_low_frequencies_first": Variant(optim={"curriculum": 0.5}, search={"rounds": 0}),
    "search_alone": Variant(optim=UNTRAINED),
    "no_residuals": Variant(optim={"residual_lr": 0.0}),
    "free_reflectivity": Variant(optim={"materials_lr": 0.0, "thickness_lr": 0.0}, search={"rounds": 0}),
    "untrained": Variant(optim=UNTRAINED, search={"rounds": 0}),
    "no_snapshot_loss": Variant(optim={"snapshot_weight": 0.0, "power_weight": 0.0}),
    "more_candidates": Variant({"diffracted_tried": 4096, "diffracted_kept": 512, "mirror_areas": (0.0, 0.02, 0.3)}),
    "mesh_moved_3mm": Variant(displacement=0.003),
    "mesh_moved_3cm": Variant(displacement=0.03),
    "mesh_moved_1m": Variant(displacement=1.0),
}


@dataclass(frozen=True)
class Command:
    """Train variants of the wave field and score them."""

    data: str
    """Scene number, scene file or folder."""
    steps: int = 600
    seeds: tuple[int, ...] = (0,)
    only: tuple[str, ...] = ()
    """Names of variants; all by default."""
    out: Path = RESULTS


def settings_of(variant: Variant, steps: int) -> Settings:
    """The `cpu` preset of the wave field with a variant's changes."""
    base = preset_settings("cpu", "wave")
    optim: Change = {"steps": steps, "min_steps": steps} | variant.optim
    return dataclasses.replace(
        base,
        wave=dataclasses.replace(base.wave, **variant.wave),
        optim=dataclasses.replace(base.optim, **optim),
        search=dataclasses.replace(base.search, **variant.search),
        loop=dataclasses.replace(base.loop, evaluate_every=10 * steps, checkpoint_every=10 * steps),
    )


def displaced(dataset: Dataset, metres: float, seed: int) -> Dataset:
    """The same spectra with every part of the mesh in a wrong place."""
    corners = trimesh.Trimesh(dataset.vertices, dataset.faces, process=False)
    part = trimesh.graph.connected_component_labels(corners.edges, node_count=len(dataset.vertices))
    shift = np.random.default_rng([seed, 7]).normal(0, metres, (part.max() + 1, 3))
    return dataclasses.replace(dataset, vertices=(dataset.vertices + shift[part]).astype(np.float32))


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.wave_choices")
    names = chosen_names(command.only, VARIANTS, "variant")
    dataset = load_dataset(command.data)
    path = command.out / f"wave_choices_{dataset.name}.json"
    report: dict[str, Any] = (
        read_json(path) if path.exists() else {"dataset": dataset.name, "steps": command.steps, "changes": {}}
    )
    if report["steps"] != command.steps:
        raise UserError(f"{path} holds runs of {report['steps']} steps; move it away or use --steps {report['steps']}")

    def run(name: str, seed: int) -> dict[str, Any]:
        variant = VARIANTS[name]
        changed = displaced(dataset, variant.displacement, seed) if variant.displacement else dataset
        return measure(changed, settings_of(variant, command.steps), seed, "wave")

    run_series(path, report, names, command.seeds, run)


if __name__ == "__main__":
    run_command(main)
