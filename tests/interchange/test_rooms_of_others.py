"""Rooms as other programs write them: every triangle that a file declares, or a refusal that names the object."""

import base64
import json
import urllib.parse
from pathlib import Path

import numpy as np
import pytest
import trimesh

from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.rooms import read_room
from wbgs_jax.mesh.importers import read_objects

CASES = Path(__file__).parents[3] / "shared" / "cases"
BOX = trimesh.creation.box((1, 1, 1))
FLOOR = "o floor\nv 0 0 0\nv 6 0 0\nv 6 5 0\nv 0 5 0\nf 1 2 3 4\n"


def found(path, **options):
    """Areas, and centres of the bounding boxes, by name."""
    return {o.name: (float(o.mesh.area), tuple(np.round(o.mesh.bounds.mean(0), 4))) for o in read_objects(path, **options)}


# OBJ


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (lambda text: text, ["floor", "wall"]),
        (lambda text: text.replace(" ", "\t"), ["floor", "wall"]),
        (lambda text: "\ufeff" + text, ["floor", "wall"]),
        (lambda text: text.replace("\n", "\r\n"), ["floor", "wall"]),
        (lambda text: text.replace("f 1 2 3 4", "f -4 -3 -2 -1").replace("f 1 2 6 5", "f -6 -5 -1 -2"), ["floor", "wall"]),
        (lambda text: text.replace("f 1 2 3 4", "f 1/1/1 2//1 \\\n3/3 4"), ["floor", "wall"]),
        (lambda text: text.replace("o ", "g "), ["floor", "wall"]),
        (lambda text: text.replace("floor", "Fußboden # beneath"), ["Fußboden", "wall"]),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "latin-1"])
def test_obj_in_every_spelling(tmp_path, change, names, encoding):
    text = change(FLOOR + "o wall\nv 0 0 3\nv 6 0 3\nf 1 2 6 5\n")
    if encoding == "latin-1":
        text = text.removeprefix("\ufeff")
    (tmp_path / "a.obj").write_bytes(text.encode(encoding))
    objects = found(tmp_path / "a.obj")
    assert sorted(objects) == sorted(names)
    assert {area for area, _ in objects.values()} == {30.0, 18.0}


def test_obj_names_of_an_unknown_encoding_stay_apart(tmp_path):
    text = b"o \xb5\xd8\xb0\xe5\nv 0 0 0\nv 6 0 0\nv 6 5 0\nf 1 2 3\no \xb7\xe7\xc9\xc8\nf 3 2 1\n"
    (tmp_path / "a.obj").write_bytes(text)
    assert len(read_objects(tmp_path / "a.obj")) == 2


def test_obj_names_may_hold_signs_that_mean_something_elsewhere(tmp_path):
    """A `#` within a name, and characters of Shift-JIS whose last byte is a backslash or a line's end in Unicode."""
    (tmp_path / "a.obj").write_bytes(
        b"# from C:\\rooms\\\n" + FLOOR.replace("floor", "desk#1").encode() + b"o desk#2\nf 1 2 3 # half\n"
        b"o \x95\x5c\nv 0 0 3\nv 6 0 3\nf 1 2 6 5\no \x95\x85a\nf 1 2 6\n"
    )
    areas = {name: area for name, (area, _) in found(tmp_path / "a.obj").items()}
    assert len(areas) == 4 and areas["desk#1"] == 30 and areas["desk#2"] == 15
    assert sorted(areas.values()) == [9, 15, 18, 30]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("o room\ng floor\nf 1 2 3\ng wall\nf 1 2 4\n", ["floor", "wall"]),
        ("o room\nusemtl wood\nf 1 2 3\nusemtl glass\nf 1 2 4\n", ["glass", "wood"]),
        ("g all\nusemtl wood\nf 1 2 3\nusemtl glass\nf 1 2 4\nusemtl wood\nf 1 3 4\n", ["glass", "wood"]),
        ("o floor\ng a\nf 1 2 3\no wall\ng b\nf 1 2 4\ng c\nf 1 3 4\n", ["floor", "wall"]),
        ("g floor\nf 1 2 3\ng desk\nf 1 3 4\no wall\nf 1 2 4\n", ["desk", "floor", "wall"]),
        ("g default\no room\nusemtl a\nf 1 2 3\nf 1 2 4\n", ["room"]),
        ("usemtl wood\nf 1 2 3\n", ["a"]),
    ],
)
def test_obj_is_divided_by_objects_or_groups_or_materials(tmp_path, text, names):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 6 0 0\nv 6 5 0\nv 0 0 3\n" + text)
    assert sorted(found(tmp_path / "a.obj")) == names


