"""Where a transmitter stands, from what receivers observe of it: the place whose answers of a trained field are most alike.

A grid over the scene is asked once; an observation is compared with it, and gradient steps lead on from the best places that
stand apart (`multistart.py`). A planar array cannot tell its front from its back, and rooms have places that sound alike: the
runners-up say how ambiguous an observation is.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree, static
from wbgs_jax.applications.multistart import best_apart, gauss_newton, grid_over, in_blocks, shrinking
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Observation, Params, as_observed, outputs_of
from wbgs_jax.inference.predictor import check_power
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.radio.channel import NOT_HEARD_DB
from wbgs_jax.types import Query, Receiver

What = Literal["spectra", "snapshots", "power"]
"""What is observed of a transmitter."""
POOLED = 10
"""Pixels along each axis whose mean a spectrum is compared by: an array of 4 x 4 elements resolves 25 degrees."""
BLUR = 0.5
"""The blur of the grid, relative to its step."""
NARROWEST_M = 0.12
"""The last blur, metres. Below it some wrong place fits the fringes of a field that is not right to millimetres better than the
right one: among the ends of the search, validation transmitters of scenes 2 and 4 are chosen best under this blur, and worst
under none."""
NOISE = 0.01
"""How far (one minus the cosine) a trained field's spectra are off at the right place, in the median over frequencies. What is
off by much more says that the field is wrong there, and hardly how wrong the place is: the loss grows by its logarithm."""
LEVELS, STEPS = 2, 3
"""Blurs down to that, by equal factors, and steps under each."""
FAINTEST = 1e-12
SMALL = 1e-6
"""Added to what is divided by."""
LARGEST_DB = 20.0
"""No received power counts as off by more: a path that is missing is off by any number."""


class Located(NamedTuple):
    """Where a transmitter seems to stand."""

    position: Float[Array, "3"]
    """World frame, metres."""
    loss: Float[Array, ""]
    """What is left there, a mean over links, 0 where an observation is explained: `NOISE` log(1 + c / `NOISE`), where c is one
    minus the cosine between spectra, or between products y y^H of snapshots; or squared decibels."""
    others: Float[Array, "k 3"]
    """Runners-up, the best one first, world frame, metres. They may have ended at `position` too."""
    other_losses: Float[Array, " k"]
    """Their losses. What stands elsewhere and is hardly worse says that the observation is ambiguous."""


@pytree
class Locator:
    """A trained field that is asked for places. Make it with `locator`, and call it with an observation: (frequencies, 90, 360)
    spectra, (frequencies, elements) snapshots or (frequencies,) powers in dB; of several receivers (receivers, frequencies,
    ...)."""

    field: Field
    params: Params
    plans: tuple[Any, ...]
    """Of every receiver."""
    frequencies_hz: Float[Array, " f"]
    box: Float[Array, "2 3"]
    """No place is looked for outside; world frame, metres."""
    places: Float[Array, "n 3"]
    """The grid."""
    answers: Array
    """What the field says of it, (n, receivers * frequencies, m)."""
    what: What = static()
    known_power: bool = static(default=True)
    starts: int = static(default=12)
    step: float = static(default=0.5)

    def __call__(self, observed: Any) -> Located:
        """Returns where the transmitter of an observation stands.

        Raises:
            ValueError: the observation has another shape than receivers and frequencies.
        """
        elements = round((self.answers.shape[-1] / 2) ** 0.5)  # of products y y^H, real and imaginary
        shape = {"spectra": (PAS_HEIGHT, PAS_WIDTH), "snapshots": (elements,), "power": ()}[self.what]
        observed = jnp.asarray(observed)
        wanted = (len(self.plans), len(self.frequencies_hz), *shape)
        if observed.shape not in (wanted, wanted[1:] if len(self.plans) == 1 else wanted):
            raise ValueError(f"the observation has shape {observed.shape}; expected {wanted}, or without the 1 of one receiver")
        return _locate(self, observed.reshape(-1, *shape))

    def loss(self, places: Float[Array, "k 3"], observed: Array, blur: Any) -> Float[Array, " k"]:
        """Returns how unlike the answers of K places are to an observation; differentiable in reverse mode.

        Args:
            places: world frame, metres.
            observed: (receivers * frequencies, ...), spectra, snapshots or powers.
            blur: metres over which the answers are averaged, where the field has fringes.
        """
        return _loss(_residuals(self, self.ask(places, blur), _target(self.what, observed)))

    def ask(self, places: Float[Array, "k 3"], blur: Any) -> Float[Array, "k links m"]:
        """Returns what the field says of K places, in the form that is compared: (k, receivers * frequencies, m)."""
        params = self.field.smoothed(self.params, blur)

        def at(plan: Any, frequency_hz: Float[Array, ""]) -> Array:
            query = Query(places, jnp.broadcast_to(frequency_hz, places.shape[:1]))
            seen = self.field.render(params, plan, query)
            if self.what == "spectra":  # an observation has the noise that the data had
                seen = seen._replace(pas=as_observed(self.field, params, seen.pas))
            return _compared(self.what, seen)

        # Under `vmap` over frequencies what depends on places alone, such as paths, is computed once.
        seen = [jax.vmap(partial(at, plan))(self.frequencies_hz) for plan in self.plans]
        return jnp.moveaxis(jnp.concatenate(seen), 0, 1)


def locator(
    trained: TrainedField,
    frequencies_hz: Any,
    what: What = "spectra",
    receivers: Sequence[Receiver] | None = None,
    box: Any = None,
    step: float = 0.5,
    starts: int = 12,
    known_power: bool = True,
) -> Locator:
    """Returns a function from observations to places; asking the grid takes a while, an observation seconds.

    Args:
        trained: the field. Known spectra nearby (its `neighbours`) are not asked.
        frequencies_hz: (f,), hertz, at which the transmitter is observed: the more, the less ambiguous.
        what: is observed: "spectra" (normalised PAS), "snapshots" (complex voltages of the elements), "power" (dB).
        receivers: that observe it; by default the first of the data that the field was trained on.
        box: (2, 3), lowest and highest corner of where it may stand, metres; by default the scene's.
        step: metres between places of the grid.
        starts: places that gradient steps begin from.
        known_power: whether it is known what is transmitted. If not, powers are compared up to a common number of decibels.

    Raises:
        UserError: the field knows nothing of what is observed.
    """
    needed = {"spectra": "pas", "snapshots": "snapshots", "power": "power"}[what]
    if needed not in outputs_of(trained.field):
        raise UserError(f"the {trained.field.name} field knows no {what}, only {', '.join(outputs_of(trained.field))}")
    dataset = trained.dataset()
    if what == "power":
        check_power(trained.field, dataset)
    receivers = [dataset.receiver()] if receivers is None else list(receivers)
    box = np.asarray(DatasetScene(dataset).box if box is None else box, np.float32)
    plans = tuple(trained.field.plan(trained.params, receiver) for receiver in receivers)
    frequencies, places = jnp.atleast_1d(jnp.asarray(frequencies_hz, jnp.float32)), grid_over(box, step)
    if what == "power" and len(plans) * len(frequencies) < (1 if known_power else 2):
        raise UserError("one received power of unknown transmitted power says nothing; give several receivers or frequencies")
    asked = (trained.field, trained.params, plans, frequencies, jnp.asarray(box), jnp.asarray(places))
    empty = Locator(*asked, jnp.zeros(0), what, known_power, min(starts, len(places)), step)
    return Locator(*asked, _ask_grid(empty), what, known_power, min(starts, len(places)), step)


@jax.jit
def _ask_grid(locator: Locator) -> Array:
    """Returns what the field says of the grid."""
    return in_blocks(lambda places: locator.ask(places, BLUR * locator.step), locator.places)


@jax.jit
def _locate(locator: Locator, observed: Array) -> Located:
    target = _target(locator.what, observed)
    losses = _loss(_residuals(locator, locator.answers, target))
    chosen = best_apart(locator.places, losses, locator.starts, 1.5 * locator.step)

    def residuals(places: Float[Array, "k 3"], blur: Any) -> Float[Array, "k m"]:
        return _residuals(locator, locator.ask(places, blur), target)

    first = BLUR * locator.step
    blurs = shrinking(first, min(NARROWEST_M, first), LEVELS)
    found = gauss_newton(residuals, locator.places[chosen], locator.box, blurs, STEPS)
    return Located(found.place[0], found.loss[0], found.place[1:], found.loss[1:])


def pooled(spectra: Float[Array, "*n 90 360"]) -> Float[Array, "*n h w"]:
    """Returns the means of `POOLED` x `POOLED` pixels of spectra."""
    high, wide = PAS_HEIGHT // POOLED, PAS_WIDTH // POOLED
    return spectra.reshape(*spectra.shape[:-2], high, POOLED, wide, POOLED).mean((-3, -1))


def _compared(what: What, seen: Observation) -> Float[Array, "k m"]:
    """Returns of what a field says of K links that which is compared with an observation: numbers of a link, of norm 1 but for
    powers."""
    if what == "power":
        assert seen.power_db is not None, "`locator` has asked"
        return seen.power_db[:, None]
    if what == "spectra":
        return _unit(pooled(seen.pas))
    assert seen.snapshots is not None, "`locator` has asked"
    return _unit(_products(seen.snapshots) if seen.covariance is None else seen.covariance)


def _target(what: What, observed: Array) -> Float[Array, "links m"]:
    """Returns what an observation of some links is compared by."""
    if what == "power":
        return observed[:, None]
    return _unit(pooled(observed) if what == "spectra" else _products(observed))


def _products(snapshots: Complex[Array, "k e"]) -> Complex[Array, "k e e"]:
    """Returns y y^H, scaled against underflow."""
    largest = jnp.maximum(jnp.max(jnp.abs(snapshots), -1, keepdims=True), FAINTEST)
    unit = snapshots / largest
    return unit[:, :, None] * unit[:, None].conj()


def _unit(values: Array) -> Float[Array, "k m"]:
    """Returns real numbers of norm 1, those of a complex array one after the other."""
    flat = values.reshape(values.shape[0], -1)
    flat = jnp.concatenate([flat.real, flat.imag], -1) if jnp.iscomplexobj(flat) else flat
    return flat / jnp.sqrt(jnp.maximum(jnp.sum(flat**2, -1, keepdims=True), FAINTEST))


def _residuals(locator: Locator, answers: Float[Array, "k links m"], target: Float[Array, "links m"]) -> Float[Array, "k n"]:
    """Returns residuals whose squares add up to the loss, a mean over links."""
    error = answers - target
    if locator.what == "power":
        heard = target > NOT_HEARD_DB
        count = jnp.maximum(jnp.sum(heard), 1)
        error = jnp.where(heard, error, 0)
        if not locator.known_power:
            error = jnp.where(heard, error - jnp.sum(error, 1, keepdims=True) / count, 0)
        tamed = error / jnp.sqrt(1 + (error / LARGEST_DB) ** 2)
        return tamed[..., 0] / jnp.sqrt(count)
    error = error / np.sqrt(2)  # one minus the cosine is half of the square
    off = jnp.sum(error**2, -1, keepdims=True) / NOISE + SMALL
    tamed = error * jnp.sqrt(jnp.log1p(off) / off)  # squares add up to NOISE log(1 + (1 - cosine) / NOISE)
    return tamed.reshape(len(error), -1) / np.sqrt(len(target))


def _loss(residuals: Float[Array, "k n"]) -> Float[Array, " k"]:
    return jnp.sum(residuals**2, -1)
