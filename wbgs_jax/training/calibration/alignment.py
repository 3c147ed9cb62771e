"""Surfaces of a mesh that is wrong by millimetres to centimetres, put where the spectra say they are, on the host.

A length that is off by a tenth of a wavelength is hardly seen, one that is off by a whole one cannot be told from right. So
low frequencies come first, and each narrows it down for the next: every mover of the facets, and the receiver, gets a small
rigid motion whose effect on phases is first-order (propagation/displacement.py), found by least squares (`gauss_newton.py`)
or, where there are no snapshots, by descent (`gradient.py`); now and then things are moved and paths traced again. Materials
are named as far as places are known by then, since powers tell where phases cannot, and by phases once places are found; then
all is gone through once more, or twice where thicknesses are unknown, and more often where a free receiver still moves. A
prior keeps what no path sees where it was. What comes out is kept if it predicts training spectra surely better than the mesh
as it was, each with the position uncertainty that suits it best.
"""

import dataclasses
import itertools
from dataclasses import dataclass
from dataclasses import field as having

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int

from wbgs_jax._util.pytree import same
from wbgs_jax.config import SearchConfig
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import PreparedPaths, WaveParams
from wbgs_jax.propagation.displacement import Motion
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.batches import TrainingData
from wbgs_jax.training.calibration.antennas import ENDS
from wbgs_jax.training.calibration.gauss_newton import adjust, adjusted_numbers
from wbgs_jax.training.calibration.gradient import descend
from wbgs_jax.training.calibration.material_fit import search_materials
from wbgs_jax.training.calibration.objective import Compared, Told, surely_better
from wbgs_jax.training.calibration.thickness import Likely, search_slabs
from wbgs_jax.training.calibration.uncertainty import search_placement
from wbgs_jax.training.hooks import Say, silent
from wbgs_jax.types import Links

SPREAD = 0.05
"""How far surfaces are taken to be off when materials are named, in wavelengths of the highest frequency; at most as far as the
prior says."""
TRACED_AGAIN = 5.0
"""Ratio of frequencies after which surfaces are moved and paths traced again."""
APART = 1.5
"""Ratio of two frequencies up to which snapshots are looked at one after the other, at least, but for the highest."""
TURN = 1e-3
"""Standard deviation (radians) of how far surfaces are turned."""
HELD_RECEIVER, FREE_RECEIVER = (1e-3, 2e-3), (1e-2, 1e-2)
"""Standard deviations (metres, radians) of how far the receiver stands elsewhere and is turned: held, since what all walls have
in common is easily taken for the receiver's; and free. If it then goes far, what was found with it free replaces the other
where spectra are surely better for it; otherwise both are followed to the end."""
MORE = 2
"""Times that places are found again, with the materials that they told, where thicknesses are unknown: these depend on places,
and places on thicknesses. Where they are known, once is enough."""
MOST = 5
"""Times at most where the receiver is free: it can be far from where it was said to be, and walls that stand right take long to
give back what they took on for it. Places are found again until it goes no further than a standard deviation of a held one."""
SURE = 2.0
"""As many standard errors over transmitters as the gain has to be sure by (`surely_better`): the mesh is doubted already."""


@dataclass(frozen=True)
class GeometryReport:
    """What was moved."""

    before: float
    """Mean score of training spectra with the mesh as it was ..."""
    after: float
    """... and with things moved."""
    kept: bool
    """Whether they stay there."""
    antennas_kept: bool
    """Whether the antennas are those that were found before anything was moved."""
    typical_mm: float
    """Root mean square of the shifts of movers, along all axes together ..."""
    largest_mm: float
    """... and the largest; ..."""
    largest_deg: float
    """... and by how much any of them was turned."""
    receiver_mm: float
    """How far the receiver, or that of several which was moved furthest, was moved ..."""
    receiver_deg: float
    """... and turned."""
    bodies: list[dict[str, float]] = having(default_factory=list)
    """Of every mover: how far it was shifted (mm), and the standard deviations (mm) of where it stands along the direction in
    which that is known best, and along the one in which it is known least; where snapshots were heard."""


@dataclass(frozen=True)
class Place:
    """A field in which things stand somewhere, with the paths of some transmitters there."""

    field: Calibratable
    """A field that can be `moved`."""
    params: WaveParams
    prepared: PreparedPaths
    known: Float[np.ndarray, "m 3 3"] | None = None
    """Covariances of where the movers stand (square metres); None where they are not known."""
    likely: Likely | None = None
    """Slabs that materials may be; None where they have not been looked for."""


