"""Brings a trained field up to date with a few new links (host): the data of the test and of the search
(`calibration.changes`), the places that a change affects, and the run folder of the changed room.

Old links near an affected place are stale. They are left out of the data of the new run, out of the measured spectra that
correct its predictions, and out of the places from which its prediction intervals take the distance. The regression of the
intervals is kept: predictions elsewhere are the same as before. They are no better next to new links, which neither train the
field nor correct it, so that these are no such places.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from wbgs_jax._util.cli import point_words
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import write_json
from wbgs_jax.data.dataset import Dataset, checksum, keep_links, places_of, training_links
from wbgs_jax.data.load import PARTS, source_paths
from wbgs_jax.data.scene_file import SceneFile, load_scene, save_scene
from wbgs_jax.fields.base import Ability
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import WaveParams
from wbgs_jax.inference.intervals import C, write_confidence
from wbgs_jax.inference.kriging import SAME_PLACE_M, some_of, write_neighbours
from wbgs_jax.inference.predictor import observe_links
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.metrics import ssim
from wbgs_jax.radio.antenna import PATTERN_EXPONENTS
from wbgs_jax.training import checkpoint
from wbgs_jax.training.batches import training_data
from wbgs_jax.training.calibration.changes import (
    CONTROLS,
    STATISTICS,
    Change,
    Evidence,
    Group,
    Notice,
    box_of,
    find_changes,
    gather,
    limit_of,
    notice,
    objects_of,
    power_change_db,
)
from wbgs_jax.training.calibration.objective import CalibrationProblem
from wbgs_jax.training.hooks import Say, silent
from wbgs_jax.training.run_folder import load_trained, locked, prepare_folder, write_manifest
from wbgs_jax.training.step import TrainState
from wbgs_jax.types import Receiver

FEWEST_TX = 5
"""Minimum number of new transmitters, and of old ones."""
AFFECTED = 0.02
"""Change of a predicted spectrum, one minus its SSIM with the earlier prediction, from which on a place is affected."""
SCENE, RECORD = "scene.npz", "update.json"
"""Data of the changed room, and what has changed, in the run folder."""


@dataclass(frozen=True)
class Update:
    """Result of an update."""

    notice: Notice
    """Result of the test whether the room has changed."""
    changes: list[Change]
    """Changed objects; empty if nothing has changed, or if no object explains it."""
    gain_db: float
    """Common gain, dB; 0 unless the received powers have changed."""
    trained: TrainedField
    """The field of the room as it is now."""
    dataset: Dataset
    """Its data: old links that are not stale, new links, and the surfaces as they are now."""
    stale: Bool[np.ndarray, " n"]
    """Which links of the old data are stale."""
    remarks: list[str]
    """Remarks for the terminal."""


class Joined(NamedTuple):
    """Old and new links as one dataset."""

    dataset: Dataset
    group: Int[np.ndarray, " n"]
    """Group of every link in the test (`changes.Group`)."""


def check_new(new: Dataset, old: Dataset) -> Dataset:
    """Returns new links, numbered by the receivers of the old data.

    Raises:
        UserError: they are of another kind, of receivers or arrays that the old data do not have, or too few.
    """
    if not len(old.vertices):
        raise UserError(f"{old.name} has no mesh, so that no object can be found to have changed; train on data with a mesh")
    if new.observed != old.observed:
        raise UserError(f"{new.name} holds {new.observed.words}, but the field was trained on {old.observed.words}")
    number = np.zeros(new.n_receivers, int)
    for i in np.unique(new.receiver_index):
        number[i] = _like(new.receiver(int(i)), old, f"receiver {i} of {new.name}")
    if len(new.vertices):
        now, before = (np.ptp(one.vertices, axis=0) for one in (new, old))
        if not np.allclose(now, before, rtol=0.1, atol=0.2):
            words = " and ".join(" x ".join(f"{x:.3g}" for x in span) for span in (now, before))
            raise UserError(f"{new.name} is of another room than {old.name}: their surfaces span {words} m")
    low, high = old.vertices.min(0) - SAME_PLACE_M, old.vertices.max(0) + SAME_PLACE_M
    if (away := ((new.tx_positions < low) | (new.tx_positions > high)).any(1)).any():
        raise UserError(f"{away.sum()} of {len(new)} links of {new.name} lie outside of the room of {old.name}")
    if (count := len(np.unique(places_of(new)))) < FEWEST_TX:
        raise UserError(f"{new.name} has {count} transmitters; an update needs at least {FEWEST_TX} new ones")
    return dataclasses.replace(new, receivers=old.receivers, receiver_index=number[new.receiver_index])


def _like(receiver: Receiver, old: Dataset, name: str) -> int:
    """Returns the number of the receiver of the old data that equals a receiver of the new ones."""
    for number in range(old.n_receivers):
        own = old.receiver(number)
        if receiver.unit != own.unit or receiver.element_positions.shape != own.element_positions.shape:
            continue
        alike = np.abs(np.vdot(receiver.orientation, own.orientation)) > 1 - 1e-5
        close = np.allclose(receiver.position, own.position, atol=SAME_PLACE_M)
        if alike and close and np.allclose(receiver.element_positions, own.element_positions, atol=SAME_PLACE_M):
            return number
    raise UserError(f"{name} is not a receiver of {old.name}, or has another array; measure with a receiver of the training")


def joined(old: Dataset, new: Dataset) -> tuple[Joined, list[str]]:
    """Returns the new links together with the old ones that they are compared with, and remarks. The lower half of the
    frequencies of the new links is used, at which phases are known best. Old links are those of the training or validation at
    these frequencies and receivers whose transmitters are next to the new ones.

    Raises:
        UserError: there are too few old links.
    """
    learned = training_links(old)
    learned = learned[np.isin(old.receiver_index[learned], new.receiver_index)]
    available, hertz = np.unique(old.frequencies_hz[learned]), np.unique(new.frequencies_hz)
    hertz, partners, remarks = hertz[: -(-len(hertz) // 2)], list[float](), list[str]()
    for one in hertz if len(available) else ():
        partners.append(float(available[np.argmin(np.abs(np.log(available / one)))]))
        if not np.isclose(partners[-1], one, rtol=1e-6):
            words = f"there are no old links at {one / 1e9:g} GHz; those at {partners[-1] / 1e9:g} GHz take their place"
            remarks.append(words)
    learned = learned[np.isin(old.frequencies_hz[learned], partners)]
    transmitters, first = np.unique(old.tx_index[learned], return_index=True)
    if len(transmitters) < FEWEST_TX:
        raise UserError(f"the run has {len(transmitters)} old transmitters to compare with; an update needs {FEWEST_TX}")
    new = keep_links(new, np.flatnonzero(np.isin(new.frequencies_hz, hertz)))
    places = np.unique(new.tx_positions, axis=0)
    near = cKDTree(old.tx_positions[learned[first]]).query(places, min(CONTROLS, len(first)))[1]
    kept = learned[np.isin(old.tx_index[learned], transmitters[np.unique(near)])]
    groups = np.repeat([Group.OLD, Group.NEW], [len(kept), len(new)])
    return Joined(with_links(old, kept, new), groups), remarks


def with_links(old: Dataset, kept: Int[np.ndarray, " k"], new: Dataset) -> Dataset:
    """Returns a dataset of some of the old links and all new ones, which are for training."""
    rest = keep_links(old, kept)
    observed = {name: np.concatenate([values, new.observations[name]]) for name, values in rest.observations.items()}
    return dataclasses.replace(
        rest,
        tx_positions=np.concatenate([rest.tx_positions, new.tx_positions]),
        frequencies_hz=np.concatenate([rest.frequencies_hz, new.frequencies_hz]),
        receiver_index=np.concatenate([rest.receiver_index, new.receiver_index]),
        tx_index=np.concatenate([rest.tx_index, rest.tx_index.max(initial=-1) + 1 + new.tx_index]),  # even at an old place
        train=np.concatenate([rest.train, len(rest) + np.arange(len(new))]),
        observations=observed,
    )


def affected_links(
    before: Calibratable, old: WaveParams, after: Calibratable, now: WaveParams, dataset: Dataset, rng: np.random.Generator
) -> Bool[np.ndarray, " n"]:
    """Returns which links of a dataset belong to a transmitter whose predicted spectra have changed by more than `AFFECTED`, at
    the lowest or at a middle frequency.

    Args:
        before, old: field with paths before the change, and its parameters.
        after, now: the same after the change.
        dataset: data that the field was trained on.
        rng: random numbers for the transmitters whose spectra are compared.
    """
    learned = np.unique(dataset.frequencies_hz[training_links(dataset)])
    used = np.isin(dataset.frequencies_hz, learned[[0, len(learned) // 2]])
    # Number of transmitters whose spectra are predicted before and after; the others are like the nearest of them
    most_tx = 256
    chosen = rng.permutation(np.unique(dataset.tx_index))[:most_tx]
    index = np.flatnonzero(used & np.isin(dataset.tx_index, chosen))
    pas = [observe_links(field, params, dataset, index).pas for field, params in ((before, old), (after, now))]
    changed = 1 - ssim(*(np.asarray(one) for one in pas)) > AFFECTED
    tx, place = np.unique(dataset.tx_index[index], return_inverse=True)
    of_tx = np.bincount(place, changed) > 0
    first = np.unique(dataset.tx_index, return_index=True)[1]
    nearest = cKDTree(dataset.tx_positions[first[tx]]).query(dataset.tx_positions[first])[1]
    found: Bool[np.ndarray, " n"] = of_tx[nearest][dataset.tx_index]
    return found


def surfaces_after(
    dataset: Dataset, before: Calibratable, moves: Sequence[tuple[int, Float[np.ndarray, "3"] | None]]
) -> Dataset:
    """Returns a dataset with the surfaces of the changed room.

    Args:
        dataset: data of the room before the change.
        before: field with paths before the change.
        moves: objects by their index in `objects_of`, each with its displacement (metres), or None for one that is gone.
    """
    vertices, faces = np.asarray(dataset.vertices, np.float64), np.asarray(dataset.faces)
    objects, gone = objects_of(before), np.zeros(len(faces), bool)
    for number, shift in moves:
        own = _triangles_of(before, objects[number], vertices[faces])
        if shift is None:
            gone |= own
            continue
        corners = vertices[faces[own]].reshape(-1, 3) + shift
        faces = faces.copy()
        faces[own] = len(vertices) + np.arange(len(corners)).reshape(-1, 3)
        vertices = np.concatenate([vertices, corners])
    part = None if dataset.face_part is None else dataset.face_part[~gone]
    materials = dataset.materials
    if materials is not None:
        materials = dataclasses.replace(materials, material=materials.material[~gone])
    kept = faces[~gone].astype(np.int32)
    return dataclasses.replace(dataset, vertices=vertices.astype(np.float32), faces=kept, face_part=part, materials=materials)


def _triangles_of(
    field: Calibratable, movers: Int[np.ndarray, " k"], triangles: Float[np.ndarray, "t 3 3"]
) -> Bool[np.ndarray, " t"]:
    """Returns which triangles lie on the facets of rigid bodies, at their nominal positions."""
    facets, low_high = field.facets, box_of(field, movers)
    own = np.isin(np.asarray(facets.mover), movers)
    on_surface_m = 1e-3  # distance (metres) of a triangle's centre from the plane of the facet that it is part of
    off = np.abs(np.asarray(field.motion.shift)[movers]).max(initial=0) + on_surface_m
    middle = triangles.mean(1)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    away = np.abs(middle @ np.asarray(facets.normal)[own].T - np.asarray(facets.offset)[own])
    on_plane = (away < off) & (normal @ np.asarray(facets.normal)[own].T > 1 - on_surface_m)
    inside = ((triangles > low_high[0] - off) & (triangles < low_high[1] + off)).all((1, 2))
    found: Bool[np.ndarray, " t"] = on_plane.any(1) & inside
    return found


def part_names(source: str) -> list[str]:
    """Returns the names of the objects of a scene file; empty if there are none."""
    first = source_paths(source)[0]
    parts = load_scene(first).meta.get("parts", []) if first.suffix == ".npz" and first.is_file() else []
    return [str(part.get("name", number)) for number, part in enumerate(parts)]


def object_name(dataset: Dataset, field: Calibratable, movers: Int[np.ndarray, " k"], names: list[str]) -> str:
    """Returns the name of an object in its scene file, or the number of its part."""
    own = _triangles_of(field, movers, np.asarray(dataset.vertices, np.float64)[dataset.faces])
    if dataset.face_part is None or not own.any():
        return f"body {movers[0]}"
    part = int(np.bincount(dataset.face_part[own]).argmax())
    return names[part] if part < len(names) else f"part {part}"


class Comparison(NamedTuple):
    """New links beside the old ones next to them."""

    part: Ability[Calibratable]
    """The part of the field that traces paths."""
    problem: CalibrationProblem
    """All of these links, with their paths."""
    new: Int[np.ndarray, " k"]
    """Indices of the new links among its spectra."""
    evidence: Evidence
    """Scores of their transmitters, for the test."""
    remarks: list[str]
    """Remarks for the terminal."""


def compare(trained: TrainedField, old: Dataset, new: Dataset, say: Say = silent) -> Comparison:
    """Returns new links beside the old ones next to them, scored by a field with paths.

    Raises:
        UserError: the field has no paths, or there are too few old links.
    """
    part = trained.field.ability(Calibratable)
    if part is None:
        raise UserError(
            f"the {trained.config.field} field traces no paths, so that no object can be found; train one that does"
        )
    (both, group), remarks = joined(old, new)
    counts = [len(np.unique(both.tx_index[group == one])) for one in (Group.NEW, Group.OLD)]
    say(f"{counts[0]} new transmitters are compared with the {counts[1]} old ones next to them")
    data = training_data(both)
    problem = CalibrationProblem(part.field, part.field.prepare(data.links, data.receivers), data, np.arange(len(both)))
    evidence = gather(problem, part.of(trained.params), objects_of(part.field), group)
    return Comparison(part, problem, np.flatnonzero(group == Group.NEW), evidence, remarks)


def updated(trained: TrainedField, old: Dataset, new: Dataset, false_alarms: float, say: Say = silent) -> Update:
    """Returns whether a room has changed, what has, and the updated field.

    Args:
        trained: a trained field with paths.
        old: its data.
        new: new links (`check_new`).
        false_alarms: probability of finding a change where there is none.
        say: called with a description of each stage.

    Raises:
        UserError: as `compare`.
    """
    part, problem, new_links, evidence, remarks = compare(trained, old, new, say)
    field, params, rng = part.field, part.of(trained.params), np.random.default_rng(trained.config.seed)
    noticed = notice(evidence, rng)
    result = Update(noticed, [], 0.0, trained, old, np.zeros(len(old), bool), remarks)
    if noticed.p_value > false_alarms:
        return result
    of_new = dataclasses.replace(problem, spectra=new_links)
    now, own, changes = find_changes(of_new, params, limit_of(evidence, false_alarms, rng), say)
    gain_db = 0.0
    least_gain_db = 0.5  # smallest change of a common gain that is corrected
    if noticed.p_values["power"] <= false_alarms / len(STATISTICS) and abs(power_change_db(evidence)) > least_gain_db:
        gain_db = power_change_db(evidence)
        own = dataclasses.replace(own, log_gain=own.log_gain + jnp.float32(gain_db * np.log(10) / 20))
    if not changes and not gain_db:
        return result
    say("places that are affected")
    stale = affected_links(field, params, now, own, old, rng) if changes else result.stale
    replaced = cKDTree(new.tx_positions).query(old.tx_positions)[0] < SAME_PLACE_M
    names, objects = part_names(trained.config.source), objects_of(field)
    named = [dataclasses.replace(one, name=object_name(old, field, objects[one.number], names)) for one in changes]
    moves = [(one.number, None if one.shift is None else np.array(one.shift)) for one in changes]
    room = with_links(surfaces_after(old, field, moves), np.flatnonzero(~stale & ~replaced), new)
    after = dataclasses.replace(trained, field=part.put(trained.field, now), params=part.put(trained.params, own))
    return Update(noticed, named, gain_db, after, room, stale, remarks)


def lines_of(update: Update, old: Dataset) -> list[str]:
    """Returns what has changed and where it matters, for the terminal."""
    lines = []
    for one in update.changes:
        size = " x ".join(f"{metres:.2g}" for metres in one.size)
        what = f"{one.name}, {size} m at {point_words(np.array(one.centre))}"
        if one.shift is None:
            lines.append(f"gone: {what}")
        else:
            lines.append(f"moved by {np.linalg.norm(one.shift):.2f} m to {point_words(np.add(one.centre, one.shift))}: {what}")
    if update.gain_db:
        lines.append(f"common gain: {update.gain_db:+.1f} dB")
    if update.changes:
        learned = training_links(old)
        count, stale = (len(np.unique(old.tx_index[index])) for index in (learned, learned[update.stale[learned]]))
        box = box_words(old.tx_positions[learned[update.stale[learned]]])
        lines.append(f"affected: {100 * stale / count:.0f} % of {count} old transmitters{box}; their links are no longer used")
    return lines


def box_words(positions: Float[np.ndarray, "n 3"]) -> str:
    """Returns the box around positions (metres) as words; empty without any."""
    return f", from {point_words(positions.min(0))} to {point_words(positions.max(0))}" if len(positions) else ""


def write_run(folder: Path, update: Update, old: Dataset) -> None:
    """Writes the run folder of the changed room.

    Args:
        folder: new run folder.
        update: result of `updated`.
        old: data of the run before.

    Raises:
        UserError: the folder holds other files, or cannot be written.
    """
    trained, dataset = update.trained, update.dataset
    scene = scene_of(dataset, trained.config.source)
    config = dataclasses.replace(
        trained.config, source=str((folder / SCENE).resolve()), train_tx=0, test_box=(), receiver=None, convention=None
    )
    prepare_folder(folder, config, resume=False)
    with locked(folder):
        save_scene(folder / SCENE, scene)
        state = TrainState(trained.params, (), (), jnp.asarray(trained.step, jnp.int32))
        metadata = {"limits": None, "seconds": trained.seconds, "data": checksum(config.dataset())}
        checkpoint.save(folder / "checkpoints", trained.step, state, trained.field, metadata, 1)
        write_neighbours(folder, _without_places(trained.correction, old.tx_positions[update.stale]))
        stale = old.tx_positions[update.stale]
        write_confidence(folder, _far_from(trained.intervals, stale), _far_from(trained.power_intervals, stale))
        changes = [dataclasses.asdict(one) for one in update.changes]
        test = {"p_value": update.notice.p_value, "p_values": update.notice.p_values}
        write_json(folder / RECORD, test | {"changes": changes, "gain_db": update.gain_db, "lines": lines_of(update, old)})
    write_manifest(folder, load_trained(folder))


def _without_places(correction: Any, stale: Float[np.ndarray, "n 3"]) -> Any:
    """Returns measured spectra that correct predictions without those of stale places; None if none remain."""
    if correction is None or not len(stale):
        return correction
    return some_of(correction, np.flatnonzero(_elsewhere(correction, stale)))


def _far_from(intervals: C | None, stale: Float[np.ndarray, "n 3"]) -> C | None:
    """Returns a regression without stale places, unless none would remain."""
    if intervals is None or not len(stale):
        return intervals
    away = _elsewhere(intervals, stale)
    return dataclasses.replace(intervals, tx_position=intervals.tx_position[away]) if away.any() else intervals


def _elsewhere(learned: Any, stale: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " m"]:
    """Returns which places of something learned are not stale."""
    return np.asarray(cKDTree(stale).query(np.asarray(learned.tx_position))[0] > SAME_PLACE_M)


def scene_of(dataset: Dataset, source: str) -> SceneFile:
    """Returns a dataset as a scene file.

    Args:
        dataset: data; transmitters in none of its parts are left out.
        source: name of the data that it was made from, for the names of its objects.

    Raises:
        UserError: links are missing that observations of this kind cannot mark as missing.
    """
    kind, receivers = dataset.observed, dataset.receivers
    listed = np.isin(dataset.tx_index, dataset.tx_index[np.concatenate([getattr(dataset, name) for name in PARTS])])
    tx, first, row = np.unique(dataset.tx_index[listed], return_index=True, return_inverse=True)
    hertz, column = np.unique(dataset.frequencies_hz[listed], return_inverse=True)
    shape = len(tx), dataset.n_receivers, len(hertz)
    values = dataset.observations[kind.name][listed]
    missing = len(values) < np.prod(shape)
    if missing and kind.measured is None:
        raise UserError(f"the new {kind.words} must have the frequencies and receivers of the old ones; omit the others")
    grid = np.full((*shape, *values.shape[1:]), np.nan if missing else 0, values.dtype)
    grid[row, dataset.receiver_index[listed], column] = values
    split = np.zeros(len(tx), np.int8)
    for name, code in PARTS.items():
        split[np.isin(tx, dataset.tx_index[getattr(dataset, name)])] = code
    names = part_names(source)
    part = np.zeros(len(dataset.faces), np.int32) if dataset.face_part is None else dataset.face_part
    return SceneFile(
        name=dataset.name,
        tx_positions=dataset.tx_positions[listed][first],
        frequencies_hz=hertz,
        rx_position=np.asarray(receivers.position, np.float64),
        rx_orientation=np.asarray(receivers.orientation, np.float64),
        element_positions=np.asarray(receivers.element_positions, np.float64),
        vertices=dataset.vertices,
        faces=dataset.faces,
        face_part=part,
        split=split,
        others={kind.name: grid},
        element_unit=receivers.unit,
        element_pattern=tuple(_pattern(dataset, number) for number in range(dataset.n_receivers)),
        meta={"parts": _parts(dataset, part, names)},
    )


def _pattern(dataset: Dataset, number: int) -> str:
    """Returns the name of the pattern of a receiver's elements."""
    antenna = dataset.receiver(number).antenna
    for name, exponents in PATTERN_EXPONENTS.items():
        if antenna.pattern is None and np.allclose(antenna.exponents, exponents):
            return name
    raise UserError(f"receiver {number} of {dataset.name} has an antenna of its own, which scene files cannot hold")


def _parts(dataset: Dataset, part: Int[np.ndarray, " faces"], names: list[str]) -> list[dict[str, Any]]:
    """Returns the parts of a scene file with the materials of a dataset; empty if they are unknown."""
    if dataset.materials is None:
        return []
    found = []
    for number in range(int(part.max(initial=-1)) + 1):
        own = np.flatnonzero(part == number)
        material = int(dataset.materials.material[own[0]]) if len(own) else 0
        label, thickness = dataset.materials.names[material], float(dataset.materials.thickness[material])
        name = names[number] if number < len(names) else f"part {number}"
        found.append({"name": name, "material": label.rsplit(" ", 1)[0], "thickness": thickness})
    return found
