"""Reads objects from glTF 2.0 files, .gltf and .glb (Khronos specification 2.0.1): all declared triangles, or an error.

Supported: lists, strips and fans of triangles; sparse, interleaved and (normalised) integer accessors (KHR_mesh_quantization);
instanced nodes (EXT_mesh_gpu_instancing); morph targets with their default weights. Compressed primitives, skins and other
required extensions are rejected. Units are metres, y up.
"""

import base64
import json
import struct
import urllib.parse
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from wbgs_jax._util.errors import UserError
from wbgs_jax.mesh.bodies import Body, joined
from wbgs_jax.mesh.ply import Ragged, strip_triangles

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TRIANGLES, STRIP, FAN = 4, 5, 6
SUPPORTED = {
    "KHR_mesh_quantization",
    "EXT_mesh_gpu_instancing",
    "KHR_texture_transform",
    "KHR_lights_punctual",
    "EXT_texture_webp",
}
"""Extensions that may be required: supported ones that concern geometry, and ones that concern appearance and do not matter."""
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


class _File:
    """A glTF document and its binary data."""

    def __init__(self, file: Path) -> None:
        content = file.read_bytes()
        self.file, self.binary = file, b""
        text = content
        if content[:4] == b"glTF":
            text, self.binary = _chunks(content)
        self.document = json.loads(text.decode("utf-8-sig"))
        self.buffers: dict[int, bytes] = {}
        self.seen: set[int] = set()

    def of(self, kind: str, number: int) -> dict[str, Any]:
        """Returns an entry of the document.

        Raises:
            ValueError: there is no such entry.
        """
        entries = self.document.get(kind, [])
        if not 0 <= number < len(entries):
            raise ValueError(f"{kind} {number} does not exist")
        found: dict[str, Any] = entries[number]
        return found

    def buffer(self, number: int) -> bytes:
        """Returns the bytes of a buffer."""
        if number not in self.buffers:
            uri = self.of("buffers", number).get("uri")
            if uri is None:
                self.buffers[number] = self.binary
            elif uri.startswith("data:"):
                kind, data = uri.split(",", 1)
                plain = urllib.parse.unquote_to_bytes(data)
                self.buffers[number] = base64.b64decode(plain) if kind.endswith(";base64") else plain
            else:
                self.buffers[number] = (self.file.parent / urllib.parse.unquote(uri)).read_bytes()
        return self.buffers[number]

    def accessor(self, number: int, what: str) -> Float[np.ndarray, "n k"]:
        """Returns the values of an accessor, one row per element, float64.

        Raises:
            UserError: compressed data.
            ValueError: invalid sizes.
        """
        entry = self.of("accessors", number)
        count, width = int(entry["count"]), WIDTHS[entry["type"]]
        if count > 20_000_000:  # more than any room
            raise ValueError(f"it declares {count} vertices")
        kind = np.dtype(COMPONENTS[entry["componentType"]])
        if "bufferView" in entry:
            values = self._numbers(entry["bufferView"], entry.get("byteOffset", 0), kind, count, width, what)
        elif "sparse" in entry:
            values = np.zeros((count, width), kind)
        else:
            raise UserError(f"{what} has no data for {count} vertices: export it without compression")
        if "sparse" in entry:
            sparse = entry["sparse"]
            own, where = int(sparse["count"]), sparse["indices"]
            index_kind = np.dtype(COMPONENTS[where["componentType"]])
            index = self._numbers(where["bufferView"], where.get("byteOffset", 0), index_kind, own, 1, what)[:, 0]
            sparse_values = sparse["values"]
            values[index] = self._numbers(
                sparse_values["bufferView"], sparse_values.get("byteOffset", 0), kind, own, width, what
            )
        found = values.astype(np.float64)
        if entry.get("normalized") and kind.kind in "iu":
            found = np.maximum(found / np.iinfo(kind).max, -1.0)
        return found

    def _numbers(self, view: int, offset: int, kind: np.dtype, count: int, width: int, what: str) -> np.ndarray:
        entry = self.of("bufferViews", view)
        if compressed := set(entry.get("extensions", {})) & set(COMPRESSED):
            raise UserError(f"{what} is compressed by {compressed.pop()}; export it without compression")
        start = int(entry.get("byteOffset", 0)) + int(offset)
        stride = int(entry.get("byteStride") or kind.itemsize * width)
        content = self.buffer(int(entry["buffer"]))
        if (
            count < 1
            or start < 0
            or stride < kind.itemsize * width
            or start + stride * (count - 1) + kind.itemsize * width > len(content)
        ):
            raise ValueError(f"{count} rows are declared, but the data end before")
        shape, strides = (count, width), (stride, kind.itemsize)
        return np.ndarray(shape, kind, content, start, strides).copy()


