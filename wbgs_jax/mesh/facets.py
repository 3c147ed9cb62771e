"""Represents a mesh by a few planar facets: convex polygons of three or four corners, merged from coplanar triangles of one
body.

Facets reflect, transmit and block waves. They cover every planar piece of the mesh without gaps or overlaps. A body is the unit
in which triangles are merged and edges are found (`edges.py`): an object of the scene, or several open sheets of one material
that meet, such as the walls of a room. Closed objects stay separate even where they touch. Runs on the host.

Frequent errors of exported meshes are repaired first (`repaired`): parts that contain triangles twice, where a surface would
reflect twice and transmit through two slabs, and inconsistent orientations, where no edge diffracts.
"""

import dataclasses
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import AnyArray, pytree
from wbgs_jax.types import Mesh


def components(count: int, first: Int[np.ndarray, " n"], second: Int[np.ndarray, " n"]) -> Int[np.ndarray, " nodes"]:
    """Returns the connected component of each of `count` nodes; components are numbered by their first nodes."""
    ends = first.astype(np.int32), second.astype(np.int32)  # some versions of SciPy's graph functions accept no wider indices
    joined = coo_array((np.ones(len(first), bool), ends), shape=(count, count))
    return connected_components(joined, directed=False)[1]


def sides(triangles: Int[np.ndarray, "t 3"]) -> Int[np.ndarray, "sides 2"]:
    """Returns the three sides of every triangle, the smaller corner first."""
    return np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)


