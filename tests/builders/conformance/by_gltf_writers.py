"""glTF files of pygltflib: what the format allows and exporters make, and what is refused; truth by closed forms."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from builders.conformance.entries import entries
from builders.conformance.shapes import CABINET, RAMP, TURNED, Y_UP, Geometry, Shape, box, geometry

INSIDE = box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))


class Writer:
    """A document that grows."""

    def __init__(self) -> None:
        import pygltflib

        self.lib = pygltflib
        self.document = pygltflib.GLTF2(scene=0, scenes=[pygltflib.Scene(nodes=[])], asset=pygltflib.Asset())
        self.bytes = b""

    def accessor(self, values: np.ndarray, kind: str = "VEC3", stride: int | None = None, **more: Any) -> int:
        """Adds numbers, and returns the number of their accessor."""
        types = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
        self.bytes += bytes(-len(self.bytes) % 4)
        view = self.lib.BufferView(buffer=0, byteOffset=len(self.bytes), byteLength=values.nbytes, byteStride=stride)
        self.document.bufferViews.append(view)
        self.bytes += np.ascontiguousarray(values).tobytes()
        bounds = {"min": values[:, :3].min(0).tolist(), "max": values[:, :3].max(0).tolist()} if kind == "VEC3" else {}
        one = self.lib.Accessor(
            bufferView=len(self.document.bufferViews) - 1,
            componentType=types[values.dtype.str[1:]],
            count=len(values),
            type=kind,
            **{**bounds, **more},
        )
        self.document.accessors.append(one)
        return len(self.document.accessors) - 1

    def mesh(self, position: int, index: np.ndarray | None = None, mode: int = 4, width: str = "<u2", **more: Any) -> int:
        """Adds a mesh, and returns its number."""
        corners = None if index is None else self.accessor(np.ravel(index).astype(width)[:, None], "SCALAR")
        primitive = self.lib.Primitive(attributes=self.lib.Attributes(POSITION=position), indices=corners, mode=mode, **more)
        self.document.meshes.append(self.lib.Mesh(primitives=[primitive]))
        return len(self.document.meshes) - 1

    def node(self, mesh: int | None, name: str | None, root: bool = True, **more: Any) -> int:
        """Adds a node, and returns its number."""
        self.document.nodes.append(self.lib.Node(mesh=mesh, name=name, **more))
        if root:
            self.document.scenes[0].nodes.append(len(self.document.nodes) - 1)
        return len(self.document.nodes) - 1

    def save(self, path: Path) -> Path:
        """Writes the file."""
        self.document.buffers = [self.lib.Buffer(byteLength=len(self.bytes))]
        self.document.set_binary_blob(self.bytes)
        if path.suffix == ".gltf":
            self.document.convert_buffers(self.lib.BufferFormat.DATAURI)
        self.document.save(str(path))
        return path


def up(shape: Shape) -> np.ndarray:
    """Returns vertices y-up, as the file has them."""
    return shape.moved(Y_UP).vertices.astype("<f4")


def maker(name: str, build: Callable[[Writer], dict[str, Shape]], tolerance: float = 1e-4) -> Callable[[Path], Geometry]:
    """Returns a maker of a file."""

    def make(folder: Path) -> Geometry:
        writer = Writer()
        shapes = build(writer)
        return geometry(writer.save(folder / name), shapes, tolerance=tolerance)

    return make


def indexed(kind: str) -> Callable[[Writer], dict[str, Shape]]:
    """Returns a builder with corners of some width."""

    def build(writer: Writer) -> dict[str, Shape]:
        writer.node(writer.mesh(writer.accessor(up(RAMP)), RAMP.triangles, width=kind), "ramp")
        return {"ramp": RAMP}

    return build


def listed(writer: Writer) -> dict[str, Shape]:
    """Triangles without corners' numbers."""
    writer.node(writer.mesh(writer.accessor(up(RAMP)[RAMP.triangles.ravel()])), "ramp")
    return {"ramp": RAMP}


def fans(writer: Writer) -> dict[str, Shape]:
    """A fan for each polygon, which together are one object."""
    place = writer.accessor(up(CABINET))
    mesh = writer.mesh(place, np.array(CABINET.polygons[0]), 6)
    for polygon in CABINET.polygons[1:]:
        other = writer.mesh(place, np.array(polygon), 6)
        writer.document.meshes[mesh].primitives += writer.document.meshes[other].primitives
        writer.document.meshes.pop()
    writer.node(mesh, "cabinet")
    return {"cabinet": CABINET}


