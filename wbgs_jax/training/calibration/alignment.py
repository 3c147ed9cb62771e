"""Alignment of the surfaces of a mesh that is inaccurate by millimetres to centimetres with training spectra (host).

A path length error of a tenth of a wavelength has little effect, and an error of a whole wavelength looks the same as none.
Alignment therefore starts at low frequencies, and each frequency reduces the ambiguity of the next: every rigid body, and the
receiver, is given a small rigid motion whose effect on phases is computed to first order (propagation/displacement.py). The
motions are estimated by least squares (`gauss_newton.py`) or, without snapshots, by gradient descent (`descend`); at
intervals the surfaces are displaced and paths are traced again. Materials are chosen in view of the current uncertainty of
positions, since powers are informative where phases are not, and by phases once positions are accurate. Everything is then
repeated once, or twice if thicknesses are unknown, and more often as long as a free receiver still moves. A prior keeps
surfaces that affect no path at their nominal positions. The result is kept if it predicts training spectra significantly better
than the nominal mesh, both with the position uncertainty that fits them best.

Gradient alignment takes steps proportional to the wavelength of the highest frequency; the coherence of waves follows from the
current uncertainty of positions, and materials and corrections are learned together with the motion. With snapshots, least
squares are faster and more accurate.
"""

import dataclasses
import itertools
from dataclasses import dataclass
from dataclasses import field as having
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from wbgs_jax._util.pytree import same
from wbgs_jax.config import CalibrationConfig
from wbgs_jax.fields.base import compare, without_unreceived
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import PreparedPaths, WaveParams
from wbgs_jax.mesh.facets import centres
from wbgs_jax.propagation.displacement import Motion
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.batches import TrainingData, batches_of_one_receiver
from wbgs_jax.training.calibration.antennas import ENDS
from wbgs_jax.training.calibration.gauss_newton import adjust, adjusted_numbers
from wbgs_jax.training.calibration.material_fit import Likely, search_materials, search_slabs
from wbgs_jax.training.calibration.objective import CalibrationProblem, Compared, search_placement, surely_better
from wbgs_jax.training.hooks import Say, silent
from wbgs_jax.types import Links

UNSEEN = 3e-3
"""Gradient of the loss, per radian of a path's phase, below which steps shrink with the gradient, since the surface has hardly
any effect."""
RATE = 5e-3
"""Learning rate of the materials and corrections."""


def descend(
    field: Calibratable,
    params: WaveParams,
    prepared: PreparedPaths,
    motion: Motion,
    widths: Motion,
    data: TrainingData,
    pool: Int[np.ndarray, " n"],
    count: int,
    rng: np.random.Generator,
) -> tuple[WaveParams, Motion]:
    """Returns parameters and a motion after a number of steps on spectra up to some frequency.

    Args:
        field, params: a coherent field, which is not displaced: the motion is small.
        prepared: paths of the links of the pool.
        motion: initial motion, with all receivers.
        widths: prior standard deviations of the total motion, which includes that of the field.
        data: training data with spectra.
        pool: indices of links up to the highest frequency in use.
        count: number of steps.
        rng: random numbers.
    """
    batch = 8  # links per step
    batches = batches_of_one_receiver(data, pool, count, batch, rng)
    wavelength = SPEED_OF_LIGHT / float(np.asarray(data.links.frequency_hz)[pool].max())
    step = 0.012  # learning rate of motions, in wavelengths of the highest frequency
    longest_step = 2e-3  # upper bound of this learning rate, metres
    rate, unseen = min(step * wavelength, longest_step), UNSEEN * 2 * np.pi / wavelength
    # Curvature of the normal prior, relative to a loss that is a mean over this number of values.
    numbers = len(pool) * data.receivers.element_positions.shape[-2]
    prior = jax.tree.map(lambda far: 1 / (far**2 * numbers), widths)
    return _steps(field, params, motion, prepared, data, batches, rate, unseen, prior)


