"""Components of a scene: parts with a material, a receiver and candidate transmitters.

World frame: z up, metres. Walls, floor and ceiling are SINGLE surfaces whose material has a thickness (Sionna RT's slab model);
furniture is made of closed meshes. No two surfaces may coincide: the ray tracer would hit both, or one of them at random.
Furniture therefore stands `GAP` above the floor, and its boxes are `JOINT` apart.
"""

import hashlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from data_gen.scenes.geometry import Vec3, crossings, distance, winding_number
from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.rooms import THICKNESS, check_material

GAP = 0.01
"""Metres between furniture and the floor or wall beside it, which keeps surfaces apart and hides nothing."""
JOINT = 0.002
"""Metres between the boxes of one piece of furniture."""
TX_CLEARANCE = 0.10
"""Minimum distance (metres) of a transmitter from every surface."""
RX_CLEARANCE = 0.50
"""Minimum distance (metres) of a transmitter from the receiver, and of the receiver from every surface."""
IDENTITY = (1.0, 0.0, 0.0, 0.0)
FREQUENCIES_HZ = tuple(ghz * 1e9 for ghz in (1.0, 2.4, 5.0, 10.0, 24.25, 37.0, 47.0, 60.0, 77.0, 94.0))
"""The ten frequencies of the paper's Table 4, used by all scenes."""
FREQUENCIES_21_HZ = tuple(ghz * 1e9 for ghz in (1.0, *np.arange(5.0, 101.0, 5.0).tolist()))
"""1, 5, 10, ..., 100 GHz: a finer sampling of the same band."""
KINDS = ("shell", "partition", "solid")
"""Kinds of parts: a piece of the room's outer surface, a single sheet inside the room, or a closed body."""


@dataclass(frozen=True)
class Part:
    """One object of a scene: a mesh of one material."""

    name: str
    mesh: trimesh.Trimesh
    material: str
    thickness: float
    """Slab thickness in metres."""
    kind: str = "solid"
    """One of `KINDS`."""

    @property
    def closed(self) -> bool:
        """Whether the part is a body with an inside rather than a single sheet."""
        return self.kind == "solid"


def part(name: str, mesh: trimesh.Trimesh, material: str, thickness: float | None = None, kind: str = "solid") -> Part:
    """Returns a part with a checked material and, by default, that material's usual thickness (metres)."""
    check_material(material)
    if kind not in KINDS:
        raise ValueError(f"a part is one of {KINDS}, not {kind!r}")
    return Part(name, mesh, material, THICKNESS[material] if thickness is None else thickness, kind)


@dataclass(frozen=True)
class SceneSpec:
    """A scene before simulation. Positions in metres, orientation as a unit quaternion (wxyz, local to world)."""

    name: str
    parts: tuple[Part, ...]
    rx_position: Vec3
    tx_grid: Float[np.ndarray, "candidates 3"]
    """Candidate transmitter positions; `accessible_tx` selects those in free space."""
    frequencies_hz: tuple[float, ...] = FREQUENCIES_HZ
    rx_orientation: tuple[float, float, float, float] = IDENTITY
    description: str = field(default="")

    @property
    def solids(self) -> tuple[Part, ...]:
        """The closed bodies: furniture, door frames, pillars."""
        return tuple(p for p in self.parts if p.closed)

    def triangles(self, *kinds: str) -> Float[np.ndarray, "m 3 3"]:
        """Returns the corners of all triangles of parts of the given kinds, by default of all kinds."""
        found = [np.asarray(p.mesh.triangles) for p in self.parts if p.kind in (kinds or KINDS)]
        return np.concatenate([np.zeros((0, 3, 3)), *found])

    def mesh(self, *kinds: str) -> trimesh.Trimesh:
        """Returns the same triangles as one mesh."""
        return trimesh.Trimesh(**trimesh.triangles.to_kwargs(self.triangles(*kinds)), process=False)

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Returns the lowest and highest corner of the room."""
        corners = np.concatenate([p.mesh.bounds for p in self.parts])
        return np.stack([corners.min(0), corners.max(0)])

    def in_room(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Returns which points the outer surface encloses: a line out of the room crosses it an odd number of times."""
        low, high = self.bounds()
        outside = high + np.array([1.0, np.sqrt(2), np.sqrt(3)]) * (high - low)  # oblique, to hit no edge of a wall
        return crossings(self.mesh("shell"), points, outside) % 2 == 1

    def line_of_sight(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Returns which points have an unobstructed line of sight to the receiver; even glass obstructs it."""
        return crossings(self.mesh(), points, np.asarray(self.rx_position)) == 0

    def inside_objects(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Returns which points are inside a solid."""
        inside = np.zeros(len(points), bool)
        for p in self.solids:
            near = trimesh.bounds.contains(p.mesh.bounds, points)  # for the other points, triangles need not be tested
            inside[near] |= np.abs(winding_number(p.mesh, points[near])) > 0.5
        return inside

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Returns the distance (metres) of every point to the nearest surface."""
        return distance(self.mesh(), points)

    def accessible_tx(self) -> Float[np.ndarray, "tx 3"]:
        """Returns the candidates inside the room, outside all objects, and clear of surfaces and of the receiver, in grid
        order.

        Raises:
            UserError: the receiver is inside or too near to something, or no candidate is left.
        """
        self.check_receiver()
        grid = np.asarray(self.tx_grid, np.float64)
        keep = self.in_room(grid) & ~self.inside_objects(grid) & (self.distance(grid) >= TX_CLEARANCE)
        keep &= np.linalg.norm(grid - self.rx_position, axis=1) >= RX_CLEARANCE
        if not keep.any():
            raise UserError(f"no transmitter position of scene {self.name} is accessible; change its grid or its furniture")
        return grid[keep]

    def check_receiver(self) -> None:
        """Raises a `UserError` if the receiver is outside the room, inside an object or too near to a surface."""
        point = np.asarray([self.rx_position], np.float64)
        if not self.in_room(point)[0] or self.inside_objects(point)[0] or self.distance(point)[0] < RX_CLEARANCE:
            raise UserError(f"the receiver of scene {self.name} at {self.rx_position} is not {RX_CLEARANCE} m clear; move it")

    def mesh_arrays(self) -> dict[str, np.ndarray]:
        """Returns all surfaces as one mesh: vertices (n, 3), faces (m, 3), and face_part (m,), the index into `parts`."""
        offsets = np.cumsum([0, *(len(p.mesh.vertices) for p in self.parts)])
        vertices = np.concatenate([np.asarray(p.mesh.vertices, np.float32) for p in self.parts])
        faces = np.concatenate([np.asarray(p.mesh.faces) + start for p, start in zip(self.parts, offsets, strict=False)])
        face_part = np.repeat(np.arange(len(self.parts)), [len(p.mesh.faces) for p in self.parts])
        return {"vertices": vertices, "faces": faces.astype(np.int32), "face_part": face_part.astype(np.int32)}

    def mesh_sha256(self) -> str:
        """Returns the checksum of the surfaces and their materials."""
        digest = hashlib.sha256(repr(self.part_table()).encode())
        for array in self.mesh_arrays().values():
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def part_table(self) -> list[dict[str, Any]]:
        """Returns name, material and thickness (metres) of every part, as in a scene file's meta."""
        return [{"name": p.name, "material": p.material, "thickness": p.thickness} for p in self.parts]


def grid_3d(low: Vec3, high: Vec3, counts: tuple[int, int, int]) -> Float[np.ndarray, "n 3"]:
    """Returns a uniform grid including both ends, x slowest, z fastest."""
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
