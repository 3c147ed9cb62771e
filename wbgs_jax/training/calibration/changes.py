"""Finds what has changed in a room since a field was trained, from a few new links (host).

A change is noticed by a permutation test within strata. If nothing has changed, a new transmitter is like those next to it that
the field was trained with, so that any of them could be the new one. Several statistics see different changes: the mean score;
the largest gain that making one object of air brings, with and without the transmitters at which it does harm; and the received
power, for a common gain. All are relative to the mean of the stratum, so that they do not depend on where in the room the new
transmitters are. Each is compared with its own distribution over random exchanges, and so is the smallest of the resulting
probabilities: false alarms then have the given rate whatever the statistics are. Transmitters are exchanged, not links, since
the links of one transmitter are correlated.

What has changed is found object by object. The scores of all objects made of air need no tracing; for the objects that gain
most, paths are traced again without the object and with the object in places around its own. The best place is refined in
halved steps, during which the position uncertainty of the object shrinks as well: its paths are first compared by their power,
and by their phase only when its position is known to a fraction of a wavelength. A change is kept if it improves the scores of
the new links by more than the removal of any object improves those of old links.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from wbgs_jax._util.statistics import by_transmitter
from wbgs_jax.data.dataset import group_places
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import PreparedPaths, WaveParams
from wbgs_jax.mesh.facets import areas, centres
from wbgs_jax.observation_kinds import power_of
from wbgs_jax.propagation.displacement import still
from wbgs_jax.training.calibration.objective import CalibrationProblem, Compared, predicted
from wbgs_jax.training.calibration.obstacles import each_by_itself, of_air
from wbgs_jax.training.hooks import Say, silent

CLOSED = 1e-3
"""Largest sum of area vectors of a closed surface, relative to its area."""
DRAWS = 4000
"""Random exchanges of transmitters."""
STATISTICS = ("mean", "object", "signed object", "power")
"""Names of the statistics of the test."""
CONTROLS = 6
"""Maximum number of old transmitters in the stratum of a new one, the nearest ones."""
NOTICED: Compared = "snapshots"
"""The quantity that is compared in the test and to rank objects; covariances would take four times as long."""
COMPARED: Compared = "covariances"
"""The quantity that is compared in the search, which accounts for the uncertainty of positions."""
LIKELY, LIKELIEST = 6, 1
"""Number of objects that are tried nearby, those without which the new links fit best, and of those that are tried further
away."""
RINGS_M, DIRECTIONS = (0.45, 0.9), 8
"""Distances of the places that are tried, nearby and further away, and their number at each."""
BEGIN_STD_M, FIRST_STEP_M, LAST_STEP_M = 0.2, 0.24, 0.015
"""Position uncertainty with which these are compared, and the first and the last step of the refinement."""


class Group(IntEnum):
    """Kinds of links in the test."""

    OLD = 0
    NEW = 1


@dataclass(frozen=True)
class Evidence:
    """Scores of N old and new transmitters, means over their links; lower is better."""

    score: Float[np.ndarray, " n"]
    """Scores of the field as it is."""
    without: Float[np.ndarray, "objects n"]
    """Gains by one object made of air: reductions of the score."""
    without_worse: Float[np.ndarray, "objects n"]
    """The same, with links that get worse counted as zero."""
    power_db: Float[np.ndarray, " n"] | None
    """Measured minus predicted received power; None for data without powers."""
    place: Float[np.ndarray, "n 3"]
    """Metres."""
    group: Int[np.ndarray, " n"]
    """Members of `Group`."""

    def some(self, kept: Int[np.ndarray, " k"]) -> "Evidence":
        """Returns the evidence of some of the transmitters."""
        power = None if self.power_db is None else self.power_db[kept]
        gains = self.without[:, kept], self.without_worse[:, kept]
        return Evidence(self.score[kept], *gains, power, self.place[kept], self.group[kept])


@dataclass(frozen=True)
class Change:
    """An object that has changed."""

    number: int
    """Index of the object in `objects_of` of the field before all changes."""
    centre: list[float]
    """Middle of its bounding box before the change, world frame, metres."""
    size: list[float]
    """Extent of its bounding box, metres."""
    shift: list[float] | None
    """Displacement, world frame, metres; None if the object is gone."""
    gain: float
    """Improvement of the mean score of the new links."""
    name: str = ""
    """Name of the object in its scene."""


@dataclass(frozen=True)
class Notice:
    """Result of the test whether a room has changed."""

    p_value: float
    """Probability of such new links if nothing has changed."""
    p_values: dict[str, float]
    """The same for each of the statistics alone."""


def objects_of(field: Calibratable) -> list[Int[np.ndarray, " _"]]:
    """Returns the rigid bodies (`Facets.mover`) of every object that can be moved: the closed bodies of one object of the scene
    together, or each by itself if they are too far apart to be one."""
    facets = jax.tree.map(np.asarray, field.facets)
    area_vectors, size = facets.normal * areas(facets)[:, None], areas(facets)

    largest_m = 4.0  # largest extent of an object that is moved as one; larger bodies are parts of the building

    def movable(own: Bool[np.ndarray, " f"]) -> bool:
        closed = np.linalg.norm(area_vectors[own].sum(0)) < CLOSED * size[own].sum()
        return bool(closed and np.ptp(facets.corners[own].reshape(-1, 3), axis=0).max() <= largest_m)

    found = []
    for body in np.unique(facets.body):
        movers = np.unique(facets.mover[facets.body == body])
        whole = movable(facets.body == body)
        found += [movers] if whole else [np.array([one]) for one in movers if movable(facets.mover == one)]
    return found


def gather(
    problem: CalibrationProblem, params: WaveParams, objects: Sequence[Int[np.ndarray, " _"]], group: Int[np.ndarray, " n"]
) -> Evidence:
    """Returns the scores of all transmitters of a problem, with the field as it is and without each object.

    Args:
        problem: links, with the paths of their transmitters.
        params: parameters of its field.
        objects: rigid bodies of every object.
        group: group of every link.
    """
    score, *without = _without_each(problem, params, objects, NOTICED)
    positions = np.asarray(problem.data.links.tx_position, np.float64)[problem.spectra]
    samples = samples_of(positions, problem.tx_index(), group)
    transmitters, first, place = np.unique(samples, return_index=True, return_inverse=True)
    count = np.bincount(place)

    def by_tx(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " tx"]:
        return np.bincount(place, values) / count

    gains = score - np.array(without).reshape(-1, len(score))
    power = _power_error_db(problem, params)
    return Evidence(
        by_tx(score),
        np.array([by_tx(one) for one in gains]).reshape(-1, len(transmitters)),
        np.array([by_tx(np.maximum(one, 0)) for one in gains]).reshape(-1, len(transmitters)),
        None if power is None else by_tx(power),
        positions[first],
        group[first],
    )


def samples_of(
    positions: Float[np.ndarray, "n 3"], tx_index: Int[np.ndarray, " n"], group: Int[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """Returns the independent samples that links belong to: transmitters, or places that were measured again in one group."""
    found = tx_index.copy()
    for one in np.unique(group):
        own = group == one
        found[own] = group_places(positions[own], tx_index[own])
    return found


def _without_each(
    problem: CalibrationProblem, params: WaveParams, objects: Sequence[Int[np.ndarray, " _"]], compared: Compared
) -> Float[np.ndarray, "h n"]:
    """Returns the scores of the field as it is, then with each object made of air, without tracing paths again."""
    own, parted = each_by_itself(params, problem)
    candidates = [parted]
    for movers in objects:
        gone = parted
        for one in movers:
            gone = of_air(gone, int(one))
        candidates.append(gone)
    return own.scores(compared=compared)(candidates)


def notice(evidence: Evidence, rng: np.random.Generator) -> Notice:
    """Returns how probable the scores of new links are if nothing has changed.

    Args:
        evidence: scores of old and new transmitters.
        rng: random numbers for the exchanges of transmitters.
    """
    strata, sizes = strata_of(evidence)
    count = len(sizes)
    drawn = np.floor(rng.uniform(size=(DRAWS, count)) * sizes).astype(int)
    exchanged = np.concatenate([np.zeros((1, count), int), drawn])

    def means(values: Float[np.ndarray, "h n"]) -> Float[np.ndarray, "h draws"]:
        own = values[:, strata]
        own = own - (own * inside).sum(-1, keepdims=True) / sizes[:, None]
        return own[:, np.arange(count), exchanged].mean(-1)

    inside = np.arange(strata.shape[1]) < sizes[:, None]
    power = np.zeros_like(evidence.score) if evidence.power_db is None else evidence.power_db
    found = [
        means(evidence.score[None])[0],
        means(evidence.without_worse).max(0, initial=0),
        means(evidence.without).max(0, initial=0),
        np.abs(means(power[None]))[0],
    ]
    return _of_statistics(np.stack(found, 1))


def strata_of(evidence: Evidence) -> tuple[Int[np.ndarray, "new most"], Int[np.ndarray, " new"]]:
    """Returns the indices of the transmitters of every stratum, and their number: a new one, then the old ones to which none of
    the others is nearer, at most `CONTROLS`. A stratum is filled up with the new one. Strata share no transmitter, which keeps
    their exchanges independent."""
    new, old = (np.flatnonzero(evidence.group == one) for one in (Group.NEW, Group.OLD))
    distance, owner = cKDTree(evidence.place[new]).query(evidence.place[old])
    strata, sizes = np.tile(new[:, None], (1, CONTROLS + 1)), np.ones(len(new), int)
    for one in np.argsort(distance):
        if sizes[owner[one]] <= CONTROLS:
            strata[owner[one], sizes[owner[one]]] = old[one]
            sizes[owner[one]] += 1
    return strata, sizes


def power_change_db(evidence: Evidence) -> float:
    """Returns the median change of the received power of new transmitters relative to the old ones next to them, dB."""
    strata, sizes = strata_of(evidence)
    if evidence.power_db is None or not (sizes > 1).any():
        return 0.0
    own = evidence.power_db[strata][sizes > 1]
    others = (own.sum(1) - own[:, 0] * (own.shape[1] - sizes[sizes > 1] + 1)) / (sizes[sizes > 1] - 1)
    return float(np.median(own[:, 0] - others))


def limit_of(evidence: Evidence, level: float, rng: np.random.Generator) -> float:
    """Returns the gain that the removal of an object brings by chance with a probability of at most `level`: a quantile over
    groups of old transmitters, as many as there are new ones."""
    gains = evidence.without_worse[:, evidence.group == Group.OLD]
    drawn = rng.integers(gains.shape[1], size=(DRAWS, int(np.sum(evidence.group == Group.NEW))))
    return float(np.quantile(gains[:, drawn].mean(-1).max(0, initial=0), 1 - level))


def _of_statistics(found: Float[np.ndarray, "draws statistics"]) -> Notice:
    """Returns the probabilities of the first row among all rows, and that of its smallest one."""
    single = np.stack([_upper_share(column) for column in found.T], 1)
    together = _upper_share(-single.min(1))
    return Notice(float(together[0]), dict(zip(STATISTICS, single[0].tolist(), strict=True)))


def _upper_share(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns for each value the share of all values, itself included, that are at least as large."""
    return 1 - np.searchsorted(np.sort(values), values, "left") / len(values)