@jax.jit
def _steps(
    field: Calibratable,
    params: WaveParams,
    motion: Motion,
    prepared: PreparedPaths,
    data: TrainingData,
    batches: Int[Array, "k b"],
    rate: float | Float[Array, ""],
    unseen: float | Float[Array, ""],
    prior: Motion,
) -> tuple[WaveParams, Motion]:
    """Returns the parameters and the motion after one step on every batch."""
    others, reach = optax.adam(RATE), _reach(field)
    # The steps of motions decay to a tenth over the batches.
    shifts = optax.adam(optax.cosine_decay_schedule(1.0, batches.shape[0], 0.1), eps=unseen)

    def objective(learned: tuple[WaveParams, Motion], index: Int[Array, " b"]) -> Float[Array, ""]:
        params, metres = learned
        batch = data.batch(index, jax.random.key(0))
        motion = _by(metres, reach)
        seen_from = motion.of_receiver(batch.links.receiver_index[0])
        plan = field.displaced(field.plan(params, batch.receiver, prepared), seen_from)
        seen = field.render(params, plan, batch.links)
        loss, _ = compare(seen, without_unreceived(batch, seen))
        total = jax.tree.map(jnp.add, field.motion, motion)
        pulled = jax.tree.map(lambda stiffness, far: 0.5 * jnp.sum(stiffness * far**2), prior, total)
        return loss + field.penalty(params) + sum(jax.tree.leaves(pulled))

    # Parameters that other parts of the calibration determine; they are not changed here
    searched = ("transmitter", "element", "placement", "thick", "curved")

    def step(carry: Any, index: Int[Array, " b"]) -> tuple[Any, None]:
        (params, metres), (own, shift) = carry
        gradient, pull = jax.grad(objective)((params, metres), index)
        still = {name: jax.tree.map(jnp.zeros_like, getattr(gradient, name)) for name in searched}
        gradient = dataclasses.replace(gradient, **still)
        updates, own = others.update(gradient, own)
        moves, shift = shifts.update(pull, shift)
        metres = jax.tree.map(lambda leaf, move: leaf + rate * move, metres, moves)
        return ((optax.apply_updates(params, updates), metres), (own, shift)), None

    metres = jax.tree.map(lambda leaf, one: leaf * one, motion, reach)
    ((params, metres), _), _ = jax.lax.scan(step, ((params, metres), (others.init(params), shifts.init(metres))), batches)
    return params, _by(metres, reach)


def _reach(field: Calibratable) -> Motion:
    """Returns the displacement (metres) caused by 1 metre or radian of every component of a motion. The rotation of a receiver
    only changes phases along its array, and is treated like metres."""
    facets, movers = field.facets, len(field.motion.shift)
    arms = jnp.linalg.norm(facets.corners - centres(facets, movers)[facets.mover][:, None], axis=-1)
    shortest_arm = 0.05  # minimum lever arm of rotations, metres, for small bodies
    radius = jnp.full(movers, shortest_arm).at[facets.mover].max(jnp.max(arms, -1))
    one = jnp.ones_like(field.motion.receiver)
    return Motion(jnp.ones((movers, 3)), jnp.broadcast_to(radius[:, None], (movers, 3)), one, one)


def _by(metres: Motion, reach: Motion) -> Motion:
    return jax.tree.map(lambda leaf, far: leaf / far, metres, reach)


APART = 1.5
"""Minimum ratio of two successive maximum frequencies of the snapshots, except for the highest."""
HELD_RECEIVER, FREE_RECEIVER = (1e-3, 2e-3), (1e-2, 1e-2)
"""Prior standard deviations (metres, radians) of the displacement and rotation of the receiver: "held", since a common
displacement of all walls is easily attributed to the receiver, and "free". If a free receiver moves far, the result with it
free replaces the other if spectra fit significantly better; otherwise both are refined to the end."""
MOST = 5
"""Maximum number of these repetitions for a free receiver, which can be far from its nominal position: correctly placed walls
that have compensated for it return slowly. Positions are estimated again until the receiver moves by less than a standard
deviation of a held one."""


