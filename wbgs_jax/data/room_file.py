"""A room as a separate file, for data measured in it: surfaces, the objects that they belong to, and their materials.

One `.npz` with the arrays `vertices` (metres, world frame), `faces`, `face_part` and `meta`, JSON with `parts`: name, material
and thickness (metres; 0 if unknown) of every object, as in a scene file (docs/formats.md).
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
    """int32: index of the object that every triangle belongs to."""
    parts: Any = field(default_factory=list)
    """List of mappings with "name", "material" and "thickness" (metres; 0: unknown) of every object, as in the file;
    `materials_of` checks them."""


def save_room(path: Path | str, room: Room) -> None:
    """Writes a room file."""
    meta = json.dumps({"format": FORMAT, "parts": room.parts}, sort_keys=True)
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **{name: getattr(room, name) for name in ARRAYS}, meta=np.array(meta))


def load_room(path: Path | str) -> Room:
    """Reads a room from a room file, or from a scene file that has a mesh.

    Args:
        path: of the file (.npz).

    Returns:
        Vertices (metres, world frame), triangles, and objects and materials if the file names them.

    Raises:
        UserError: the file is missing, damaged or of another kind, or has no triangles.
    """
    path, advice = Path(path), "create it with `wbgs-jax convert room.glb --out room.npz`"
    arrays = read_arrays(path, "room file", advice, {*ARRAYS, "meta"})
    if missing := [name for name in (*ARRAYS, "meta") if name not in arrays]:
        raise UserError(f"{path} is not a room file: it lacks {', '.join(missing)}; {advice}")
    with told(f"meta of room file {path}", advice):
        meta = json.loads(str(arrays.pop("meta")))
        parts = meta.get("parts", [])
    room = Room(**check_mesh(arrays, str(path)), parts=parts)
    if not len(room.faces):
        raise UserError(f"{path} has no triangles; {advice}")
    return room