def test_obj_with_curved_surfaces_is_refused(tmp_path):
    (tmp_path / "a.obj").write_text(FLOOR + "o vase\ncstype bspline\nsurf 0 1 0 1 1 2 3 4\n")
    with pytest.raises(UserError, match=r"object 'vase' .* curved surface"):
        read_objects(tmp_path / "a.obj")


def test_obj_with_vertices_in_a_plane_is_refused(tmp_path):
    (tmp_path / "a.obj").write_text("o floor\n" + "v 0 0\nv 5 0\nv 5 5\n" * 2 + "f 1 2 3\n")
    with pytest.raises(UserError, match=r"a\.obj has the vertex 'v 0 0' without x, y and z"):
        read_objects(tmp_path / "a.obj")


def test_obj_that_calls_another_file_is_refused_and_outlines_are_faces(tmp_path):
    (tmp_path / "a.obj").write_text(FLOOR.replace("f ", "fo "))
    assert found(tmp_path / "a.obj")["floor"][0] == 30
    (tmp_path / "a.obj").write_text(FLOOR + "call walls.obj\n")
    with pytest.raises(UserError, match=r"a\.obj calls another file \(walls\.obj\); export it in one"):
        read_objects(tmp_path / "a.obj")


@pytest.mark.parametrize("corner", ["0", "-9"])
def test_obj_with_corners_that_are_none(tmp_path, corner):
    (tmp_path / "a.obj").write_text(FLOOR + f"f 1 2 {corner}\n")
    with pytest.raises(UserError, match="which does not exist"):
        read_objects(tmp_path / "a.obj")


# glTF


class Gltf:
    """A document with one box, to be changed."""

    def __init__(self):
        self.bytes = b""
        self.document = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": "cabinet"}], "meshes": [], "accessors": [], "bufferViews": [],
        }  # fmt: skip

    def add(self, values, kind="VEC3", **more):
        values = np.ascontiguousarray(values)
        component = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}[values.dtype.str[1:]]
        self.bytes += b"\0" * (-len(self.bytes) % 4)
        self.document["bufferViews"].append({"buffer": 0, "byteOffset": len(self.bytes), "byteLength": values.nbytes})
        self.bytes += values.tobytes()
        entry = {"bufferView": len(self.document["bufferViews"]) - 1, "componentType": component, "count": len(values)}
        self.document["accessors"].append(entry | {"type": kind} | more)
        return len(self.document["accessors"]) - 1

    def mesh(self, vertices, index=None, mode=4, **more):
        primitive = {"attributes": {"POSITION": self.add(vertices)}, "mode": mode} | more
        if index is not None:
            primitive["indices"] = self.add(np.ravel(index).astype("<u2"), "SCALAR")
        self.document["meshes"].append({"primitives": [primitive]})
        return self

    def write(self, path):
        data = "data:application/octet-stream;base64," + base64.b64encode(self.bytes).decode()
        self.document["buffers"] = [{"byteLength": len(self.bytes), "uri": data}]
        path.write_text(json.dumps(self.document))
        return path


VERTICES, FACES = BOX.vertices.astype("<f4"), BOX.faces
STRIP = np.array([3, 2, 6, 7, 4, 2, 0, 3, 1, 6, 5, 4, 1, 0])
"""A cube by one strip of its corners, numbered as below."""
CORNERS = np.array(
    [[0.5, 0.5, 0.5], [-0.5, 0.5, 0.5], [0.5, 0.5, -0.5], [-0.5, 0.5, -0.5], [0.5, -0.5, 0.5], [-0.5, -0.5, 0.5],
     [-0.5, -0.5, -0.5], [0.5, -0.5, -0.5]], "<f4")  # fmt: skip


def cabinet(gltf, tmp_path):
    """Area and centre, y up as in the file."""
    return found(gltf.write(tmp_path / "a.gltf"), up="z")["cabinet"]


