"""Data at the edges of what can be measured: a training ends with answers that are finite, or stops with one clear sentence.

The commands of a user, train, eval and predict, on a room in which one thing is extreme.
"""

import dataclasses
import json

import numpy as np
import pytest
from builders.commands import call
from builders.synthetic import ROOM, RX, tiny_scene

from wbgs_jax._util.errors import UserError
from wbgs_jax.commands import evaluate as eval_command
from wbgs_jax.commands import predict as predict_command
from wbgs_jax.commands import train as train_command
from wbgs_jax.data.scene_file import SceneFile, save_scene

SMALL = ["--optim.steps", "4", "--optim.batch", "2"]
SMALL += ["--loop.epoch-steps", "2", "--loop.evaluate-every", "4", "--loop.evaluate-spectra", "2"]
FIELDS = {
    "hybrid": [
        "--no-neighbours",
        "--calibration.geometry",
        "--calibration.array-gain-spectra",
        "48",
        "--calibration.spurious-spectra",
        "48",
    ],
    "wideband": [],
}
"""The default and the paper's; the others are parts of these. Neighbours are asked of one, for they take as long again."""
NO_TEST = "no test spectra"


def changed(kind: str = "snapshot", n_tx: int = 9, **changes) -> SceneFile:
    """The made-up room in which some arrays are replaced: by a function of the scene, or by a value."""
    scene = tiny_scene(n_tx, kind=kind)
    found = {name: value(scene) if callable(value) else value for name, value in changes.items()}
    return dataclasses.replace(scene, **found)


def scaled(factor: float) -> SceneFile:
    """The room, its transmitters and its receiver, so many times as large."""
    names = ("vertices", "tx_positions", "rx_position")
    return changed(**{name: lambda scene, name=name: getattr(scene, name) * factor for name in names})


def noise(scene: SceneFile) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(*scene.snapshots.shape, 2)).astype(np.float32).view(np.complex64)[..., 0]


def with_first(name: str, value):
    """The array of this name with another first row."""

    def of(scene: SceneFile) -> np.ndarray:
        array = getattr(scene, name).copy()
        array[0] = value
        return array

    return of


SCENES = {
    "one transmitter": lambda: changed(n_tx=1),
    "three transmitters": lambda: changed(n_tx=3),
    "one frequency": lambda: changed(
        frequencies_hz=lambda s: s.frequencies_hz[1:2], snapshots=lambda s: s.snapshots[:, :, 1:2]
    ),
    "transmitters in a wall": lambda: changed(tx_positions=lambda s: np.where([True, False, False], ROOM[1], s.tx_positions)),
    "a transmitter at the receiver": lambda: changed(tx_positions=with_first("tx_positions", RX)),
    "all transmitters at one place": lambda: changed(tx_positions=lambda s: np.repeat(s.tx_positions[:1], 9, 0)),
    "receiver on a vertex": lambda: changed(rx_position=lambda s: s.vertices[:1].astype(float)),
    "receiver in the floor": lambda: changed(rx_position=np.array([[0.3, -0.2, 0.0]])),
    "black images": lambda: changed("pas", pas=lambda s: np.zeros_like(s.pas)),
    "white images": lambda: changed("pas", pas=lambda s: np.full_like(s.pas, 255)),
    "noisy images": lambda: changed("pas", pas=lambda s: np.random.default_rng(0).integers(0, 256, s.pas.shape, np.uint8)),
    "silence": lambda: changed(snapshots=lambda s: np.zeros_like(s.snapshots)),
    "silent while it trained": lambda: changed(snapshots=lambda s: s.snapshots * (s.split == 1)[:, None, None, None]),
    "one silent transmitter": lambda: changed(snapshots=with_first("snapshots", 0)),
    "noise": lambda: changed(snapshots=noise),
    "loud": lambda: changed(snapshots=lambda s: s.snapshots * np.float32(1e15)),
    "faint": lambda: changed(snapshots=lambda s: s.snapshots * np.float32(1e-15)),
    "a mesh of one triangle": lambda: changed(faces=lambda s: s.faces[:1], face_part=lambda s: s.face_part[:1]),
    "triangles without area": lambda: changed(
        faces=lambda s: np.concatenate([s.faces, [[0, 0, 1], [2, 2, 2]]]).astype(np.int32),
        face_part=lambda s: np.zeros(len(s.faces) + 2, np.int32),
    ),
    "kilometres": lambda: scaled(1e3),
    "millimetres": lambda: scaled(1e-3),
    "one element": lambda: changed(
        snapshots=lambda s: s.snapshots[..., :1], element_positions=lambda s: s.element_positions[:, :1]
    ),
    "elements at one place": lambda: changed(element_positions=lambda s: 0 * s.element_positions),
}
REFUSED: dict[str, str] = {
    "one transmitter": NO_TEST,
    "a transmitter at the receiver": "is at its receiver; correct its position",
    "black images": "pas contains only 0",
}
"""Words of the sentence that a case stops with; all others end."""
QUICK = {
    (case, "wideband")
    for case in ("black images", "a transmitter at the receiver", "white images", "all transmitters at one place")
}
"""In `make test-heavy` too."""
ALL = [
    pytest.param(case, field, marks=[] if (case, field) in QUICK else [pytest.mark.slow]) for case in SCENES for field in FIELDS
]


def numbers(tree) -> list[float]:
    """Returns all numbers of a JSON tree."""
    if isinstance(tree, dict):
        tree = list(tree.values())
    if isinstance(tree, list):
        return [number for branch in tree for number in numbers(branch)]
    return [tree] if isinstance(tree, float) else []


@pytest.mark.heavy
@pytest.mark.parametrize(("case", "field"), ALL)
def test_data_at_the_edges(case, field, tmp_path):
    try:
        save_scene(tmp_path / "room.npz", SCENES[case]())
    except UserError as error:  # not even written
        assert REFUSED[case] in str(error)
        return
    run, answer = tmp_path / "run", tmp_path / "answer.npz"
    stages = (
        (
            train_command,
            ("--scene", tmp_path / "room.npz", "--field", field, "--preset", "smoke", *SMALL, *FIELDS[field], "--out", run),
        ),
        (eval_command, ("--run", run)),
        (predict_command, ("--run", run, "--tx", "1,0.5,1.5", "--ghz", "10", "--out", answer)),
    )
    for command, arguments in stages:
        result = call(command.main, *arguments)
        if result.code:
            break
    if case in REFUSED:
        assert result.code == 2 and REFUSED[case] in result.err.splitlines()[-1], result.err
        return
    assert result.code == 0, result.err
    assert np.isfinite(numbers(json.loads((run / "eval.json").read_text()))).all()
    with np.load(answer) as found:
        spectrum = found["pas"]
        assert all(np.isfinite(found[name]).all() for name in found.files if found[name].dtype.kind in "fc")
    assert spectrum.shape == (1, 1, 90, 360) and spectrum.min() >= 0 and spectrum.max() <= 1
