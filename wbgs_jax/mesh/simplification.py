"""Simplification of a finely tessellated mesh, with a measure of the deviation from the original (host).

Vertices are collapsed into neighbours where that changes the surfaces least, by quadric error metrics (Garland and Heckbert,
SIGGRAPH 1997): the sum of squared distances from the planes that met in a vertex, weighted by area. A border adds a plane
perpendicular to its surface, so that sheets keep their outline. The remaining vertices are vertices of the original mesh, so
planes stay planes. Separate objects are never merged, and large surfaces are simplified last. Many vertices that are not
neighbours are collapsed at once.
"""

import dataclasses
import warnings
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array

from wbgs_jax.mesh.facets import Facets, areas, facets_from_mesh
from wbgs_jax.types import Mesh

FEW = 3000
"""Number of facets that cost little time: at least this many of the existing ones are kept (and this many of a simplified
mesh), ..."""
KEPT = 0.98
"""... and as many of the largest ones as make up this fraction of the surface."""
LEFT_OUT = 0.1
"""Fraction of the surface that may be omitted as its smallest facets before the mesh is simplified instead."""

Quadrics = Float[np.ndarray, "v 10"]
"""Coefficients xx, xy, xz, yy, yz, zz, x, y, z and 1 of the sum of squared distances from planes, relative to the vertex:
relative to the origin of a large room, rounding errors would exceed the contributions of small objects."""


@dataclass(frozen=True)
class Simplified:
    """Size of a simplified mesh and its deviation from the original."""

    triangles: int
    """Triangles of the original mesh ..."""
    left: int
    """... and of the simplified one."""
    typical_mm: float
    """Median distance of points on the original mesh from the simplified one, millimetres ..."""
    largest_mm: float
    """... and the 99th percentile of these distances, millimetres."""

    def __str__(self) -> str:
        size = f"{self.typical_mm:.2f} mm in the median, 99 of 100 points within {self.largest_mm:.1f} mm"
        return f"the mesh of {self.triangles:,} triangles was simplified to {self.left:,}: {size}"


def facets_that_fit(mesh: Mesh, most: int) -> Facets:
    """Returns at most `most` facets: the largest of the mesh, as many as matter (`FEW`, `KEPT`), or those of a simplified mesh
    if the largest would omit too much of the surface (`LEFT_OUT`). A warning then states the deviation from the original
    mesh."""
    fine = 300_000  # triangles: larger meshes are simplified before coplanar triangles are merged, which would take longer
    if len(mesh.faces) <= fine:
        found = facets_from_mesh(mesh)
        share = np.cumsum(areas(found)) / areas(found).sum()
        if share[min(most, len(share)) - 1] >= 1 - LEFT_OUT:
            enough = max(FEW, int(np.searchsorted(share, KEPT)) + 1)
            return jax.tree.map(lambda leaf: leaf[: min(most, enough)], found)
    most = min(most, FEW)
    count = 2 * most  # pairs of triangles often make one facet
    for _ in range(4):
        small, what = simplified(mesh, count)
        found = facets_from_mesh(small)
        if len(found.offset) <= most:
            break
        count = max(most, int(count * 0.95 * most / len(found.offset)))
    warnings.warn(str(what), stacklevel=2)
    return jax.tree.map(lambda leaf: leaf[:most], found)