@dataclass(frozen=True)
class _Heard:
    """Some training spectra, and what they say of places."""

    data: TrainingData
    spectra: Int[np.ndarray, " n"]
    config: SearchConfig
    rng: np.random.Generator
    say: Say

    def told(self, now: Place) -> Told:
        """Returns what they say of a place, in an order drawn anew."""
        return Told(now.field, now.prepared, self.data, self.rng.permutation(self.spectra))

    def named(self, now: Place, rounds: int, compared: Compared = "covariances", sized: bool = False) -> Place:
        """Names the materials: as far as places are believed, or as if all of them were known; with the thicknesses that the
        scene does not say, or in those that they have."""
        self.say("search: materials, as far as places are known")
        count = self.config.geometry_spectra if compared == "covariances" else self.config.spectra
        once, told = dataclasses.replace(self.config, rounds=rounds), self.told(now)
        if sized:
            params, _, likely = search_slabs(now.params, told, once, count, compared, now.likely)
            return dataclasses.replace(now, params=params, likely=likely)
        params, _ = search_materials(now.params, told, count, once, compared)
        return dataclasses.replace(now, params=params)

    def guessed(self, now: Place, compared: Compared = "covariances") -> Place:
        """Believes places as far as spectra say."""
        params, _ = search_placement(now.params, self.told(now).scores(self.config.placement_spectra, compared))
        return dataclasses.replace(now, params=params)

    def surprised(self, now: Place) -> float:
        """Returns how badly some spectra, always the same ones, are explained as far as places are known."""
        told = Told(now.field, now.prepared, self.data, np.random.default_rng(0).permutation(self.spectra))
        return float(told.scores(self.config.spectra, "covariances")([now.params])[0].mean())

    def compared(self, places: list[Place]) -> tuple[list[Place], list[np.ndarray], np.ndarray]:
        """Returns places, each with as much doubt as suits it, the scores of some spectra at each, and their transmitters."""
        spectra = self.rng.choice(self.spectra, min(self.config.spectra, len(self.spectra)), replace=False)
        doubted = [self.guessed(one, "spectra") for one in places]
        scores = [Told(p.field, p.prepared, self.data, spectra).scores(compared="spectra")([p.params])[0] for p in doubted]
        return doubted, scores, np.asarray(self.data.links.tx_index)[spectra]


def learn_geometry(
    place: Place,
    data: TrainingData,
    train: Int[np.ndarray, " n"],
    config: SearchConfig,
    rng: np.random.Generator,
    say: Say = silent,
) -> tuple[Place, GeometryReport]:
    """Returns the field with its surfaces where training spectra say they are, its materials named there, and the paths of all
    transmitters; as it was, where that explains spectra no worse. `say` is told of what is looked for next."""
    tx = np.asarray(data.links.tx_index)
    some_tx = rng.permutation(np.unique(tx[train]))[: config.geometry_tx]
    own = train[np.isin(tx[train], some_tx)]
    links = jax.tree.map(lambda leaf: leaf[own], data.links)
    heard, all_heard = _Heard(data, own, config, rng, say), _Heard(data, train, config, rng, say)
    start = _begun(place, heard, links)
    held = _followed(start, heard, links, HELD_RECEIVER, named=True)
    found = [(held, HELD_RECEIVER)]
    if data.snapshots is not None:
        free = _followed(start, heard, links, FREE_RECEIVER, named=True)
        if _went_far(free.field.motion, 3.0):  # further than by chance
            say("search: whether the receiver stands elsewhere")
            sure = _surely_better(free, held, heard, links)
            found = [(free, FREE_RECEIVER)] if sure else [*found, (free, FREE_RECEIVER)]
    begun = [(_retraced(now, _fresh(now.params, place.params), data.links, data), width) for now, width in found]
    return _judged(place, [one for now, width in begun for one in _refined(now, width, all_heard)], all_heard)


def _refined(now: Place, receiver: tuple[float, float], heard: _Heard) -> list[Place]:
    """Returns where things are found by all transmitters, with ever better materials; the last is not always the best."""
    data, config = heard.data, heard.config
    now = dataclasses.replace(heard.named(heard.guessed(now), 1), likely=None)  # where things stood before rules nothing out
    moved = [now, heard.named(now, config.rounds, "snapshots", sized=True)]
    unknown = bool(np.any(np.asarray(now.field.known_thickness) == 0))
    least = 0 if data.snapshots is None else MORE if unknown else 1
    most = MOST if least and receiver == FREE_RECEIVER else least
    for times in range(1, most + 1):
        before = moved[-1].field.motion
        now = _followed(moved[-1], heard, data.links, receiver, named=False)
        now = _retraced(now, now.params, data.links, data)
        moved.append(heard.named(now, 1, "snapshots", sized=True))
        if times >= least and not _went_far(jax.tree.map(np.subtract, now.field.motion, before), 1.0):
            break
    return moved


