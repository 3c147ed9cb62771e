"""Files that Blender's exporters write; the truth is what Blender knows of the objects in its own world.

Blender runs in a process of its own, once: its module brings libraries along that others have too.
"""

import functools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from builders import PYTHONPATH
from builders.conformance.entries import entries
from builders.conformance.shapes import Extent, Geometry

HERE = Path(__file__).parent


@functools.cache
def rooms() -> tempfile.TemporaryDirectory:
    """Returns the folder with all files, which goes when the process ends."""
    folder = tempfile.TemporaryDirectory(prefix="conformance-blender-")
    environment = os.environ | {"PYTHONPATH": PYTHONPATH}
    command = [sys.executable, str(HERE / "blender_room.py"), folder.name]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0 and (Path(folder.name) / "truth.json").exists(), done.stdout[-2000:] + done.stderr[-2000:]
    return folder


def blender(name: str, up: str | None = None, scale: float = 1.0, alone: bool = False) -> Callable[[Path], Geometry]:
    """Returns a maker of one of the files; `alone` where the file names no object, so that its own name is the object's."""

    def make(folder: Path) -> Geometry:
        made = Path(rooms().name)
        for path in made.glob(Path(name).stem + ".*"):
            shutil.copy(path, folder)
        known = json.loads((made / "truth.json").read_text())[name]
        extents = {
            key: Extent(value["area"], np.array(value["bounds"]), np.array(value["centroid"])) for key, value in known.items()
        }
        if alone:
            extents = {Path(name).stem: next(iter(extents.values()))}
        return Geometry(folder / name, extents, up, scale)

    return make


def renamed(name: str, rule: Callable[[str], str]) -> Callable[[Path], Geometry]:
    """Returns a maker of an OBJ file, for whose names Blender has a rule."""

    def make(folder: Path) -> Geometry:
        found = blender(name, "y")(folder)
        found.truth = {rule(key): extent for key, extent in found.truth.items()}
        return found

    return make


FILES = {
    ("glb", "a room with a concave polygon"): blender("plain.glb"),
    ("gltf", "buffers in a file of their own"): blender("plain.gltf"),
    ("glb", "objects turned, scaled and mirrored"): blender("turned.glb"),
    ("glb", "z up"): blender("zup.glb", "z"),
    ("glb", "modifiers: mirror, array, thickness"): blender("modified.glb"),
    ("glb", "objects below each other"): blender("below.glb"),
    ("glb", "a collection placed twice"): blender("collections.glb"),
    ("glb", "a collection placed twice, as instances"): blender("instances.glb"),
    ("glb", "names in other alphabets, with signs"): blender("names.glb"),
    ("glb", "a curve with a bevel"): blender("curved.glb"),
    ("glb", "one mesh of two objects and two materials"): blender("shared.glb"),
    ("glb", "keys of a shape, half-way"): blender("posed.glb"),
    ("glb", "an armature"): (blender("boned.glb"), "refused"),
    ("glb", "compressed by Draco"): (blender("draco.glb"), "refused"),
    ("obj", "a room with a concave polygon, y up"): blender("plain.obj", "y"),
    ("obj", "z up"): blender("zup.obj"),
    ("obj", "triangles with normals"): blender("triangles.obj", "y"),
    ("obj", "groups named by object and mesh"): renamed("groups.obj", lambda name: f"{name}_{name}"),
    ("obj", "names in other alphabets, with signs"): renamed("names.obj", lambda name: name.replace(" ", "_")),
    ("obj", "modifiers: mirror, array, thickness"): blender("modified.obj", "y"),
    ("obj", "millimetres"): blender("millimetres.obj", "y", 0.001),
    ("obj", "a curve with a bevel"): blender("curved.obj", "y"),
    ("obj", "a curve as NURBS"): (blender("nurbs.obj", "y"), "refused"),
    ("ply", "polygons"): blender("ply.ply", alone=True),
    ("ply", "a concave polygon, text"): blender("text.ply", alone=True),
    ("ply", "triangles with normals"): blender("triangles.ply", alone=True),
    **{(kind, "a room"): (blender(f"room.{kind}"), "refused") for kind in ("stl", "usdc", "fbx", "abc", "blend")},
}
ENTRIES = entries("Blender", FILES, ("bpy",), "bpy")
