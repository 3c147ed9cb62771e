"""Placement of an antenna so that it covers a region.

A coherent field finds the mirror images of its receiver on the host, so its powers have no gradient with respect to the
receiver's position, but they have one with respect to the transmitter's. Channels are reciprocal: what an isotropic antenna at
p receives from a position q equals what q receives from p. The positions of the region therefore become receivers, which stay
fixed, and the antenna to be placed becomes the transmitter.
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
from wbgs_jax.fields.calibratable import at_isotropic_antennas
from wbgs_jax.types import Query, Transmitter, make_receiver

Powers = Callable[[Any, Any], Float[Array, "k users"]]
"""(antenna positions (k, 3) or a `Transmitter`, smoothing length, metres) -> power (dB) that every user receives from each."""
SOFT_DB = 3.0
"""Powers that differ by less than this have nearly equal weight in `soft_minimum`."""
STEPS = 30
"""Gradient steps."""
NARROWEST_M = 0.02
"""Final smoothing length, metres: variations over a few millimetres are fading, which does not matter for coverage."""


def soft_minimum(power_db: Any, soft_db: float = SOFT_DB) -> Float[Array, "*k"]:
    """Returns a smooth minimum over the users, between the lowest power and the mean of the decibels; it approaches the mean as
    `soft_db` grows.

    Args:
        power_db: (*k, users), powers of the users.
        soft_db: width of the transition, decibels.

    Returns:
        Decibels (*k,).

    Example:
        >>> import jax.numpy as jnp
        >>> round(float(soft_minimum(jnp.array([-60.0, -90.0]), 1.0)), 1)
        -89.3
    """
    power_db = jnp.asarray(power_db)
    return -soft_db * (jax.nn.logsumexp(-power_db / soft_db, -1) - jnp.log(power_db.shape[-1]))


def mean_power(power_db: Any) -> Float[Array, "*k"]:
    """Returns the mean over the users of their powers in dB.

    Args:
        power_db: (*k, users), powers of the users.

    Returns:
        Decibels (*k,).
    """
    return jnp.mean(jnp.asarray(power_db), -1)


def tenth_percentile(power_db: Any) -> Float[Array, "*k"]:
    """Returns the power that nine of ten users exceed; its gradient is that of the two adjacent users.

    Args:
        power_db: (*k, users), powers of the users.

    Returns:
        Decibels (*k,).
    """
    return jnp.quantile(jnp.asarray(power_db), 0.1, axis=-1)


def power_at_users(field: Field, params: Params, users: Any, frequencies_hz: Any) -> Powers:
    """Returns a function for the powers (dB, mean over the frequencies) that users receive from antennas at any positions, all
    antennas isotropic unless a `Transmitter` names its own; differentiable in reverse mode with respect to positions and
    orientations.

    Every user is a receiver that is planned here and compiled together with the function: a dozen take a minute, hundreds are
    too many.

    Args:
        field, params: a trained field, of which the receiver-independent part is used (`Field.receiver_independent`).
        users: (users, 3), world frame, metres.
        frequencies_hz: (f,) or one, hertz.

    Returns:
        The function: positions (k, 3) in metres, or k antennas as a `radio.Transmitter` with orientations and patterns, and a
        smoothing length in metres -> powers (k, users), dB relative to the transmitted powers.

    Raises:
        UserError: the field predicts no power, or only at the receivers it was trained for.
    """
    field, params = at_isotropic_antennas(field, params)
    if "power" not in outputs_of(field):
        raise UserError(f"the {field.name} field predicts only spectra, no power; train another field")
    one = np.zeros((1, 3))  # a single antenna
    places = np.atleast_2d(np.asarray(users, np.float32))
    plans = [field.plan(params, make_receiver(user, element_positions=one)) for user in places]
    frequencies = jnp.atleast_1d(jnp.asarray(frequencies_hz, jnp.float32))

    def at(plan: Any, antennas: Transmitter, blur: Any, frequency_hz: Float[Array, ""]) -> Float[Array, " k"]:
        query = Query(antennas, jnp.broadcast_to(frequency_hz, antennas.position.shape[:1]))
        power = field.render(field.smoothed(params, blur), plan, query).power_db
        assert power is not None, "the field predicts power"
        return power

    def powers(places: Any, blur: Any) -> Float[Array, "k users"]:
        antennas = places if isinstance(places, Transmitter) else Transmitter(jnp.asarray(places, jnp.float32))
        # Under `vmap` over frequencies, whatever depends on positions alone, such as paths, is computed only once.
        each = [jnp.mean(jax.vmap(partial(at, plan, antennas, blur))(frequencies), 0) for plan in plans]
        return jnp.stack(each, -1)

    return powers


def place_antenna(
    powers: Powers,
    box: Any,
    aim: Callable[[Float[Array, "k users"]], Float[Array, " k"]] = soft_minimum,
    step: float = 0.5,
    starts: int = 4,
) -> Descended:
    """Returns the antenna positions that serve the users best: `place` (starts, 3), the best one first, and `loss`, minus the
    objective (dB).

    The best points of a grid that are not close together are refined by gradient steps on powers that are smoothed over shorter
    and shorter distances, down to two centimetres.

    Args:
        powers: of the users, from `power_at_users` or any similar function.
        box: (2, 3), lowest and highest corner of the possible antenna positions, metres.
        aim: objective to maximise, a function of the users' powers: `soft_minimum`, `mean_power`, `tenth_percentile`, or any
            smooth function (k, users) -> (k,).
        step: grid spacing, metres.
        starts: number of starting points of the gradient steps.

    Returns:
        `place` (starts, 3), world frame, metres, and `loss` (starts,), dB.
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
