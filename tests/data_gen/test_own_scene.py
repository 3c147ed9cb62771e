"""A user's own scene: every mistake is told in one line, and the guide's example works."""

import re
import shlex
import tomllib
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import trimesh
import tyro
from builders.own_room import (
    FREQUENCIES,
    GRID,
    ROOM,
    RX,
    TOML,
    load,
    meshes,
    refused,
    shape,
    toml,
    with_object,
    write_obj,
    write_xml,
)

from data_gen.example.make_room import OBJECTS, obj
from data_gen.own_scene import describe, own_scene
from wbgs_jax._util.errors import UserError
from wbgs_jax.data.scene_file import load_scene

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / "docs" / "own_scene.md").read_text()


# The example and the guide


def test_the_example_is_what_its_script_writes():
    assert ROOM.read_text() == obj(OBJECTS)


def test_the_example_is_understood():
    spec = load()
    found = {p.name: (p.material, p.thickness, p.kind) for p in spec.parts}
    assert found == {
        "cabinet": ("metal", 0.002, "solid"),
        "ceiling": ("ceiling_board", 0.02, "shell"),
        "door": ("wood", 0.04, "shell"),
        "floor": ("wood", 0.03, "shell"),
        "table": ("oiled_oak(2.2, 0, 0.006, 1)", 0.04, "solid"),
        "wall_east": ("plasterboard", 0.1, "shell"),
        "wall_north": ("concrete", 0.25, "shell"),
        "wall_south": ("plasterboard", 0.1, "shell"),
        "wall_west": ("plasterboard", 0.1, "shell"),
        "window": ("glass", 0.006, "shell"),
    }
    assert spec.name == "room" and spec.rx_position == (0.8, 2.4, 1.2) and spec.frequencies_hz == FREQUENCIES
    np.testing.assert_allclose(spec.bounds(), [[0, 0, 0], [6, 4.5, 2.7]])
    assert all(p.mesh.volume > 0 for p in spec.solids)
    area = sum(p.mesh.area for p in spec.parts if not p.closed)
    np.testing.assert_allclose(area, 2 * (6 * 4.5 + 6 * 2.7 + 4.5 * 2.7))  # holes are cut and filled
    lines = describe(spec).splitlines()
    assert len(lines) == 10 and "concrete" in lines[6] and "0.25 m" in lines[6] and "sheet" in lines[6]


def test_transmitters_of_the_example_are_free():
    spec = load()
    tx = spec.accessible_tx()
    assert len(spec.tx_grid) == 252 and 200 < len(tx) < 252
    assert not spec.inside_objects(tx).any() and spec.distance(tx).min() >= 0.1


def test_the_guide_shows_the_example():
    shown = re.search(r"```toml\n(.*?)```", GUIDE, re.DOTALL)
    assert shown and tomllib.loads(shown[1]) == tomllib.loads(TOML.read_text())


def test_the_guide_lists_every_material():
    from wbgs_jax.interchange.rooms import ITU

    text = GUIDE[GUIDE.index("The materials of ITU-R P.2040") :]
    for name, (thickness, low, _) in ITU.items():
        assert f"`{name}` {thickness:g}" in text or low > 100, name


def commands():
    blocks = re.findall(r"```bash\n(.*?)```", GUIDE, re.DOTALL)
    return [line for block in blocks for line in block.replace("\\\n", " ").splitlines() if line.startswith("python")]


@pytest.mark.parametrize("command", commands())
def test_commands_of_the_guide_are_understood(command, monkeypatch):
    monkeypatch.chdir(ROOT)
    _, _, module, *arguments = shlex.split(command)
    options = tyro.cli(import_module(module).Options, args=arguments)
    spec = own_scene(Path(options.scene), options.materials, rx=options.rx, tx_grid=options.tx_grid)
    assert len(spec.parts) == len(OBJECTS)