def read_gltf(file: Path) -> list[Body]:
    """Returns the objects of a file, named after their nodes, which may hold several primitives.

    Raises:
        UserError: a declared object is of an unsupported kind; the message names the object.
    """
    opened = _File(file)
    document = opened.document
    appearance = ("KHR_materials_", "KHR_texture_", "MSFT_texture_", "EXT_texture_", "EXT_lights_")
    for name in document.get("extensionsRequired", []):
        if name not in SUPPORTED and not name.startswith(appearance):
            where = _first_object(document, name)
            raise UserError(f"{file} requires the extension {name}{where}, which is not supported; export it without")
    if str(document.get("asset", {}).get("version", "2"))[:1] == "1":
        raise UserError(f"{file} is of glTF version 1; export it as glTF 2.0")
    if "CESIUM_RTC" in document.get("extensions", {}):
        raise UserError(f"{file} has a centre for all objects (CESIUM_RTC), which is not supported; export it without")
    roots = _roots(document)
    bodies: list[Body] = []
    for number in roots:
        _node(opened, number, np.eye(4), bodies, 0)
    nodes = enumerate(document.get("nodes", []))
    others = [str(node.get("name") or f"node_{i}") for i, node in nodes if "mesh" in node and i not in opened.seen]
    if others:
        warnings.warn(
            f"{file}: objects outside of its scene are left out: {', '.join(others[:8])}; export a single scene "
            "if they belong to it",
            stacklevel=2,
        )
    return joined(bodies)


def _roots(document: dict[str, Any]) -> list[int]:
    scenes = document.get("scenes", [])
    if scenes:
        return list(scenes[int(document.get("scene", 0))].get("nodes", []))
    nodes = document.get("nodes", [])
    below = {child for node in nodes for child in node.get("children", [])}
    return [number for number in range(len(nodes)) if number not in below]


def _node(opened: _File, number: int, above: Float[np.ndarray, "4 4"], bodies: list[Body], depth: int) -> None:
    """Adds the bodies of a node and of its descendants."""
    node = opened.of("nodes", number)
    if depth > 200:
        raise ValueError("its nodes form a cycle")
    opened.seen.add(number)
    placed = above @ _matrix(node)
    if "mesh" in node:
        mesh = opened.of("meshes", int(node["mesh"]))
        name = str(node.get("name") or mesh.get("name") or f"node_{number}").strip()
        if "skin" in node:
            raise UserError(f"object {name!r} of {opened.file} is deformed by a skin; apply its pose and export it again")
        own = _mesh(opened, mesh, node, name)
        bodies += [
            Body(name, vertices @ one[:3, :3].T + one[:3, 3], faces)
            for one in _instances(opened, node, placed, name)
            for vertices, faces in own
        ]
    for child in node.get("children", []):
        _node(opened, int(child), placed, bodies, depth + 1)


