"""Scenes that Mitsuba writes, and those that come with Sionna RT; the truth is what they load from the same files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from builders.conformance.entries import Unavailable, entries
from builders.conformance.shapes import CABINET, RAMP, WALL, Extent, Geometry, Shape, extent_of, mesh_of, room
from wbgs_jax._util.errors import UserError

ROUND = 5e-3
"""What 64 sections leave of round shapes."""


def mitsuba() -> Any:
    """Returns the package with a variant that needs nothing else; Sionna RT's where it has been chosen."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    return mi


def sionna() -> Any:
    """Returns Sionna RT with something to compute on."""
    from data_gen.llvm import ensure_backend

    try:
        ensure_backend()
    except UserError as error:
        raise Unavailable(str(error)) from error
    import sionna.rt

    return sionna.rt


def extent_by_mitsuba(shape: Any) -> Extent:
    """Returns area and box as Mitsuba has them, the centroid of its triangles; of built-in shapes that of the box."""
    box = shape.bbox()
    bounds = np.array([np.ravel(box.min), np.ravel(box.max)], np.float64)
    parameters = mitsuba().traverse(shape)
    if "vertex_positions" in parameters:
        corners = np.array(parameters["vertex_positions"], np.float64).reshape(-1, 3)
        triangles = corners[np.array(parameters["faces"]).reshape(-1, 3)]
        weights = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1) / 2
        return Extent(float(weights.sum()), bounds, weights @ triangles.mean(1) / weights.sum())
    return Extent(float(np.ravel(shape.surface_area())[0]), bounds, bounds.mean(0))


def extents_of(scene: Any) -> dict[str, Extent]:
    """Returns what Mitsuba has loaded."""
    return {shape.id().removeprefix("mesh-"): extent_by_mitsuba(shape) for shape in scene.shapes()}


def mesh_in(mi: Any, shape: Shape, name: str) -> Any:
    """Returns Mitsuba's mesh of a shape."""
    made = mi.Mesh(name, len(shape.vertices), len(shape.triangles))
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = shape.vertices.ravel().astype(np.float32)
    parameters["faces"] = shape.triangles.ravel().astype(np.uint32)
    parameters.update()
    return made


def ply(shape: Shape) -> Callable[[Path], Geometry]:
    """Returns a maker of a mesh alone."""

    def make(folder: Path) -> Geometry:
        mi = mitsuba()
        made = mesh_in(mi, shape, "mesh")
        made.write_ply(str(folder / "mesh.ply"))
        return Geometry(folder / "mesh.ply", {"mesh": extent_by_mitsuba(made)._replace(centroid=extent_of(shape).centroid)})

    return make


def written(
    shapes: Callable[[Any, Path], dict[str, Any]], tolerance: float = 1e-4, known: bool = True
) -> Callable[[Path], Geometry]:
    """Returns a maker of a scene by Mitsuba's own writer of XML, which calls names what its reader calls ids."""

    def make(folder: Path) -> Geometry:
        mi = mitsuba()
        scene = {"type": "scene", **shapes(mi, folder)}
        parsed = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), scene)
        mi.parser.write_file(parsed, str(folder / "scene.xml"), add_section_headers=True)
        truth = extents_of(mi.load_dict(scene, optimize=False)) if known else {}
        return Geometry(folder / "scene.xml", truth, tolerance=tolerance)

    return make


def meshes(mi: Any, folder: Path) -> dict[str, Any]:
    """Every object of the room as a PLY file of its own."""
    found = {}
    for name, shape in room().items():
        mesh_in(mi, shape, name).write_ply(str(folder / f"{name}.ply"))
        found[name] = {"type": "ply", "filename": str(folder / f"{name}.ply"), "bsdf": {"type": "diffuse"}}
    return found


def turned(mi: Any, folder: Path) -> dict[str, Any]:
    """The same, moved by transforms of several steps."""
    step = mi.ScalarTransform4f
    found = meshes(mi, folder)
    for number, shape in enumerate(found.values()):
        turn = step().rotate([1, number, 2], 35 * number)
        shape["to_world"] = step().translate([number, 1, 0.5]) @ turn @ step().scale([1 + number, 1, -1])
    return found


def objects(mi: Any, folder: Path) -> dict[str, Any]:
    """OBJ files."""
    found = {}
    for name, shape in room().items():
        mesh_of(shape).export(folder / f"{name}.obj")
        found[name] = {"type": "obj", "filename": str(folder / f"{name}.obj")}
    return found


def built_in(*kinds: str) -> Callable[[Any, Path], dict[str, Any]]:
    """Returns a builder of shapes without files, turned and shifted."""

    def build(mi: Any, folder: Path) -> dict[str, Any]:
        move = mi.ScalarTransform4f().translate([1, 2, 3]) @ mi.ScalarTransform4f().rotate([0, 0, 1], 90)
        return {f"a {kind}": {"type": kind, "to_world": move} for kind in kinds}

    return build


