"""Multi-start optimisation in a box: a grid, the best points that are not close together, and descent steps from each of them.

Predictions of a coherent field have interference fringes: they vary over a fraction of a wavelength, and gradients lead only to
the next fringe. Functions of the position therefore take a smoothing length (metres) over which predictions are averaged
(`Field.smoothed`): the descent begins with a large one, for which there are few minima, and ends with a small one, for which
they are sharp.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import AnyArray
from wbgs_jax.radio.array import EXACT

Loss = Callable[[Float[Array, "k n"], Any], Float[Array, " k"]]
"""(points (k, n), smoothing length in metres) -> loss of every point independently; differentiable in reverse mode."""
Residuals = Callable[[Float[Array, "k n"], Any], Float[Array, "k m"]]
"""(points (k, n), smoothing length in metres) -> residuals of every point independently; their squares add up to its loss."""
STEP = 0.3
"""Length of a gradient step along each axis, relative to the smoothing length."""
ASIDE = 0.2
"""Step of Gauss-Newton's finite differences, relative to the smoothing length ..."""
DAMPING, EASED, RAISED = 1e-2, 0.2, 10.0
"""Damping of Gauss-Newton: relative to the mean curvature initially, and factors after a step that helped and one that did
not."""
BLOCK = 16
"""Number of points evaluated together."""


class Descended(NamedTuple):
    """Results of K starts, the best one first."""

    place: Float[Array, "k n"]
    loss: Float[Array, " k"]


def grid_over(box: Float[np.ndarray, "2 n"], step: float) -> Float[np.ndarray, "places n"]:
    """Returns grid points (float32) in a box, at most `step` apart along every axis and half of that from its sides.

    Args:
        box: lowest and highest corner.
        step: largest grid spacing, in the unit of the box.

    Raises:
        UserError: the box is empty, or there would be more than a million points.
    """
    low, high = np.asarray(box, float)
    if not (low < high).all() or not step > 0:
        raise UserError(
            f"no points between {low} and {high}, {step:g} m apart; give the lowest corner first and a step above 0"
        )
    counts = np.maximum(np.ceil((high - low) / step - 1e-9), 1).astype(int)
    most_places = 1_000_000
    if np.prod(counts.astype(float)) > most_places:
        raise UserError(f"a step of {step:g} m gives more than {most_places:,} points; give a larger one or a smaller box")
    axes = [a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low, high, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(low)).astype(np.float32)


def best_apart(
    places: Float[Array, "places n"], losses: Float[Array, " places"], count: int, apart: float
) -> Int[Array, " count"]:
    """Returns the indices of the `count` points of lowest loss that are at least `apart` from each other; if there are fewer,
    the best of the others follow."""

    far = 1e6  # added to the losses of points that are taken or near one that is, so that the remaining ones are chosen first

    def choose(left: Float[Array, " places"], _: None) -> tuple[Float[Array, " places"], Int[Array, ""]]:
        best = jnp.argmin(left)
        near = jnp.sum((places - places[best]) ** 2, -1) < apart**2
        return jnp.where(near, left + far, left).at[best].add(far), best

    return jax.lax.scan(choose, losses, None, length=count)[1]


