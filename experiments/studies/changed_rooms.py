"""Whether a change of a room is found from a few new links, and what an update of a trained field then gains:
`python -m experiments.studies.changed_rooms --trace`, then without it: experiments/results/changed_rooms.json.

Pieces of furniture of at least a metre in scenes 2 and 4 are moved by half a metre, one at a time; other cases have three or
ten changed ones, one that is gone, or none. The simulator traces each room again, at 20 new transmitters within two metres of
the first change, at 20 anywhere in the room, and at some of the test transmitters. Where nothing has changed, the first 20 are
within two metres of some object.
"""

import dataclasses
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float

from data_gen.options import SceneOptions
from data_gen.scenes import Part, SceneSpec, get_scene
from data_gen.scenes.changes import changed
from experiments.results import FOLDER
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import write_json
from wbgs_jax.data.dataset import Dataset, keep_links
from wbgs_jax.data.load import load_dataset
from wbgs_jax.evaluation.report import environment
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.inference.predictor import observe_links
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.metrics import ssim
from wbgs_jax.training.calibration.changes import Group, notice, objects_of, with_object_moved, without_object
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.training.update import check_new, compare, lines_of, object_name, part_names, updated

SCENES = 2, 4
GHZ = 2.4, 5.0, 24.25, 60.0
COUNT, TESTS, TESTED_CASES = 20, 24, 2
"""New transmitters of each kind, test transmitters, and the number of single moves of a scene in which these are traced."""
LEAST_M, MOVE_M, NEAR_M = 1.0, 0.5, 2.0
FIXED = "frames", "leaves", "posts"
"""Ends of the names of objects that belong to the building."""
KINDS = "near", "test", "anywhere"
"""Kinds of places, in the order in which they are traced."""
SEED, LEVEL = 52, 0.05


