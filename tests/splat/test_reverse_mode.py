"""Splatting has one reverse-mode derivative: everything else says so in a sentence, however it is asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.splat import GeometryPlan, Splats, composite, render_splats
from wbgs_jax.splat.tiles import CHUNK, CPU_TILING, SlotLists, TileJobs

SENTENCE = "reverse mode only: use jax.grad, jax.vjp or jax.jacrev instead of jax.jvp, jax.jacfwd or jax.linearize"
TILE = 200


def one_tile_plan() -> GeometryPlan:
    """Three splats in one tile, made by hand: nothing is compiled."""
    row, column = divmod(TILE, 45)
    centres = np.add([[0, 0], [1.2, -0.7], [-0.4, 2]], [column * 8 + 3.5, row * 9 + 4])
    of_floats = (centres, np.tile([0.3, 0.05, 0.2], (3, 1)), np.arange(3), np.full((3, 2), 9))
    members, count = np.full((8, CHUNK), -1), np.zeros(CPU_TILING.tiles)
    members[0, :3], count[TILE] = range(3), 1
    of_ints = (members, np.full(8, TILE), np.zeros(CPU_TILING.tiles), count, 3, 1)
    slots = SlotLists(*(jnp.zeros(3, jnp.int32) for _ in range(3)))
    jobs = TileJobs(*(jnp.asarray(a, jnp.int32) for a in of_ints), jnp.zeros((), bool), slots)
    return GeometryPlan(Splats(*(jnp.asarray(a, jnp.float32) for a in of_floats)), jobs)


PLAN = one_tile_plan()
SIGNAL, ATTENUATION = jnp.asarray([[0.3], [0.9], [0.5]]), jnp.asarray([[0.6], [0.2], [0.4]])


def energy(attenuation):
    return jnp.sum(render_splats(PLAN, attenuation, SIGNAL) ** 2)


def energy_at(centres):
    plan = GeometryPlan(Splats(centres, PLAN.splats.conics, PLAN.splats.depths, PLAN.splats.radii), PLAN.jobs)
    return jnp.sum(render_splats(plan, ATTENUATION, SIGNAL) ** 2)


def direction(function, at):
    return jax.jvp(function, (at,), (jnp.ones_like(at),))


def slope(attenuation):
    return jnp.sum(jax.grad(energy)(attenuation))


REFUSED = {
    "jvp": lambda: direction(energy, ATTENUATION),
    "jvp over the geometry": lambda: direction(energy_at, PLAN.splats.means2d),
    "jvp of a jitted function": lambda: direction(jax.jit(energy), ATTENUATION),
    "jitted jvp": lambda: jax.jit(lambda a: direction(energy, a))(ATTENUATION),
    "jacfwd": lambda: jax.jacfwd(energy)(ATTENUATION),
    "jitted jacfwd": lambda: jax.jit(jax.jacfwd(energy))(ATTENUATION),
    "jacfwd of a jitted function": lambda: jax.jacfwd(jax.jit(energy))(ATTENUATION),
    "jvp of a mapped function": lambda: direction(jax.vmap(energy), jnp.stack([ATTENUATION, ATTENUATION])),
    "linearize": lambda: jax.linearize(energy, ATTENUATION)[1](ATTENUATION),
    "linearize of a jitted function": lambda: jax.linearize(jax.jit(energy), ATTENUATION)[1](ATTENUATION),
    "grad of grad": lambda: jax.grad(slope)(ATTENUATION),
    "jitted grad of grad": lambda: jax.jit(jax.grad(slope))(ATTENUATION),
    "grad of a jitted grad": lambda: jax.grad(lambda a: jnp.sum(jax.jit(jax.grad(energy))(a)))(ATTENUATION),
    "jvp of grad": lambda: direction(jax.grad(energy), ATTENUATION),
    "hessian": lambda: jax.hessian(energy)(ATTENUATION),
}


@pytest.mark.parametrize("asked", REFUSED)
def test_forward_mode_and_second_derivatives_are_refused_in_a_sentence(asked):
    with pytest.raises(TypeError, match=SENTENCE):
        REFUSED[asked]()


def test_what_both_forms_share_has_no_second_derivative():
    """Whoever does without the first refusal meets the second."""
    geometry = jnp.concatenate([PLAN.splats.means2d, PLAN.splats.conics], -1)

    def slope_of_tiles(geometry):
        return jnp.sum(jax.grad(lambda g: jnp.sum(composite._blend_tiles(g, ATTENUATION, SIGNAL, PLAN.jobs)))(geometry))

    with pytest.raises(TypeError, match=SENTENCE):
        jax.jit(jax.grad(slope_of_tiles)).trace(geometry)


def test_reverse_mode_works_within_other_transformations():
    """Some of them use tangents on their way to a gradient."""

    def mapped(attenuation):
        return jnp.sum(jax.vmap(energy)(jnp.stack([attenuation, 0.5 * attenuation])))

    def scanned(attenuation):
        body = jax.checkpoint(lambda total, share: (total + energy(share * attenuation), None))
        return jax.lax.scan(body, jnp.zeros(()), jnp.array([1.0, 0.5]))[0]

    of_map, of_scan = jax.jit(lambda a: (jax.grad(mapped)(a), jax.grad(scanned)(a)))(ATTENUATION)
    assert float(jnp.abs(of_map).min()) > 0
    np.testing.assert_allclose(of_scan, of_map, rtol=1e-5)