def test_gltf_lists_strips_and_fans(tmp_path):
    assert cabinet(Gltf().mesh(VERTICES, FACES), tmp_path) == (pytest.approx(6), (0, 0, 0))
    assert cabinet(Gltf().mesh(VERTICES[FACES.ravel()]), tmp_path)[0] == pytest.approx(6)  # without indices
    assert cabinet(Gltf().mesh(CORNERS, STRIP, 5), tmp_path)[0] == pytest.approx(6)
    fan = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [1, 3, 0], [0, 2, 0]], "<f4")
    assert cabinet(Gltf().mesh(fan, None, 6), tmp_path)[0] == pytest.approx(5)


def test_gltf_accessors_of_every_kind(tmp_path):
    """Integers, normalised or not; interleaved; sparse ones, with or without a base."""
    signed = Gltf().mesh((VERTICES * 2 * 32767).astype("<i2"), FACES)
    signed.document["accessors"][0]["normalized"] = True
    assert cabinet(signed, tmp_path) == (pytest.approx(24, rel=1e-3), (0, 0, 0))
    plain = Gltf().mesh((VERTICES * 200).astype("<i2"), FACES)
    plain.document["nodes"][0] |= {"scale": [0.01, 0.01, 0.01], "translation": [1, 2, 3]}
    assert cabinet(plain, tmp_path) == (pytest.approx(24), (1, 2, 3))
    wide = Gltf().mesh(np.column_stack([VERTICES, VERTICES * 9]).astype("<f4"), FACES)
    wide.document["bufferViews"][0]["byteStride"] = 24
    assert cabinet(wide, tmp_path) == (pytest.approx(6), (0, 0, 0))
    moved = VERTICES.copy()
    top = np.flatnonzero(VERTICES[:, 1] > 0)
    moved[top, 1] = -0.5  # flat, but for what is sparse
    sparse = Gltf().mesh(moved, FACES)
    index, values = sparse.add(top.astype("<u2"), "SCALAR"), sparse.add(VERTICES[top])
    views = [sparse.document["accessors"][number] for number in (index, values)]
    sparse.document["accessors"][0]["sparse"] = {
        "count": len(top),
        "indices": {"bufferView": views[0]["bufferView"], "componentType": 5123},
        "values": {"bufferView": views[1]["bufferView"]},
    }
    assert cabinet(sparse, tmp_path)[0] == pytest.approx(6)
    del sparse.document["accessors"][0]["bufferView"]  # from zeros
    assert cabinet(sparse, tmp_path)[0] < 6


def test_gltf_buffers_inside_in_both_codings(tmp_path):
    gltf = Gltf().mesh(VERTICES, FACES)
    text = json.loads(gltf.write(tmp_path / "a.gltf").read_text())
    text["buffers"][0]["uri"] = "data:application/octet-stream," + urllib.parse.quote_from_bytes(gltf.bytes)
    (tmp_path / "a.gltf").write_text(json.dumps(text))
    assert found(tmp_path / "a.gltf", up="z")["cabinet"] == (pytest.approx(6), (0, 0, 0))


def test_gltf_instances_and_morph_targets(tmp_path):
    many = Gltf().mesh(VERTICES, FACES)
    places = many.add(np.array([[0, 0, 0], [4, 0, 0], [0, 0, 6]], "<f4"))
    many.document["nodes"][0] |= {
        "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}}, "translation": [1, 0, 0]
    }  # fmt: skip
    many.document |= {"extensionsUsed": ["EXT_mesh_gpu_instancing"], "extensionsRequired": ["EXT_mesh_gpu_instancing"]}
    assert cabinet(many, tmp_path) == (pytest.approx(18), (3, 0, 3))
    grown = Gltf().mesh(VERTICES, FACES)
    grown.document["meshes"][0] |= {"weights": [0.5]}
    grown.document["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": grown.add(2 * VERTICES)}]
    assert cabinet(grown, tmp_path)[0] == pytest.approx(24)


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "VENDOR_walls"])
def test_gltf_that_requires_more_is_refused(tmp_path, name):
    gltf = Gltf().mesh(VERTICES, FACES, extensions={name: {"bufferView": 0}})
    gltf.document |= {"extensionsUsed": [name], "extensionsRequired": [name]}
    with pytest.raises(UserError, match=rf"requires the extension {name} \(object 'cabinet'\), which is not supported"):
        read_objects(gltf.write(tmp_path / "a.gltf"))
    del gltf.document["extensionsRequired"]
    if "VENDOR" not in name:
        with pytest.raises(UserError, match=f"object 'cabinet' .* is compressed by {name}"):
            read_objects(gltf.write(tmp_path / "a.gltf"))


