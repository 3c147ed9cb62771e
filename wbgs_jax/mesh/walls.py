"""Closed boxes that are walls: building models give a wall two faces, where a slab of its thickness is one surface.

A wave that passes two surfaces, each a slab of the wall's thickness, is attenuated twice. So of a thin closed body only the
face that looks at the middle of the room is kept, and the distance of the two faces is its thickness. Surfaces that met meet
again: a panel in an opening moves into the plane of its wall, and a sheet that ended at the face that is gone is lengthened
to the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

THICKEST = 0.6
"""Metres of a wall or a floor, at most."""
THIN = 0.25
"""Thickness over the smaller of the two other sides, at most."""
SMALLEST_WALL, SMALLEST_FLOOR = 0.5, 2.0
"""Metres: the smaller side of an upright slab and of a level one, at least; a table top is a body with edges."""
MOST_FACES = 2_000
"""Triangles of a wall; a body of more is something else."""
UNEQUAL = 0.02
"""Share by which the areas of the two faces may differ."""
FLAT = 1e-3
"""Metres that corners may be off the plane of a face, and corners of one side off a line."""
PARALLEL = 0.999
"""Cosine between the normals of one face, at least."""
NEAR = 0.02
"""Metres between bodies that touch, at most."""


@dataclass
class Sheet:
    """A flat piece of surface, and the body that it stands for."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "t 3"]
    normal: Float[np.ndarray, "3"]
    thickness: float
    """Metres between the two faces of the body; 0 where there was but one."""
    bounds: Float[np.ndarray, "2 3"]
    """Lowest and highest corner of the body."""
    span: Float[np.ndarray, "2"]
    """Lowest and highest place of the body along the normal, metres."""

    @property
    def offset(self) -> float:
        """The place of the plane along the normal, metres."""
        return float(self.vertices[0] @ self.normal)

    def axes(self) -> Float[np.ndarray, "2 3"]:
        """Returns two directions in the plane, the first one level."""
        level = np.cross(self.normal, [0.0, 0.0, 1.0])
        size = np.linalg.norm(level)
        first = level / size if size > 1e-3 else np.array([1.0, 0.0, 0.0])
        return np.stack([first, np.cross(self.normal, first)])


def walls_as_sheets(meshes: Sequence[trimesh.Trimesh]) -> tuple[list[trimesh.Trimesh], list[float]]:
    """Returns the meshes of a room (metres, z up), those of which all bodies are walls as sheets; and the thickness of these
    walls, metres, 0 for all other meshes."""
    corners = np.concatenate([mesh.bounds for mesh in meshes])
    centre = (corners.min(0) + corners.max(0)) / 2
    walls = [_walls(mesh, centre) for mesh in meshes]
    if not any(walls):
        return list(meshes), [0.0] * len(meshes)
    single = [[] if own else _panels(mesh) for mesh, own in zip(meshes, walls, strict=True)]
    sheets = [sheet for own in (*walls, *single) for sheet in own]
    _move_panels(sheets)
    _lengthen(sheets)
    pieces = [own or panels for own, panels in zip(walls, single, strict=True)]
    results = [_joined(own) if own else mesh for mesh, own in zip(meshes, pieces, strict=True)]
    return results, [float(np.median([sheet.thickness for sheet in own])) if own else 0.0 for own in walls]


def _walls(mesh: trimesh.Trimesh, centre: Float[np.ndarray, "3"]) -> list[Sheet]:
    """Returns a sheet for every body of a mesh; none unless all bodies are walls of one thickness, to a tenth."""
    if not mesh.is_watertight:
        return []
    found = [_wall(body, centre) for body in mesh.split(only_watertight=False)]
    sheets = [sheet for sheet in found if sheet is not None]
    thickness = [sheet.thickness for sheet in sheets]
    return sheets if sheets and len(sheets) == len(found) and max(thickness) < 1.1 * min(thickness) else []


