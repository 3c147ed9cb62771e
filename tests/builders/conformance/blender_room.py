"""Run by Blender's Python (`bpy`): writes rooms by its exporters into a folder, and what it knows of every object.

python blender_room.py FOLDER           truth.json: by file, by object: area, box, centroid, all in Blender's z-up world
"""

import json
import sys
from pathlib import Path

import bpy
import mathutils

from builders.conformance.shapes import Shape, floor, room


def add(name: str, shape: Shape) -> bpy.types.Object:
    """Adds an object of polygons."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(shape.vertices.tolist(), [], shape.polygons)
    mesh.update()
    made = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(made)
    return made


def begin(plain: bool = True) -> dict[str, bpy.types.Object]:
    """Begins a new file with the room; the floor is one concave polygon, and objects are turned where not plain."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    shapes = {**room(), "floor": floor(3)}
    made = {name: add(name, shape) for name, shape in shapes.items()}
    if not plain:
        for number, one in enumerate(made.values()):
            one.location, one.rotation_euler = (number, -1, 0.5), (0.3 * number, 0.2, 1.0)
            one.scale = (1, 1 + number, (-1) ** number)
    return made


def known() -> dict[str, dict]:
    """Returns areas, boxes and centroids of what Blender evaluates, in its world."""
    graph, found = bpy.context.evaluated_depsgraph_get(), {}
    graph.update()
    for instance in graph.object_instances:
        one = instance.object
        if one.type != "MESH":  # curves with a surface come as meshes too
            continue
        mesh = one.to_mesh().copy()
        mesh.transform(instance.matrix_world)
        if not mesh.polygons:
            continue
        mesh.calc_loop_triangles()
        corners = [tuple(vertex.co) for vertex in mesh.vertices]
        area, moment = 0.0, mathutils.Vector((0, 0, 0))
        for triangle in mesh.loop_triangles:
            a, b, c = (mathutils.Vector(corners[i]) for i in triangle.vertices)
            own = (b - a).cross(c - a).length / 2
            area, moment = area + own, moment + own * (a + b + c) / 3
        low, high = ([pick(axis) for axis in zip(*corners, strict=True)] for pick in (min, max))
        found.setdefault(one.name, []).append({"area": area, "low": low, "high": high, "moment": list(moment)})
    return {name: together(parts) for name, parts in found.items()}


def together(parts: list[dict]) -> dict:
    """Returns instances of one name as one."""
    area = sum(part["area"] for part in parts)
    low = [min(values) for values in zip(*(part["low"] for part in parts), strict=True)]
    high = [max(values) for values in zip(*(part["high"] for part in parts), strict=True)]
    moment = [sum(values) for values in zip(*(part["moment"] for part in parts), strict=True)]
    return {"area": area, "bounds": [low, high], "centroid": [value / area for value in moment]}


def modified() -> None:
    """Mirrors, arrays, bevels: applied as they are seen."""
    made = begin()
    mirror = made["ramp"].modifiers.new("mirror", "MIRROR")
    mirror.use_axis = (False, True, False)
    array = made["cabinet"].modifiers.new("array", "ARRAY")
    array.count, array.relative_offset_displace = 3, (1.5, 0, 0)
    made["wall"].modifiers.new("thick", "SOLIDIFY").thickness = 0.2


def below() -> None:
    """Objects below each other, below an empty one that is turned."""
    made = begin(False)
    empty = bpy.data.objects.new("house", None)
    bpy.context.collection.objects.link(empty)
    empty.rotation_euler, empty.scale = (0, 0, 0.7), (2, 2, 2)
    made["floor"].parent = empty
    made["cabinet"].parent = made["floor"]
    bpy.context.view_layer.update()


def collections() -> None:
    """A group of objects that is placed twice, beside the room."""
    begin()
    group = bpy.data.collections.new("set")
    for name, shape in (("seat", room()["cabinet"]), ("slope", room()["ramp"])):
        one = add(name, shape)
        bpy.context.collection.objects.unlink(one)
        group.objects.link(one)
    for number in range(2):
        one = bpy.data.objects.new(f"set {number}", None)
        one.instance_type, one.instance_collection = "COLLECTION", group
        one.location = (10 * number, 0, 1)
        bpy.context.collection.objects.link(one)


def odd_names() -> None:
    """Names as people give them."""
    for number, one in enumerate(begin().values()):
        one.name = ("Fußboden #1", "wall.001", "柜子", "the ramp  2")[number]