def simplified(mesh: Mesh, triangles: int, seed: int = 0) -> tuple[Mesh, Simplified]:
    """Returns a mesh of at most `triangles` triangles, if its shape allows, and its deviation from the original.

    Args:
        mesh: objects (`part`) and materials stay separate.
        triangles: number of triangles to keep.
        seed: of the points at which distances are measured.
    """
    faces, part, material = (np.asarray(leaf) for leaf in (mesh.faces, mesh.part, mesh.material))
    corners = np.asarray(mesh.vertices, np.float64)[faces]
    pieces, piece = np.unique(np.stack([part, material], 1), axis=0, return_inverse=True)
    points, own = welded(corners, piece.reshape(-1))
    left, which = decimated(points, own, triangles)
    small = dataclasses.replace(
        mesh,
        vertices=jnp.asarray(points, jnp.float32),
        faces=jnp.asarray(left, jnp.int32),
        part=jnp.asarray(pieces[piece.reshape(-1)[which], 0], jnp.int32),
        material=jnp.asarray(pieces[piece.reshape(-1)[which], 1], jnp.int32),
    )
    far = distances(corners, points[left], seed)
    sizes = (float(1e3 * np.quantile(far, share)) for share in (0.5, 0.99))
    return small, Simplified(len(faces), len(left), *sizes)


def welded(
    corners: Float[np.ndarray, "t 3 3"], piece: Int[np.ndarray, " t"]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]:
    """Returns the corners of every piece without duplicates, and the indices of all triangles' corners among them."""
    weld = 1e-5  # metres: corners of one object that are nearer than this are merged
    grid = np.round(corners.reshape(-1, 3) / weld).astype(np.int64)
    keys = np.ascontiguousarray(np.column_stack([np.repeat(piece, 3), grid]))
    rows = keys.view([("", keys.dtype)] * 4).reshape(-1)
    _, first, which = np.unique(rows, return_index=True, return_inverse=True)
    return corners.reshape(-1, 3)[first], which.reshape(-1, 3)