def _power_error_db(problem: CalibrationProblem, params: WaveParams) -> Float[np.ndarray, " n"] | None:
    """Returns measured minus predicted received powers, limited, since one of both may be silence; None for data without
    powers."""
    measured = power_of({name: values[problem.spectra] for name, values in problem.data.observations.items()})
    most = 30.0  # dB, of a link that is blocked
    return None if measured is None else np.clip(np.asarray(measured) - predicted(problem, params, "power_db"), -most, most)


@dataclass(frozen=True)
class Trial:
    """A field with an object in another place, and how well it fits."""

    field: Calibratable
    params: WaveParams
    prepared: PreparedPaths
    score: Float[np.ndarray, " n"]
    """Scores of the new links."""


def with_object_moved(
    field: Calibratable, movers: Int[np.ndarray, " k"], shift: Float[np.ndarray, "3"], turn: float = 0.0
) -> Calibratable:
    """Returns a field with an object displaced as a whole (host).

    Args:
        field: a field with paths.
        movers: rigid bodies of the object.
        shift: metres, world frame.
        turn: rotation about the vertical axis through the middle of its bounding box, radians.
    """
    motion = still(len(field.motion.shift), len(field.motion.receiver))
    axis = np.array([0, 0, turn])
    arm = np.asarray(centres(field.facets, len(field.motion.shift)))[movers] - middle_of(field, movers)
    shifts, turns = motion.shift.copy(), motion.turn.copy()
    shifts[movers] = shift + Rotation.from_rotvec(axis).apply(arm) - arm
    turns[movers] = axis
    return field.moved(dataclasses.replace(motion, shift=shifts, turn=turns))


