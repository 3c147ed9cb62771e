"""Made-up scenes whose waves are known in closed form, and the steps of `wbgs_jax.propagation` in one call each."""

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from wbgs_jax.fields import coherent
from wbgs_jax.fields.coherent import WaveConfig
from wbgs_jax.mesh.edges import Edges, edges_of_facets
from wbgs_jax.mesh.facets import Facets, facets_from_mesh
from wbgs_jax.propagation.image_method import ImageTree, make_image_tree
from wbgs_jax.propagation.materials import Slabs, complex_permittivity
from wbgs_jax.propagation.mechanisms import trace_paths, transports_of
from wbgs_jax.propagation.paths import TracedPaths
from wbgs_jax.propagation.transport import arrivals, snapshots_from_paths
from wbgs_jax.radio.channel import Paths
from wbgs_jax.types import Mesh, Receiver, make_receiver

SPEED_OF_LIGHT = 299_792_458.0
METAL = 1e6
"""Conductivity, S/m."""


def mesh_of(*parts: trimesh.Trimesh, material=None, thickness=0.1) -> Mesh:
    """Every part is a material of its own, unless `material` (an index for every part) says which ones share one."""
    material = range(len(parts)) if material is None else material
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)])
    sizes = [len(part.faces) for part in parts]
    return Mesh(
        jnp.asarray(vertices, jnp.float32),
        jnp.asarray(faces, jnp.int32),
        jnp.asarray(np.repeat(np.arange(len(parts)), sizes), jnp.int32),
        jnp.asarray(np.repeat(np.array(material), sizes), jnp.int32),
        jnp.full(max(material) + 1, thickness, jnp.float32),
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


def facets_of(*parts, material=None) -> Facets:
    return facets_from_mesh(mesh_of(*parts, material=material))


def edges_of(*parts, material=None) -> Edges:
    return edges_of_facets(facets_of(*parts, material=material))


def search_of(parts, rx, mirror_areas=(0.0, 0.0, 0.0), material=None) -> ImageTree:
    """What the paths to a receiver are searched in."""
    facets = facets_of(*parts, material=material)
    return make_image_tree(facets, edges_of_facets(facets), np.asarray(rx, np.float32), mirror_areas, 0.5, 3.0)


_trace = jax.jit(trace_paths, static_argnums=2)


def trace(search, tx, specular=(512, 128), diffracted=(1024, 256)) -> TracedPaths:
    """All paths of one transmitter; (tried, kept) of either kind."""
    sizes = ("specular", *specular), ("diffracted", *diffracted)
    return _trace(search, jnp.asarray(tx, search.receiver_position.dtype), sizes)


def slabs_of(search, frequency, permittivity=4.0, conductivity=0.02, thickness=0.1) -> Slabs:
    """Every facet is made of the same."""
    dtype = search.receiver_position.dtype
    properties = (permittivity, conductivity, thickness)
    eps, sigma, metres = (jnp.full(search.facets.offset.shape, value, dtype) for value in properties)
    return Slabs(complex_permittivity(eps, sigma, jnp.asarray(frequency, dtype)), metres)


@jax.jit
def arrivals_of(search: ImageTree, traced: TracedPaths, slabs: Slabs, receiver: Receiver, frequency, antennas=()) -> Paths:
    """What arrives over all paths, those without diffraction first, between the antennas of transmitter and elements."""
    return arrivals(traced, search, slabs, frequency, receiver, transports_of(traced), *antennas)


def snapshot_of(search, tx, frequency, receiver=None, antennas=(), **slab) -> np.ndarray:
    """The voltages of an array (the 4x4 one of isotropic elements unless another is given) where the search's receiver is."""
    return snapshot_over(search, trace(search, tx), frequency, receiver, antennas, **slab)


def snapshot_over(search, traced, frequency, receiver=None, antennas=(), **slab) -> np.ndarray:
    """The same, of paths that are known."""
    receiver = make_receiver(search.receiver_position) if receiver is None else receiver
    frequency = jnp.asarray(frequency, search.receiver_position.dtype)
    found = arrivals_of(search, traced, slabs_of(search, frequency, **slab), receiver, frequency, antennas)
    return np.asarray(snapshots_from_paths(found, receiver, frequency))


def field_of(parts, rx, permittivity=4.0, conductivity=0.02, thickness=0.1, excess_amplitude=1.0, pattern="iso", **config):
    """An untrained coherent field, its parameters and its plan."""
    settings = WaveConfig(
        permittivity=permittivity,
        conductivity=conductivity,
        slope=0.0,
        excess_amplitude=excess_amplitude,
        **{"mirror_areas": (0.0, 0.0, 0.0)} | config,
    )
    field = coherent.make_field(mesh_of(*parts, thickness=thickness), settings)
    params = field.init(jax.random.key(0))
    return field, params, field.plan(params, make_receiver(rx, pattern=pattern))


def as_float64(tree):
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float64) if jnp.issubdtype(a.dtype, jnp.floating) else a, tree)
