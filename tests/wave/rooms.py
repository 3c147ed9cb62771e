"""Made-up scenes whose waves are known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from wbgs_jax.config import WaveConfig
from wbgs_jax.fields import wave
from wbgs_jax.types import Mesh, make_receiver

SPEED_OF_LIGHT = 299_792_458.0


def mesh_of(*parts: trimesh.Trimesh, thickness=0.1, directivity=0.0) -> Mesh:
    """Every part is a material of its own."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)])
    cluster = np.concatenate([np.full(len(part.faces), i) for i, part in enumerate(parts)])
    return Mesh(
        jnp.asarray(vertices, jnp.float32),
        jnp.asarray(faces, jnp.int32),
        jnp.asarray(cluster, jnp.int32),
        jnp.full(len(parts), thickness, jnp.float32),
        jnp.asarray(directivity, jnp.float32),
    )


def box(low, high) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=np.array([low, high], float))


def room(size=(6.0, 4.0, 3.0)) -> list[trimesh.Trimesh]:
    """Floor, ceiling and four walls as single sheets, parts of their own; a corner at the origin."""
    sheets = []
    whole = box((0, 0, 0), size)
    for axis in range(3):
        for side in (0.0, size[axis]):
            on_it = np.abs(whole.vertices[whole.faces][:, :, axis] - side).max(1) < 1e-9
            sheets.append(trimesh.Trimesh(whole.vertices, whole.faces[on_it], process=False))
    return sheets


def rectangle(corner, first, second) -> trimesh.Trimesh:
    corner, first, second = (np.array(v, float) for v in (corner, first, second))
    corners = [corner, corner + first, corner + first + second, corner + second]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def field_of(parts, rx, permittivity=4.0, conductivity=0.02, thickness=0.1, survival=1.0, directivity=0.0, **config):
    """Parameters and plan of an untrained field."""
    settings = WaveConfig(
        permittivity=permittivity,
        conductivity=conductivity,
        slope=0.0,
        survival=survival,
        **{"mirror_areas": (0.0, 0.0, 0.0)} | config,
    )
    params = wave.init(jax.random.key(0), mesh_of(*parts, thickness=thickness, directivity=directivity), settings)
    return params, wave.plan(params, make_receiver(rx))


def as_float64(tree):
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float64) if jnp.issubdtype(a.dtype, jnp.floating) else a, tree)