def test_gltf_with_a_skin_is_refused(tmp_path):
    gltf = Gltf().mesh(VERTICES, FACES)
    gltf.document["nodes"][0]["skin"] = 0
    with pytest.raises(UserError, match=r"object 'cabinet' .* is deformed by a skin"):
        read_objects(gltf.write(tmp_path / "a.gltf"))


def test_gltf_objects_outside_of_its_scene_are_noted(tmp_path):
    gltf = Gltf().mesh(VERTICES, FACES)
    gltf.document["nodes"] += [{"mesh": 0, "name": "wall"}, {"mesh": 0}]
    gltf.document["scenes"].append({"nodes": [1]})
    with pytest.warns(
        UserWarning, match=r"a\.gltf: objects outside of its scene are left out: wall, node_2; export a single scene"
    ):
        assert list(found(gltf.write(tmp_path / "a.gltf"))) == ["cabinet"]


def test_gltf_against_trimesh(tmp_path, rng):
    """Nested nodes with rotations, scales and mirrors."""
    scene = trimesh.Scene()
    for name in ("a", "b", "c"):
        matrix = trimesh.transformations.random_rotation_matrix(rng.random(3))
        matrix[:3, :3] *= rng.uniform(0.5, 2, 3) * [1, 1, -1]
        matrix[:3, 3] = rng.normal(size=3)
        scene.add_geometry(trimesh.creation.icosphere(2), node_name=name, geom_name=name, transform=matrix)
    scene.export(tmp_path / "a.glb")
    ours = found(tmp_path / "a.glb", up="z")
    for name in ("a", "b", "c"):
        matrix, geometry = scene.graph[name]
        mesh = scene.geometry[geometry].copy().apply_transform(matrix)
        assert ours[name] == (pytest.approx(mesh.area, rel=1e-4), pytest.approx(tuple(mesh.bounds.mean(0)), abs=2e-4))


# PLY