def decimated(
    points: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], count: int
) -> tuple[Int[np.ndarray, "l 3"], Int[np.ndarray, " l"]]:
    """Returns at most `count` triangles, if their shape allows, and the index of each among the original ones."""
    which = np.flatnonzero((triangles != np.roll(triangles, 1, 1)).all(1))
    triangles = triangles[which]
    quadrics, rng = vertex_quadrics(points, triangles), np.random.default_rng(0)
    refused, fewer = np.zeros(0, np.int64), False
    while len(triangles) > count:
        sides = _Sides.of(points, triangles, quadrics, refused, rng)
        removed, kept, no = sides.collapses(points, triangles, (len(triangles) - count + 1) // 2)
        if not len(removed) and not len(no):  # every side left has been refused; the reasons may have disappeared since
            if not fewer:
                break
            refused, fewer = refused[:0], False
            continue
        refused, fewer = np.union1d(refused, no), fewer or len(removed) > 0
        np.add.at(quadrics, kept, _displaced(quadrics[removed], points[kept] - points[removed]))
        target = np.arange(len(points))
        target[removed] = kept
        triangles = target[triangles]
        alive = (triangles != np.roll(triangles, 1, 1)).all(1)
        triangles, which = triangles[alive], which[alive]
    return triangles, which


def vertex_quadrics(points: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> Quadrics:
    """Returns the quadrics of all vertices: planes of their triangles, weighted by area, and perpendicular planes on
    borders."""
    a, b, c = points[triangles].swapaxes(0, 1)
    normal, twice = _unit(np.cross(b - a, c - a))
    planes = _plane(normal) * (twice / 2)[:, None]
    quadrics = np.zeros((len(points), 10))
    for corner in triangles.T:
        np.add.at(quadrics, corner, planes)
    sides = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    border = np.flatnonzero(_multiplicity(sides, len(points)) == 1)
    u, v = sides[border].T
    upright, length = _unit(np.cross(points[v] - points[u], normal[border // 3]))
    weight = 10.0  # weight of a border's perpendicular plane, whose area is the square of the border's length
    walls = weight * _plane(upright) * (length**2)[:, None]
    for corner in (u, v):
        np.add.at(quadrics, corner, walls)
    return quadrics


def distances(corners: Float[np.ndarray, "t 3 3"], others: Float[np.ndarray, "f 3 3"], seed: int) -> Float[np.ndarray, " n"]:
    """Returns the distances (metres) of points drawn at random on triangles from other triangles."""
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    rng = np.random.default_rng(seed)
    number = 1000  # points on the mesh whose distances from the simplified mesh are measured
    one = corners[rng.choice(len(corners), number, p=area / area.sum())]
    probes = np.sum(one * rng.dirichlet(np.ones(3), number)[..., None], 1)
    return np.array([distance_from(probe, others) for probe in probes])


def distance_from(point: Float[np.ndarray, "3"], triangles: Float[np.ndarray, "f 3 3"]) -> float:
    """Returns the distance from a point to the nearest triangle: to its plane if the foot lies inside it, else to a side."""
    along = np.roll(triangles, -1, 1) - triangles
    arm = point - triangles
    share = np.sum(arm * along, -1) / np.maximum(np.sum(along**2, -1), 1e-30)
    to_sides = np.linalg.norm(arm - np.clip(share, 0, 1)[..., None] * along, axis=-1).min(1)
    normal, twice = _unit(np.cross(along[:, 0], along[:, 1]))
    over = (np.sum(np.cross(along, arm) * normal[:, None], -1) >= 0).all(1) & (twice > 0)
    height = np.abs(np.sum(arm[:, 0] * normal, -1))
    return float(np.where(over, height, to_sides).min())


@dataclass(frozen=True)
class _Sides:
    """Directed sides of triangles, and the cost of collapsing their first ends into the second ones."""

    start: Int[np.ndarray, " e"]
    end: Int[np.ndarray, " e"]
    cost: Float[np.ndarray, " e"]

    @classmethod
    def of(
        cls,
        points: Float[np.ndarray, "v 3"],
        triangles: Int[np.ndarray, "t 3"],
        quadrics: Quadrics,
        refused: Int[np.ndarray, " n"],
        rng: np.random.Generator,
    ) -> "_Sides":
        names = np.sort(_side_key(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), len(points)))
        names = names[np.append(True, np.diff(names) > 0)]
        u, v = names // len(points), names % len(points)
        way = points[v] - points[u]
        # Extra cost of a side: this factor times the fourth power of its length and a random factor of 1 to 2. Flat pieces lose
        # their short sides first, in a random order in which many can be collapsed at once.
        extra = 1e-16
        short = extra * np.sum(way**2, -1) ** 2
        to_v, to_u = _at(quadrics[u], way) + quadrics[v, -1], _at(quadrics[v], -way) + quadrics[u, -1]
        cost = [np.maximum(one, 0) + short * rng.uniform(1, 2, len(u)) for one in (to_v, to_u)]
        start, end = np.concatenate([u, v]), np.concatenate([v, u])
        refuses = np.isin(start * len(points) + end, refused) if len(refused) else False
        return cls(start, end, np.where(refuses, np.inf, np.concatenate(cost)))

    def collapses(
        self, points: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], most: int
    ) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Int[np.ndarray, " n"]]:
        """Returns vertices to remove, no two of them neighbours, the neighbours they collapse into, and sides refused."""
        lowest_cost, best = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
        np.minimum.at(lowest_cost, self.start, self.cost)
        is_best = np.flatnonzero(self.cost == lowest_cost[self.start])
        best[self.start[is_best]] = is_best
        by_cost = np.argsort(lowest_cost)
        rank = np.empty(len(points), np.int64)
        rank[by_cost] = np.arange(len(points))
        lowest = np.full(len(points), len(points))
        np.minimum.at(lowest, self.start, rank[self.end])
        at_once = 0.5  # fraction of the vertices (the cheapest) that may be collapsed in one step
        cheap = np.isfinite(lowest_cost) & (rank <= at_once * np.isfinite(lowest_cost).sum())
        removed = np.flatnonzero(cheap & (rank < lowest))
        kept = self.end[best[removed]]
        fine = _keeps_shape(points, triangles, removed, kept) & self._keeps_topology(triangles, removed, kept, len(points))
        refused = removed[~fine] * len(points) + kept[~fine]
        removed, kept = removed[fine], kept[fine]
        cheapest = np.argsort(rank[removed])[:most]
        return removed[cheapest], kept[cheapest], refused

    def _keeps_topology(
        self, triangles: Int[np.ndarray, "t 3"], removed: Int[np.ndarray, " k"], kept: Int[np.ndarray, " k"], count: int
    ) -> Bool[np.ndarray, " k"]:
        """Returns where two ends share only the neighbours of the triangles that vanish, so that nothing is pinched."""
        ones = np.ones(len(self.start), np.int32)
        neighbours = coo_array((ones, (self.start, self.end)), shape=(count, count)).tocsr()
        common = neighbours[removed].multiply(neighbours[kept]).sum(1)
        own = _owner(triangles, removed, count)
        partner = np.append(kept, -1)[own]
        vanish = (own >= 0) & (triangles == partner[:, None]).any(1)
        return np.asarray(common).reshape(-1) == np.bincount(own[vanish], minlength=len(removed))


def _keeps_shape(
    points: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    removed: Int[np.ndarray, " k"],
    kept: Int[np.ndarray, " k"],
) -> Bool[np.ndarray, " k"]:
    """Returns which vertices can be removed without flipping a triangle."""
    own = _owner(triangles, removed, len(points))
    touched = np.flatnonzero(own >= 0)
    target = np.arange(len(points))
    target[removed] = kept
    before, after = triangles[touched], target[triangles[touched]]
    stays = (after != np.roll(after, 1, 1)).all(1)
    before, after, owner = before[stays], after[stays], own[touched][stays]
    (old, _), (new, twice) = (_unit(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])) for p in (points[before], points[after]))
    fine = np.ones(len(removed), bool)
    turned = 0.2  # cosine of the largest angle by which a triangle may be rotated in one step
    fine[owner[(np.sum(old * new, -1) < turned) | (twice < 1e-12)]] = False
    return fine