def _wall(body: trimesh.Trimesh, centre: Float[np.ndarray, "3"]) -> Sheet | None:
    """Returns the face of a slab that looks at a point; None for a body that is no wall."""
    normals, areas = np.asarray(body.face_normals), np.asarray(body.area_faces)
    if len(normals) > MOST_FACES:
        return None
    normal = normals[np.argmax((np.abs(normals @ normals.T) > PARALLEL) @ areas)]
    heights = np.asarray(body.triangles) @ normal
    flat = np.ptp(heights, axis=1) < FLAT
    top, bottom = (flat & (np.abs(heights[:, 0] - level) < FLAT) for level in (heights.max(), heights.min()))
    thickness = float(np.ptp(heights))
    if not 0 < thickness <= THICKEST or abs(areas[top].sum() - areas[bottom].sum()) > UNEQUAL * areas[top].sum():
        return None
    front = top if (centre - body.vertices.mean(0)) @ normal >= 0 else bottom
    sheet = _sheet(body, front, normal, thickness)
    side = float(np.ptp(sheet.vertices @ sheet.axes().T, axis=0).min())
    smallest = SMALLEST_FLOOR if abs(normal[2]) > PARALLEL else SMALLEST_WALL
    return sheet if side >= smallest and thickness <= THIN * side else None


def _panels(mesh: trimesh.Trimesh) -> list[Sheet]:
    """Returns a mesh as a sheet if it is flat: a pane or a door in an opening, perhaps."""
    if not 0 < len(mesh.faces) <= MOST_FACES:
        return []
    normal = np.asarray(mesh.face_normals[np.argmax(mesh.area_faces)])
    flat = np.ptp(mesh.vertices @ normal) < FLAT
    return [_sheet(mesh, np.ones(len(mesh.faces), bool), normal, 0.0)] if flat else []


def _sheet(body: trimesh.Trimesh, faces: Bool[np.ndarray, " t"], normal: Float[np.ndarray, "3"], thickness: float) -> Sheet:
    used, index = np.unique(body.faces[faces], return_inverse=True)
    heights = body.vertices @ normal
    span = np.array([heights.min(), heights.max()])
    return Sheet(np.array(body.vertices[used]), index.reshape(-1, 3), normal, thickness, np.array(body.bounds), span)


def _move_panels(sheets: Sequence[Sheet]) -> None:
    """Moves what stands within the thickness of a parallel wall into the wall's plane: beside it there would be a gap."""
    for panel in sheets:
        for wall in sheets:
            low, high = np.sort(panel.span * np.sign(panel.normal @ wall.normal))
            inside = abs(panel.normal @ wall.normal) > PARALLEL and wall.span[0] - NEAR < low and high < wall.span[1] + NEAR
            if inside and panel.thickness < wall.thickness and _touch(panel, wall):
                panel.vertices += (wall.offset - panel.vertices @ wall.normal)[:, None] * wall.normal
                break


def _lengthen(sheets: Sequence[Sheet]) -> None:
    """Moves straight sides of walls to the plane of the wall that their bodies touched."""
    moves = [(sheet, *move) for sheet in sheets if sheet.thickness for move in _missing(sheet, sheets)]
    for sheet, corners, step in moves:
        sheet.vertices[corners] += step


def _missing(sheet: Sheet, sheets: Sequence[Sheet]) -> list[tuple[Bool[np.ndarray, " v"], Float[np.ndarray, "3"]]]:
    """Returns which corners of a sheet are to move, and by how much (metres)."""
    found = []
    for outward in (*sheet.axes(), *-sheet.axes()):
        places = sheet.vertices @ outward
        corners = places > places.max() - FLAT
        middle = sheet.vertices[corners].mean(0)
        for wall in sheets:
            towards = float(wall.normal @ outward)
            if wall is sheet or not wall.thickness or abs(towards) < 0.5 or not _touch(sheet, wall):
                continue
            step = (wall.offset - middle @ wall.normal) / towards
            if FLAT < step <= (wall.thickness + NEAR) / abs(towards):
                found.append((corners, step * outward))
                break
    return found


def _touch(first: Sheet, second: Sheet) -> bool:
    return bool((first.bounds[0] < second.bounds[1] + NEAR).all() and (second.bounds[0] < first.bounds[1] + NEAR).all())


def _joined(sheets: Sequence[Sheet]) -> trimesh.Trimesh:
    starts = np.cumsum([0, *(len(sheet.vertices) for sheet in sheets)])
    faces = [sheet.faces + start for sheet, start in zip(sheets, starts, strict=False)]
    return trimesh.Trimesh(np.concatenate([sheet.vertices for sheet in sheets]), np.concatenate(faces), process=False)
