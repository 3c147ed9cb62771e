"""Bodies as returned by the readers of room files: named, in the units and axes of their file."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


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