def strips(writer: Writer) -> dict[str, Shape]:
    """A strip of six triangles."""
    corners = np.array([[x, y, 0.5] for x in range(4) for y in (0, 2)], np.float64)
    shape = Shape(corners, [[0, 2, 3, 1], [2, 4, 5, 3], [4, 6, 7, 5]])
    writer.node(writer.mesh(writer.accessor(up(shape)), np.arange(8), 5), "shelf")
    return {"shelf": shape}


def lines(writer: Writer) -> dict[str, Shape]:
    """Points and lines stand beside triangles."""
    place = writer.accessor(up(RAMP))
    for mode in (0, 1, 2, 3):
        writer.node(writer.mesh(place, np.arange(6), mode), f"marks {mode}")
    writer.node(writer.mesh(place, RAMP.triangles), "ramp")
    return {"ramp": RAMP}


def quantised(kind: str, normalised: bool) -> Callable[[Writer], dict[str, Shape]]:
    """Returns a builder with whole numbers and a node that scales them (KHR_mesh_quantization)."""

    def build(writer: Writer) -> dict[str, Shape]:
        unit = np.iinfo(kind).max if normalised else 50
        width = 4 if kind[-1] == "1" else 8
        padded = np.zeros((8, width // np.dtype(kind).itemsize), kind)
        padded[:, :3] = np.round(2 * INSIDE.moved(Y_UP).vertices * unit)
        writer.bytes += bytes(-len(writer.bytes) % 4)
        place = writer.accessor(padded, stride=width, normalized=normalised)
        for attribute in ("extensionsUsed", "extensionsRequired"):
            setattr(writer.document, attribute, ["KHR_mesh_quantization"])
        size = [0.3, 0.9, 0.3] if normalised else [0.3 / unit, 0.9 / unit, 0.3 / unit]
        writer.node(writer.mesh(place, INSIDE.triangles), "cabinet", translation=[1.3, 0.91, -1.3], scale=size)
        return {"cabinet": CABINET}

    return build


def interleaved(writer: Writer) -> dict[str, Shape]:
    """Places and normals alternate in one view."""
    both = np.column_stack([up(RAMP), np.ones((6, 3), "<f4")]).astype("<f4")
    writer.node(writer.mesh(writer.accessor(both, stride=24), RAMP.triangles), "ramp")
    return {"ramp": RAMP}


def sparse(writer: Writer) -> dict[str, Shape]:
    """Some corners are given apart."""
    flat = up(RAMP).copy()
    flat[4:, 1] = 0
    place = writer.accessor(flat, min=up(RAMP).min(0).tolist(), max=up(RAMP).max(0).tolist())
    index, values = writer.accessor(np.array([[4], [5]], "<u2"), "SCALAR"), writer.accessor(up(RAMP)[4:])
    views = [writer.document.accessors[number].bufferView for number in (index, values)]
    writer.document.accessors[place].sparse = writer.lib.Sparse(
        count=2,
        indices=writer.lib.AccessorSparseIndices(bufferView=views[0], componentType=5123),
        values=writer.lib.AccessorSparseValues(bufferView=views[1]),
    )
    writer.node(writer.mesh(place, RAMP.triangles), "ramp")
    return {"ramp": RAMP}


def instanced(writer: Writer) -> dict[str, Shape]:
    """Copies by EXT_mesh_gpu_instancing, one of them turned."""
    half = np.sqrt(0.5)
    columns = {
        "TRANSLATION": writer.accessor(np.array([[0, 0, 0], [4, 0.5, -1]], "<f4")),
        "ROTATION": writer.accessor(np.array([[0, 0, 0, 1], [0, half, 0, half]], "<f4"), "VEC4"),
    }
    mesh = writer.mesh(writer.accessor(up(RAMP)), RAMP.triangles)
    writer.node(mesh, "ramps", extensions={"EXT_mesh_gpu_instancing": {"attributes": columns}})
    writer.document.extensionsUsed = writer.document.extensionsRequired = ["EXT_mesh_gpu_instancing"]
    other = RAMP.moved(TURNED)
    polygons = RAMP.polygons + [[corner + 6 for corner in polygon] for polygon in RAMP.polygons]
    return {"ramps": Shape(np.concatenate([RAMP.vertices, other.vertices]), polygons)}


def below(writer: Writer) -> dict[str, Shape]:
    """A node with a matrix and one with a mirror below it; a mesh without a name in the node."""
    matrix = Y_UP @ TURNED @ np.linalg.inv(Y_UP)
    mesh = writer.mesh(writer.accessor(up(RAMP)), RAMP.triangles)
    writer.document.meshes[mesh].name = "ramp"
    child = writer.node(mesh, None, False, scale=[-1, 1, 1])
    writer.node(None, "group", matrix=matrix.T.ravel().tolist(), children=[child])
    return {"ramp": RAMP.moved(TURNED @ np.diag([-1, 1, 1, 1.0]))}


def two_scenes(writer: Writer) -> dict[str, Shape]:
    """The default scene is the second one."""
    place = writer.accessor(up(RAMP))
    writer.node(writer.mesh(place, RAMP.triangles), "elsewhere", translation=[9, 0, 0])
    own = writer.node(writer.mesh(place, RAMP.triangles), "ramp", root=False)
    writer.document.scenes.append(writer.lib.Scene(nodes=[own]))
    writer.document.scene = 1
    return {"ramp": RAMP}


def morphed(writer: Writer) -> dict[str, Shape]:
    """A target that counts by its weight."""
    place, target = writer.accessor(up(RAMP)), writer.accessor(2 * up(RAMP))
    mesh = writer.mesh(place, RAMP.triangles, targets=[{"POSITION": target}])
    writer.document.meshes[mesh].weights = [0.25]
    writer.node(mesh, "ramp")
    return {"ramp": RAMP.moved(np.diag([1.5, 1.5, 1.5, 1]))}


def requiring(extension: str) -> Callable[[Writer], dict[str, Shape]]:
    """Returns a builder of a file that requires what is not read."""

    def build(writer: Writer) -> dict[str, Shape]:
        extensions = {extension: {"bufferView": 0}}
        writer.node(writer.mesh(writer.accessor(up(RAMP)), RAMP.triangles, extensions=extensions), "ramp")
        writer.document.extensionsUsed = writer.document.extensionsRequired = [extension]
        return {"ramp": RAMP}

    return build


def skinned(writer: Writer) -> dict[str, Shape]:
    """A pose moves it."""
    writer.node(writer.mesh(writer.accessor(up(RAMP)), RAMP.triangles), "ramp", skin=0)
    writer.document.skins = [writer.lib.Skin(joints=[0])]
    return {"ramp": RAMP}


FILES = {
    **{
        ("glb", f"corners of {2 ** (i + 3)} bits"): maker(f"u{i}.glb", indexed(kind))
        for i, kind in enumerate(("u1", "<u2", "<u4"))
    },
    ("glb", "triangles without corners' numbers"): maker("listed.glb", listed),
    ("glb", "fans"): maker("fans.glb", fans),
    ("gltf", "fans"): maker("fans.gltf", fans),
    ("glb", "strips"): maker("strips.glb", strips),
    ("glb", "points and lines besides"): maker("lines.glb", lines),
    ("glb", "whole numbers of 16 bits, normalised"): maker("n16.glb", quantised("<i2", True)),
    ("glb", "whole numbers of 8 bits, normalised"): maker("n8.glb", quantised("i1", True)),
    ("glb", "whole numbers of 16 bits"): maker("q16.glb", quantised("<i2", False)),
    ("glb", "places and normals alternate"): maker("woven.glb", interleaved),
    ("glb", "sparse"): maker("sparse.glb", sparse),
    ("glb", "instances"): maker("instances.glb", instanced),
    ("gltf", "matrices and mirrors below each other"): maker("below.gltf", below),
    ("glb", "two scenes"): maker("scenes.glb", two_scenes),
    ("glb", "morph targets"): maker("morph.glb", morphed),
    ("glb", "compressed by Draco"): (maker("draco.glb", requiring("KHR_draco_mesh_compression")), "refused"),
    ("glb", "compressed by meshopt"): (maker("meshopt.glb", requiring("EXT_meshopt_compression")), "refused"),
    ("glb", "an extension of somebody's own"): (maker("own.glb", requiring("VENDOR_walls")), "refused"),
    ("glb", "a skin"): (maker("skin.glb", skinned), "refused"),
}
ENTRIES = entries("pygltflib", FILES, ("pygltflib",), "pygltflib")