@dataclass(frozen=True)
class Case:
    """A room after a change, and where it is measured."""

    name: str
    scene: int
    moved: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    tested: bool = False

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the changed objects."""
        return tuple(word.split(":")[0] for word in (*self.moved, *self.removed))


def furniture(spec: SceneSpec) -> list[Part]:
    """Returns the objects of a scene that may be moved."""
    large = (p for p in spec.solids if np.ptp(p.mesh.bounds, axis=0).max() >= LEAST_M)
    return [p for p in large if not p.name.endswith(FIXED)]


def move_of(spec: SceneSpec, one: Part, rng: np.random.Generator, taken: tuple[str, ...] = ()) -> str:
    """Returns a random move of an object by half a metre to where there is room; empty if there is none."""
    for angle in rng.permutation(16) * np.pi / 8:
        word = f"{one.name}:{MOVE_M * np.cos(angle):.3f},{MOVE_M * np.sin(angle):.3f}"
        try:
            changed(spec, (*taken, word))
        except UserError:
            continue
        return word
    return ""


def cases(scene: int, singles: int) -> Iterator[Case]:
    """Returns the cases of a scene."""
    spec, rng = get_scene(scene), np.random.default_rng([SEED, scene])
    objects = furniture(spec)
    order = itertools.cycle(rng.permutation(len(objects)))
    yield Case(f"scene{scene}_unchanged0", scene)
    found = 0
    while found < singles:
        if word := move_of(spec, objects[next(order)], rng):
            yield Case(f"scene{scene}_moved{found}", scene, (word,), tested=found < TESTED_CASES)
            found += 1
            if found in (2, 6, 10):
                yield several(scene, spec, objects, {2: 0, 6: 3, 10: 10}[found], rng)
                yield Case(f"scene{scene}_unchanged{found // 4 + 1}", scene)


def several(scene: int, spec: SceneSpec, objects: list[Part], count: int, rng: np.random.Generator) -> Case:
    """Returns a case with several objects moved, the last of ten gone; without a number, with one object gone."""
    chosen = [objects[i] for i in rng.permutation(len(objects))]
    if not count:
        return Case(f"scene{scene}_gone", scene, removed=(chosen[0].name,), tested=True)
    words: tuple[str, ...] = ()
    for one in chosen:
        if len(words) < count - (count == 10) and (word := move_of(spec, one, rng, words)):
            words = (*words, word)
    names = {word.split(":")[0] for word in words}
    gone = tuple(one.name for one in chosen if one.name not in names)[: int(count == 10)]
    return Case(f"scene{scene}_several{count}", scene, words, gone, tested=True)


def new_places(case: Case, number: int) -> dict[str, Float[np.ndarray, "n 3"]]:
    """Returns transmitters, metres: new ones near the first change (if there is none, near any object), new ones anywhere, and
    test transmitters."""
    spec = changed(get_scene(case.scene), case.moved, case.removed)
    rng, grid = np.random.default_rng([SEED, case.scene, number]), np.asarray(spec.tx_grid)
    drawn = rng.uniform(grid.min(0), grid.max(0), (20_000, 3)).round(3)
    about = case.objects[0] if case.objects else furniture(spec)[rng.integers(len(furniture(spec)))].name
    middle = next(p for p in get_scene(case.scene).parts if p.name == about).mesh.bounds.mean(0)
    close = drawn[400:][np.linalg.norm(drawn[400:, :2] - middle[:2], axis=1) < NEAR_M][:200]
    found = {
        "near": dataclasses.replace(spec, tx_grid=close).accessible_tx()[:COUNT],
        "anywhere": dataclasses.replace(spec, tx_grid=drawn[:400]).accessible_tx()[:COUNT],
    }
    if case.tested:
        data = load_dataset(case.scene)
        tests = np.unique(data.tx_positions[data.test], axis=0)
        some = tests[np.sort(np.random.default_rng(SEED).permutation(len(tests))[:TESTS])]
        found["test"] = dataclasses.replace(spec, tx_grid=some).accessible_tx()
    return found


def trace(case: Case, number: int, kind: str, folder: Path) -> None:
    """Traces a case at one kind of places, and writes the scene file."""
    from data_gen.generate import Options, generate

    out, table = folder / f"{case.name}_{kind}.npz", folder / f"{case.name}_{kind}.csv"
    places = new_places(case, number).get(kind)
    if places is None or out.exists():
        return
    say(f"{case.name}, {kind}: {', '.join((*case.moved, *case.removed)) or 'unchanged'}")
    table.write_text("x,y,z\n" + "".join(f"{x},{y},{z}\n" for x, y, z in places))
    room = SceneOptions(scene=str(case.scene), moved=case.moved, removed=case.removed, tx_grid=str(table))
    options = Options(**dataclasses.asdict(room), frequencies=GHZ, ceilings=False, workers=1, out=out, work=folder / "work")
    generate(options)


def truth_of(trained: TrainedField, case: Case, names: dict[str, int]) -> TrainedField:
    """Returns a trained field with the true changes applied to its mesh."""
    part = trained.field.ability(Calibratable)
    assert part is not None, "a field with paths"
    field, params = part.field, part.of(trained.params)
    objects = objects_of(field)
    for word in case.moved:
        dx, dy = (float(value) for value in word.split(":")[1].split(","))
        field = with_object_moved(field, objects[names[word.split(":")[0]]], np.array([dx, dy, 0]))
    for name in case.removed:  # one at most
        field, params = without_object(field, params, objects[names[name]])
    return dataclasses.replace(trained, field=part.put(trained.field, field), params=part.put(trained.params, params))


def object_numbers(trained: TrainedField, old: Dataset) -> dict[str, int]:
    """Returns the indices of the objects of a field by their names in the scene."""
    part = trained.field.ability(Calibratable)
    assert part is not None, "a field with paths"
    names = part_names(trained.config.source)
    return {object_name(old, part.field, movers, names): number for number, movers in enumerate(objects_of(part.field))}


def ssim_of(trained: TrainedField, data: Dataset) -> float:
    """Returns the median SSIM of predicted spectra on all links of a dataset."""
    index = np.arange(len(data))
    pas = observe_links(trained.field, trained.params, data, index).pas
    return float(np.median(ssim(np.asarray(pas), np.asarray(data.pas(index)))))


def tested(trained: TrainedField, old: Dataset, case: Case, kind: str, folder: Path) -> dict[str, Any]:
    """Returns the result of the test alone with the new links of one file."""
    new = check_new(load_dataset(str(folder / f"{case.name}_{kind}.npz")), old)
    begin, cpu = time.monotonic(), time.process_time()
    noticed = notice(compare(trained, old, new).evidence, np.random.default_rng(trained.config.seed))
    return {
        "case": case.name, "scene": case.scene, "places": kind, "transmitters": len(np.unique(new.tx_index)),
        "moved": case.moved, "removed": case.removed, "p_value": noticed.p_value, "p_values": noticed.p_values,
        "noticed": noticed.p_value <= LEVEL, "seconds": time.monotonic() - begin, "cpu_seconds": time.process_time() - cpu,
    }  # fmt: skip


def account(trained: TrainedField, old: Dataset, case: Case, kind: str, folder: Path) -> dict[str, Any]:
    """Returns the result of an update with the new links of one file."""
    new = check_new(load_dataset(str(folder / f"{case.name}_{kind}.npz")), old)
    begin, cpu = time.monotonic(), time.process_time()
    found = updated(trained, old, new, LEVEL)
    seconds = {"seconds": time.monotonic() - begin, "cpu_seconds": time.process_time() - cpu}
    numbers = object_numbers(trained, old)
    shifts: dict[str, list[float] | None] = dict.fromkeys(case.removed)
    shifts |= {word.split(":")[0]: [*(float(v) for v in word.split(":")[1].split(",")), 0.0] for word in case.moved}
    hit = [one for one in found.changes if one.name in shifts]
    off = [float(np.linalg.norm(np.subtract(a, b))) for one in hit if (a := one.shift) and (b := shifts[one.name])]
    result = {
        "case": case.name, "scene": case.scene, "places": kind, "transmitters": len(np.unique(new.tx_index)),
        "true": shifts, "p_value": found.notice.p_value, "p_values": found.notice.p_values,
        "noticed": found.notice.p_value <= LEVEL, "found": [one.name for one in found.changes], "right": len(hit),
        "shifts": [one.shift for one in found.changes], "off_m": off, "lines": lines_of(found, old),
    } | seconds  # fmt: skip
    if (tests := folder / f"{case.name}_test.npz").exists():
        data = check_new(load_dataset(str(tests)), old)
        result |= {"ssim_before": ssim_of(trained, data), "ssim_after": ssim_of(found.trained, data)}
        result |= {"ssim_true_mesh": ssim_of(truth_of(trained, case, numbers), data)}
    return result


def false_alarms(trained: TrainedField, old: Dataset, draws: int) -> dict[str, float]:
    """Returns the share of random groups of test transmitters of the unchanged room in which a change is noticed."""
    index = old.test[np.isin(np.round(old.frequencies_hz[old.test] / 1e9, 4), GHZ)]
    every = compare(trained, old, keep_links(old, index)).evidence
    rng, is_new = np.random.default_rng(SEED), every.group == Group.NEW
    old_ones, tests = np.flatnonzero(~is_new), np.flatnonzero(is_new)
    p_values = []
    for _ in range(draws):
        kept = np.concatenate([old_ones, rng.permutation(tests)[:COUNT]])
        p_values.append(notice(every.some(kept), rng).p_value)
    return {"groups": draws, "transmitters": len(tests), "noticed": float(np.mean(np.array(p_values) <= LEVEL))}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns figures over the cases with one moved object, and over unchanged rooms, by scene and kind of places."""
    found = {}
    for scene, kind in itertools.product(SCENES, KINDS):
        own = [row for row in rows if row["scene"] == scene and row["places"] == kind]
        single, none = ([row for row in own if word in row["case"]] for word in ("moved", "unchanged"))
        if not single:
            continue
        off = [value for row in single for value in row.get("off_m", ())]
        found[f"scene{scene}_{kind}"] = {
            "rooms": len(single),
            "noticed": float(np.mean([row["noticed"] for row in single])),
            "right_object": float(np.mean([row["right"] > 0 for row in single])) if "right" in single[0] else None,
            "off_m": float(np.median(off)) if off else None,
            "unchanged_rooms": len(none),
            "false_alarms": int(sum(row["noticed"] for row in none)),
            "seconds": float(np.median([row["seconds"] for row in single if row["noticed"]] or [0])),
            "cpu_seconds": float(np.median([row["cpu_seconds"] for row in single if row["noticed"]] or [0])),
        }
    return found


