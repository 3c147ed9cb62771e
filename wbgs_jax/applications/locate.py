"""Localisation of a transmitter from observations at receivers: the position whose predictions by a trained field match best.

Predictions on a grid over the scene are computed once. An observation is compared with them, and the best grid points that are
not close together are refined by Gauss-Newton steps (`multistart.py`). A planar array cannot distinguish its front from its
back, and different positions in a room can have similar channels: the runners-up show how ambiguous an observation is.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from wbgs_jax._util.checks import concrete
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree, static
from wbgs_jax.applications.multistart import best_apart, gauss_newton, grid_over, in_blocks, shrinking
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Observation, Params, as_observed, outputs_of
from wbgs_jax.inference.predictor import check_power
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.radio.channel import NO_PATH_DB
from wbgs_jax.types import Receiver, make_query

What = Literal["spectra", "snapshots", "power"]
"""Kind of observation."""
POOLED = 10
"""Pixels along each axis that are averaged before spectra are compared: an array of 4 x 4 elements resolves 25 degrees."""
BLUR = 0.5
"""Smoothing length of the predictions on the grid, relative to the grid spacing."""
NOISE = 0.01
"""Error (one minus the cosine) of a trained field's spectra at the true position, median over frequencies. Much larger errors
indicate that the field is wrong there, and say little about the position: the loss grows only with their logarithm."""
LEVELS, STEPS = 2, 3
"""Number of smoothing lengths, down to the final one by equal factors, and steps at each."""
FAINTEST = 1e-12


class Located(NamedTuple):
    """Estimated position of a transmitter."""

    position: Float[Array, "3"]
    """World frame, metres."""
    loss: Float[Array, ""]
    """Remaining loss there, a mean over links, 0 for a perfect match: `NOISE` log(1 + c / `NOISE`), where c is one minus the
    cosine between spectra or between products y y^H of snapshots; for powers, squared decibels."""
    others: Float[Array, "k 3"]
    """Runners-up, the best one first, world frame, metres. Some may have converged to `position` too."""
    other_losses: Float[Array, " k"]
    """Losses of the runners-up. A distant one with hardly larger loss shows that the observation is ambiguous."""


@pytree
class Locator:
    """Localiser based on a trained field. Create it with `make_locator`, and call it with an observation: (frequencies, 90,
    360) spectra, (frequencies, elements) snapshots or (frequencies,) powers in dB; for several receivers (receivers,
    frequencies, ...)."""

    field: Field
    params: Params
    plans: tuple[Any, ...]
    """One plan per receiver."""
    frequencies_hz: Float[Array, " f"]
    box: Float[Array, "2 3"]
    """Lowest and highest corner of the search region; world frame, metres."""
    places: Float[Array, "n 3"]
    """Grid points."""
    answers: Array
    """Predictions at the grid points, (n, receivers * frequencies, m)."""
    what: What = static()
    known_power: bool = static(default=True)
    starts: int = static(default=12)
    step: float = static(default=0.5)

    def __call__(self, observed: Any) -> Located:
        """Returns the estimated position of the transmitter of an observation.

        Raises:
            ValueError: the observation does not have the shape given by receivers and frequencies, or has too few powers.
        """
        elements = round((self.answers.shape[-1] / 2) ** 0.5)  # products y y^H have a real and an imaginary part
        shape = {"spectra": (PAS_HEIGHT, PAS_WIDTH), "snapshots": (elements,), "power": ()}[self.what]
        observed = jnp.asarray(observed)
        wanted = (len(self.plans), len(self.frequencies_hz), *shape)
        if observed.shape not in (wanted, wanted[1:] if len(self.plans) == 1 else wanted):
            raise ValueError(f"the observation has shape {observed.shape}; expected {wanted}, or without the 1 of one receiver")
        return _locate(self, self._links(observed))

    def loss(self, places: Float[Array, "k 3"], observed: Array, blur: Any) -> Float[Array, " k"]:
        """Returns the mismatch between the predictions at K positions and an observation; differentiable in reverse mode.

        Args:
            places: world frame, metres.
            observed: (receivers * frequencies, ...) or (receivers, frequencies, ...), spectra, snapshots or powers.
            blur: metres over which predictions are smoothed, if the field has interference fringes.

        Raises:
            ValueError: too few powers were received.
        """
        return _loss(_residuals(self, self.predict(places, blur), _target(self.what, self._links(observed))))

    def _links(self, observed: Array) -> Array:
        """Returns an observation with one leading axis, of receivers and frequencies."""
        observed = jnp.asarray(observed)
        own = observed.ndim - {"spectra": 2, "snapshots": 1, "power": 0}[self.what]
        known, fewest = concrete(observed), 1 if self.known_power else 2
        if self.what == "power" and known is not None and (count := np.sum(known > NO_PATH_DB)) < fewest:
            raise ValueError(
                f"{count} of the observed powers are above {NO_PATH_DB:g} dB; at least {fewest} are needed for a position"
            )
        return observed.reshape(-1, *observed.shape[own:])

    def predict(self, places: Float[Array, "k 3"], blur: Any) -> Float[Array, "k links m"]:
        """Returns the predictions at K positions, in the form that is compared: (k, receivers * frequencies, m)."""
        params = self.field.smoothed(self.params, blur)

        def at(plan: Any, frequency_hz: Float[Array, ""]) -> Array:
            query = make_query(places, frequency_hz)
            predicted = self.field.render(params, plan, query)
            if self.what == "spectra":  # observations have the noise of the training data
                predicted = predicted._replace(pas=as_observed(self.field, params, predicted.pas))
            return _compared(self.what, predicted)

        # Under `vmap` over frequencies, whatever depends on positions alone, such as paths, is computed only once.
        each = [jax.vmap(partial(at, plan))(self.frequencies_hz) for plan in self.plans]
        return jnp.moveaxis(jnp.concatenate(each), 0, 1)


def make_locator(
    trained: TrainedField,
    frequencies_hz: Any,
    what: What = "spectra",
    receivers: Sequence[Receiver] | None = None,
    box: Any = None,
    step: float = 0.5,
    starts: int = 12,
    known_power: bool = True,
) -> Locator:
    """Returns a function from observations to positions. Its construction takes a while, an evaluation seconds.

    Args:
        trained: the field; residual kriging (`TrainedField.correction`) is not used.
        frequencies_hz: (f,), hertz, at which the transmitter is observed; more of them make the result less ambiguous.
        what: kind of observation: "spectra" (normalised PAS), "snapshots" (complex voltages of the elements), "power" (dB).
        receivers: observing receivers; by default the first one of the training data.
        box: (2, 3), lowest and highest corner of the search region, metres; by default the scene's.
        step: grid spacing, metres.
        starts: number of grid points that are refined.
        known_power: whether the transmitted power is known. If not, powers are compared up to a common offset in decibels.

    Returns:
        The locator; its result for an observation is a `Located`.

    Raises:
        UserError: the field does not predict this kind of observation.
    """
    needed = {"spectra": "pas", "snapshots": "snapshots", "power": "power"}[what]
    if needed not in outputs_of(trained.field):
        raise UserError(f"the {trained.field.name} field predicts no {what}, only {', '.join(outputs_of(trained.field))}")
    dataset = trained.dataset()
    if what == "power":
        check_power(trained.field, dataset)
    receivers = [dataset.receiver()] if receivers is None else list(receivers)
    box = np.asarray(DatasetScene(dataset).box if box is None else box, np.float32)
    plans = tuple(trained.field.plan(trained.params, receiver) for receiver in receivers)
    frequencies, places = jnp.atleast_1d(jnp.asarray(frequencies_hz, jnp.float32)), grid_over(box, step)
    if what == "power" and len(plans) * len(frequencies) < (1 if known_power else 2):
        raise UserError("one received power at unknown transmitted power is not enough; give several receivers or frequencies")
    common = (trained.field, trained.params, plans, frequencies, jnp.asarray(box), jnp.asarray(places))
    empty = Locator(*common, jnp.zeros(0), what, known_power, min(starts, len(places)), step)
    return Locator(*common, _predict_grid(empty), what, known_power, min(starts, len(places)), step)


@jax.jit
def _predict_grid(locator: Locator) -> Array:
    """Returns the predictions at the grid points."""
    return in_blocks(lambda places: locator.predict(places, BLUR * locator.step), locator.places)


@jax.jit
def _locate(locator: Locator, observed: Array) -> Located:
    target = _target(locator.what, observed)
    losses = _loss(_residuals(locator, locator.answers, target))
    chosen = best_apart(locator.places, losses, locator.starts, 1.5 * locator.step)

    def residuals(places: Float[Array, "k 3"], blur: Any) -> Float[Array, "k m"]:
        return _residuals(locator, locator.predict(places, blur), target)

    first = BLUR * locator.step
    # Final smoothing length, metres. Below it, some wrong position matches the fringes of a field that is not accurate to
    # millimetres better than the right one does: among the end points, those of validation transmitters of scenes 2 and 4 are
    # ranked best with this smoothing, and worst with none
    narrowest_m = 0.12
    blurs = shrinking(first, min(narrowest_m, first), LEVELS)
    found = gauss_newton(residuals, locator.places[chosen], locator.box, blurs, STEPS)
    return Located(found.place[0], found.loss[0], found.place[1:], found.loss[1:])


def pooled(spectra: Float[Array, "*n 90 360"]) -> Float[Array, "*n h w"]:
    """Returns spectra averaged over blocks of `POOLED` x `POOLED` pixels."""
    high, wide = PAS_HEIGHT // POOLED, PAS_WIDTH // POOLED
    return spectra.reshape(*spectra.shape[:-2], high, POOLED, wide, POOLED).mean((-3, -1))


def _compared(what: What, predicted: Observation) -> Float[Array, "k m"]:
    """Returns the form of K links' predictions that is compared with an observation: a vector per link, of norm 1 except for
    powers."""
    if what == "power":
        assert predicted.power_db is not None, "`make_locator` has checked the outputs"
        return predicted.power_db[:, None]
    if what == "spectra":
        return _unit(pooled(predicted.pas))
    assert predicted.snapshots is not None, "`make_locator` has checked the outputs"
    return _unit(_products(predicted.snapshots) if predicted.covariance is None else predicted.covariance)


def _target(what: What, observed: Array) -> Float[Array, "links m"]:
    """Returns the form of an observation that is compared with predictions."""
    if what == "power":
        return observed[:, None]
    return _unit(pooled(observed) if what == "spectra" else _products(observed))


def _products(snapshots: Complex[Array, "k e"]) -> Complex[Array, "k e e"]:
    """Returns the products y y^H, scaled against underflow."""
    largest = jnp.maximum(jnp.max(jnp.abs(snapshots), -1, keepdims=True), FAINTEST)
    unit = snapshots / largest
    return unit[:, :, None] * unit[:, None].conj()


def _unit(values: Array) -> Float[Array, "k m"]:
    """Returns real vectors of norm 1; real and imaginary parts of a complex array are concatenated."""
    flat = values.reshape(values.shape[0], -1)
    flat = jnp.concatenate([flat.real, flat.imag], -1) if jnp.iscomplexobj(flat) else flat
    return flat / jnp.sqrt(jnp.maximum(jnp.sum(flat**2, -1, keepdims=True), FAINTEST))


def _residuals(locator: Locator, answers: Float[Array, "k links m"], target: Float[Array, "links m"]) -> Float[Array, "k n"]:
    """Returns residuals whose squares add up to the loss, a mean over links."""
    error = answers - target
    largest_db = 20.0  # errors of received powers saturate at this value: a missing path can cause an error of any size
    if locator.what == "power":
        received = target > NO_PATH_DB
        count = jnp.maximum(jnp.sum(received), 1)
        error = jnp.where(received, error, 0)
        if not locator.known_power:
            error = jnp.where(received, error - jnp.sum(error, 1, keepdims=True) / count, 0)
        saturated = error / jnp.sqrt(1 + (error / largest_db) ** 2)
        return saturated[..., 0] / jnp.sqrt(count)
    error = error / np.sqrt(2)  # one minus the cosine is half the squared distance
    small = 1e-6  # added to denominators
    off = jnp.sum(error**2, -1, keepdims=True) / NOISE + small
    saturated = error * jnp.sqrt(jnp.log1p(off) / off)  # squares add up to NOISE log(1 + (1 - cosine) / NOISE)
    return saturated.reshape(len(error), -1) / np.sqrt(len(target))


def _loss(residuals: Float[Array, "k n"]) -> Float[Array, " k"]:
    return jnp.sum(residuals**2, -1)