def curved(bevel: float = 0.1) -> None:
    """A curve with a bevel, which has a surface, or without one."""
    begin()
    bpy.ops.curve.primitive_nurbs_circle_add(radius=1)
    ring = bpy.context.object
    ring.name, ring.data.bevel_depth = "ring", bevel


def shared() -> None:
    """One mesh of two objects, with two materials."""
    made = begin()
    for colour in ("red", "blue"):
        made["cabinet"].data.materials.append(bpy.data.materials.new(colour))
    for polygon in made["cabinet"].data.polygons:
        polygon.material_index = polygon.index % 2
    twin = bpy.data.objects.new("twin", made["cabinet"].data)
    twin.location, twin.rotation_euler = (2, 2, 1), (0, 1, 0)
    bpy.context.collection.objects.link(twin)


def posed() -> None:
    """Keys of a shape, half-way."""
    one = begin()["ramp"]
    one.shape_key_add(name="base")
    key = one.shape_key_add(name="high")
    for point in key.data:
        point.co.z *= 2
    key.value = 0.5


def boned() -> None:
    """An armature that moves an object."""
    one = begin()["ramp"]
    bpy.ops.object.armature_add()
    bones = bpy.context.object
    one.parent = bones
    one.modifiers.new("bones", "ARMATURE").object = bones
    one.vertex_groups.new(name="Bone").add(range(6), 1.0, "REPLACE")


def exports(folder: Path) -> dict[str, object]:
    """Returns by file what makes the room and what exports it."""
    gltf, obj, ply = bpy.ops.export_scene.gltf, bpy.ops.wm.obj_export, bpy.ops.wm.ply_export
    applied = {"export_apply": True}
    return {
        "plain.glb": (begin, gltf, {}),
        "plain.gltf": (begin, gltf, {"export_format": "GLTF_SEPARATE"}),
        "turned.glb": (lambda: begin(False), gltf, {}),
        "zup.glb": (lambda: begin(False), gltf, {"export_yup": False}),
        "modified.glb": (modified, gltf, applied),
        "below.glb": (below, gltf, {}),
        "collections.glb": (collections, gltf, {}),
        "instances.glb": (collections, gltf, {"export_gpu_instances": True}),
        "names.glb": (odd_names, gltf, {}),
        "curved.glb": (curved, gltf, applied),
        "shared.glb": (shared, gltf, {}),
        "posed.glb": (posed, gltf, {}),
        "boned.glb": (boned, gltf, {}),
        "draco.glb": (begin, gltf, {"export_draco_mesh_compression_enable": True}),
        "plain.obj": (begin, obj, {}),
        "zup.obj": (lambda: begin(False), obj, {"forward_axis": "Y", "up_axis": "Z"}),
        "triangles.obj": (begin, obj, {"export_triangulated_mesh": True, "export_normals": True}),
        "groups.obj": (begin, obj, {"export_object_groups": True}),
        "names.obj": (odd_names, obj, {}),
        "modified.obj": (modified, obj, {}),
        "millimetres.obj": (begin, obj, {"global_scale": 1000.0}),
        "curved.obj": (curved, obj, {}),
        "nurbs.obj": (lambda: curved(0), obj, {"export_curves_as_nurbs": True}),
        "ply.ply": (only("ramp"), ply, {}),
        "text.ply": (only("floor"), ply, {"ascii_format": True}),
        "triangles.ply": (only("floor"), ply, {"export_triangulated_mesh": True, "export_normals": True}),
        "room.stl": (begin, bpy.ops.wm.stl_export, {}),
        "room.usdc": (begin, bpy.ops.wm.usd_export, {}),
        "room.fbx": (begin, bpy.ops.export_scene.fbx, {}),
        "room.abc": (begin, bpy.ops.wm.alembic_export, {}),
        "room.blend": (begin, bpy.ops.wm.save_as_mainfile, {}),
    }


def only(name: str):
    """Returns what makes one object of the room."""

    def make() -> None:
        for other, one in begin().items():
            if other != name:
                bpy.data.objects.remove(one)

    return make


def main(folder: Path) -> None:
    """Writes everything."""
    truth = {}
    for name, (build, export, options) in exports(folder).items():
        build()
        bpy.context.view_layer.update()
        truth[name] = known()
        export(filepath=str(folder / name), **options)
    (folder / "truth.json").write_text(json.dumps(truth))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