@dataclass(frozen=True)
class GeometryReport:
    """Result of the alignment."""

    before: float
    """Mean score of training spectra with the nominal mesh."""
    after: float
    """Mean score of training spectra with displaced surfaces."""
    kept: bool
    """Whether the displacements are kept."""
    antennas_kept: bool
    """Whether the antennas are the same as before the alignment."""
    typical_mm: float
    """Root mean square of the shifts of rigid bodies."""
    largest_mm: float
    """Largest shift of a rigid body."""
    largest_deg: float
    """Largest rotation of a rigid body."""
    receiver_mm: float
    """Shift of the receiver, the largest one of several receivers."""
    receiver_deg: float
    """Rotation of the receiver, the largest one of several receivers."""
    bodies: list[dict[str, Any]] = having(default_factory=list)
    """For every rigid body its centre (metres, world frame), size and components of its shift (mm), its rotation vector
    (degrees), and the standard deviations (mm) of its position along the most and the least certain direction; empty without
    snapshots."""


@dataclass(frozen=True)
class Place:
    """A candidate of the alignment: a field with displaced surfaces, its parameters, and paths traced in it."""

    field: Calibratable
    params: WaveParams
    prepared: PreparedPaths
    known: Float[np.ndarray, "m 3 3"] | None = None
    """Covariances of the positions of rigid bodies (square metres); None if they have not been estimated."""
    likely: Likely | None = None
    """Most likely slabs of materials; None if they have not been searched."""


@dataclass(frozen=True)
class _Observed:
    """Training spectra with which candidates are scored."""

    data: TrainingData
    spectra: Int[np.ndarray, " n"]
    config: CalibrationConfig
    rng: np.random.Generator
    say: Say

    def problem(self, now: Place) -> CalibrationProblem:
        """Returns these spectra, in a new random order, for scoring a candidate."""
        return CalibrationProblem(now.field, now.prepared, self.data, self.rng.permutation(self.spectra))

    def with_materials(self, now: Place, rounds: int, compared: Compared = "covariances", sized: bool = False) -> Place:
        """Returns a candidate with newly chosen materials.

        Args:
            now: candidate.
            rounds: maximum number of passes over all materials.
            compared: "covariances" accounts for the uncertainty of positions, "snapshots" takes them as exact.
            sized: whether unknown thicknesses are estimated as well.
        """
        self.say("calibration: materials of the surfaces, with uncertain positions")
        count = self.config.geometry_spectra if compared == "covariances" else self.config.spectra
        once, problem = dataclasses.replace(self.config, rounds=rounds), self.problem(now)
        if sized:
            params, _, likely = search_slabs(now.params, problem, once, count, compared, now.likely)
            return dataclasses.replace(now, params=params, likely=likely)
        params, _ = search_materials(now.params, problem, count, once, compared)
        return dataclasses.replace(now, params=params)

    def with_uncertainty(self, now: Place, compared: Compared = "covariances") -> Place:
        """Returns a candidate with the position uncertainty that fits spectra best."""
        params, _ = search_placement(now.params, self.problem(now).scores(self.config.position_std_spectra, compared))
        return dataclasses.replace(now, params=params)

    def unlikelihood(self, now: Place) -> float:
        """Returns the mean negative log-likelihood of some spectra, always the same ones, given the position uncertainty."""
        problem = CalibrationProblem(now.field, now.prepared, self.data, np.random.default_rng(0).permutation(self.spectra))
        return float(problem.scores(self.config.spectra, "covariances")([now.params])[0].mean())

    def compared(self, places: list[Place]) -> tuple[list[Place], list[np.ndarray], np.ndarray]:
        """Returns candidates, each with the position uncertainty that fits best, their scores on some spectra, and the
        transmitters of these."""
        spectra = self.rng.choice(self.spectra, min(self.config.spectra, len(self.spectra)), replace=False)
        uncertain = [self.with_uncertainty(one, "spectra") for one in places]
        scores = [
            CalibrationProblem(p.field, p.prepared, self.data, spectra).scores(compared="spectra")([p.params])[0]
            for p in uncertain
        ]
        return uncertain, scores, np.asarray(self.data.links.tx_index)[spectra]