def in_blocks(function: Callable[[Float[Array, "k n"]], Array], places: Float[Array, "places n"]) -> Array:
    """Returns a function of K points, (k, ...), for any number of points, evaluated in blocks: one compilation, little
    memory."""
    count = places.shape[0]
    filled = np.minimum(np.arange(-(-count // BLOCK) * BLOCK), count - 1)  # the last block is padded with the last point
    found = jax.lax.map(function, places[filled].reshape(-1, BLOCK, places.shape[1]))
    return found.reshape(-1, *found.shape[2:])[:count]


def shrinking(first: float, last: float, steps: int) -> Float[np.ndarray, " steps"]:
    """Returns smoothing lengths (metres) that decrease by equal factors."""
    return np.geomspace(first, last, steps).astype(np.float32)


def descend(loss: Loss, starts: Float[Array, "k n"], box: Float[Array, "2 n"], blurs: Float[AnyArray, " steps"]) -> Descended:
    """Returns the results of gradient steps (Adam) from K starts independently, ordered by the loss at the last smoothing
    length.

    Pure and jittable. No step leaves the box.

    Args:
        loss: of every point.
        starts: K starting points.
        box: lowest and highest corner.
        blurs: smoothing length of every step, metres.
    """
    low, high = jnp.asarray(box, starts.dtype)
    moments = 0.7, 0.9  # moment decay rates of Adam: short averages, for tens of steps on a loss that sharpens meanwhile
    adam = optax.scale_by_adam(*moments)
    slopes = jax.value_and_grad(lambda places, blur: jnp.sum(loss(places, blur)))

    def step(carry: tuple[Array, optax.OptState], blur: Float[Array, ""]) -> tuple[tuple[Array, optax.OptState], None]:
        places, memory = carry
        _, slope = slopes(places, blur)
        slope = jnp.where(jnp.isfinite(slope), slope, 0)
        move, memory = adam.update(slope, memory)
        return (jnp.clip(places - STEP * blur * move, low, high), memory), None

    (places, _), _ = jax.lax.scan(step, (starts, adam.init(starts)), jnp.asarray(blurs, starts.dtype))
    found = loss(places, jnp.asarray(blurs[-1], starts.dtype))
    order = jnp.argsort(found)
    return Descended(places[order], found[order])


class _Slopes(NamedTuple):
    """State of Gauss-Newton at K points."""

    place: Float[Array, "k n"]
    loss: Float[Array, " k"]
    slope: Float[Array, "k n"]
    curvature: Float[Array, "k n n"]


def gauss_newton(
    residuals: Residuals, starts: Float[Array, "k n"], box: Float[Array, "2 n"], blurs: Float[AnyArray, " levels"], steps: int
) -> Descended:
    """Returns the results of damped Gauss-Newton steps (Levenberg-Marquardt) from K starts independently, ordered by the loss
    at the last smoothing length.

    Pure and jittable. No step leaves the box or increases the loss. Derivatives are finite differences over a fraction of the
    smoothing length: four evaluations per step in space, less than reverse mode costs for a field that traces paths; not all
    fields support forward mode.

    Args:
        residuals: of every point.
        starts: K starting points.
        box: lowest and highest corner.
        blurs: smoothing lengths, metres.
        steps: at each smoothing length.
    """
    low, high = jnp.asarray(box, starts.dtype)
    k, n = starts.shape

    def look(place: Float[Array, "k n"], blur: Float[Array, ""]) -> _Slopes:
        inward = jnp.where(place + ASIDE * blur > high, -1.0, 1.0) * ASIDE * blur
        aside = place[:, None] + jnp.concatenate([jnp.zeros((k, 1, n)), inward[:, :, None] * jnp.eye(n)], 1)
        found = residuals(aside.reshape(-1, n), blur).reshape(k, n + 1, -1)
        here, jacobian = found[:, 0], (found[:, 1:] - found[:, :1]) / inward[:, :, None]
        slope = jnp.einsum("knm,km->kn", jacobian, here, precision=EXACT)
        curvature = jnp.einsum("kim,kjm->kij", jacobian, jacobian, precision=EXACT)
        return _Slopes(place, jnp.sum(here**2, -1), slope, curvature)

    farthest = 2.0  # the longest step, in smoothing lengths
    tiny = 1e-12

    def step(carry: tuple[_Slopes, Float[Array, "k n"], Float[Array, " k"]], blur: Float[Array, ""]) -> Any:
        best, place, damping = carry
        tried = look(place, blur)
        helped = tried.loss < best.loss  # false for NaN
        best = jax.tree.map(lambda a, b: jnp.where(helped.reshape(-1, *[1] * (a.ndim - 1)), a, b), tried, best)
        damping = damping * jnp.where(helped, EASED, RAISED)
        scale = damping * jnp.trace(best.curvature, axis1=-2, axis2=-1) / n + tiny
        move = -jnp.linalg.solve(best.curvature + scale[:, None, None] * jnp.eye(n), best.slope[..., None])[..., 0]
        length = jnp.linalg.norm(move, axis=-1, keepdims=True)
        move = move * jnp.minimum(1, farthest * blur / jnp.maximum(length, tiny))
        return (best, jnp.clip(best.place + move, low, high), damping), None

    def level(place: Float[Array, "k n"], blur: Float[Array, ""]) -> Any:
        nothing = _Slopes(place, jnp.full(k, jnp.inf), jnp.zeros((k, n)), jnp.zeros((k, n, n)))
        begin = nothing, place, jnp.full(k, DAMPING / EASED)
        (best, _, _), _ = jax.lax.scan(step, begin, jnp.full(steps + 1, blur))
        return best.place, best.loss

    place, losses = jax.lax.scan(level, starts, jnp.asarray(blurs, starts.dtype))
    order = jnp.argsort(losses[-1])
    return Descended(place[order], losses[-1][order])