def _went_far(motion: Motion, deviations: float) -> bool:
    """Returns whether a receiver went further than so many standard deviations of how far one goes that is held."""
    far = (np.linalg.norm(motion.receiver, axis=-1), np.linalg.norm(motion.receiver_turn, axis=-1))
    return any(bool(np.any(one > deviations * width)) for one, width in zip(far, HELD_RECEIVER, strict=True))


def _begun(place: Place, heard: _Heard, links: Links) -> Place:
    """Returns the field with surfaces doubted and materials named anew, as far as places are known.

    Where phases are wrong, a wrong antenna can explain them best, and materials then make up for it. So antennas that were
    found, at either end, have to explain spectra better than those of before, each with materials of its own.
    """
    new, seed = place.field.init(jax.random.key(0)), int(heard.rng.integers(2**32))
    alike = dataclasses.replace(place.params, materials=new.materials)
    first = _doubted(_retraced(place, alike, links, heard.data), heard.config.geometry_width)
    ends = [(getattr(place.params, end), getattr(new, end)) for end in ENDS]
    begins = []
    for antennas in itertools.product(*([found] if same(found, before) else [found, before] for found, before in ends)):
        params = dataclasses.replace(first.params, **dict(zip(ENDS, antennas, strict=True)))
        alike_heard = dataclasses.replace(heard, rng=np.random.default_rng(seed))  # the same spectra name materials of each
        begins.append(alike_heard.named(dataclasses.replace(first, params=params), heard.config.rounds, sized=True))
    return min(begins, key=heard.surprised)


def _surely_better(place: Place, other: Place, heard: _Heard, links: Links) -> bool:
    """Returns whether spectra are surely better where one place was found than where another was."""
    _, (ours, others), tx = heard.compared([_retraced(one, one.params, links, heard.data) for one in (place, other)])
    return surely_better(others - ours, tx, SURE)


def _followed(now: Place, heard: _Heard, links: Links, receiver: tuple[float, float], named: bool) -> Place:
    """Returns the field with things moved as spectra say, from low frequencies to high ones; its paths are those of before.
    Paths are traced again on the way, and materials named, if they are.

    Args:
        now: with the paths of the transmitters of `links`.
        heard: what their spectra say.
        links: of which paths are traced.
        receiver: standard deviations of how far it stands elsewhere and is turned.
        named: whether materials are named.
    """
    data, config, frequency = heard.data, heard.config, np.asarray(heard.data.links.query.frequency_hz)[heard.spectra]
    traced_at, none = float(frequency.min()), jax.tree.map(jnp.zeros_like, now.field.motion)
    motion, widths = none, _widths(none, config.geometry_width, receiver)
    variances, numbers = np.asarray(ravel_pytree(widths)[0], np.float64) ** 2, adjusted_numbers(now.prepared, none)
    covariance = np.diag(variances[numbers])
    for highest in frequencies_apart(frequency):
        heard.say(f"search: places, up to {highest / 1e9:.4g} GHz")
        if highest > TRACED_AGAIN * traced_at:
            now, motion = _retraced(dataclasses.replace(now, field=now.field.moved(motion)), now.params, links, data), none
            now = heard.named(now, 1) if named else now
            traced_at = float(highest)
        now = _doubted(now, min(SPREAD * SPEED_OF_LIGHT / float(highest), config.geometry_width))
        pool = heard.spectra[frequency <= highest * (1 + 1e-6)]
        if data.snapshots is not None:
            count, before = config.geometry_snapshots, (motion, covariance, widths)
            motion, covariance = adjust(now.field, now.params, now.prepared, *before, numbers, data, pool, count, heard.rng)
        else:
            count = config.geometry_steps
            params, motion = descend(now.field, now.params, now.prepared, motion, widths, data, pool, count, heard.rng)
            now = dataclasses.replace(now, params=params)
    known = _known(covariance, numbers, variances, len(none.shift)) if data.snapshots is not None else None
    return dataclasses.replace(now, field=now.field.moved(motion), known=known)