@dataclass(frozen=True)
class Command:
    """Measure how reliably a change is found, and what an update gains."""

    runs: tuple[Path, ...] = ()
    """Runs of scene 2 and of scene 4: `wbgs-jax train --scene 2 --preset cpu`, and scene 4 with `--field wave`."""
    trace: bool = False
    """Trace the rooms instead; what is there already is not traced again."""
    folder: Path = Path("runs/changed_rooms")
    """Folder of the traced rooms."""
    singles: int = 8
    """Number of rooms of each scene with one moved object."""
    draws: int = 200
    """Groups of test transmitters of the unchanged rooms; 0: none."""
    search: bool = True
    """Also search what has changed, and update the field; otherwise only the test is made."""
    out: Path = FOLDER / "changed_rooms.json"


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.studies.changed_rooms")
    every = [list(enumerate(cases(scene, command.singles))) for scene in SCENES]
    together = [one for both in itertools.zip_longest(*every) for one in both if one]
    if command.trace:
        command.folder.mkdir(parents=True, exist_ok=True)
        for kind in KINDS:
            for number, case in together:
                trace(case, number, kind, command.folder)
        return
    use_compilation_cache()
    rows, alarms = list[dict[str, Any]](), dict[str, Any]()
    fields = {scene: load_trained(run) for scene, run in zip(SCENES, command.runs, strict=True)}
    data = {scene: trained.dataset() for scene, trained in fields.items()}
    if command.draws:
        alarms = {f"scene{scene}": false_alarms(fields[scene], data[scene], command.draws) for scene in SCENES}
    origins = {f"scene{scene}": trained.origin() for scene, trained in fields.items()}
    made = account if command.search else tested
    for kind, (_, case) in itertools.product(("near", "anywhere"), together):
        if not (command.folder / f"{case.name}_{kind}.npz").exists():
            continue
        rows.append(row := made(fields[case.scene], data[case.scene], case, kind, command.folder))
        say(f"{case.name} {kind}: p {row['p_value']:.3f}, {row.get('found')}, {row['cpu_seconds']:.0f} s")
        found = {"summary": summary(rows), "false_alarms": alarms, "cases": rows, "runs": origins, "ghz": GHZ, "level": LEVEL}
        write_json(command.out, found | environment())  # after each case: a search of all takes hours


if __name__ == "__main__":
    run_command(main)