def names(owner: Int[np.ndarray, " n"], sides: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Returns one integer per side and owner, the same for equal ones."""
    corners = int(sides.max(initial=0)) + 1
    return (owner.astype(np.int64) * corners + sides[:, 0]) * corners + sides[:, 1]


def repaired(
    points: Float[np.ndarray, "w 3"], triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]
) -> tuple[Int[np.ndarray, "k 3"], Int[np.ndarray, " k"]]:
    """Returns the triangles that are kept, with consistent orientations, and their indices; warns of repairs.

    Args:
        points: corners, metres, without duplicates.
        triangles: indices of corners.
        part: part of every triangle.
    """
    kept = _once(triangles, part)
    triangles, part = triangles[kept].copy(), part[kept]
    pairs = _neighbours(triangles, part)
    wrong = np.unique(part[pairs.first[pairs.against]])
    if len(wrong):
        own = np.flatnonzero(np.isin(part, wrong))
        flipped = own[_flipped(points, triangles[own], _neighbours(triangles[own], part[own]))]
        triangles[flipped] = triangles[flipped, ::-1]
        warnings.warn(f"inconsistent triangle orientations were repaired (parts of the mesh: {len(wrong)})", stacklevel=4)
    return triangles, kept


def _once(triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]) -> Int[np.ndarray, " k"]:
    """Returns the triangles without duplicates, in either orientation. Bodies of one part that touch share triangles that face
    opposite ways and have no side with an odd number of triangles; unless all of their part are repeated, these stay."""
    corners = np.sort(triangles, 1)
    _, side = np.unique(names(part, corners[:, :2]), return_inverse=True)
    _, first, which, count = np.unique(
        side * (int(corners.max(initial=0)) + 1) + corners[:, 2], return_index=True, return_inverse=True, return_counts=True
    )
    again = np.arange(len(triangles)) != first[which]
    if not again.any():
        return np.arange(len(triangles))
    single = np.zeros(part.max(initial=-1) + 1, bool)
    single[part[count[which] == 1]] = True
    _, edge, of_side = np.unique(names(np.repeat(part, 3), sides(triangles)), return_inverse=True, return_counts=True)
    odd = (of_side % 2 == 1)[edge].reshape(-1, 3).any(1)
    turn = np.prod(np.sign(triangles - np.roll(triangles, 1, 1)), 1)  # of an orientation; 0 for one with a corner twice
    again &= ~single[part] | (turn != 0) & (odd | (turn == turn[first[which]]))
    if again.any():
        doubled, few = len(np.unique(part[~single[part]])), int(np.count_nonzero(again & single[part]))
        counts = f"parts of the mesh with every triangle twice: {doubled}; triangles of other parts: {few}"
        warnings.warn(f"duplicate triangles are ignored ({counts})", stacklevel=5)
    return np.flatnonzero(~again)


class _Neighbours(NamedTuple):
    """Pairs of triangles that share a side with no other triangle of their part."""

    first: Int[np.ndarray, " n"]
    second: Int[np.ndarray, " n"]
    against: Bool[np.ndarray, " n"]
    """Whether both traverse it in the same direction, so that their orientations differ."""
    closed: Bool[np.ndarray, " t"]
    """Whether all sides of a triangle are of this kind."""


def _neighbours(triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]) -> _Neighbours:
    side = sides(triangles)
    _, which, count = np.unique(names(np.repeat(part, 3), side), return_inverse=True, return_counts=True)
    start, order = (np.cumsum(count) - count)[count == 2], np.argsort(which, kind="stable")
    one, other = order[start], order[start + 1]
    forward = (np.roll(triangles, -1, 1) > triangles).reshape(-1)
    closed = (count == 2)[which].reshape(-1, 3).all(1)
    against = (forward[one] == forward[other]) & (side[one, 0] != side[one, 1])  # a side of zero length has no direction
    return _Neighbours(one // 3, other // 3, against, closed)


def _flipped(points: Float[np.ndarray, "w 3"], triangles: Int[np.ndarray, "t 3"], pairs: _Neighbours) -> Bool[np.ndarray, " t"]:
    """Returns which triangles to flip so that orientations agree within bodies, and point outwards if these are closed."""
    count, across = len(triangles), len(triangles) * pairs.against
    # Every triangle occurs twice, as given and flipped. Consistent ones are connected, so that every body occurs twice as well.
    first = np.concatenate([pairs.first, pairs.first + count])
    second = np.concatenate([pairs.second + across, pairs.second + count - across])
    as_it_is, other_way = components(2 * count, first, second).reshape(2, count)
    body, flipped = np.minimum(as_it_is, other_way), as_it_is > other_way
    a, b, c = (points - points.mean(0))[triangles].swapaxes(0, 1)
    volume = np.bincount(body, np.where(flipped, -1, 1) * np.sum(a * np.cross(b, c), -1))
    inward = (volume < 0) & (np.bincount(body, ~pairs.closed) == 0)
    return flipped ^ inward[body]


CORNERS = 4
WELD = 1e-5
"""Metres: corners nearer than this are merged."""
FLAT = 1e-4
"""Sine of the largest angle between normals of one plane, and between sides of one straight line."""
Polygon = list[int]


@pytree
class Facets:
    """F planar convex polygons. A triangle repeats its last corner."""

    corners: Float[AnyArray, "f 4 3"]
    """World frame, metres, counter-clockwise around the normal."""
    normal: Float[AnyArray, "f 3"]
    """Unit vectors, world frame."""
    offset: Float[AnyArray, " f"]
    """Distance of the plane from the origin along the normal, metres."""
    body: Int[AnyArray, " f"]
    """Index of the body within which a facet can form edges: its object, or the open sheets of its material that meet."""
    material: Int[AnyArray, " f"]
    """Index of the mesh's material."""
    mover: Int[AnyArray, " f"]
    """Index of the rigid body that a facet moves with when the geometry is displaced: a connected component of its body."""


@pytree
class HalfPlanes:
    """Half-planes of all facets: a point of the plane lies inside where inward . point >= offset for all four sides."""

    inward: Float[AnyArray, "f 4 3"]
    """Unit vectors in the plane, world frame; zero for a side of zero length."""
    offset: Float[AnyArray, "f 4"]
    """Metres."""


def facets_from_mesh(mesh: Mesh) -> Facets:
    """Returns the facets of a mesh, which is `repaired` first, as float64 and int32 NumPy arrays, the largest first.

    Raises:
        UserError: a mesh without any surface.
    """
    points, index = _weld(np.asarray(mesh.vertices, np.float64))
    part_and_material = np.column_stack([np.asarray(mesh.part), np.asarray(mesh.material)])
    pieces, piece = np.unique(part_and_material, axis=0, return_inverse=True)
    triangles, kept = repaired(points, index[np.asarray(mesh.faces)], piece.reshape(-1))
    piece = piece.reshape(-1)[kept]
    material = pieces[piece, 1]
    body = _bodies(triangles, piece, pieces[:, 1])
    rigid_body = _rigid_bodies(triangles, body)
    normal, area = _normals(points, triangles)
    smallest_area = 1e-10  # square metres: smaller triangles are ignored
    keep = area > smallest_area
    if not keep.any():
        raise UserError("the mesh has no triangle with an area; omit the mesh, or provide one with surfaces")
    triangles, normal, body, material, rigid_body = (a[keep] for a in (triangles, normal, body, material, rigid_body))
    polygons: list[Polygon] = []
    first = []  # a triangle in every polygon's plane
    for group in _coplanar(triangles, normal, body):
        merged = _merge(points, triangles[group].tolist(), normal[group[0]])
        polygons += merged
        first += [group[0]] * len(merged)
    rows = [polygon + polygon[-1:] * (CORNERS - len(polygon)) for polygon in polygons]
    corners = points[np.array(rows, int).reshape(-1, CORNERS)]
    normals, sizes = _polygon_normals(corners)
    order = np.argsort(-sizes, kind="stable")
    owner = np.array(first, int)[order]
    offset = np.sum(normals[order] * corners[order].mean(1), -1)
    _, rigid_body = np.unique(rigid_body[owner], return_inverse=True)
    numbers = (values.astype(np.int32) for values in (body[owner], material[owner], rigid_body.reshape(-1)))
    facets = Facets(corners[order], normals[order], offset, *numbers)
    _warn_of_coincident(facets)
    return facets


def _warn_of_coincident(facets: Facets) -> None:
    """Warns of sheets that lie on each other, facets in descending order of their areas."""
    most, apart, parallel = 20_000, 1e-3, 0.999  # sheets that are compared; metres between them; cosine between their normals
    sheets = jax.tree.map(lambda leaf: leaf[~of_solids(facets)][:most], facets)
    corners, half_planes = sheets.corners, half_planes_of(sheets)
    centre, area, found = corners.mean(1), areas(sheets), []
    radius, tree = np.linalg.norm(corners - centre[:, None], axis=-1).max(1, initial=0), cKDTree(centre)
    at_once = 256  # sheets whose neighbourhood is searched together
    for first in range(0, len(centre), at_once):
        some = np.arange(first, min(first + at_once, len(centre)))
        near = tree.query_ball_point(centre[some], radius[some], return_sorted=False)
        large, small = np.repeat(some, [len(own) for own in near]), np.concatenate(near).astype(int)
        cosine = np.sum(sheets.normal[large] * sheets.normal[small], -1)
        apart_bodies = sheets.mover[large] != sheets.mover[small]  # blocks of one body that touch face opposite ways
        along = (cosine > parallel) | (cosine < -parallel) & apart_bodies
        height = np.abs(np.sum(sheets.normal[large] * centre[small], -1) - sheets.offset[large])
        pairs = np.flatnonzero((small > large) & along & (height < apart))
        large, small = large[pairs], small[pairs]
        inside = np.sum(half_planes.inward[large] * centre[small, None], -1) >= half_planes.offset[large]
        found.append(small[inside.all(-1)])
    twice = np.concatenate([*found, np.zeros(0, int)])
    if len(twice):
        where = ", ".join(f"{value:.4g}" for value in centre[twice[0]])
        warnings.warn(
            f"open surfaces of the mesh lie on each other (pairs: {len(twice)}, {area[np.unique(twice)].sum():.3g} square "
            f"metres, the largest at {where} m), and waves meet both; remove one of each pair",
            stacklevel=4,
        )


def centres(facets: Facets, rigid_bodies: int) -> Float[Array, "m 3"]:
    """Returns the centres about which the rigid bodies rotate: the means of their facets' corners, metres."""
    start = jnp.zeros((rigid_bodies, 3)), jnp.zeros((rigid_bodies, 1))
    total = start[0].at[facets.mover].add(jnp.mean(jnp.asarray(facets.corners, jnp.float32), 1))
    return total / jnp.maximum(start[1].at[facets.mover].add(1), 1)


def moved(facets: Facets, shift: Float[np.ndarray, "m 3"], turn: Float[np.ndarray, "m 3"]) -> Facets:
    """Returns the facets with their rigid bodies rotated about their centres and shifted.

    Args:
        facets: at their nominal positions.
        shift: of every rigid body, metres.
        turn: rotation vector of every rigid body, radians.
    """
    rigid_body, corners = np.asarray(facets.mover), np.asarray(facets.corners, np.float64)
    centre, rotation = np.asarray(centres(facets, len(shift)), np.float64)[rigid_body], Rotation.from_rotvec(turn[rigid_body])
    arms = corners - centre[:, None]
    rotated = np.stack([rotation.apply(arms[:, k]) for k in range(CORNERS)], 1)
    corners = centre[:, None] + rotated + np.asarray(shift, np.float64)[rigid_body][:, None]
    normal = rotation.apply(np.asarray(facets.normal, np.float64))
    return dataclasses.replace(facets, corners=corners, normal=normal, offset=np.sum(normal * corners.mean(1), -1))


def remaining(facets: Facets, rigid_bodies: Int[np.ndarray, " k"]) -> Facets:
    """Returns the facets of the given rigid bodies (indices, ascending), which are renumbered in that order."""
    own = np.isin(np.asarray(facets.mover), rigid_bodies)
    left: Facets = jax.tree.map(lambda leaf: np.asarray(leaf)[own], facets)
    return dataclasses.replace(left, mover=np.searchsorted(rigid_bodies, left.mover).astype(np.int32))


def half_planes_of(facets: Facets) -> HalfPlanes:
    """Returns the half-planes of all facets (float64). Where two facets meet, one of them ends `WELD` before the other begins,
    so that a point on the seam, as is common in rooms with round dimensions, hits exactly one of them."""
    corners = np.asarray(facets.corners, np.float64)
    along = np.roll(corners, -1, 1) - corners
    inward = np.cross(np.asarray(facets.normal)[:, None], along)
    length = np.linalg.norm(inward, axis=-1, keepdims=True)
    inward = np.where(length > WELD, inward / np.maximum(length, WELD), 0)
    first = np.take_along_axis(inward, np.argmax(np.abs(inward) > FLAT, -1)[..., None], -1)[..., 0]
    return HalfPlanes(inward, np.sum(inward * corners, -1) + WELD * (first < 0))


def areas(facets: Facets) -> Float[np.ndarray, " f"]:
    """Returns the areas of all facets in square metres."""
    return _polygon_normals(np.asarray(facets.corners))[1]


def of_solids(facets: Facets) -> Bool[np.ndarray, " f"]:
    """Returns which facets belong to closed bodies, whose normals point outwards; all others are sheets. A closed body as large
    as the scene is the room itself, hence made of sheets."""
    corners, area, closed = np.asarray(facets.corners), areas(facets), np.zeros(len(facets.offset), bool)
    room_share = 0.9  # minimum size of the room's own mesh relative to the scene's length, width and height
    room = room_share * np.ptp(corners, axis=(0, 1))
    gap = 0.01  # maximum share of the surface that a closed body may lack
    for group in (np.asarray(facets.mover), np.asarray(facets.body)):
        flux, low, high = np.zeros((3, group.max(initial=-1) + 1, 3))
        low[:], high[:] = np.inf, -np.inf
        np.add.at(flux, group, np.asarray(facets.normal) * area[:, None])
        np.minimum.at(low, group, corners.min(1))
        np.maximum.at(high, group, corners.max(1))
        whole = np.linalg.norm(flux, axis=-1) < gap * np.bincount(group, area, len(flux))
        closed |= (whole & ~(high - low > room).all(-1))[group]
    return closed


def _weld(vertices: Float[np.ndarray, "v 3"]) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, " v"]]:
    """Returns the corners without duplicates, and the new index of every vertex."""
    different, which = np.unique(vertices, axis=0, return_inverse=True)  # first, as there may be many pairs of equal ones
    pairs = cKDTree(different).query_pairs(WELD, output_type="ndarray")
    index = components(len(different), pairs[:, 0], pairs[:, 1])[which.reshape(-1)]
    _, first = np.unique(index, return_index=True)
    return vertices[first], index


