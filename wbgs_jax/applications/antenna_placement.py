"""Where to put an antenna so that a region is covered.

A coherent field finds mirror images of its receiver on the host, so that its powers have no gradient with respect to the
receiver's position; with respect to the transmitter's they have. Channels are reciprocal: what an isotropic antenna at p
receives from a place q is what q receives from p. So the places of the region become the receivers, which stay where they are,
and the antenna to be placed becomes the transmitter.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.multistart import Descended, best_apart, descend, grid_over, in_blocks, shrinking
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params, outputs_of
from wbgs_jax.types import Query, make_receiver

Powers = Callable[[Float[Array, "k 3"], Any], Float[Array, "k users"]]
"""(places of the antenna (k, 3), blur in metres) -> power (dB) that every user gets from each."""
SOFT_DB = 3.0
"""Powers that differ by less than this count nearly alike in `soft_minimum`."""
STEPS = 30
NARROWEST_M = 0.02
"""The last blur: a few millimetres to and fro are fading, and no matter of coverage."""


def soft_minimum(power_db: Float[Array, "*k users"], soft_db: float = SOFT_DB) -> Float[Array, "*k"]:
    """Returns a smooth minimum over the users, between the least power and their mean: the largest `soft_db` gives the mean of
    the decibels."""
    return -soft_db * (jax.nn.logsumexp(-power_db / soft_db, -1) - jnp.log(power_db.shape[-1]))


def mean_power(power_db: Float[Array, "*k users"]) -> Float[Array, "*k"]:
    """Returns the mean of the decibels over the users."""
    return jnp.mean(power_db, -1)


def tenth_percentile(power_db: Float[Array, "*k users"]) -> Float[Array, "*k"]:
    """Returns the power that nine users of ten get at least; its gradient is that of the two users next to it."""
    return jnp.quantile(power_db, 0.1, axis=-1)


def power_at_users(field: Field, params: Params, users: Any, frequencies_hz: Any) -> Powers:
    """Returns the powers (dB, mean over the frequencies) of users by an antenna that may stand anywhere, both isotropic:
    differentiable in reverse mode with respect to its place.

    Every user is a receiver that is planned here and compiled when the function is: a dozen take a minute, hundreds are too
    many.

    Args:
        field, params: a trained field; of it the part that holds anywhere (`Field.receiver_independent`).
        users: (users, 3), world frame, metres.
        frequencies_hz: (f,) or one, hertz.

    Raises:
        UserError: the field does not hold elsewhere than at the receivers that it was trained for.
    """
    field, params = field.receiver_independent(params)
    if "power" not in outputs_of(field):
        raise UserError(f"the {field.name} field has no power, only spectra; train another field")
    one = np.zeros((1, 3))  # an antenna, no array
    places = np.atleast_2d(np.asarray(users, np.float32))
    plans = [field.plan(params, make_receiver(user, element_positions=one)) for user in places]
    frequencies = jnp.atleast_1d(jnp.asarray(frequencies_hz, jnp.float32))

    def at(plan: Any, places: Float[Array, "k 3"], blur: Any, frequency_hz: Float[Array, ""]) -> Float[Array, " k"]:
        query = Query(places, jnp.broadcast_to(frequency_hz, places.shape[:1]))
        power = field.render(field.smoothed(params, blur), plan, query).power_db
        assert power is not None, "the field knows it"
        return power

    def powers(places: Any, blur: Any) -> Float[Array, "k users"]:
        places = jnp.asarray(places, jnp.float32)
        # Under `vmap` over frequencies what depends on places alone, such as paths, is computed once.
        each = [jnp.mean(jax.vmap(partial(at, plan, places, blur))(frequencies), 0) for plan in plans]
        return jnp.stack(each, -1)

    return powers


def place_antenna(
    powers: Powers,
    box: Any,
    aim: Callable[[Float[Array, "k users"]], Float[Array, " k"]] = soft_minimum,
    step: float = 0.5,
    starts: int = 4,
) -> Descended:
    """Returns where an antenna serves its users best: `place` (starts, 3), the best one first, and `loss`, minus the aim (dB).

    The best places of a grid that stand apart are followed by gradient steps; local means of the powers over ever smaller
    distances are what counts, down to two centimetres.

    Args:
        powers: of the users, as `power_at_users` makes it, or any function like it.
        box: (2, 3), lowest and highest corner of where the antenna may stand, metres.
        aim: of the users' powers, to be as large as possible: `soft_minimum`, `mean_power`, `tenth_percentile`, or any smooth
            function (k, users) -> (k,).
        step: metres between places of the grid.
        starts: places that gradient steps begin from.
    """
    low_high = jnp.asarray(box, jnp.float32)
    places = grid_over(np.asarray(box, np.float32), step)

    def loss(tried: Float[Array, "k 3"], blur: Any) -> Float[Array, " k"]:
        return -aim(powers(tried, blur))

    @jax.jit
    def search(places: Float[Array, "n 3"]) -> Descended:
        losses = in_blocks(lambda block: loss(block, step / 2), places)
        chosen = best_apart(places, losses, min(starts, len(places)), 1.5 * step)
        return descend(loss, places[chosen], low_high, shrinking(step / 2, min(NARROWEST_M, step / 2), STEPS))

    return search(jnp.asarray(places))