def placed_round(mi: Any, folder: Path) -> dict[str, Any]:
    """Round shapes with places and radii of their own, where turning them keeps their boxes."""
    return {
        "ball": {"type": "sphere", "center": [1, 2, 3], "radius": 0.5},
        "pipe": {"type": "cylinder", "p0": [0, 0, 0], "p1": [0, 4, 0], "radius": 0.1},
    }


def repeated(mi: Any, folder: Path) -> dict[str, Any]:
    """A group of shapes, placed twice."""
    group = {"type": "shapegroup", "inner": {"type": "rectangle"}}
    return {"group": group, "one": {"type": "instance", "ref": {"type": "ref", "id": "group"}}}


XML = """<scene version="{version}">{head}<bsdf type="diffuse" id="grey"/>{shapes}</scene>"""
CUBE = (
    """<shape type="cube" id="mesh-cabinet"><transform name="{name}">{steps}</transform><ref id="grey" name="bsdf"/></shape>"""
)
STEPS = '<scale x="0.3" y="{wide}" z="0.9"/><rotate z="1" angle="30"/><translate x="1.3" y="2" z="0.91"/>'


def text(shapes: str, version: str = "3.0.0", head: str = "") -> Callable[[Path], Geometry]:
    """Returns a maker of a scene as people write it, which Mitsuba loads."""

    def make(folder: Path) -> Geometry:
        (folder / "scene.xml").write_text(XML.format(version=version, head=head, shapes=shapes))
        (folder / "other.xml").write_text('<scene version="3.0.0"/>')
        return Geometry(folder / "scene.xml", extents_of(mitsuba().load_file(str(folder / "scene.xml"), optimize=False)))

    return make


MATRIX = '<matrix value="0 -1 0 4 1 0 0 1 0 0 2 0.5 0 0 0 1"/>'
LOOK = '<lookat origin="1,1,1" target="1,2,1" up="0,0,1"/>'
PLAIN = STEPS.format(wide=0.3)
FILES = {
    ("ply", "a wall"): ply(WALL),
    ("ply", "a box"): ply(CABINET),
    ("ply", "a ramp"): ply(RAMP),
    ("xml", "meshes"): written(meshes),
    ("xml", "meshes, turned, scaled and mirrored"): written(turned),
    ("xml", "OBJ files"): written(objects),
    ("xml", "rectangle and cube"): written(built_in("rectangle", "cube")),
    ("xml", "disk, sphere and cylinder"): written(built_in("disk", "sphere", "cylinder"), tolerance=ROUND),
    ("xml", "spheres and cylinders with places of their own"): written(placed_round, tolerance=ROUND),
    ("xml", "steps of a transform"): text(CUBE.format(name="to_world", steps=PLAIN)),
    ("xml", "a matrix"): text(CUBE.format(name="to_world", steps=MATRIX)),
    ("xml", "a matrix among steps"): text(CUBE.format(name="to_world", steps=MATRIX + PLAIN)),
    ("xml", "scene format 0.6"): text(CUBE.format(name="toWorld", steps=PLAIN), "0.6.0"),
    ("xml", "a name with a default"): text(
        CUBE.format(name="to_world", steps=STEPS.format(wide="$wide")), head='<default name="wide" value="0.7"/>'
    ),
    ("xml", "a name with a default that another one begins with"): text(
        CUBE.format(name="to_world", steps=STEPS.format(wide="$wide2")),
        head='<default name="wide" value="0.7"/><default name="wide2" value="0.4"/>',
    ),
    ("xml", "<lookat>"): (text(CUBE.format(name="to_world", steps=LOOK)), "refused"),
    ("xml", "several files"): (text('<include filename="other.xml"/>'), "refused"),
    ("xml", "instances"): (written(repeated, known=False), "refused"),
}
ENTRIES = entries("Mitsuba 3", FILES, ("mitsuba",), "mitsuba")


def scene_of_sionna(name: str) -> Callable[[Path], Geometry]:
    """Returns a maker of a scene that comes with Sionna RT, as it loads it."""

    def make(folder: Path) -> Geometry:
        rt = sionna()
        path = Path(getattr(rt.scene, name))
        scene = rt.load_scene(str(path), merge_shapes=False)
        return Geometry(path, {key: extent_by_mitsuba(one.mi_mesh) for key, one in scene.objects.items()})

    return make


SCENES = (
    *("box", "box_knife", "box_one_screen", "box_two_screens", "double_reflector", "floor_wall", "simple_reflector"),
    *("simple_street_canyon", "simple_street_canyon_with_cars", "simple_wedge", "triple_reflector"),
)
CITIES = ("etoile", "florence", "munich", "san_francisco")
"""Thousands of objects each."""
NEEDS = ("sionna",)
ENTRIES += entries("Sionna RT", {("xml", name): scene_of_sionna(name) for name in SCENES}, NEEDS, "sionna-rt", heavy=True)
ENTRIES += entries("Sionna RT", {("xml", name): scene_of_sionna(name) for name in CITIES}, NEEDS, "sionna-rt", heavy=True)