def _bodies(
    triangles: Int[np.ndarray, "t 3"], piece: Int[np.ndarray, " t"], material: Int[np.ndarray, " pieces"]
) -> Int[np.ndarray, " t"]:
    """Returns the body of every triangle: its piece (the triangles of one part and material), or all open pieces of its
    material that meet in corners of their borders.

    A piece is open if one of its sides belongs to an odd number of triangles. (This differs from trimesh's watertightness: two
    blocks of one object that touch along an edge share it four times, and are closed.)
    """
    owner, side = np.repeat(piece, 3), sides(triangles)
    _, first, count = np.unique(names(owner, side), return_index=True, return_counts=True)
    border = first[(count % 2 == 1) & (side[first, 0] != side[first, 1])]
    owner, corner = np.repeat(owner[border], 2), side[border].reshape(-1)
    _, shared = np.unique(np.column_stack([material[owner], corner]), axis=0, return_inverse=True)
    # The nodes of the graph are the pieces, followed by the corners of borders, one for each material that meets there.
    label = components(len(material) + len(owner), owner, len(material) + shared.reshape(-1))
    return label[piece]


def _rigid_bodies(triangles: Int[np.ndarray, "t 3"], body: Int[np.ndarray, " t"]) -> Int[np.ndarray, " t"]:
    """Returns the rigid body of every triangle: triangles of one body that are connected by common corners share it."""
    _, node = np.unique(np.column_stack([np.repeat(body, 3), triangles.reshape(-1)]), axis=0, return_inverse=True)
    node = node.reshape(-1, 3)
    label = components(int(node.max(initial=-1)) + 1, node[:, [0, 1]].reshape(-1), node[:, [1, 2]].reshape(-1))
    return label[node[:, 0]]