def test_the_whole_command_and_the_checks_of_the_guide(simulator_backend, tmp_path, monkeypatch, capsys):
    from data_gen.generate import Options, generate

    monkeypatch.setattr("data_gen.options.CEILING_TX", 2)
    for name, samples in (("room_trial", 2000), ("room_more_rays", 4000)):
        options = Options(
            scene=str(ROOM), materials=TOML, rx=RX, tx_grid=GRID, frequencies=(2.4, 60.0), work=tmp_path / "work",
            out=tmp_path / "runs" / f"{name}.npz", samples=samples, depth=1, max_paths=2000, max_tx=20, diffraction=False,
            workers=1,
        )  # fmt: skip
        scene = load_scene(generate(options))
    assert scene.snapshots.shape == (20, 1, 2, 16) and (np.abs(scene.snapshots).max(-1) > 0).all()
    assert {p["name"]: p["material"] for p in scene.meta["parts"]}["table"] == "oiled_oak(2.2, 0, 0.006, 1)"
    monkeypatch.chdir(tmp_path)
    for code in re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL):
        names: dict = {}
        exec(compile(code, "docs/own_scene.md", "exec"), names)
        if "angle" in names:
            assert np.median(names["angle"][names["above"]]) < 15
        else:
            assert (np.median(names["correlation"], 0) > 0.9).all()
    assert "median angle" in capsys.readouterr().out


# Solids, sheets and the room


def test_one_closed_mesh_around_everything_is_the_room(tmp_path):
    scene = trimesh.Scene()
    room = trimesh.creation.box((6, 4.5, 2.7))
    room.apply_translation((3, 2.25, 1.35))
    scene.add_geometry(room, node_name="room", geom_name="room")
    scene.add_geometry(meshes()["cabinet"], node_name="cabinet", geom_name="cabinet")
    scene.export(tmp_path / "scene.obj")
    materials = toml(tmp_path, '[objects]\nroom = "concrete"\ncabinet = "metal"')
    spec = load(tmp_path / "scene.obj", materials)
    assert [p.name for p in spec.solids] == ["cabinet"] and len(spec.accessible_tx()) > 200


def test_a_single_ply_is_a_scene(tmp_path):
    trimesh.creation.box((6, 4.5, 2.7), trimesh.transformations.translation_matrix((3, 2.25, 1.35))).export(
        tmp_path / "hall.ply"
    )
    spec = load(tmp_path / "hall.ply", toml(tmp_path, '[objects]\nhall = "concrete"'))
    assert [(p.name, p.closed) for p in spec.parts] == [("hall", False)]


def test_a_picture_on_an_uncut_wall_is_refused(tmp_path):
    poster = [[(0, 1, 1), (0, 2, 1), (0, 2, 2), (0, 1, 2)]]
    refused("'poster' and 'wall_west' coincide, for example at .*cut a hole", *with_object(tmp_path, "poster", poster))
    off = [[(0.01, y, z) for _, y, z in poster[0]]]
    load(*with_object(tmp_path, "poster", off))


def test_sheets_may_cross_and_solids_may_touch(tmp_path):
    partition = [[(3, 0, 0), (3, 1.2, 0), (3, 1.2, 2.7), (3, 0, 2.7)]]
    load(*with_object(tmp_path, "partition", partition))
    standing = [[(x, y, z - 0.01) for x, y, z in face] for face in OBJECTS["cabinet"]]
    (tmp_path / "room.obj").write_text(obj(OBJECTS | {"cabinet": standing}))
    load(tmp_path / "room.obj")


@pytest.mark.parametrize("first", range(5))
def test_a_concave_face_is_cut_right_and_refused_where_an_exporter_fanned_it_out(first, tmp_path):
    corners = [(1.8, 3, 0.2), (1, 3, 1), (1, 3, 0.1), (2, 3, 0.1), (2, 3, 1)]  # the first sees all others
    file, materials = with_object(tmp_path, "screen", [corners[1:]])
    lines = file.read_text().splitlines()
    start = lines.index("o screen")
    count = sum(line.startswith("v ") for line in lines[:start])
    screen = ["o screen", *(f"v {x} {y} {z}" for x, y, z in corners)]
    screen += [f"f {' '.join(str(count + 1 + (first + i) % 5) for i in range(5))}"]
    file.write_text("\n".join(lines[:start] + screen) + "\n")
    (own,) = (p for p in load(file, materials).parts if p.name == "screen")
    assert own.mesh.area == pytest.approx(0.5) and len(own.mesh.faces) == 3
    fan = [(first, (first + i) % 5, (first + i + 1) % 5) for i in (1, 2, 3)]
    screen = [*screen[:-1], *(f"f {' '.join(str(count + 1 + i) for i in three)}" for three in fan)]
    file.write_text("\n".join(lines[:start] + screen) + "\n")
    if first:
        refused("'screen' folds back onto itself at .*triangulate", file, materials)