def learn_geometry(
    place: Place,
    data: TrainingData,
    train: Int[np.ndarray, " n"],
    config: CalibrationConfig,
    rng: np.random.Generator,
    say: Say = silent,
) -> tuple[Place, GeometryReport]:
    """Returns the field with aligned surfaces, newly chosen materials, and the paths of all transmitters; the nominal one
    unless the alignment fits spectra significantly better.

    Args:
        place: field, parameters and paths before the alignment.
        data: training data.
        train: indices of the training links.
        config: settings of the calibration.
        rng: random numbers.
        say: called with a description of each stage.
    """
    tx = np.asarray(data.links.tx_index)
    some_tx = rng.permutation(np.unique(tx[train]))[: config.geometry_tx]
    own = train[np.isin(tx[train], some_tx)]
    links = jax.tree.map(lambda leaf: leaf[own], data.links)
    observed, all_observed = _Observed(data, own, config, rng, say), _Observed(data, train, config, rng, say)
    start = _started(place, observed, links)
    held = _aligned(start, observed, links, HELD_RECEIVER, named=True)
    found = [(held, HELD_RECEIVER)]
    if data.snapshots is not None:
        free = _aligned(start, observed, links, FREE_RECEIVER, named=True)
        if _went_far(free.field.motion, 3.0):  # further than by chance
            say("calibration: position of the receiver")
            sure = _surely_better(free, held, observed, links)
            found = [(free, FREE_RECEIVER)] if sure else [*found, (free, FREE_RECEIVER)]
    started = [(_retraced(now, _fresh(now.params, place.params), data.links, data), width) for now, width in found]
    return _accepted(place, [one for now, width in started for one in _refined(now, width, all_observed)], all_observed)


def _refined(now: Place, receiver: tuple[float, float], observed: _Observed) -> list[Place]:
    """Returns candidates that are aligned with all transmitters, with successively better materials; the last one is not always
    the best."""
    data, config = observed.data, observed.config
    now = observed.with_materials(observed.with_uncertainty(now), 1)
    now = dataclasses.replace(now, likely=None)  # slabs of earlier positions rule nothing out
    moved = [now, observed.with_materials(now, config.rounds, "snapshots", sized=True)]
    unknown = bool(np.any(np.asarray(now.field.known_thickness) == 0))
    # Number of repetitions of the estimate of positions with the chosen materials if thicknesses are unknown, since
    # thicknesses and positions depend on each other. If thicknesses are known, once is sufficient
    more = 2
    least = 0 if data.snapshots is None else more if unknown else 1
    most = MOST if least and receiver == FREE_RECEIVER else least
    for times in range(1, most + 1):
        before = moved[-1].field.motion
        now = _aligned(moved[-1], observed, data.links, receiver, named=False)
        now = _retraced(now, now.params, data.links, data)
        moved.append(observed.with_materials(now, 1, "snapshots", sized=True))
        if times >= least and not _went_far(jax.tree.map(np.subtract, now.field.motion, before), 1.0):
            break
    return moved


def _went_far(motion: Motion, deviations: float) -> bool:
    """Returns whether a receiver has moved by more than so many prior standard deviations of a held receiver."""
    far = (np.linalg.norm(motion.receiver, axis=-1), np.linalg.norm(motion.receiver_turn, axis=-1))
    return any(bool(np.any(one > deviations * width)) for one, width in zip(far, HELD_RECEIVER, strict=True))