def _normals(
    points: Float[np.ndarray, "w 3"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, " t"]]:
    """Returns unit normals and areas (square metres) of triangles."""
    a, b, c = points[triangles].swapaxes(0, 1)
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=-1)
    return cross / np.maximum(length, 1e-30)[:, None], length / 2


def _polygon_normals(corners: Float[np.ndarray, "f 4 3"]) -> tuple[Float[np.ndarray, "f 3"], Float[np.ndarray, " f"]]:
    """Returns unit normals and areas (square metres) of polygons."""
    cross = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    cross = np.where(
        np.linalg.norm(corners[:, 3] - corners[:, 2], axis=-1, keepdims=True) < WELD,
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
        cross,
    )
    length = np.linalg.norm(cross, axis=-1)
    return cross / np.maximum(length, 1e-30)[:, None], length / 2


def _coplanar(
    triangles: Int[np.ndarray, "t 3"], normal: Float[np.ndarray, "t 3"], body: Int[np.ndarray, " t"]
) -> list[Int[np.ndarray, " k"]]:
    """Returns groups of triangles (indices) of one body that are connected by common sides and coplanar."""
    _, first, which = np.unique(names(np.repeat(body, 3), sides(triangles)), return_index=True, return_inverse=True)
    owner = np.repeat(np.arange(len(triangles)), 3)
    other = owner[first[which]]
    flat = _parallel(normal[owner], normal[other])
    label = components(len(triangles), owner[flat], other[flat])
    by_group = np.argsort(label, kind="stable")
    return np.split(by_group, np.flatnonzero(np.diff(label[by_group])) + 1)