def middle_of(field: Calibratable, movers: Int[np.ndarray, " k"]) -> Float[np.ndarray, "3"]:
    """Returns the middle of the bounding box of rigid bodies, world frame, metres."""
    low, high = box_of(field, movers)
    return (low + high) / 2


def box_of(field: Calibratable, movers: Int[np.ndarray, " k"]) -> Float[np.ndarray, "2 3"]:
    """Returns the lowest and the highest corner of the bounding box of rigid bodies, world frame, metres."""
    corners = np.asarray(field.facets.corners, np.float64)[np.isin(np.asarray(field.facets.mover), movers)].reshape(-1, 3)
    return np.stack([corners.min(0), corners.max(0)])


def without_object(field: Calibratable, params: WaveParams, movers: Int[np.ndarray, " k"]) -> tuple[Calibratable, WaveParams]:
    """Returns a field and its parameters without an object, with everything else unchanged (host)."""
    mover = np.asarray(field.facets.mover)
    stays = np.setdiff1d(np.arange(len(params.placement)), movers)  # the last one is that of the transmitters
    kept = np.flatnonzero(~np.isin(mover, movers))
    return field.without(movers), dataclasses.replace(
        params, facet_correction=params.facet_correction[kept], placement=params.placement[stays]
    )


def find_changes(
    problem: CalibrationProblem, params: WaveParams, limit: float, say: Say = silent
) -> tuple[Calibratable, WaveParams, list[Change]]:
    """Returns the field and parameters of the changed room, and what has changed, in the order in which it was found.

    Args:
        problem: new links, with the paths of their transmitters in the unchanged room.
        params: parameters of its field.
        limit: improvement of the mean score below which a change is not kept.
        say: called with a description of each stage.
    """
    now, changes = Trial(problem.field, params, problem.prepared, _scores(problem, params)), list[Change]()
    names = list(range(len(objects_of(problem.field))))
    # Position uncertainties with which an object in its place is compared with itself elsewhere: an uncertain object often
    # fits better than a certain one, even where nothing has changed
    stds_m = 0.2, 0.03, 0.0075
    most_changes = 12  # maximum number of changes
    for _ in range(most_changes):
        objects = objects_of(now.field)
        here = dataclasses.replace(problem, field=now.field, prepared=now.prepared)
        if not len(objects):
            break
        score, *without = _without_each(here, now.params, objects, NOTICED)
        gains = by_object(score, np.array(without), problem.tx_index())
        if gains.max() <= 0:
            break
        say(f"objects that may have changed: {len(objects)} compared")
        tried = [(one, *_anywhere(here, now, objects[one], RINGS_M[0])) for one in np.argsort(-gains)[:LIKELY].tolist()]
        tried.sort(key=lambda one: -one[3])
        tried += [(one[0], *_anywhere(here, now, objects[one[0]], RINGS_M[1])) for one in tried[:LIKELIEST]]
        number, best, offset, _ = max(tried, key=lambda one: one[3])
        movers = objects[number]
        if offset is not None:
            say("place of the object")
            best, offset = _refined(here, now, movers, offset)
        in_place = [now.score.mean(), *(_scores(here, _uncertain(now.params, movers, std)).mean() for std in stds_m)]
        gain = float(min(in_place) - best.score.mean())
        if gain <= limit:
            break
        before, size = middle_of(now.field, movers), np.ptp(box_of(now.field, movers), axis=0)
        found = Change(names[number], before.tolist(), size.tolist(), None if offset is None else offset.tolist(), gain)
        changes = _merged(changes, found)
        names = names if offset is not None else [*names[:number], *names[number + 1 :]]
        now = best
    return now.field, now.params, changes


