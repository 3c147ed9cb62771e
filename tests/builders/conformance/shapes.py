"""A room of planar polygons whose areas, boxes and centroids have closed forms."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float

from wbgs_jax.mesh.importers import read_objects


class Extent(NamedTuple):
    """What is compared of an object."""

    area: float
    bounds: Float[np.ndarray, "2 3"]
    centroid: Float[np.ndarray, "3"]


class Shape(NamedTuple):
    """Polygons of an object."""

    vertices: Float[np.ndarray, "v 3"]
    polygons: list[list[int]]

    @property
    def triangles(self) -> np.ndarray:
        """Returns the fans of convex polygons."""
        return np.array([[p[0], p[i], p[i + 1]] for p in self.polygons for i in range(1, len(p) - 1)])

    def moved(self, matrix: Float[np.ndarray, "4 4"]) -> "Shape":
        """Returns the shape elsewhere."""
        return Shape(self.vertices @ matrix[:3, :3].T + matrix[:3, 3], self.polygons)


def box(low: tuple[float, ...], high: tuple[float, ...]) -> Shape:
    """Returns a box of six quads."""
    corners = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)], np.float64)
    return Shape(corners, [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])


L_SHAPE = np.array([[0, 0], [6, 0], [6, 3], [2.5, 3], [2.5, 5], [0, 5]], np.float64)
"""An outline with one corner that points inwards."""


def floor(first: int = 0) -> Shape:
    """Returns a concave polygon, whichever of its corners comes first."""
    return Shape(np.column_stack([L_SHAPE, np.zeros(6)]), [[(first + i) % 6 for i in range(6)]])


def convex_floor() -> Shape:
    """Returns the same floor as two quads."""
    return Shape(np.column_stack([np.vstack([L_SHAPE, [[0, 3]]]), np.zeros(7)]), [[0, 1, 2, 3, 6], [6, 3, 4, 5]])


CABINET = box((1, 1, 0.01), (1.6, 1.6, 1.81))
WALL = Shape(np.array([[0, 0, 0], [6, 0, 0], [6, 0.5, 2.7], [0, 0.5, 2.7]], np.float64), [[0, 1, 2, 3]])
RAMP = Shape(
    np.array([[3, 1, 0.1], [5, 1, 0.1], [5, 2, 0.1], [3, 2, 0.1], [3, 1, 1], [3, 2, 1]], np.float64),
    [[3, 2, 1, 0], [0, 1, 4], [2, 3, 5], [0, 4, 5, 3], [1, 2, 5, 4]],
)
TURNED = np.array([[0, -1, 0, 4], [1, 0, 0, 1], [0, 0, 1, 0.5], [0, 0, 0, 1]], np.float64)
"""A quarter about the vertical, and aside."""
Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
"""From z-up to y-up, as glTF wants it."""


def room() -> dict[str, Shape]:
    """Returns the room; its polygons are convex."""
    return {"floor": convex_floor(), "wall": WALL, "cabinet": CABINET, "ramp": RAMP}


def mesh_of(shape: Shape) -> trimesh.Trimesh:
    """Returns the triangles of a shape."""
    return trimesh.Trimesh(shape.vertices, shape.triangles, process=False)


def extent_of(*shapes: Shape) -> Extent:
    """Returns the closed form of planar polygons, concave ones too: triangles of a fan count with their sign."""
    area, moment = 0.0, np.zeros(3)
    for shape in shapes:
        for polygon in shape.polygons:
            points = shape.vertices[polygon]
            crosses = np.cross(points[1:-1] - points[0], points[2:] - points[0]) / 2
            normal = crosses.sum(0) / np.linalg.norm(crosses.sum(0))
            signed = crosses @ normal
            area += signed.sum()
            moment += signed @ (points[0] + points[1:-1] + points[2:]) / 3
    vertices = np.concatenate([shape.vertices for shape in shapes])
    return Extent(float(area), np.array([vertices.min(0), vertices.max(0)]), moment / area)


def extent_of_mesh(mesh: trimesh.Trimesh) -> Extent:
    """Returns the same of triangles."""
    weights = mesh.area_faces / max(mesh.area, 1e-300)
    return Extent(float(mesh.area), mesh.bounds, weights @ mesh.triangles.mean(1))


def deviation(found: Extent, true: Extent) -> float:
    """Returns the largest difference: of areas, and of places in units of the object's size."""
    size = float(np.linalg.norm(true.bounds[1] - true.bounds[0]))
    places = max(np.abs(found.bounds - true.bounds).max(), np.abs(found.centroid - true.centroid).max())
    return max(abs(found.area / true.area - 1), places / size)


@dataclass
class Geometry:
    """A file of objects."""

    path: Path
    truth: dict[str, Extent]
    up: str | None = None
    scale: float = 1.0
    tolerance: float = 1e-4
    measure: str = field(default="geometry", init=False)

    def difference(self) -> float:
        """Returns the largest difference over all objects."""
        found = {one.name: extent_of_mesh(one.mesh) for one in read_objects(self.path, self.up, self.scale)}
        if set(found) != set(self.truth):
            return float("inf")
        return max(deviation(found[name], extent) for name, extent in self.truth.items())


def geometry(path: Path, shapes: dict[str, Shape], **options: float | str) -> Geometry:
    """Returns a file with the closed forms of what was written into it."""
    return Geometry(path, {name: extent_of(shape) for name, shape in shapes.items()}, **options)  # type: ignore[arg-type]
