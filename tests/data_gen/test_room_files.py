"""Every format gives the same objects, in metres and z-up; damaged files are told in one line."""

import json
import re

import numpy as np
import pytest
import trimesh
from builders.own_room import WRITERS, Y_UP, load, meshes, refused, toml, write_glb, write_xml

from data_gen.example.make_room import OBJECTS, obj
from wbgs_jax.mesh.importers import read_objects


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_every_format_gives_the_same_objects(kind, scale, tmp_path):
    objects = read_objects(WRITERS[kind](tmp_path, scale), scale=1 / scale)
    expected = meshes()
    assert [o.name for o in objects] == sorted(expected)
    for found in objects:
        mesh = expected[found.name]
        np.testing.assert_allclose(found.mesh.bounds, mesh.bounds, atol=1e-4)
        np.testing.assert_allclose(found.mesh.area, mesh.area, rtol=1e-4)
        assert found.mesh.is_watertight == (found.name in ("cabinet", "table"))
    if kind != "xml":
        assert all(o.material is None for o in objects)


def test_a_mirrored_body_is_a_solid_with_normals_outward(tmp_path):
    spec = load(write_glb(tmp_path))
    assert all(p.mesh.volume > 0 and p.mesh.is_winding_consistent for p in spec.solids)
    assert [p.name for p in spec.solids] == ["cabinet", "table"]


def test_up_overrides_the_file(tmp_path):
    turned = {name: mesh.apply_transform(Y_UP) for name, mesh in meshes().items()}
    for name, mesh in turned.items():
        mesh.export(tmp_path / f"{name}.ply")
    (found,) = read_objects(tmp_path / "cabinet.ply", up="y")
    np.testing.assert_allclose(found.mesh.bounds, meshes()["cabinet"].bounds, atol=1e-6)
    (found,) = read_objects(tmp_path / "cabinet.ply")
    np.testing.assert_allclose(found.mesh.bounds, turned["cabinet"].bounds, atol=1e-6)
    assert found.name == "cabinet"
    (ceiling,) = (o for o in read_objects(write_glb(tmp_path), up="z") if o.name == "ceiling")
    np.testing.assert_allclose(ceiling.mesh.bounds[:, 1], 2.7, atol=1e-6)  # left as it is in the file


def test_obj_groups_are_objects_where_there_are_no_others(tmp_path):
    text = obj(OBJECTS).replace("\no ", "\ng ").replace("f ", "usemtl grey\nf ", 3)
    (tmp_path / "groups.obj").write_text(text)
    assert [o.name for o in read_objects(tmp_path / "groups.obj")] == sorted(OBJECTS)
    (tmp_path / "nameless.obj").write_text(re.sub("\no .*", "", obj(OBJECTS)))
    assert [o.name for o in read_objects(tmp_path / "nameless.obj")] == ["nameless"]


def test_an_object_of_two_visual_materials_is_one(tmp_path):
    scene = trimesh.Scene()
    for name, x in (("sofa", 0), ("chair", 3)):
        box = trimesh.creation.box((1, 1, 1), trimesh.transformations.translation_matrix((x, 0, 0)))
        scene.add_geometry(box, node_name=name, geom_name=name)
    scene.export(tmp_path / "two.gltf")
    header = json.loads((tmp_path / "two.gltf").read_text())
    sofa, chair = sorted(header["meshes"], key=lambda mesh: mesh["name"], reverse=True)
    sofa["primitives"] += chair["primitives"]
    (tmp_path / "two.gltf").write_text(json.dumps(header))
    found = {o.name: o.mesh for o in read_objects(tmp_path / "two.gltf")}
    assert {name: len(mesh.faces) for name, mesh in found.items()} == {"chair": 12, "sofa": 24}
    np.testing.assert_allclose(found["sofa"].bounds, [[-0.5, -0.5, -0.5], [3.5, 0.5, 0.5]])