def _started(place: Place, observed: _Observed, links: Links) -> Place:
    """Returns the initial candidate, with the prior uncertainty of surfaces and newly chosen materials.

    If phases are inaccurate, a wrong antenna may fit best, with materials that compensate for it. Antennas that were found by
    calibration must therefore fit better than the initial ones at either end, each with materials of its own.
    """
    new, seed = place.field.init(jax.random.key(0)), int(observed.rng.integers(2**32))
    alike = dataclasses.replace(place.params, materials=new.materials)
    first = _uncertain(_retraced(place, alike, links, observed.data), observed.config.geometry_width)
    ends = [(getattr(place.params, end), getattr(new, end)) for end in ENDS]
    starts = []
    for antennas in itertools.product(*([found] if same(found, before) else [found, before] for found, before in ends)):
        params = dataclasses.replace(first.params, **dict(zip(ENDS, antennas, strict=True)))
        observed_alike = dataclasses.replace(observed, rng=np.random.default_rng(seed))  # the same spectra for all combinations
        starts.append(
            observed_alike.with_materials(dataclasses.replace(first, params=params), observed.config.rounds, sized=True)
        )
    return min(starts, key=observed.unlikelihood)


def _surely_better(place: Place, other: Place, observed: _Observed, links: Links) -> bool:
    """Returns whether spectra fit significantly better with one candidate than with another."""
    _, (ours, others), tx = observed.compared([_retraced(one, one.params, links, observed.data) for one in (place, other)])
    return surely_better(others - ours, tx, observed.config.geometry_n_sigma)


def _aligned(now: Place, observed: _Observed, links: Links, receiver: tuple[float, float], named: bool) -> Place:
    """Returns the candidate aligned with the spectra `observed`, from low to high frequencies. Paths are traced again in
    between, but those of the result precede the last displacement.

    Args:
        now: candidate with the paths of the transmitters of `links`.
        links: links whose paths are traced.
        receiver: prior standard deviations of the displacement (metres) and rotation (radians) of the receiver.
        named: whether materials are chosen again whenever paths are traced.
    """
    data, config, frequency = observed.data, observed.config, np.asarray(observed.data.links.frequency_hz)[observed.spectra]
    traced_at, none = float(frequency.min()), jax.tree.map(jnp.zeros_like, now.field.motion)
    motion, widths = none, _widths(none, config.geometry_width, receiver)
    variances, numbers = np.asarray(ravel_pytree(widths)[0], np.float64) ** 2, adjusted_numbers(now.prepared, none)
    covariance = np.diag(variances[numbers])
    # position_std that is assumed when materials are chosen, in wavelengths of the highest frequency; limited to the prior
    spread = 0.05
    traced_again = 5.0  # ratio of frequencies after which surfaces are displaced and paths are traced again
    for highest in frequencies_apart(frequency):
        observed.say(f"calibration: positions of surfaces, up to {highest / 1e9:.4g} GHz")
        if highest > traced_again * traced_at:
            now, motion = _retraced(dataclasses.replace(now, field=now.field.moved(motion)), now.params, links, data), none
            now = observed.with_materials(now, 1) if named else now
            traced_at = float(highest)
        now = _uncertain(now, min(spread * SPEED_OF_LIGHT / float(highest), config.geometry_width))
        pool = observed.spectra[frequency <= highest * (1 + 1e-6)]
        if data.snapshots is not None:
            count, before = config.geometry_snapshots, (motion, covariance, widths)
            motion, covariance = adjust(now.field, now.params, now.prepared, *before, numbers, data, pool, count, observed.rng)
        else:
            count = config.geometry_steps
            params, motion = descend(now.field, now.params, now.prepared, motion, widths, data, pool, count, observed.rng)
            now = dataclasses.replace(now, params=params)
    known = _known(covariance, numbers, variances, len(none.shift)) if data.snapshots is not None else None
    return dataclasses.replace(now, field=now.field.moved(motion), known=known)