# Mistakes


def test_a_missing_or_unknown_file(tmp_path):
    refused("scene file .*none.glb does not exist", tmp_path / "none.glb")
    refused(r"is not a supported scene file \(.glb, .gltf, .obj, .ply, .xml\)", tmp_path / "room.step")


@pytest.mark.parametrize("scale", [1000.0, 100.0, 0.001])
def test_another_unit(scale, tmp_path):
    refused(f"measures .* perhaps --scale {1 / scale:g}", write_obj(tmp_path, scale))


def test_a_size_that_is_said_to_be_right_is_believed(tmp_path):
    """A factory of 600 m, whose author says so; a scene of the simulator's says so by itself."""
    places = {"rx": "80,240,120", "tx_grid": "160,50,50:540,400,230:9,7,4"}
    spec = load(write_obj(tmp_path, 100.0), scale=1.0, **places)
    np.testing.assert_allclose(spec.bounds()[1], [600, 450, 270])
    assert len(load(write_xml(tmp_path, 100.0), None, **places).parts) == len(OBJECTS)
    refused("measures", write_obj(tmp_path, 1e5), scale=1.0, **places)


def test_flaws_of_a_scene_of_the_simulator_are_warnings(tmp_path):
    """Its users trace it as it is; an export of one's own should be mended."""
    file = write_xml(tmp_path)
    poster = trimesh.Trimesh([(0, 1, 1), (0, 2, 1), (0, 2, 2), (0, 1, 2)], [(0, 1, 2), (0, 2, 3)])
    poster.export(tmp_path / "meshes" / "poster.ply")
    file.write_text(file.read_text().replace("</scene>", shape("poster") + "</scene>"))
    spec = load(file, None)
    assert len(spec.flaws) == 2 and "coincide" in spec.flaws[0]
    last = describe(spec).splitlines()[-1]
    assert last.startswith("warning: objects ") and "'wall_west'" in last and last.endswith("(similar flaws: 1)")


def test_many_objects_are_not_all_described(tmp_path, monkeypatch):
    monkeypatch.setattr("wbgs_jax.interchange.rooms.SHOWN", 3)
    lines = describe(load()).splitlines()
    assert len(lines) == 4 and lines[-1] == "... and 7 smaller objects" and any("table" in line for line in lines)


def test_too_many_triangles(tmp_path, monkeypatch):
    monkeypatch.setattr("wbgs_jax.interchange.rooms.MAX_TRIANGLES", 80)
    refused("has 98 triangles, most in 'table'")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"up": "x"}, "--up is 'x'"),
        ({"scale": 0.0}, "--scale is 0.0"),
        ({"scale": float("nan")}, "--scale is nan"),
        ({"rx": "1,2"}, "--rx has '1,2'"),
        ({"rx": "1,2,z"}, "--rx has '1,2,z'"),
        ({"rx": "1,2,nan"}, "finite"),
        ({"rx": "3,2,7"}, r"the receiver at \(3, 2, 7\) m is outside the scene, which spans \(0, 0, 0\) to \(6, 4.5, 2.7\) m"),
        ({"rx": "5.6,3.7,1"}, "is inside the solid 'cabinet'"),
        ({"rx": "0.2,2,1"}, "is 0.2 m from 'wall_west'; move it"),
        ({"tx_grid": "1,1,1:2,2,2"}, "--tx-grid is '1,1,1:2,2,2'; give"),
        ({"tx_grid": "1,1,1:2,2:2,2,2"}, "--tx-grid has '2,2'"),
        ({"tx_grid": "1,1,1:2,2,2:2,2,0"}, "whole numbers"),
        ({"tx_grid": "1,1,1:2,2,2:2,2,1.5"}, "whole numbers"),
        ({"tx_grid": "1,1,1:2,2,2:2000,2000,2"}, "at most"),
        ({"tx_grid": "9,1,1:12,2,2:2,2,2"}, "no transmitter of --tx-grid is inside the scene"),
        ({"tx_grid": "tx.csv"}, "cannot read --tx-grid tx.csv"),
        ({"frequencies_hz": (140e9,)}, "140 GHz is outside"),
    ],
)
def test_mistakes_on_the_command_line(changes, message):
    refused(message, **changes)


def test_a_grid_inside_a_solid_leaves_no_transmitter():
    with pytest.raises(UserError, match="accessible"):
        load(tx_grid="5.5,3.4,0.5:5.8,4.2,1.5:3,3,3").accessible_tx()


