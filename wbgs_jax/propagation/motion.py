"""How the lengths of paths change where surfaces stand elsewhere than the mesh says, to first order, and what is left of
interference where nobody knows by how much.

By Fermat's principle the points of a path need not follow: if mirrors and edges move by m, a path grows by

    dL = sum over reflections and diffractions of (u - v) . m

with u and v the unit directions of the wave before and after. What it passes through changes nothing. Where the m of all
movers are unknown, independent and normal with standard deviations s, dL is normal too, and the mean product of two
amplitudes loses exp(-k^2 Var(dL_i - dL_j) / 2): the spectrum is that of partially coherent waves.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from wbgs_jax.propagation.image_method import Search
from wbgs_jax.propagation.paths import DIFFRACTED, REFLECTED, Paths
from wbgs_jax.propagation.transport import legs_of
from wbgs_jax.radio.array import EXACT


def length_changes(paths: Paths, search: Search, motion: Float[Array, "m 3"]) -> Float[Array, "k"]:
    """Returns by how much the K paths of one transmitter grow (metres) if every mover of the facets moves by so much."""
    turn, mover = _turns(paths, search)
    return jnp.sum(turn * motion[mover], (-2, -1))


def length_gradient(paths: Paths, search: Search, movers: int) -> Float[Array, "k places 3"]:
    """Returns the derivative of the K path lengths of one transmitter with respect to the places of all movers of the facets
    and, last, of the transmitter."""
    turn, mover = _turns(paths, search)
    start = jnp.zeros((len(turn), movers + 1, 3)).at[:, movers].set(-legs_of(paths).direction[:, 0])
    return start.at[jnp.arange(len(turn))[:, None], mover].add(turn)


def coherence(gradient: Float[Array, "k m 3"], spread: Float[Array, "m"], wavenumber: Float[Array, ""]) -> Float[Array, "k k"]:
    """Returns what is left, 0 to 1, of the mean product of two paths' amplitudes where the places that their lengths depend on
    are unknown.

    Args:
        gradient: of the lengths with respect to the places (`length_gradient`).
        spread: standard deviation of every place along each axis, metres.
        wavenumber: radians a metre.
    """
    phase = (wavenumber * gradient * spread[:, None]).reshape(len(gradient), -1)
    variance = jnp.sum(phase**2, -1)
    both = jnp.matmul(phase, phase.T, precision=EXACT)
    return jnp.exp(-0.5 * jnp.maximum(variance[:, None] + variance - 2 * both, 0))


def _turns(paths: Paths, search: Search) -> tuple[Float[Array, "k 5 3"], Int[Array, "k 5"]]:
    """Returns how paths turn at what they interact with, zero where they do not, and the mover that it belongs to."""
    direction = legs_of(paths).direction
    path, leg = jnp.arange(len(direction))[:, None], jnp.minimum(paths.interaction_leg, direction.shape[1] - 2)
    turn = direction[path, leg] - direction[path, leg + 1]
    reflects, diffracts = paths.interaction_type == REFLECTED, paths.interaction_type == DIFFRACTED
    number = paths.interaction_facet
    facet = jnp.where(reflects, number, 0)
    if search.edges.facet.shape[0]:
        facet = jnp.where(diffracts, search.edges.facet[jnp.where(diffracts, number, 0)], facet)
    return jnp.where((reflects | diffracts)[..., None], turn, 0), search.facets.mover[facet]