def frequencies_apart(frequency_hz: Float[np.ndarray, " n"]) -> list[float]:
    """Returns frequencies of the data whose successive ratios are at least `APART`, ascending, always with the lowest and the
    highest."""
    lowest, *others = np.unique(frequency_hz).tolist()
    found, highest = [lowest], max([lowest, *others])
    for one in others:
        found += [one] if one == highest or one >= APART * found[-1] else []
    return found


def _widths(motion: Motion, shift: float, receiver: tuple[float, float]) -> Motion:
    """Returns the prior standard deviations of all components of a motion."""
    turn = 1e-3  # prior standard deviation (radians) of the rotation of surfaces
    far = {"shift": shift, "turn": turn, "receiver": receiver[0], "receiver_turn": receiver[1]}
    return Motion(**{name: jnp.full_like(getattr(motion, name), width) for name, width in far.items()})


def _accepted(place: Place, moved: list[Place], observed: _Observed) -> tuple[Place, GeometryReport]:
    """Returns the best candidate with its position uncertainty. A displaced one must fit spectra significantly better than the
    nominal one; the likelihood of snapshots is not used, since it tolerates an inaccurate mesh with a large uncertainty."""
    (as_it_was, *others), (before, *after), tx = observed.compared([place, *moved])
    best = int(np.argmin([own.mean() for own in after]))
    kept = surely_better(before - after[best], tx, observed.config.geometry_n_sigma)
    chosen = others[best]
    sizes, bodies = _sizes(chosen.field.motion), _bodies(chosen.field, chosen.known)
    unchanged = not kept or all(same(*(getattr(one.params, end) for one in (as_it_was, chosen))) for end in ENDS)
    report = GeometryReport(float(before.mean()), float(after[best].mean()), kept, unchanged, **sizes, bodies=bodies)
    return chosen if kept else as_it_was, report


def _sizes(motion: Motion) -> dict[str, float]:
    """Returns typical and largest displacements for the report."""
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
    """Returns the covariances of the shifts of all rigid bodies: posterior ones of those that were adjusted, the prior of the
    others."""
    found = variances[: 3 * movers].reshape(movers, 3)[:, None] * np.eye(3)
    for first in range(0, int(np.sum(numbers < 3 * movers)), 3):  # shifts come first, three components per rigid body
        own = slice(first, first + 3)
        found[numbers[first] // 3] = covariance[own, own]
    return found


def _bodies(field: Calibratable, known: Float[np.ndarray, "m 3 3"] | None) -> list[dict[str, Any]]:
    """Returns place, displacement and position uncertainty of every rigid body; an empty list without covariances."""
    if known is None:
        return []
    moved = 1e3 * np.asarray(field.motion.shift)
    off = 1e3 * np.sqrt(np.maximum(np.linalg.eigvalsh(known), 0))
    columns = {
        "centre_m": np.asarray(centres(field.facets, len(moved))),
        "shift_mm": np.linalg.norm(moved, axis=-1),
        "moved_mm": moved,
        "turned_deg": np.rad2deg(np.asarray(field.motion.turn)),
        "best_known_mm": off[:, 0],
        "least_known_mm": off[:, 2],
    }
    rows = zip(*(np.round(column.astype(float), 3).tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def _retraced(now: Place, params: WaveParams, links: Links, data: TrainingData) -> Place:
    return dataclasses.replace(now, params=params, prepared=now.field.prepare(links, data.receivers))


def _uncertain(now: Place, spread: float) -> Place:
    """Returns a candidate with this position_std (metres) for all surfaces; that of the transmitters is unchanged."""
    placement = now.params.placement
    spreads = jnp.full_like(placement, np.log(spread)).at[-1].set(placement[-1])
    return dataclasses.replace(now, params=dataclasses.replace(now.params, placement=spreads))


def _fresh(learned: WaveParams, initial: WaveParams) -> WaveParams:
    """Returns the initial parameters, with the learned materials, antennas and position uncertainty."""
    known = {name: getattr(learned, name) for name in ("materials", "placement", *ENDS)}
    return dataclasses.replace(initial, **known)
