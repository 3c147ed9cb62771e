"""Converts walls modelled as closed boxes to single sheets: building models give a wall two faces, while the propagation model
needs one surface with a slab of the wall's thickness.

A wave that passes two surfaces, each a slab of the wall's thickness, would be attenuated twice. Of a thin closed body,
therefore, only the face towards the nearest antenna is kept (towards the middle of the scene if there is none), and the
distance between its two faces is the thickness.
Surfaces that met are joined again: a panel in an opening moves into the plane of its wall, and a sheet that ended at a removed
face is extended to the remaining one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

MOST_FACES = 2_000
"""Maximum number of triangles of a wall."""
FLAT = 1e-3
"""Metres: maximum distance of corners from the plane of a face, and of the corners of a side from a line."""
PARALLEL = 0.999
"""Minimum cosine between the normals of one face."""
SAME_DEPTH = 1.1
"""Maximum ratio between thicknesses that count as the same."""
NEAR = 0.02
"""Maximum distance between touching bodies, metres."""


@dataclass
class Sheet:
    """A planar piece of surface and the body that it represents."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "t 3"]
    normal: Float[np.ndarray, "3"]
    thickness: float
    """Distance between the two faces of the body, metres; 0 if there was only one."""
    bounds: Float[np.ndarray, "2 3"]
    """Lowest and highest corner of the body."""
    span: Float[np.ndarray, "2"]
    """Lowest and highest coordinate of the body along the normal, metres."""

    @property
    def offset(self) -> float:
        """Coordinate of the plane along the normal, metres."""
        return float(self.vertices[0] @ self.normal)

    def axes(self) -> Float[np.ndarray, "2 3"]:
        """Returns two orthogonal unit vectors in the plane, the first one horizontal."""
        level = np.cross(self.normal, [0.0, 0.0, 1.0])
        size = np.linalg.norm(level)
        first = level / size if size > 1e-3 else np.array([1.0, 0.0, 0.0])
        return np.stack([first, np.cross(self.normal, first)])


def walls_as_sheets(
    meshes: Sequence[trimesh.Trimesh], antennas: Float[np.ndarray, "n 3"] | None = None
) -> tuple[list[trimesh.Trimesh], list[float]]:
    """Returns the meshes of a room with those consisting only of walls converted to sheets, and the thickness of these walls.

    Args:
        meshes: metres, z up.
        antennas: positions of transmitters and receivers, metres; those outside of the box around the scene are ignored.

    Returns:
        The meshes, and one thickness per mesh (metres), 0 for those that are not walls.
    """
    corners = np.concatenate([mesh.bounds for mesh in meshes])
    places = np.zeros((0, 3)) if antennas is None else antennas
    places = places[((places > corners.min(0)) & (places < corners.max(0))).all(1)]
    places = places if len(places) else (corners.min(0) + corners.max(0))[None] / 2
    walls = [_walls(mesh, places) for mesh in meshes]
    if not any(walls):
        return list(meshes), [0.0] * len(meshes)
    single = [[] if own else _panels(mesh) for mesh, own in zip(meshes, walls, strict=True)]
    sheets = [sheet for own in (*walls, *single) for sheet in own]
    _move_panels(sheets)
    _extend(sheets)
    pieces = [own or panels for own, panels in zip(walls, single, strict=True)]
    results = [_joined(own) if own else mesh for mesh, own in zip(meshes, pieces, strict=True)]
    return results, [float(np.median([sheet.thickness for sheet in own])) if own else 0.0 for own in walls]