def _matrix(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    return _transform(node.get("translation", (0, 0, 0)), node.get("rotation", (0, 0, 0, 1)), node.get("scale", (1, 1, 1)))


def _transform(translation: Any, rotation: Any, scale: Any) -> Float[np.ndarray, "4 4"]:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_quat(np.asarray(rotation, np.float64)).as_matrix() * np.asarray(scale, np.float64)
    result[:3, 3] = translation
    return result


def _instances(
    opened: _File, node: dict[str, Any], placed: Float[np.ndarray, "4 4"], name: str
) -> list[Float[np.ndarray, "4 4"]]:
    """Returns the transform of a node, or those of its instances."""
    extension = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
    if extension is None:
        return [placed]
    what = f"object {name!r} of {opened.file}"
    columns = {key: opened.accessor(int(value), what) for key, value in extension.get("attributes", {}).items()}
    count = max((len(values) for values in columns.values()), default=0)
    usual = {"TRANSLATION": (0, 0, 0), "ROTATION": (0, 0, 0, 1), "SCALE": (1, 1, 1)}
    rows = [columns.get(key, np.tile(np.array(value, float), (count, 1))) for key, value in usual.items()]
    return [placed @ _transform(*row) for row in zip(*rows, strict=True)]


def _mesh(
    opened: _File, mesh: dict[str, Any], node: dict[str, Any], name: str
) -> list[tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]]:
    """Returns vertices and triangles of every primitive that has triangles; points and lines are skipped."""
    found, what = [], f"object {name!r} of {opened.file}"
    for primitive in mesh["primitives"]:
        mode = primitive.get("mode", TRIANGLES)
        if mode not in (TRIANGLES, STRIP, FAN):
            continue
        if compressed := set(primitive.get("extensions", {})) & set(COMPRESSED):
            raise UserError(f"{what} is compressed by {compressed.pop()}; export it without compression")
        vertices = opened.accessor(int(primitive["attributes"]["POSITION"]), what)
        weights = node.get("weights", mesh.get("weights", []))
        for weight, target in zip(weights, primitive.get("targets", []), strict=False):
            if weight and "POSITION" in target:
                vertices = vertices + weight * opened.accessor(int(target["POSITION"]), what)
        index = np.arange(len(vertices))
        if "indices" in primitive:
            index = opened.accessor(int(primitive["indices"]), what)[:, 0].astype(np.int64)
        found.append((vertices, _triangles(index, mode)))
    return found


def _triangles(index: Int[np.ndarray, " n"], mode: int) -> Int[np.ndarray, "t 3"]:
    if mode == TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if mode == STRIP:
        return strip_triangles(Ragged(index, np.array([len(index)])))
    return np.stack([np.full(max(len(index) - 2, 0), index[0] if len(index) else 0), index[1:-1], index[2:]], -1)


def _first_object(document: dict[str, Any], extension: str) -> str:
    """Returns " (object NAME)" for the first object that uses an extension; empty if there is none."""
    for number, mesh in enumerate(document.get("meshes", [])):
        if any(extension in primitive.get("extensions", {}) for primitive in mesh.get("primitives", [])):
            names = [node.get("name") for node in document.get("nodes", []) if node.get("mesh") == number]
            name = next(filter(None, names), mesh.get("name", number))
            return f" (object {name!r})"
    return ""


def _chunks(content: bytes) -> tuple[bytes, bytes]:
    """Returns the JSON text and the binary data of a .glb file."""
    (version,) = struct.unpack_from("<I", content, 4)
    if version != 2:
        raise ValueError(f"it is glTF version {version}, not 2")
    text, binary, place = b"", b"", 12
    while place + 8 <= len(content):
        size, kind = struct.unpack_from("<II", content, place)
        chunk = content[place + 8 : place + 8 + size]
        if len(chunk) < size:
            raise ValueError("it is truncated")
        if kind == int.from_bytes(b"JSON", "little") and not text:
            text = chunk
        elif kind == int.from_bytes(b"BIN\0", "little") and not binary:
            binary = chunk
        place += 8 + size + -size % 4
    return text, binary