def test_transmitters_from_a_table(tmp_path):
    table = tmp_path / "tx.csv"
    table.write_text("x, y, z\r\n2,1,1\r\n3.5,1,1.25\r\n\r\n")
    np.testing.assert_array_equal(load(tx_grid=str(table)).tx_grid, [[2, 1, 1], [3.5, 1, 1.25]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,1\n", "needs the header x,y,z"),
        ("x,y,z\n", "one row of three numbers"),
        ("x,y,z\n1,2\n", "one row of three numbers"),
        ("x,y,z\n1,2,1\n1,2\n", "not three numbers"),
        ("x,y,z\n1,2,a\n", "not three numbers"),
        ("x,y,z\n1,2,inf\n", "one row of three numbers"),
        ("x,y,z\n1,2,1\n1.0,2,1\n", "has a transmitter twice"),
    ],
)
def test_a_broken_table_of_transmitters(text, message, tmp_path):
    (tmp_path / "tx.csv").write_text(text)
    refused(message, tx_grid=str(tmp_path / "tx.csv"))


ALL = '[objects]\n"*" = "wood"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[objects\n", "is not valid TOML"),
        ('floor = "wood"\n', r"may contain only the tables \[objects\]"),
        ('[objects]\nfloor = "wood"\n', "no material for 'cabinet', 'ceiling', .* of .*room.obj; name them under"),
        (ALL + 'flor = "wood"\n', "'flor' is not an object of .*; its objects are 'cabinet', 'ceiling'"),
        (ALL + '"Wall*" = "wood"\n', r"'Wall\*' is not an object"),
        (ALL + 'floor = "wod"\n', "'floor' has the unknown material 'wod'; choose one of .*wood"),
        (ALL + 'floor = "vacuum"\n', "unknown material 'vacuum'"),
        (ALL + "floor = 3\n", "'floor' needs \"material\" or"),
        (ALL + "floor = { thickness = 0.1 }\n", "'floor' needs \"material\" or"),
        (ALL + 'wall.001 = "wood"\n', "quote names with a dot"),
        (ALL + 'floor = { material = "wood", thickness = 20 }\n', "'floor' has a thickness of 20; give metres"),
        (ALL + 'floor = { material = "wood", thickness = 0 }\n', "more than 0"),
        (ALL + 'floor = "brick"\n', "brick is defined for 1-40 GHz, not at 60 GHz"),
        (
            ALL + "[materials.clay]\nrelative_permittivity = 4\n",
            r"\[materials.clay\] needs exactly relative_permittivity, conductivity",
        ),
        (ALL + '[materials.clay]\nrelative_permittivity = "4"\nconductivity = 0\nthickness = 0.1\n', "needs numbers, or"),
        (
            ALL + "[materials.clay]\nrelative_permittivity = 0.4\nconductivity = 0\nthickness = 0.1\n",
            "permittivity of 1 or more",
        ),
        (ALL + "[materials.brick]\nrelative_permittivity = 4\nconductivity = 0\nthickness = 0.1\n", "needs another name"),
        (ALL + "[materials.clay]\nrelative_permittivity = 4\nconductivity = 0\nthickness = 100\n", "thickness of 100"),
    ],
)
def test_mistakes_in_the_materials(text, message, tmp_path):
    refused(message, ROOM, toml(tmp_path, text))


def test_a_missing_materials_file(tmp_path):
    refused("no material for 'cabinet', .*--materials", ROOM, None)
    refused("cannot read .*none.toml", ROOM, tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b"\xff")
    refused("not valid TOML", ROOM, tmp_path / "latin.toml")


def test_a_name_counts_before_a_pattern_and_the_first_pattern_before_the_next(tmp_path):
    text = '[objects]\n"w*" = "glass"\n"*" = "wood"\n"wall_?????" = "metal"\nwindow = "chipboard"\n'
    found = {p.name: p.material for p in load(ROOM, toml(tmp_path, text)).parts}
    assert found["wall_east"] == found["wall_north"] == "glass"
    assert found["window"] == "chipboard" and found["floor"] == "wood"


def test_frequencies_are_those_of_the_released_scenes_unless_given():
    from data_gen.scenes.base import FREQUENCIES_HZ

    assert load(frequencies_hz=()).frequencies_hz == FREQUENCIES_HZ