def frequencies_apart(frequency_hz: Float[np.ndarray, " n"]) -> list[float]:
    """Returns frequencies of the data that stand apart, ascending; the lowest and the highest are among them."""
    lowest, *others = np.unique(frequency_hz).tolist()
    found, highest = [lowest], max([lowest, *others])
    for one in others:
        found += [one] if one == highest or one >= APART * found[-1] else []
    return found


def _widths(motion: Motion, shift: float, receiver: tuple[float, float]) -> Motion:
    """Returns the standard deviations of all numbers of a motion before anything was heard."""
    far = {"shift": shift, "turn": TURN, "receiver": receiver[0], "receiver_turn": receiver[1]}
    return Motion(**{name: jnp.full_like(getattr(motion, name), width) for name, width in far.items()})


def _judged(place: Place, moved: list[Place], heard: _Heard) -> tuple[Place, GeometryReport]:
    """Returns the best place, with its uncertainty. A moved one has to be surely better at what counts in the end, spectra: the
    likelihood of snapshots forgives a wrong mesh that is doubted enough."""
    (as_it_was, *others), (before, *after), tx = heard.compared([place, *moved])
    best = int(np.argmin([own.mean() for own in after]))
    kept = surely_better(before - after[best], tx, SURE)
    chosen = others[best]
    sizes, bodies = _sizes(chosen.field.motion), _bodies(chosen.field.motion, chosen.known)
    unchanged = not kept or all(same(*(getattr(one.params, end) for one in (as_it_was, chosen))) for end in ENDS)
    report = GeometryReport(float(before.mean()), float(after[best].mean()), kept, unchanged, **sizes, bodies=bodies)
    return chosen if kept else as_it_was, report


def _sizes(motion: Motion) -> dict[str, float]:
    """Returns how far things were moved."""
    size = jax.tree.map(lambda leaf: np.linalg.norm(np.asarray(leaf), axis=-1), motion)
    return {
        "typical_mm": float(1e3 * np.sqrt(np.mean(size.shift**2))),
        "largest_mm": float(1e3 * size.shift.max()),
        "largest_deg": float(np.rad2deg(size.turn.max())),
        "receiver_mm": float(1e3 * size.receiver.max()),
        "receiver_deg": float(np.rad2deg(size.receiver_turn.max())),
    }


def _known(
    covariance: Float[np.ndarray, "q q"], numbers: Int[np.ndarray, " q"], variances: Float[np.ndarray, " p"], movers: int
) -> Float[np.ndarray, "m 3 3"]:
    """Returns the covariances of the shifts of all movers: of those that were adjusted as known by now, of others the prior."""
    found = variances[: 3 * movers].reshape(movers, 3)[:, None] * np.eye(3)
    for first in range(0, int(np.sum(numbers < 3 * movers)), 3):  # shifts come first, three numbers a mover
        own = slice(first, first + 3)
        found[numbers[first] // 3] = covariance[own, own]
    return found


def _bodies(motion: Motion, known: Float[np.ndarray, "m 3 3"] | None) -> list[dict[str, float]]:
    """Returns how far every mover was shifted, and how well it is known where it stands."""
    if known is None:
        return []
    shifts = 1e3 * np.linalg.norm(np.asarray(motion.shift), axis=-1)
    off = 1e3 * np.sqrt(np.maximum(np.linalg.eigvalsh(known), 0))
    names = "shift_mm", "best_known_mm", "least_known_mm"
    rows = np.round(np.stack([shifts, off[:, 0], off[:, 2]], -1), 3).tolist()
    return [dict(zip(names, row, strict=True)) for row in rows]


def _retraced(now: Place, params: WaveParams, links: Links, data: TrainingData) -> Place:
    return dataclasses.replace(now, params=params, prepared=now.field.prepare(links, data.receivers))


def _doubted(now: Place, spread: float) -> Place:
    """Believes that every surface may be off by so many metres (standard deviation); transmitters are where they are said."""
    placement = now.params.placement
    spreads = jnp.full_like(placement, np.log(spread)).at[-1].set(placement[-1])
    return dataclasses.replace(now, params=dataclasses.replace(now.params, placement=spreads))


def _fresh(learned: WaveParams, initial: WaveParams) -> WaveParams:
    """Returns parameters as they were before, but for materials, antennas and how far places are believed."""
    known = {name: getattr(learned, name) for name in ("materials", "placement", *ENDS)}
    return dataclasses.replace(initial, **known)
