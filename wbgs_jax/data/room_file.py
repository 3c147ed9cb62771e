"""A room by itself, for data that were measured in it: surfaces, the objects that they are of, and what these are made of.

One `.npz` with the arrays `vertices` (metres, world frame), `faces`, `face_part` and `meta`, JSON with `parts`: of every object
its name, material and thickness (metres; 0 where it is not known), as a scene file has them (docs/formats.md).
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_arrays, told
from wbgs_jax.data.scene_file import check_mesh

ARRAYS = ("vertices", "faces", "face_part")
FORMAT = "room 1"


@dataclass(frozen=True)
class Room:
    """Surfaces of a room."""

    vertices: Float[np.ndarray, "vertices 3"]
    """World frame, metres, float32."""
    faces: Int[np.ndarray, "faces 3"]
    """int32."""
    face_part: Int[np.ndarray, " faces"]
    """int32: the object that every triangle is of."""
    parts: Any = field(default_factory=list)
    """A list: of every object a mapping of "name", "material" and "thickness" (metres; 0: not known). As a file has it:
    `materials_of` checks it."""


def save_room(path: Path | str, room: Room) -> None:
    """Writes a room file."""
    meta = json.dumps({"format": FORMAT, "parts": room.parts}, sort_keys=True)
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **{name: getattr(room, name) for name in ARRAYS}, meta=np.array(meta))


def load_room(path: Path | str) -> Room:
    """Reads a room from a room file, or from a scene file that has a mesh.

    Raises:
        UserError: the file is missing, damaged or another one, or it holds no triangles.
    """
    path, advice = Path(path), "make it with `wbgs-jax convert room.glb --out room.npz`"
    arrays = read_arrays(path, "room file", advice, {*ARRAYS, "meta"})
    if missing := [name for name in (*ARRAYS, "meta") if name not in arrays]:
        raise UserError(f"{path} is no room file: it lacks {', '.join(missing)}; {advice}")
    with told(f"meta of room file {path}", advice):
        meta = json.loads(str(arrays.pop("meta")))
        parts = meta.get("parts", [])
    room = Room(**check_mesh(arrays, str(path)), parts=parts)
    if not len(room.faces):
        raise UserError(f"{path} holds no triangles; {advice}")
    return room