def test_ply_of_strips_and_of_points_alone(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
    points = "0 0 0\n1 0 0\n0 1 0\n1 1 0\n0 2 0\n1 2 0\n"
    strips = "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(head + strips + points + "9 0 1 2 3 -1 2 3 4 5\n")
    (strip,) = read_objects(tmp_path / "a.ply")
    assert len(strip.mesh.faces) == 4 and strip.mesh.area == pytest.approx(2) and strip.mesh.is_winding_consistent
    (tmp_path / "b.ply").write_text(head + "end_header\n" + points)
    with pytest.raises(UserError, match="points without faces"):
        read_objects(tmp_path / "b.ply")


# Mitsuba


XML = '<scene version="2.1.0"><default name="high" value="2"/>{}</scene>'
SHAPES = {
    "rectangle": (4.0, '<scale x="1" y="1"/>'),
    "cube": (24.0, ""),
    "disk": (np.pi, ""),
    "sphere": (4 * np.pi, ""),
    "cylinder": (2 * np.pi, ""),
}


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("transform", ["to_world", "toWorld"])
def test_mitsuba_shapes_that_are_built_in(tmp_path, kind, transform):
    area, steps = SHAPES[kind]
    shape = f'<shape type="{kind}" id="a"><transform name="{transform}">{steps}<translate x="1" z="$high"/></transform></shape>'
    (tmp_path / "a.xml").write_text(XML.format(shape))
    measured, centre = found(tmp_path / "a.xml")["a"]
    assert measured == pytest.approx(area, rel=5e-3)
    np.testing.assert_allclose(centre, (1, 0, 2.5 if kind == "cylinder" else 2), atol=1e-6)


def test_mitsuba_spheres_and_cylinders_have_their_own_places(tmp_path):
    ball = '<shape type="sphere" id="ball"><point name="center" x="1" y="2" z="3"/><float name="radius" value="0.5"/></shape>'
    ends = '<point name="p0" value="0, 0, 0"/><point name="p1" value="0, 4, 0"/><float name="radius" value="0.1"/>'
    (tmp_path / "a.xml").write_text(XML.format(ball + f'<shape type="cylinder" id="pipe">{ends}</shape>'))
    objects = found(tmp_path / "a.xml")
    assert objects["ball"] == (pytest.approx(np.pi, rel=5e-3), (1, 2, 3))
    assert objects["pipe"] == (pytest.approx(0.8 * np.pi, rel=5e-3), (0, 2, 0))


def test_mitsuba_writes_names_and_vectors_for_ids_and_points(tmp_path):
    ball = (
        '<shape type="sphere" name="ball"><vector name="center" x="1" y="2" z="3"/><float name="radius" value="0.5"/></shape>'
    )
    (tmp_path / "a.xml").write_text(XML.format(ball))
    assert found(tmp_path / "a.xml") == {"ball": (pytest.approx(np.pi, rel=5e-3), (1, 2, 3))}


def test_mitsuba_numbers_may_be_integers(tmp_path):
    material = '<bsdf type="radio-material" id="clay">{}</bsdf>'
    values = "".join(
        f'<integer name="{name}" value="{value}"/>'
        for name, value in (("relative_permittivity", 4), ("conductivity", 1), ("thickness", 2))
    )
    ball = '<shape type="sphere" id="ball"><integer name="radius" value="2"/><ref id="clay"/></shape>'
    (tmp_path / "a.xml").write_text(XML.format(material.format(values) + ball))
    (read,) = read_objects(tmp_path / "a.xml")
    assert read.mesh.area == pytest.approx(16 * np.pi, rel=5e-3) and read.material == ("clay", 2.0, (4.0, 1.0))
    (tmp_path / "a.xml").write_text(XML.format(material.format('<float name="eta_r" value="4"/>') + ball))
    with pytest.raises(
        UserError, match=r"material 'clay' of .*a\.xml has the unknown property 'eta_r'; it may have relative_p"
    ):
        read_objects(tmp_path / "a.xml")


def test_mitsuba_names_that_nobody_fills_in_and_files_of_windows(tmp_path):
    (tmp_path / "meshes").mkdir()
    BOX.export(tmp_path / "meshes" / "box.ply")
    shape = '<shape type="ply" id="mesh-box"><string name="filename" value="{}"/></shape>'
    (tmp_path / "a.xml").write_text(XML.format(shape.format("meshes\\box.ply")))
    assert found(tmp_path / "a.xml") == {"box": (pytest.approx(6), (0, 0, 0))}
    (tmp_path / "b.xml").write_text(XML.format(shape.format("$folder/box.ply")))
    with pytest.raises(UserError, match=r"has no value for '\$folder/box.ply'; add a <default>"):
        read_objects(tmp_path / "b.xml")


# Other kinds, and places far away


@pytest.mark.parametrize("name", ["house.ifc", "plan.dxf", "walls.svg", "street.geojson", "room.fbx", "room.blend"])
def test_other_kinds_are_refused_by_what_they_are(tmp_path, name):
    (tmp_path / name).write_text("anything")
    with pytest.raises(UserError, match=r"room|drawing|building|map|Autodesk|Blender"):
        read_objects(tmp_path / name)


@pytest.mark.parametrize("away", [3e4, 4.5e6])
def test_map_coordinates_are_refused(tmp_path, away):
    (tmp_path / "a.obj").write_text(f"v {away} 0 0\nv {away + 6} 0 0\nv {away} 5 0\nf 1 2 3\n")
    with pytest.raises(UserError, match="single precision is too coarse for waves; subtract a point on the site"):
        read_objects(tmp_path / "a.obj")


# Units and axes


@pytest.mark.parametrize(
    ("name", "comment", "scale"),
    [
        ("a.obj", "# Alias OBJ Model File\n# Exported from SketchUp, (c) 2000-2012\n# File units = inches\n\n", "0.0254"),
        ("a.obj", "# This file uses centimeters as units for non-parametric coordinates.\n\n", "0.01"),
        ("a.obj", "# Units: mm\n", "0.001"),
        ("a.obj", "# File units = meters\n", ""),
        ("a.obj", "# Exported unit by unit\n", ""),
        ("a.ply", "comment units: cm\n", "0.01"),
    ],
)
def test_a_unit_that_a_file_states_is_never_taken_for_the_metre(tmp_path, name, comment, scale):
    ply = "ply\nformat ascii 1.0\n{}element vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
    ply += "property list uchar int vertex_indices\nend_header\n0 0 0\n6 0 0\n6 5 0\n3 0 1 2\n"
    (tmp_path / name).write_text(ply.format(comment) if name.endswith("ply") else comment + FLOOR)
    if scale:
        with pytest.raises(UserError, match=f"{name} states that its unit is .*; read it with --scale {scale}, or"):
            read_room(tmp_path / name, named=False)
    (one,) = read_room(tmp_path / name, named=False, scale=1.0 if scale else None)
    assert one.mesh.bounds[1, 0] == pytest.approx(6)


def test_rooms_on_their_side_are_refused(tmp_path):
    """A floor that spans the room reveals it; walls of a ground floor, lamps and mirrors do not."""
    corners = np.array([[0, 0, 0], [6, 0, 0], [6, 5, 0], [0, 5, 0], [0, 0, 2.5], [6, 0, 2.5]])
    text = "o {}\nf 1 2 3 4\no {}\nf 1 2 6 5\n"

    def room(first, second, axes):
        lines = "".join("v {:g} {:g} {:g}\n".format(*corner) for corner in corners[:, axes] * [1, 1, -1])
        (tmp_path / "a.obj").write_text(lines + text.format(first, second))
        return {one.name: one for one in read_room(tmp_path / "a.obj", named=False)}

    for name in ("Floor01", "IfcSlab_3", "Boden", "floor.001"):
        with pytest.raises(UserError, match=f"a.obj lies on its side: '{name}' is upright; give --up y, "):
            room(name, "north", [0, 2, 1])
        assert room(name, "north", [0, 1, 2])
    for name in ("ground floor wall", "background", "plate"):
        assert room(name, "north", [0, 2, 1])
    (one,) = read_room(tmp_path / "a.obj", named=False, up="y")[:1]
    assert one.mesh.extents[2] == pytest.approx(2.5)


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ({"asset": {"version": "1.0"}}, "is of glTF version 1; export it as glTF 2.0"),
        ({"extensions": {"CESIUM_RTC": {"center": [100, 0, 0]}}}, "a centre for all objects .CESIUM_RTC., which is not"),
    ],
)
def test_gltf_of_other_versions_and_centres_is_refused(tmp_path, extra, words):
    (tmp_path / "a.gltf").write_text(json.dumps({"asset": {"version": "2.0"}} | extra))
    with pytest.raises(UserError, match=f"a.gltf .*{words}"):
        read_objects(tmp_path / "a.gltf")


