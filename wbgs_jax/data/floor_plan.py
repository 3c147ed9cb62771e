"""Walls of a floor plan: the number of walls between two points, and a mesh of the walls.

walls.csv (or layout.csv) has segments x1,y1,x2,y2, one per wall, optionally with the class of each (`material`), or the corners
x,y of an outline of free space, in which a wall between rooms has two faces. A column `room` separates several outlines, or
empty lines, or the first corner of each at its end. Metres.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree, static
from wbgs_jax.data.tables import check_positions, numbers, read_lines, read_table

FILES = ("walls.csv", "layout.csv")
CLASSES = ("material", "class", "type")
"""Names of the column of segments with the class of each wall."""
ON_WALL = 1e-2
"""Metres: a point this near to a wall counts as lying on it, and the wall as no obstacle."""


@pytree
class Walls:
    """W vertical walls."""

    ends: Float[Array | np.ndarray, "w 2 2"]
    """End points of every wall on the floor, metres."""
    share: Float[Array | np.ndarray, " w"]
    """Weight: 1, or 1/2 for each face of a wall drawn with two faces."""
    of_class: Float[Array | np.ndarray, "w c"] | None = None
    """1 where a wall belongs to a class, else 0; None without classes."""
    classes: tuple[str, ...] = static(default=())
    """Names of the classes."""


NO_WALLS = Walls(np.zeros((0, 2, 2)), np.zeros(0))


@dataclass(frozen=True)
class _Format:
    columns: tuple[str, ...]
    share: float


SEGMENTS, OUTLINE = _Format(("x1", "y1", "x2", "y2"), 1.0), _Format(("x", "y"), 0.5)


def load_walls(path: Path) -> Walls:
    """Reads the walls of a CSV file.

    Args:
        path: of the file, in metres.

    Returns:
        The walls (docs/measured.md).

    Raises:
        UserError: the file is in neither of the two forms.
    """
    header, rows = read_table(path)
    form = SEGMENTS if SEGMENTS.columns[0] in header else OUTLINE
    values = numbers(path, header, rows, list(form.columns))
    check_positions(f"{path}: corners", values)
    ignored = ("id", "name", "thickness", "comment", "note")  # names of columns that are not used
    outline_column = "room"  # column that separates outlines
    allowed = (*form.columns, *ignored, *(CLASSES if form is SEGMENTS else (CLASSES[0], outline_column)))
    if other := [name for name in header if name not in allowed]:
        raise UserError(
            f"{path} has an unknown column {other[0]!r}; the columns of a floor plan are {', '.join(form.columns)}"
            + (f" and, for several outlines, {outline_column}" if form is OUTLINE else "")
        )
    if form is SEGMENTS:
        return Walls(values.reshape(-1, 2, 2), np.full(len(values), form.share), *_classes(path, header, rows))
    if outline_column in header:
        room = np.array([row[header.index(outline_column)] for row in rows])
        outlines = [values[room == one] for one in dict.fromkeys(room.tolist())]
    else:
        outlines = np.split(values, _gaps(path))
    outlines = [ring for corners in outlines for ring in _rings(path, corners)]
    ends = np.concatenate([np.stack([corners, np.roll(corners, -1, 0)], 1) for corners in outlines])
    return Walls(ends, np.full(len(ends), form.share))


def _classes(path: Path, header: list[str], rows: list[list[str]]) -> tuple[Float[np.ndarray, "w c"] | None, tuple[str, ...]]:
    """Returns which walls belong to which class, and the names of the classes; none if there is only one."""
    named = [name for name in CLASSES if name in header]
    if len(named) > 1:
        raise UserError(f"{path} has the columns {named[0]!r} and {named[1]!r}; name the class of a wall in one of them")
    if not named:
        return None, ()
    own = [row[header.index(named[0])].strip().lower() for row in rows]
    classes, most = tuple(sorted({*own} - {""})), 10  # an empty cell is no class
    if len(classes) > most:
        raise UserError(f"{path} has {len(classes)} different values in the column {named[0]!r}; at most {most} can be learned")
    if len(set(own)) < 2:
        return None, ()
    return np.array([[1.0 * (name == one) for one in classes] for name in own]), classes


def _gaps(path: Path) -> Int[np.ndarray, " g"]:
    """Returns the rows of a CSV file that more empty lines precede than others (some programs write one after every row)."""
    empty = np.array([not any(row) for _, row in read_lines(path)])
    before = np.diff(np.cumsum(empty)[~empty][1:])  # every row but the header and the first
    return 1 + np.flatnonzero(before > before.min(initial=len(empty)))


def _rings(path: Path, corners: Float[np.ndarray, "n 2"]) -> list[Float[np.ndarray, "k 2"]]:
    """Returns the closed outlines, each ending in its first corner, that corners consist of; all corners if there is only one.

    Raises:
        UserError: the last of several outlines is not closed.
    """
    rings, start = [], 0
    for k in range(len(corners)):
        if k - start >= 3 and (corners[k] == corners[start]).all():
            rings.append(corners[start:k])
            start = k + 1
    if rings and start < len(corners):
        raise UserError(
            f"{path}: an outline returns to its first corner {rings[-1][0].tolist()}, but the corners after it do not "
            "return to theirs; separate the outlines by a column room"
        )
    return rings or [corners]


def namespace(array: Any) -> Any:
    """Returns the module of an array: geometry is computed in NumPy in double precision, and used in JAX."""
    return np if isinstance(array, np.ndarray) else jnp


def crossings(
    walls: Walls, start: Float[Array | np.ndarray, "*#n 2"], goal: Float[Array | np.ndarray, "*#n 2"]
) -> Float[Array | np.ndarray, "*#n"]:
    """Returns the number of walls between points of the plan; walls that contain one of the points do not count."""
    return namespace(start).sum(crossed(walls, start, goal), -1)


def crossed(
    walls: Walls, start: Float[Array | np.ndarray, "*#n 2"], goal: Float[Array | np.ndarray, "*#n 2"]
) -> Float[Array | np.ndarray, "*#n w"]:
    """Returns the weights of the walls between points of the plan, 0 for all others."""
    xp, along = namespace(start), walls.ends[:, 1] - walls.ends[:, 0]
    ray, corner = (goal - start)[..., None, :], walls.ends[:, 0] - start[..., None, :]
    ground = _cross(ray, along)
    parallel = 1e-9  # square metres: smaller cross products count as parallel
    safe = xp.where(xp.abs(ground) < parallel, 1.0, ground)
    on_ray, on_wall = _cross(corner, along) / safe, _cross(corner, ray) / safe
    long = xp.sqrt(xp.sum(along**2, -1))
    apart = xp.abs(ground) / xp.where(long > 0, long, 1.0)  # distance between the two points, perpendicular to the wall
    near = xp.minimum(on_ray, 1 - on_ray) * apart  # distance of the nearer point from the wall
    hit = (xp.abs(ground) >= parallel) & (near > ON_WALL) & (on_wall >= 0) & (on_wall < 1)
    return xp.where(hit, walls.share, 0.0)


def _cross(a: Any, b: Any) -> Any:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def extruded(walls: Walls, height: float) -> trimesh.Trimesh:
    """Returns a mesh of the walls for fields that need one: vertical rectangles without thickness between a floor at z = 0 and
    a ceiling, which extend over all of them.

    Args:
        walls: of the plan.
        height: of the ceiling, metres.
    """
    low, high = np.asarray(walls.ends).min((0, 1)), np.asarray(walls.ends).max((0, 1))
    sheets = [[[*a, 0], [*b, 0], [*b, height], [*a, height]] for a, b in np.asarray(walls.ends) if not np.allclose(a, b)]
    for z in (0.0, height):
        sheets.append([[low[0], low[1], z], [high[0], low[1], z], [high[0], high[1], z], [low[0], high[1], z]])
    vertices = np.array(sheets, float).reshape(-1, 3)
    corner = 4 * np.arange(len(sheets))[:, None, None]
    faces = (corner + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, process=False)
