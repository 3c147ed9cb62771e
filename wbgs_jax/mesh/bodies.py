"""Bodies: as the readers of room files return them, named, in the units and axes of their file; and closed ones, with tests of
which points lie inside."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from wbgs_jax._util.pytree import AnyArray


class RadioMaterial(NamedTuple):
    """Material of a body as recorded in a file."""

    name: str
    """Name of an ITU material or of a custom one."""
    thickness: float
    """Metres."""
    properties: tuple[float, float] | None = None
    """Relative permittivity and conductivity (S/m) of a custom material."""


class Body(NamedTuple):
    """One object of a file."""

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "t 3"]
    material: RadioMaterial | None = None


def joined(bodies: list[Body]) -> list[Body]:
    """Returns bodies with those of the same name joined."""
    by_name: dict[str, list[Body]] = {}
    for body in bodies:
        by_name.setdefault(body.name, []).append(body)
    found = []
    for name, own in by_name.items():
        starts = np.cumsum([0, *(len(one.vertices) for one in own)])
        vertices = np.concatenate([one.vertices for one in own])
        faces = np.concatenate([one.faces + start for one, start in zip(own, starts, strict=False)])
        found.append(Body(name, vertices, faces, next((one.material for one in own if one.material), None)))
    return found


CHUNK = 1_000_000
"""Maximum number of pairs of a point and a triangle whose solid angles are computed together; limits memory to about 100 MB."""


class ClosedBody(NamedTuple):
    """A closed object, such as a cabinet or a pillar."""

    name: str
    triangles: Float[np.ndarray, "t 3 3"]
    """Corners of the triangles, metres."""


def share_in_box(points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"]) -> float:
    """Returns the share of points (metres) that lie in the box around vertices."""
    return float(((points >= vertices.min(0)) & (points <= vertices.max(0))).all(1).mean())


def inside(body: ClosedBody, points: Float[AnyArray, "n 3"], xp: Any = np) -> Bool[AnyArray, " n"]:
    """Returns which points (metres) lie inside a body. `xp` is the module of the arrays, NumPy or `jax.numpy`."""
    if xp is not np:
        return xp.abs(_solid_angles(body.triangles, points, xp).sum(1)) > 2 * np.pi
    points = np.asarray(points, np.float64)
    low, high = body.triangles.min((0, 1)), body.triangles.max((0, 1))
    result = ((points > low) & (points < high)).all(1)
    result[result] = np.abs(winding_number(body.triangles, points[result])) > 0.5
    return result


def winding_number(triangles: Float[np.ndarray, "t 3 3"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Returns the winding number of closed triangles around every point: 0 outside, 1 or -1 inside (computed from solid angles,
    van Oosterom and Strackee 1983)."""
    step = max(1, CHUNK // max(1, len(triangles)))
    each = [_solid_angles(triangles, points[i : i + step]).sum(1) for i in range(0, len(points), step)]
    return np.concatenate([np.zeros(0), *each]) / (4 * np.pi)


def _solid_angles(
    triangles: Float[np.ndarray, "t 3 3"], points: Float[AnyArray, "n 3"], xp: Any = np
) -> Float[AnyArray, "n t"]:
    a, b, c = (triangles[None, :, corner] - points[:, None] for corner in range(3))
    la, lb, lc = (xp.linalg.norm(one, axis=-1) for one in (a, b, c))
    triple = xp.einsum("nti,nti->nt", a, xp.cross(b, c))
    below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return 2 * xp.arctan2(triple, below)
