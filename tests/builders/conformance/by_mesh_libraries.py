"""Files of meshio, Open3D, PyVista (VTK) and PyMeshLab; truth by their own areas and boxes where they have such."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from builders.conformance.entries import entries
from builders.conformance.shapes import CABINET, RAMP, WALL, Y_UP, Extent, Geometry, Shape, extent_of, floor, geometry, room


def by_meshio(name: str, shape: Shape = RAMP, **how: Any) -> Callable[[Path], Geometry]:
    """Returns a maker of one object."""

    def make(folder: Path) -> Geometry:
        import meshio

        kinds = {3: "triangle", 4: "quad"}
        cells = [(kinds[n], [p for p in shape.polygons if len(p) == n]) for n in sorted({len(p) for p in shape.polygons})]
        meshio.Mesh(shape.vertices, cells).write(folder / name, **how)
        return geometry(folder / name, {Path(name).stem: shape})

    return make


def triangles(shape: Shape) -> Shape:
    """Returns a shape cut into triangles."""
    return Shape(shape.vertices, shape.triangles.tolist())


MESHIO = {
    ("ply", "binary, triangles"): by_meshio("a.ply", triangles(CABINET)),
    ("ply", "text, triangles"): by_meshio("b.ply", triangles(CABINET), binary=False),
    ("ply", "triangles and quads"): by_meshio("c.ply"),
    ("ply", "text, triangles and quads"): by_meshio("d.ply", binary=False),
    ("obj", "triangles"): by_meshio("e.obj", triangles(RAMP)),
    ("obj", "triangles and quads"): by_meshio("f.obj"),
    ("off", "triangles"): (by_meshio("g.off", triangles(RAMP)), "refused"),
    ("stl", "triangles"): (by_meshio("h.stl", triangles(RAMP)), "refused"),
    ("vtk", "triangles and quads"): (by_meshio("i.vtk"), "refused"),
    ("vtu", "triangles and quads"): (by_meshio("j.vtu"), "refused"),
    ("msh (Gmsh)", "triangles"): (by_meshio("k.msh", triangles(RAMP), file_format="gmsh"), "refused"),
}
ENTRIES = entries("meshio", MESHIO, ("meshio",), "meshio")


def by_open3d(name: str, shape: Shape = CABINET, **how: Any) -> Callable[[Path], Geometry]:
    """Returns a maker of one object; the truth is Open3D's."""

    def make(folder: Path) -> Geometry:
        import open3d

        turned = shape.moved(Y_UP) if Path(name).suffix in (".glb", ".gltf") else shape
        mesh = open3d.geometry.TriangleMesh(
            open3d.utility.Vector3dVector(turned.vertices), open3d.utility.Vector3iVector(turned.triangles)
        )
        if how.pop("normals", False):
            mesh.compute_vertex_normals()
        assert open3d.io.write_triangle_mesh(str(folder / name), mesh, **how)
        true = extent_of(shape)
        bounds = np.array([mesh.get_min_bound(), mesh.get_max_bound()]) @ (Y_UP[:3, :3] if turned is not shape else np.eye(3))
        truth = Extent(mesh.get_surface_area(), np.sort(bounds, 0), true.centroid)
        return Geometry(folder / name, {NODES.get(Path(name).suffix, Path(name).stem): truth})

    return make


def cloud(folder: Path) -> Geometry:
    """Points without faces."""
    import open3d

    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(CABINET.vertices))
    open3d.io.write_point_cloud(str(folder / "cloud.ply"), points)
    return geometry(folder / "cloud.ply", {"cloud": CABINET})


NODES = {".glb": "node_0", ".gltf": "node_0"}
"""What Open3D's nodes are called: they have no names, and are numbered here."""
OPEN3D = {
    ("ply", "binary, double precision"): by_open3d("a.ply"),
    ("ply", "text, normals"): by_open3d("b.ply", RAMP, write_ascii=True, normals=True),
    ("ply", "compressed in name alone"): by_open3d("c.ply", compressed=True),
    ("obj", "triangles"): by_open3d("d.obj"),
    ("obj", "normals"): by_open3d("e.obj", WALL, normals=True),
    ("glb", "one mesh"): by_open3d("f.glb"),
    ("gltf", "one mesh"): by_open3d("g.gltf", RAMP),
    ("off", "triangles"): (by_open3d("h.off"), "refused"),
    ("stl", "triangles"): (by_open3d("i.stl", normals=True), "refused"),
    ("ply", "points without faces"): (cloud, "refused"),
}
ENTRIES += entries("Open3D", OPEN3D, ("open3d",), "open3d")