def _parallel(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Returns whether unit normals agree."""
    return (np.linalg.norm(np.cross(a, b), axis=-1) < FLAT) & (np.sum(a * b, -1) > 0)


def _merge(points: Float[np.ndarray, "w 3"], polygons: list[Polygon], normal: Float[np.ndarray, "3"]) -> list[Polygon]:
    """Returns polygons with neighbours merged as long as the union is convex with at most four corners."""
    merged = True
    while merged:
        merged = False
        owner: dict[tuple[int, int], int] = {}
        for i, polygon in enumerate(polygons):
            for side in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                owner[side] = i
        used: set[int] = set()
        joined: list[Polygon] = []
        for (u, v), i in owner.items():
            j = owner.get((v, u))
            if j is None or i == j or i in used or j in used:
                continue
            union = _join(points, polygons[i], polygons[j], u, v, normal)
            if union is not None:
                joined.append(union)
                used |= {i, j}
                merged = True
        polygons = [polygon for i, polygon in enumerate(polygons) if i not in used] + joined
    return polygons


def _join(
    points: Float[np.ndarray, "w 3"], first: Polygon, second: Polygon, u: int, v: int, normal: Float[np.ndarray, "3"]
) -> Polygon | None:
    """Returns the union over the side u-v, without corners on straight lines; None unless convex with at most four corners."""
    i, j = first.index(v), second.index(u)
    ring = first[i:] + first[:i] + (second[j:] + second[:j])[1:-1]
    corners = []
    for before, here, after in zip(ring[-1:] + ring[:-1], ring, ring[1:] + ring[:1], strict=True):
        a, b = points[here] - points[before], points[after] - points[here]
        turn = np.cross(a, b) @ normal / (np.linalg.norm(a) * np.linalg.norm(b))
        if turn < -FLAT:
            return None
        if turn > FLAT:
            corners.append(here)
    return corners if 3 <= len(corners) <= CORNERS else None