def _merged(changes: list[Change], found: Change) -> list[Change]:
    """Returns changes with one more; if the object has been moved before, its displacements add."""
    earlier = [one for one in changes if one.number == found.number]
    others = [one for one in changes if one.number != found.number]
    for one in earlier:
        assert one.shift is not None, "an object that is gone is not found again"
        shift = None if found.shift is None else np.add(one.shift, found.shift).tolist()
        found = dataclasses.replace(one, shift=shift, gain=one.gain + found.gain)
    return [*others, found]


def by_object(
    score: Float[np.ndarray, " n"], without: Float[np.ndarray, "objects n"], tx_index: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " objects"]:
    """Returns the mean gain of links without each object, those that get worse counted as zero: a moved object can stand in the
    way of some links as before."""
    gains: Float[np.ndarray, " objects"] = by_transmitter(np.maximum(score - without, 0), tx_index).mean(-1)
    return gains


def _anywhere(
    here: CalibrationProblem, now: Trial, movers: Int[np.ndarray, " k"], ring: float
) -> tuple[Trial, Float[np.ndarray, "3"] | None, float]:
    """Returns the best of an object's absence and of its places at one distance (metres), its offset (None: absent), and the
    gain over the object in its place with the same uncertainty."""
    unchanged = _scores(here, _uncertain(now.params, movers, BEGIN_STD_M)).mean()
    best, offset = _tried(here, *without_object(now.field, now.params, movers)), None
    gain = min(unchanged, now.score.mean()) - best.score.mean()
    for angle in np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS:
        shift = ring * np.array([np.cos(angle), np.sin(angle), 0])
        trial = _placed(here, now, movers, shift, BEGIN_STD_M)
        if unchanged - trial.score.mean() > gain:
            best, offset, gain = trial, shift, unchanged - trial.score.mean()
    return best, offset, float(gain)