def poly_data(shape: Shape) -> Any:
    """Returns PyVista's mesh of a shape, polygons as they are."""
    import pyvista

    return pyvista.PolyData(shape.vertices, faces=np.concatenate([[len(p), *p] for p in shape.polygons]))


def by_pyvista(name: str, shape: Shape = RAMP, strips: bool = False, **how: Any) -> Callable[[Path], Geometry]:
    """Returns a maker of one object; the truth is VTK's area and box."""

    def make(folder: Path) -> Geometry:
        data = poly_data(shape)
        low, high = np.reshape(data.bounds, (3, 2)).T
        truth = Extent(data.triangulate().area, np.array([low, high]), extent_of(shape).centroid)
        (data.triangulate().strip() if strips else data).save(folder / name, **how)
        return Geometry(folder / name, {Path(name).stem: truth})

    return make


SIDEWAYS = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
"""How PyVista turns the room where it turns it y-up."""


def plotted(name: str, turn: np.ndarray | None = None, **how: Any) -> Callable[[Path], Geometry]:
    """Returns a maker of a whole room by the exporters of VTK's window, which number the objects."""

    def make(folder: Path) -> Geometry:
        import pyvista

        plotter = pyvista.Plotter(off_screen=True)
        for shape in room().values():
            plotter.add_mesh(poly_data(shape).triangulate())
        getattr(plotter, "export_" + Path(name).suffix[1:])(folder / name, **how)
        shapes = [shape if turn is None else shape.moved(turn) for shape in room().values()]
        named = {f"mesh{number}": shape for number, shape in enumerate(shapes)}
        return geometry(folder / name, named, **({"up": "z"} if turn is None else {}))

    return make


PYVISTA = {
    ("ply", "binary"): by_pyvista("a.ply"),
    ("ply", "text"): by_pyvista("b.ply", binary=False),
    ("ply", "made of strips"): by_pyvista("c.ply", CABINET, strips=True),
    ("ply", "a concave polygon"): by_pyvista("d.ply", floor(3)),
    ("obj", "polygons"): by_pyvista("e.obj"),
    ("obj", "strips"): by_pyvista("f.obj", CABINET, strips=True),
    ("gltf", "a window"): plotted("g.gltf", SIDEWAYS),
    ("gltf", "a window, z up"): plotted("z.gltf", rotate_scene=False),
    ("vtp", "polygons"): (by_pyvista("h.vtp"), "refused"),
    ("vtk", "polygons"): (by_pyvista("i.vtk"), "refused"),
    ("stl", "polygons"): (by_pyvista("j.stl", CABINET), "refused"),
    ("wrl", "a window"): (plotted("k.vrml"), "refused"),
}
ENTRIES += entries("PyVista (VTK)", PYVISTA, ("pyvista",), "pyvista")


def by_meshlab(name: str, shape: Shape = CABINET, polygons: bool = False, **how: Any) -> Callable[[Path], Geometry]:
    """Returns a maker of one object; the truth is MeshLab's area and box."""

    def make(folder: Path) -> Geometry:
        import pymeshlab

        with_quads = pymeshlab.Mesh(shape.vertices, face_list_of_indices=shape.polygons)
        mesh = with_quads if polygons else pymeshlab.Mesh(shape.vertices, shape.triangles.astype(np.int32))
        held = pymeshlab.MeshSet()
        held.add_mesh(mesh, Path(name).stem)
        measures, box = held.get_geometric_measures(), held.current_mesh().bounding_box()
        bounds = np.array([box.min(), box.max()])
        held.save_current_mesh(str(folder / name), **how)
        return Geometry(folder / name, {Path(name).stem: Extent(measures["surface_area"], bounds, extent_of(shape).centroid)})

    return make


MESHLAB = {
    ("ply", "binary"): by_meshlab("a.ply"),
    ("ply", "text"): by_meshlab("b.ply", binary=False),
    ("ply", "polygons"): by_meshlab("c.ply", RAMP, True),
    ("ply", "a concave polygon"): by_meshlab("d.ply", floor(2), True),
    ("obj", "triangles"): by_meshlab("e.obj", RAMP),
    ("obj", "polygons"): by_meshlab("f.obj", CABINET, True),
    ("off", "triangles"): (by_meshlab("g.off"), "refused"),
    ("stl", "triangles"): (by_meshlab("h.stl"), "refused"),
    ("x3d", "triangles"): (by_meshlab("i.x3d"), "refused"),
    ("wrl", "triangles"): (by_meshlab("j.wrl"), "refused"),
    ("dae", "triangles"): (by_meshlab("k.dae"), "refused"),
    ("3ds", "triangles"): (by_meshlab("l.3ds"), "refused"),
}
ENTRIES += entries("PyMeshLab", MESHLAB, ("pymeshlab",), "pymeshlab")