def _owner(triangles: Int[np.ndarray, "t 3"], removed: Int[np.ndarray, " k"], count: int) -> Int[np.ndarray, " t"]:
    """Returns the index of the removed vertex of every triangle, -1 for none; no triangle has two."""
    row = np.full(count, -1)
    row[removed] = np.arange(len(removed))
    return row[triangles].max(1)


def _side_key(sides: Int[np.ndarray, "s 2"], count: int) -> Int[np.ndarray, " s"]:
    """Returns one integer per side, independent of its direction."""
    return sides.min(1).astype(np.int64) * count + sides.max(1)


def _multiplicity(sides: Int[np.ndarray, "s 2"], count: int) -> Int[np.ndarray, " s"]:
    """Returns the number of triangles that share every side."""
    _, which, times = np.unique(_side_key(sides, count), return_inverse=True, return_counts=True)
    return times[which.reshape(-1)]


def _unit(vectors: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    length = np.linalg.norm(vectors, axis=-1)
    return vectors / np.maximum(length, 1e-30)[:, None], length


def _plane(normal: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 10"]:
    """Returns the quadrics of planes, relative to points in them."""
    x, y, z = normal.T
    nothing = np.zeros((len(normal), 4))
    return np.concatenate([np.stack([x * x, x * y, x * z, y * y, y * z, z * z], -1), nothing], -1)


def _displaced(quadrics: Float[np.ndarray, "n 10"], way: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 10"]:
    """Returns quadrics relative to points displaced by `way`."""
    return np.concatenate([quadrics[:, :6], quadrics[:, 6:9] + _slope(quadrics, way), _at(quadrics, way)[:, None]], -1)


def _at(quadrics: Float[np.ndarray, "n 10"], way: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Returns the values of quadrics at a displacement `way`."""
    return quadrics[:, 9] + np.sum(way * (2 * quadrics[:, 6:9] + _slope(quadrics, way)), -1)


def _slope(quadrics: Float[np.ndarray, "n 10"], way: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    x, y, z = way.T
    xx, xy, xz, yy, yz, zz = quadrics[:, :6].T
    return np.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], -1)
