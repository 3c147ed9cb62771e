"""Files that trimesh writes; the truth is the closed form of what it was given, and what it reads back itself."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from builders.conformance.entries import entries
from builders.conformance.shapes import (
    CABINET,
    TURNED,
    WALL,
    Y_UP,
    Geometry,
    Shape,
    extent_of_mesh,
    geometry,
    mesh_of,
    room,
)


def scene_of(shapes: dict[str, Shape], transform: np.ndarray | None = None) -> trimesh.Scene:
    """Returns a scene with a node for each shape."""
    scene = trimesh.Scene()
    for name, shape in shapes.items():
        scene.add_geometry(mesh_of(shape), node_name=name, geom_name=name, transform=transform)
    return scene


def as_read_back(path: Path, **options: float | str) -> Geometry:
    """Returns a glTF file with what trimesh finds in it at every node, turned to z-up."""
    scene = trimesh.load_scene(path)
    truth = {}
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name].copy().apply_transform(matrix).apply_transform(np.linalg.inv(Y_UP))
        truth[node] = extent_of_mesh(mesh)
    return Geometry(path, truth, **options)  # type: ignore[arg-type]


def whole(name: str, up: str | None = None, scale: float = 1.0, **how: object) -> Callable[[Path], Geometry]:
    """Returns a maker of the whole room."""

    def make(folder: Path) -> Geometry:
        shapes = room()
        turn = Y_UP if up == "y" else np.eye(4)
        turned = {key: shape.moved(turn @ np.diag([1 / scale] * 3 + [1])) for key, shape in shapes.items()}
        scene_of(turned).export(folder / name, **how)
        return geometry(folder / name, shapes, up=up, scale=scale)

    return make


def placed(folder: Path) -> Geometry:
    """Nodes with rotations, uneven scales and mirrors below each other."""
    scene = trimesh.Scene()
    scene.graph.update("house", "world", matrix=TURNED)
    for number, (name, shape) in enumerate(room().items()):
        own = trimesh.transformations.rotation_matrix(0.4 * number, (1, 2, number))
        own[:3, :3] *= (1, 0.5 + number, (-1) ** number)
        scene.add_geometry(mesh_of(shape), node_name=name, geom_name=name, parent_node_name="house", transform=own)
    scene.export(folder / "placed.glb")
    return as_read_back(folder / "placed.glb")


def repeated(folder: Path) -> Geometry:
    """One mesh at several nodes."""
    scene = trimesh.Scene(mesh_of(CABINET), base_frame="world")
    (name,) = scene.geometry
    for number in range(3):
        scene.graph.update(
            f"copy {number}", "world", matrix=trimesh.transformations.translation_matrix((number, 2, 0)), geometry=name
        )
    scene.export(folder / "repeated.glb")
    return as_read_back(folder / "repeated.glb")


def named(names: dict[str, str], file: str) -> Callable[[Path], Geometry]:
    """Returns a maker of a room whose objects have other names."""

    def make(folder: Path) -> Geometry:
        shapes = {names.get(key, key): shape.moved(np.eye(4)) for key, shape in room().items()}
        scene_of({key: shape.moved(Y_UP) for key, shape in shapes.items()}).export(folder / file)
        return geometry(folder / file, shapes, up="y")

    return make


def coloured(folder: Path) -> Geometry:
    """Materials, normals and colours beside the mesh."""
    scene = trimesh.Scene()
    for number, (name, shape) in enumerate(room().items()):
        mesh = mesh_of(shape.moved(Y_UP))
        if number % 2:
            mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=[200, 10 * number, 30, 255])
        else:
            skin = trimesh.visual.material.PBRMaterial(name=f"paint {number}", baseColorFactor=[0.2, 0.4, 0.1, 1.0])
            mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(mesh.vertices), 2)), material=skin)
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    scene.export(folder / "coloured.glb", include_normals=True)
    return geometry(folder / "coloured.glb", room())


def with_points_and_lines(folder: Path) -> Geometry:
    """A cloud and a path stand beside the meshes: they have no surface."""
    scene = scene_of({name: shape.moved(Y_UP) for name, shape in room().items()})
    scene.add_geometry(trimesh.PointCloud(np.random.default_rng(0).random((20, 3))), node_name="cloud")
    scene.add_geometry(trimesh.load_path(np.array([[0, 0, 0], [1, 1, 1.0]])), node_name="line")
    scene.export(folder / "mixed.glb")
    return geometry(folder / "mixed.glb", room())


def single(name: str, shape: Shape = CABINET, **how: object) -> Callable[[Path], Geometry]:
    """Returns a maker of one object, whose name is the file's."""

    def make(folder: Path) -> Geometry:
        mesh_of(shape).export(folder / name, **how)
        return geometry(folder / name, {Path(name).stem: shape})

    return make


def cloud(folder: Path) -> Geometry:
    """Points without faces."""
    trimesh.PointCloud(CABINET.vertices).export(folder / "cloud.ply")
    return geometry(folder / "cloud.ply", {"cloud": CABINET})


ODD = {"floor": "Fußboden #1", "wall": "wall/north.001", "cabinet": "柜子", "ramp": "a  ramp"}
HASHED = {"floor": "room#1", "wall": "room#2", "cabinet": "room#3"}
FILES = {
    ("glb", "a scene"): whole("room.glb", "y"),
    ("glb", "nodes below each other, turned, scaled and mirrored"): placed,
    ("glb", "one mesh at four nodes"): repeated,
    ("glb", "names in other alphabets, with signs"): named(ODD, "odd.glb"),
    ("glb", "materials, colours and normals"): coloured,
    ("glb", "points and lines besides"): with_points_and_lines,
    ("glb", "millimetres"): whole("mm.glb", "y", 1e-3),
    ("glb", "z up"): whole("zup.glb", "z"),
    ("gltf", "one file with its buffers inside"): whole("inside.gltf", "y", embed_buffers=True, merge_buffers=True),
    ("gltf", "names in other alphabets, with signs"): named(ODD, "odd.gltf"),
    ("obj", "a scene"): whole("room.obj"),
    ("obj", "y up"): whole("yup.obj", "y"),
    ("obj", "inches"): whole("inches.obj", scale=0.0254),
    ("obj", "names that differ behind a #"): named(HASHED, "hashed.obj"),
    ("obj", "with normals, few digits"): whole("normals.obj", include_normals=True, digits=6),
    ("ply", "binary"): single("cabinet.ply"),
    ("ply", "text"): single("text.ply", encoding="ascii"),
    ("ply", "with normals"): single("normals.ply", WALL, vertex_normal=True),
    ("ply", "points without faces"): (cloud, "refused"),
    ("off", "one object"): (single("cabinet.off"), "refused"),
    ("stl", "binary"): (single("cabinet.stl"), "refused"),
    ("stl", "text"): (single("text.stl", file_type="stl_ascii"), "refused"),
}
ENTRIES = entries("trimesh", FILES, ("trimesh",), "trimesh")
DOCUMENTS = {("dae", "one object"): (single("cabinet.dae"), "refused")}
ENTRIES += entries("trimesh", DOCUMENTS, ("trimesh", "collada"), "trimesh")
PACKED = {("3mf", "a scene"): (whole("room.3mf"), "refused")}
ENTRIES += entries("trimesh", PACKED, ("trimesh", "lxml", "networkx"), "trimesh")