def test_thickness_as_text_and_materials_after_a_byte_order_mark(tmp_path):
    material = (
        '<bsdf type="itu-radio-material" id="m"><string name="type" value="concrete"/><string name="thickness" value="0.3"/>'
    )
    (tmp_path / "a.xml").write_text(f'<scene>{material}</bsdf><shape type="cube" id="c"><ref id="m"/></shape></scene>')
    (one,) = read_room(tmp_path / "a.xml")
    assert one.slab[:2] == ("concrete", 0.3)
    (tmp_path / "m.toml").write_bytes(b'\xef\xbb\xbf[objects]\nc = "wood"\n')
    (one,) = read_room(tmp_path / "a.xml", tmp_path / "m.toml")
    assert one.slab.material == "wood"


@pytest.mark.skipif(not CASES.exists(), reason="the small inputs are not beside the repository")
def test_small_inputs_that_were_read_wrongly():
    for path in sorted((CASES / "polygons").glob("*")):
        ((area, _),) = found(path).values()
        assert area == pytest.approx(18), path
    for path in sorted((CASES / "obj").glob("*")):
        assert found(path) == {"floor": (30, (3, 2.5, 0)), "box": (pytest.approx(6), (3, 3, 0.6))}, path
    for path in sorted((CASES / "scene_xml").glob("*.xml")):
        (cube,) = (place for area, place in found(path).values() if area < 10)
        assert cube == (3, 3, 1.2 if path.stem == "transform_v06" else 0.6), path
    rows = {o.name: o.mesh for o in read_objects(CASES / "glb" / "instancing.glb")}
    assert len(rows["cabinet"].faces) == 48
    for name in ("quantized", "quantized_int"):
        cabinet = {o.name: o.mesh for o in read_objects(CASES / "glb" / f"{name}.glb")}["cabinet"]
        np.testing.assert_allclose(cabinet.bounds, [[1, 1, 0.01], [1.6, 1.6, 1.81]], atol=1e-3)
