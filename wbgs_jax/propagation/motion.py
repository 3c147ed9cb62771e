"""How the lengths of paths change where surfaces stand elsewhere than the mesh says, to first order.

By Fermat's principle the points of a path need not follow: if mirrors and edges move by m, a path grows by

    dL = sum over reflections and diffractions of (u - v) . m

with u and v the unit directions of the wave before and after. What it passes through changes nothing.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from wbgs_jax.propagation.image_method import Search
from wbgs_jax.propagation.paths import DIFFRACTED, REFLECTED, Paths
from wbgs_jax.propagation.transport import legs_of


def length_changes(paths: Paths, search: Search, motion: Float[Array, "m 3"]) -> Float[Array, "k"]:
    """Returns by how much the K paths of one transmitter grow (metres) if every mover of the facets moves by so much."""
    direction = legs_of(paths).direction
    path, leg = jnp.arange(len(direction))[:, None], jnp.minimum(paths.interaction_leg, direction.shape[1] - 2)
    turn = direction[path, leg] - direction[path, leg + 1]
    reflects, diffracts = paths.interaction_type == REFLECTED, paths.interaction_type == DIFFRACTED
    number = paths.interaction_facet
    facet = jnp.where(reflects, number, 0)
    if search.edges.facet.shape[0]:
        facet = jnp.where(diffracts, search.edges.facet[jnp.where(diffracts, number, 0)], facet)
    step = motion[search.facets.mover[facet]]
    return jnp.sum(jnp.where(reflects | diffracts, jnp.sum(turn * step, -1), 0), -1)
