"""A scene with some of its objects moved or removed, for data of a room that has changed since it was measured."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import trimesh

from data_gen.scenes.base import Part, SceneSpec
from wbgs_jax._util.errors import UserError

FREE = 1e-6
"""Metres by which boxes must overlap to count as overlapping."""


def changed(spec: SceneSpec, moved: Sequence[str] = (), removed: Sequence[str] = ()) -> SceneSpec:
    """Returns a scene after its furniture has been moved.

    Args:
        spec: the scene.
        moved: objects that have moved, each as "name:dx,dy" (metres) or "name:dx,dy,degrees" with a rotation about the vertical
            axis through the centre of its bounding box.
        removed: names of objects that are gone.

    Returns:
        The scene, whose other objects, receiver and candidate transmitters are unchanged.

    Raises:
        UserError: there is no such object, it is a wall, or it does not fit where it is moved to.
    """
    parts = {p.name: p for p in spec.parts}
    for name in [*(word.split(":")[0] for word in moved), *removed]:
        if name not in parts or not parts[name].closed:
            known = ", ".join(p.name for p in spec.solids)
            raise UserError(f"{name!r} is not an object of {spec.name} that can be moved; choose one of {known}")
    parts = {name: p for name, p in parts.items() if name not in removed}
    for word in moved:
        name = word.split(":")[0]
        parts[name] = _moved(parts[name], word)
        if other := overlapping(parts[name], spec, [p for p in parts.values() if p.name != name]):
            raise UserError(f"{name!r} does not fit where {word!r} moves it: {other} is in the way; move it elsewhere")
    return dataclasses.replace(spec, parts=tuple(parts.values()))


def overlapping(one: Part, spec: SceneSpec, others: Sequence[Part]) -> str:
    """Returns the name of an object whose bounding box overlaps that of a part, or "a wall"; empty if there is none."""
    low, high = one.mesh.bounds
    for other in others:
        if other.kind != "shell" and ((other.mesh.bounds[0] < high - FREE) & (other.mesh.bounds[1] > low + FREE)).all():
            return other.name
    room = spec.bounds()
    return "" if (low > room[0]).all() and (high < room[1]).all() else "a wall"


def _moved(one: Part, word: str) -> Part:
    try:
        dx, dy, degrees = (*(float(value) for value in word.split(":")[1].split(",")), 0.0)[:3]
    except (IndexError, ValueError):
        raise UserError(f"{word!r} is not a movement; give name:dx,dy or name:dx,dy,degrees, in metres") from None
    mesh = one.mesh.copy()
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 0, 1], mesh.bounds.mean(0))
    turn[:2, 3] += dx, dy
    mesh.apply_transform(turn)
    return dataclasses.replace(one, mesh=mesh)
