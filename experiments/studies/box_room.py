"""A folder of meshes by material and `snapshots.npz` as a scene file: `python -m experiments.studies.box_room FOLDER OUT.npz`.

The folder's transmitters are in random order; the first four fifths train. Parts are materials of their own: what they are made
of is not said, and their thickness (0.1 m) is.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError
from wbgs_jax.data.scene_file import TEST, TRAIN, SceneFile, save_scene

THICKNESS = 0.1
"""Metres."""


def convert(folder: Path) -> SceneFile:
    """Returns the folder's content."""
    if not (folder / "snapshots.npz").exists():
        raise UserError(f"{folder} holds no snapshots.npz; give the folder of the box room's data")
    data = np.load(folder / "snapshots.npz", allow_pickle=False)
    meshes = {path.stem: trimesh.load_mesh(path) for path in sorted(folder.glob("*.ply"))}
    room: Any = trimesh.util.concatenate(list(meshes.values()))
    n_tx = len(data["tx_positions"])
    return SceneFile(
        name="box_room",
        snapshots=data["snapshots"][:, None],
        tx_positions=data["tx_positions"],
        frequencies_hz=np.round(data["frequencies_ghz"] * 1e9),
        rx_position=data["rx_position"][None],
        rx_orientation=np.array([[1.0, 0, 0, 0]]),
        element_positions=data["element_positions"][None].astype(np.float64),
        element_pattern="tr38901",
        vertices=room.vertices.astype(np.float32),
        faces=room.faces.astype(np.int32),
        face_part=np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes.values()]).astype(np.int32),
        split=np.where(np.arange(n_tx) < int(0.8 * n_tx), TRAIN, TEST).astype(np.int8),
        meta={"parts": [{"name": name, "material": name, "thickness": THICKNESS} for name in meshes]},
    )


def main() -> None:
    """Entry point."""
    if len(sys.argv) != 3:
        raise UserError("usage: python -m experiments.studies.box_room FOLDER OUT.npz")
    save_scene(sys.argv[2], convert(Path(sys.argv[1])))


if __name__ == "__main__":
    run_command(main)
