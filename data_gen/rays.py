"""Initial directions of the rays that search for paths: uniform over the sphere, and aimed at diffracting objects.

A ray finds a diffracted path only if it hits a face beside the edge, and most edges belong to small faces: chair legs, boards,
door frames. Uniform rays rarely do so, in particular behind a wall. Some rays are therefore aimed at points on every face of
every solid, and some at the mirror images of these points in the walls, floor and ceiling, which they reach after one
reflection. The initial directions determine only which paths are found, not their amplitudes.

Import this module only after `data_gen.llvm.ensure_backend()`.
"""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float

from data_gen.scenes.base import SceneSpec
from data_gen.settings import SolverSettings

MAX_MIRRORS = 24
"""Maximum number of mirrors, the largest planes ..."""
MAX_AIMED = 1_000_000
"""... and maximum number of aimed rays, of which a random part is used beyond it: a user's mesh may have any number of
faces."""


class RayLauncher:
    """The initial rays of a scene, the same number from every transmitter."""

    def __init__(self, spec: SceneSpec, settings: SolverSettings) -> None:
        rng = np.random.default_rng(settings.seed)
        self._evenly = settings.samples_per_src
        self._normals, self._offsets = _planes(spec)
        solids = [part.mesh.triangles for part in spec.solids] if settings.diffraction else []
        faces = np.concatenate([np.zeros((0, 3, 3)), *solids])
        straight = _points_on(faces, settings.rays_per_face, rng)
        mirrored = [_points_on(faces, settings.rays_per_mirrored_face, rng) for _ in self._normals]
        self._points = np.concatenate([straight, *mirrored])
        lengths = [len(straight), *map(len, mirrored)]
        self._mirror = np.repeat(np.arange(-1, len(mirrored)), lengths)  # -1: none
        if len(self._points) > MAX_AIMED:
            kept = np.sort(rng.permutation(len(self._points))[:MAX_AIMED])
            self._points, self._mirror = self._points[kept], self._mirror[kept]

    @property
    def count(self) -> int:
        """Number of rays from every transmitter."""
        return self._evenly + len(self._points)

    def aimed(self, origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
        """Returns the unit directions (float32, world) of the aimed rays from a point (metres)."""
        through = self._mirror >= 0
        normals = self._normals[self._mirror[through]]
        height = (self._points[through] * normals).sum(-1) - self._offsets[self._mirror[through]]
        targets = self._points.copy()
        targets[through] -= 2 * height[:, None] * normals
        directions = targets - origin
        return (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)

    def spawn(self, lattice: Callable[[int], Any], samples_per_src: int, src_positions: Any) -> Any:
        """Returns, in place of `sionna.rt.utils.spawn_ray_from_sources`, the rays of one transmitter after another."""
        if samples_per_src != self.count:
            raise RuntimeError(f"{samples_per_src} rays per transmitter requested instead of {self.count}")
        evenly = np.array(mi.warp.square_to_uniform_sphere(lattice(self._evenly))).T
        origins = np.array(src_positions).T
        directions = np.concatenate([part for origin in origins for part in (evenly, self.aimed(origin))])
        ray: Any = mi.Ray3f(o=dr.repeat(src_positions, self.count), d=mi.Vector3f(directions.T))
        ray.time = dr.zeros(mi.Float, len(directions))  # as in the original: keeps a loop from being traced twice
        return ray


def _planes(spec: SceneSpec) -> tuple[Float[np.ndarray, "planes 3"], Float[np.ndarray, " planes"]]:
    """Returns unit normals and offsets (n.x = offset, metres) of the planes of all single sheets, the largest first."""
    area: dict[tuple[float, ...], float] = {}
    for part in spec.parts:
        if part.closed:
            continue
        normals, size = np.asarray(part.mesh.face_normals), np.asarray(part.mesh.area_faces)
        offsets = (normals * np.asarray(part.mesh.triangles)[:, 0]).sum(-1)
        largest = np.take_along_axis(normals, np.abs(normals).argmax(1)[:, None], 1)
        rows = np.concatenate([normals, offsets[:, None]], 1) * np.sign(largest)  # the same plane for both orientations
        for row, value in zip(np.round(rows, 6) + 0.0, size, strict=True):  # + 0.0: no negative zeros
            area[tuple(row)] = area.get(tuple(row), 0.0) + float(value)
    found = sorted(area, key=lambda plane: (-area[plane], plane))[:MAX_MIRRORS]
    table = np.array(found, np.float64).reshape(-1, 4)
    return table[:, :3], table[:, 3]


def _points_on(faces: Float[np.ndarray, "faces 3 3"], count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Returns `count` points on every triangle, uniformly distributed."""
    u = rng.random((count, len(faces), 2))
    outside = u.sum(-1) > 1
    u[outside] = 1 - u[outside]
    a, b, c = faces[:, 0], faces[:, 1], faces[:, 2]
    return (a + u[..., :1] * (b - a) + u[..., 1:] * (c - a)).reshape(-1, 3)
