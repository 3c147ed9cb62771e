"""The example room in every format, and how the tests load it."""

import numpy as np
import pytest
import trimesh

from data_gen.example.make_room import HERE, OBJECTS, obj
from data_gen.own_scene import own_scene
from wbgs_jax._util.errors import UserError

ROOM, TOML = HERE / "room.obj", HERE / "materials.toml"
RX, GRID = "0.8,2.4,1.2", "1.6,0.5,0.5:5.4,4,2.3:9,7,4"
FREQUENCIES = (2.4e9, 60e9)
Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


def meshes(scale=1.0):
    """The example's objects as trimesh sees them, z up."""
    made = {}
    for name, faces in OBJECTS.items():
        corners = np.arange(4 * len(faces)).reshape(-1, 4)
        triangles = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
        made[name] = trimesh.Trimesh(np.reshape(faces, (-1, 3)) * scale, triangles, process=False)
    return made


def write_glb(folder, scale=1.0):
    """As an exporter does it: y up, meshes placed by their nodes, one of them mirrored."""
    scene = trimesh.Scene()
    for i, (name, mesh) in enumerate(meshes(scale).items()):
        place = trimesh.transformations.translation_matrix((i, 0, -i))
        if name == "cabinet":
            place = place @ np.diag([-1, 1, 1, 1.0])
        mesh.apply_transform(np.linalg.inv(place) @ Y_UP)
        if name == "cabinet":
            mesh.invert()
        scene.add_geometry(mesh, node_name=name, geom_name=f"mesh{i}", transform=place)
    scene.export(folder / "room.glb")
    return folder / "room.glb"


def write_obj(folder, scale=1.0):
    objects = {name: (np.array(faces) * scale).tolist() for name, faces in OBJECTS.items()}
    (folder / "room.obj").write_text(obj(objects))
    return folder / "room.obj"


XML = """<scene version="2.1.0">
  <bsdf type="twosided" id="mat-itu_concrete"><bsdf type="diffuse"/></bsdf>
  <bsdf type="itu-radio-material" id="panes">
    <string name="type" value="glass"/><float name="thickness" value="0.007"/>
  </bsdf>
  <bsdf type="radio-material" id="clay">
    <float name="relative_permittivity" value="4.5"/><float name="conductivity" value="0.02"/>
  </bsdf>
  <bsdf type="diffuse" id="paint"/>
  {shapes}
</scene>"""


def shape(name, bsdf="mat-itu_concrete", transform="", kind="ply"):
    file = f'<string name="filename" value="meshes/{name}.ply"/>'
    return f'<shape type="{kind}" id="mesh-{name}">{file}{transform}<ref id="{bsdf}" name="bsdf"/></shape>'


def write_xml(folder, scale=1.0, bsdf=None, **changes):
    (folder / "meshes").mkdir(exist_ok=True)
    for name, mesh in meshes(scale).items():
        mesh.export(folder / "meshes" / f"{name}.ply")
    of = {"window": "panes", "door": "clay", **(bsdf or {})}
    shapes = [shape(name, of.get(name, "mat-itu_concrete"), **changes) for name in OBJECTS]
    (folder / "scene.xml").write_text(XML.format(shapes="".join(shapes)))
    return folder / "scene.xml"


WRITERS = {"glb": write_glb, "obj": write_obj, "xml": write_xml}


def load(file=ROOM, materials=TOML, **changes):
    return own_scene(file, materials, **{"rx": RX, "tx_grid": GRID, "frequencies_hz": FREQUENCIES} | changes)


def toml(folder, text):
    (folder / "own.toml").write_text(text)
    return folder / "own.toml"


def refused(message, *arguments, **changes):
    with pytest.raises(UserError, match=message) as caught:
        load(*arguments, **changes)
    assert "\n" not in str(caught.value)


def with_object(folder, name, faces, material="wood"):
    """The example with one object more."""
    (folder / "room.obj").write_text(obj(OBJECTS | {name: faces}))
    (folder / "materials.toml").write_text(
        f"{TOML.read_text().replace('[objects]', f'[objects]{chr(10)}{name} = {material!r}')}"
    )
    return folder / "room.obj", folder / "materials.toml"