def _refined(
    here: CalibrationProblem, now: Trial, movers: Int[np.ndarray, " k"], offset: Float[np.ndarray, "3"]
) -> tuple[Trial, Float[np.ndarray, "3"]]:
    """Returns an object in the best place near an offset, which is found in halved steps along both axes."""
    step = FIRST_STEP_M
    while step >= LAST_STEP_M:
        best = _placed(here, now, movers, offset, step / 2)
        for axis in (0, 1):
            for sign in (-1, 1):
                shift = offset + sign * step * np.eye(3)[axis]
                trial = _placed(here, now, movers, shift, step / 2)
                if trial.score.mean() < best.score.mean():
                    best, offset = trial, shift
                    break
        step /= 2
    return best, offset


def _placed(
    here: CalibrationProblem, now: Trial, movers: Int[np.ndarray, " k"], shift: Float[np.ndarray, "3"], std: float
) -> Trial:
    """Returns a trial of an object at an offset that is known up to a standard deviation (metres)."""
    return _tried(here, with_object_moved(now.field, movers, shift), _uncertain(now.params, movers, std))


def _uncertain(params: WaveParams, movers: Int[np.ndarray, " k"], std: float) -> WaveParams:
    """Returns parameters in which the positions of rigid bodies are known up to a standard deviation (metres)."""
    return dataclasses.replace(params, placement=params.placement.at[jnp.asarray(movers)].set(np.log(std)))


def _tried(here: CalibrationProblem, field: Calibratable, params: WaveParams) -> Trial:
    """Returns a trial of a field, whose paths are traced."""
    data = here.data
    prepared = field.prepare(jax.tree.map(lambda leaf: leaf[here.spectra], data.links), data.receivers)
    problem = dataclasses.replace(here, field=field, prepared=prepared)
    return Trial(field, params, prepared, _scores(problem, params))


def _scores(problem: CalibrationProblem, params: WaveParams) -> Float[np.ndarray, " n"]:
    return problem.scores(compared=COMPARED)([params])[0]