def test_degenerate_and_repeated_triangles_are_dropped(tmp_path):
    text = "o floor\nv 0 0 0\nv 4 0 0\nv 4 4 0\nv 0 4 0\nv 2 0 0\nf 1 2 3\nf 2 3 1\nf 3 2 1\nf 1 3 4\nf 1 5 2\nf 1 1 2\n"
    (tmp_path / "a.obj").write_text(text + "o empty\nf 1 5 2\n")
    (found,) = read_objects(tmp_path / "a.obj")
    assert len(found.mesh.faces) == 2 and len(found.mesh.vertices) == 4


@pytest.mark.parametrize("faces", ["f 1 2\n", "f 1\n", "f\n", "l 1 2\n", ""])
def test_objects_without_triangles_are_dropped(faces, tmp_path):
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 4 0 0\nv 4 4 0\no floor\nf 1 2 3\no empty\n{faces}")
    (found,) = read_objects(tmp_path / "a.obj")
    assert (found.name, len(found.mesh.faces)) == ("floor", 1)
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 4 0 0\no empty\n{faces}")
    refused("a.obj.*(has no triangles|export it again)", tmp_path / "a.obj")


def test_a_scene_xml_brings_its_materials(tmp_path):
    spec = load(write_xml(tmp_path), None)
    found = {p.name: (p.material, p.thickness) for p in spec.parts}
    assert found["wall_east"] == ("concrete", 0.1)
    assert found["window"] == ("glass", 0.007)
    assert found["door"] == ("clay(4.5, 0, 0.02, 0)", 0.1)
    override = toml(tmp_path, '[objects]\nwindow = "wood"')
    found = {p.name: (p.material, p.thickness) for p in load(write_xml(tmp_path), override).parts}
    assert found["window"] == ("wood", 0.03) and found["wall_east"] == ("concrete", 0.1)


def test_a_scene_xml_moves_its_shapes(tmp_path):
    steps = (
        '<scale value="0.5"/><rotate z="1" angle="90"/><translate x="1" y="2"/>'
        '<matrix value="1 0 0 0  0 1 0 0  0 0 1 3  0 0 0 1"/>'
    )
    file = write_xml(tmp_path, transform=f'<transform name="to_world">{steps}</transform>')
    (floor,) = (o for o in read_objects(file) if o.name == "floor")
    np.testing.assert_allclose(floor.mesh.bounds, [[1 - 2.25, 2, 3], [1, 5, 3]], atol=1e-6)


@pytest.mark.parametrize("name", ["a.glb", "a.gltf", "a.obj", "a.ply", "a.xml"])
@pytest.mark.parametrize("content", [b"", b"hello", b"\xff\xfe\x00" * 50, b"ply\nformat ascii 1.0\n"])
def test_a_damaged_file(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    refused(f"{name}.*(export it again|has no triangles)", tmp_path / name)


def test_a_truncated_file(tmp_path):
    file = write_glb(tmp_path)
    file.write_bytes(file.read_bytes()[:2000])
    refused("cannot read scene file .*export it again", file)


def test_vertices_that_are_not_numbers(tmp_path):
    (tmp_path / "room.obj").write_text(obj(OBJECTS).replace("v 6 4.5 2.7", "v 6 nan 2.7"))
    refused("not finite", tmp_path / "room.obj")


def test_a_scene_xml_that_cannot_be_used(tmp_path):
    file = write_xml(tmp_path, kind="hair")
    refused("has the unsupported type 'hair'; export it as ply or obj", file, None)
    file = write_xml(tmp_path, transform='<transform name="to_world"><lookat origin="0,0,0"/></transform>')
    refused("has the transform <lookat>", file, None)
    file = write_xml(tmp_path, bsdf={"floor": "paint", "door": "missing"})
    refused("no material for 'door', 'floor'", file, None)
    file = write_xml(tmp_path)
    file.write_text(file.read_text().replace("itu_concrete", "itu_concreet"))
    refused("unknown material 'concreet'", file, None)
    (tmp_path / "meshes" / "door.ply").unlink()
    refused("needs the file .*door.ply, which is missing", file, None)