def divided(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Returns the walls of a mesh, one mesh for each thickness, and the rest; the mesh itself if it is all of one kind.
    Programs that name objects by their class give one name to walls of several thicknesses."""
    bodies = list(mesh.split(only_watertight=False)) if mesh.is_watertight else []
    if len(bodies) < 2:
        return [mesh]
    found = [_wall(body, body.bounds.mean(0)[None]) for body in bodies]
    panel = 0.05  # metres: thickness below which a body is a panel of furniture
    depths = [0.0 if wall is None or wall.thickness < panel else wall.thickness for wall in found]
    kinds: list[list[int]] = []
    for i in np.argsort(depths, kind="stable"):
        if not kinds or depths[i] > SAME_DEPTH * depths[kinds[-1][0]]:
            kinds.append([])
        kinds[-1].append(int(i))
    return [_joined([bodies[i] for i in kind]) for kind in kinds] if len(kinds) > 1 else [mesh]


def hidden_walls(mesh: trimesh.Trimesh) -> float:
    """Returns the mean thickness (metres) of a closed body as large as a room whose walls have two faces; 0 for all others."""
    floor, height, thickest = 1.0, 1.5, 0.3  # metres: least horizontal and vertical extent, and largest mean thickness
    if not mesh.is_watertight or (mesh.extents < (floor, floor, height)).any():
        return 0.0
    depth = 2 * abs(float(mesh.volume)) / float(mesh.area)
    return depth if depth < thickest else 0.0


def _walls(mesh: trimesh.Trimesh, places: Float[np.ndarray, "n 3"]) -> list[Sheet]:
    """Returns a sheet for every body of a mesh; none unless all bodies are walls of equal thickness within 10 %."""
    if not mesh.is_watertight:
        return []
    found = [_wall(body, places) for body in mesh.split(only_watertight=False)]
    sheets = [sheet for sheet in found if sheet is not None]
    thickness = [sheet.thickness for sheet in sheets]
    return sheets if sheets and len(sheets) == len(found) and max(thickness) < SAME_DEPTH * min(thickness) else []


def _wall(body: trimesh.Trimesh, places: Float[np.ndarray, "n 3"]) -> Sheet | None:
    """Returns the face of a slab towards the nearest of some points; None if the body is not a wall."""
    normals, areas = np.asarray(body.face_normals), np.asarray(body.area_faces)
    if len(normals) > MOST_FACES:
        return None
    normal = normals[np.argmax((np.abs(normals @ normals.T) > PARALLEL) @ areas)]
    heights = np.asarray(body.triangles) @ normal
    flat = np.ptp(heights, axis=1) < FLAT
    top, bottom = (flat & (np.abs(heights[:, 0] - level) < FLAT) for level in (heights.max(), heights.min()))
    thickness = float(np.ptp(heights))
    thickest = 0.6  # maximum thickness of a wall or floor, metres
    faces = np.array([areas[top].sum(), areas[bottom].sum()])
    least = 0.25  # minimum ratio between the areas of the two faces
    if not 0 < thickness <= thickest or faces.min() <= least * faces.max():
        return None
    sheet = _sheet(body, top, normal, thickness)
    unequal = 0.02  # maximum relative difference between the areas, besides that of two mitred ends
    if np.ptp(faces) > unequal * faces[0] + 2 * thickness * float(np.ptp(sheet.vertices @ sheet.axes().T, axis=0).max()):
        return None
    axes = np.stack([normal, *sheet.axes()])
    own, others = body.vertices @ axes.T, places @ axes.T
    away = np.maximum(np.maximum(own.min(0) - others, others - own.max(0)), 0)
    if others[np.argmin(np.linalg.norm(away, axis=1)), 0] < own[:, 0].mean():
        sheet = _sheet(body, bottom, normal, thickness)
    side = float(np.ptp(sheet.vertices @ sheet.axes().T, axis=0).min())
    # Metres: minimum of the smaller side of a vertical and of a horizontal slab. A table top stays a body with edges.
    smallest_wall, smallest_floor = 0.5, 2.0
    smallest = smallest_floor if abs(normal[2]) > PARALLEL else smallest_wall
    thin = 0.25  # maximum ratio of the thickness to the smaller of the two other sides
    return sheet if side >= smallest and thickness <= thin * side else None


def _panels(mesh: trimesh.Trimesh) -> list[Sheet]:
    """Returns a planar mesh as a sheet, as it may be a pane or a door in an opening; nothing for other meshes."""
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
    """Moves panels within the thickness of a parallel wall into the wall's plane, so that no gap remains beside them."""
    for panel in sheets:
        for wall in sheets:
            low, high = np.sort(panel.span * np.sign(panel.normal @ wall.normal))
            inside = abs(panel.normal @ wall.normal) > PARALLEL and wall.span[0] - NEAR < low and high < wall.span[1] + NEAR
            if inside and panel.thickness < wall.thickness and _touch(panel, wall):
                panel.vertices += (wall.offset - panel.vertices @ wall.normal)[:, None] * wall.normal
                break


def _extend(sheets: Sequence[Sheet]) -> None:
    """Extends walls to the plane of the wall that their bodies touched."""
    moves = [(sheet, *move) for sheet in sheets if sheet.thickness for move in _extensions(sheet, sheets)]
    for sheet, corners, step in moves:
        sheet.vertices[corners] += step


def _extensions(sheet: Sheet, sheets: Sequence[Sheet]) -> list[tuple[Bool[np.ndarray, " v"], Float[np.ndarray, "3"]]]:
    """Returns which corners of a sheet are to be moved, and their displacement (metres)."""
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


def _joined(sheets: Sequence[Sheet | trimesh.Trimesh]) -> trimesh.Trimesh:
    starts = np.cumsum([0, *(len(sheet.vertices) for sheet in sheets)])
    faces = [sheet.faces + start for sheet, start in zip(sheets, starts, strict=False)]
    return trimesh.Trimesh(np.concatenate([sheet.vertices for sheet in sheets]), np.concatenate(faces), process=False)
