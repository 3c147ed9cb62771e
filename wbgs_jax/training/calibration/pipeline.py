"""Calibration before the first epoch (host), for what gradients alone cannot find: antennas, materials, spurious bodies,
propagation options, array gains, positions, and the absorption grid.

Antennas and materials are chosen from lists by how well they fit training spectra; bodies without which spectra fit better are
removed from the mesh; surfaces of an inaccurate mesh are aligned, and their remaining position uncertainty is estimated.
Training starts from the result.

Propagation options are effects that ray tracers leave out, namely the finite thickness of walls and the curvature of waves. In
reality a wave that passes a wall of thickness t does not acquire the phase k t cos(theta) of the air that the wall replaces;
ray tracers whose walls are surfaces without thickness add it to the phase of the slab. In reality waves reach an array as
spherical waves about mirrored sources; ray tracers with synthetic arrays make them plane. Data are of one kind or the other,
which training spectra reveal.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from wbgs_jax._util.pytree import same
from wbgs_jax.config import CalibrationConfig
from wbgs_jax.fields import Field
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import WaveParams
from wbgs_jax.radio.antenna import is_directional
from wbgs_jax.radio.channel import beyond_free_space_db, received_power_db
from wbgs_jax.training.calibration.alignment import Place, learn_geometry
from wbgs_jax.training.calibration.antennas import search_antennas, search_pair, search_tuning
from wbgs_jax.training.calibration.material_fit import entries_of, search_materials, search_slabs, unknown_mm
from wbgs_jax.training.calibration.objective import CalibrationProblem, Scores, comparable, search_placement, surely_better
from wbgs_jax.training.calibration.obstacles import search_absent, search_clutter
from wbgs_jax.training.hooks import Context, Edit, Hook, Say


@dataclass(frozen=True)
class Idealisation:
    """Result for one propagation option."""

    ideal: float
    """Mean score of the spectra as in ray tracers."""
    natural: float
    """Mean score of the spectra as in reality."""
    dropped: bool
    """Whether the option is set as in reality."""


def search_idealisations(
    params: WaveParams, problem: CalibrationProblem, config: CalibrationConfig
) -> tuple[WaveParams, dict[str, Idealisation]]:
    """Returns parameters with options set as in reality if spectra fit significantly better, and the results by option. Before
    the finite thickness of walls is tested, materials are chosen again with it."""
    once, found, count = dataclasses.replace(config, rounds=1), {}, config.propagation_spectra
    score, tx_index = problem.scores(count), problem.tx_index(count)
    for name in ("curved", "thick"):
        if float(getattr(params, name)):
            continue
        natural = dataclasses.replace(params, **{name: 1 + getattr(params, name)})  # a new array: training donates it once
        if name == "thick":
            natural, _ = search_materials(natural, problem, count, once)
        before, after = score([params, natural])
        dropped = surely_better(before - after, tx_index, config.propagation_n_sigma)
        found[name] = Idealisation(float(before.mean()), float(after.mean()), dropped)
        params = natural if dropped else params
    return params, found


ROOMS_DB = -40.0, 10.0
"""Plausible range of the median received power relative to free space, dB. Snapshots outside it are in another unit, like
measured voltages; smaller deviations are corrected by gradients."""


def search_gain(params: WaveParams, score: Scores, gain: float = 0.0) -> tuple[WaveParams, float]:
    """Returns parameters with the overall gain that fits received powers best, and that gain (dB); the transmitted power may be
    unknown. The search begins at `gain` (dB)."""
    gains_db = (100.0, 5.0), (5.0, 0.5)  # successive ranges of the gain about the previous value, and steps within them, dB
    for reach, step in gains_db:
        tried = gain + np.arange(-reach, reach + step, step)
        candidates = [dataclasses.replace(params, log_gain=jnp.asarray(db * np.log(10) / 20, jnp.float32)) for db in tried]
        best = int(np.argmin(score(candidates).mean(1)))
        params, gain = candidates[best], float(tried[best])
    return params, gain


def unusual_level(problem: CalibrationProblem) -> float:
    """Returns the median received power relative to free space (dB) if it is implausible (`ROOMS_DB`), else zero."""
    assert problem.data.snapshots is not None, "the level is that of snapshots"
    snapshots, links = jax.tree.map(lambda leaf: leaf[problem.spectra], (problem.data.snapshots, problem.data.links))
    rx = problem.data.receivers.position[links.receiver_index]
    beyond = beyond_free_space_db(received_power_db(snapshots), links.tx_position, rx, links.frequency_hz)
    received = np.asarray(snapshots).any(-1)
    level = float(np.median(np.asarray(beyond)[received])) if received.any() else 0.0
    return 0.0 if ROOMS_DB[0] <= level <= ROOMS_DB[1] else level


@dataclass(frozen=True)
class Calibration(Hook):
    """The hook that calibrates a `Calibratable` field, whose parameters contain antennas and `materials` and whose links are
    prepared."""

    config: CalibrationConfig
    stream: int = 6

    def due(self, step: int, steps: int) -> bool:
        """Returns whether the first step is next and calibration is enabled."""
        return step == 0 and (self.config.rounds > 0 or self.config.antenna_rounds > 0)

    def apply(
        self,
        field: Field,
        params: WaveParams,
        statistics: tuple[()],
        context: Context,
        step: int,
        rng: np.random.Generator,
    ) -> Edit:
        """Returns parameters with the antennas, materials and propagation options that fit training spectra best, and the field
        without spurious bodies and, if the mesh is inaccurate, with aligned surfaces."""
        assert isinstance(field, Calibratable), "only fields that trace paths can be calibrated"
        config, data, prepared, say = self.config, context.data, context.prepared, context.say
        spectra = rng.permutation(context.train)
        report: dict[str, Any] = {}
        problem = CalibrationProblem(field, prepared, data, spectra)
        if not data.has_spectra:  # one number per link distinguishes materials, but contains neither phases nor directions
            say("calibration: gain and materials of the surfaces")
            params, gain = search_gain(params, problem.scores(config.spectra))
            if config.rounds:
                params, named = search_materials(params, problem, config.spectra, config, usual=True)
                params, gain = search_gain(params, problem.scores(config.spectra))
                report["search"] = dataclasses.asdict(named)
            return Edit(params, (), None, report | {"gain_db": gain}, field, prepared)
        one_element = comparable("snapshots", data) == "powers"  # of which everything is learned by the level
        if one_element:
            say("calibration: gain")
            params, _ = search_gain(params, problem.scores(config.spectra), unusual_level(problem))
        if config.antenna_rounds:
            say("calibration: antenna patterns")
            params, _ = self._antennas(params, problem, report)
        sweeps = 2  # maximum number of times that antennas are calibrated again after materials have been chosen
        if config.rounds:
            say("calibration: materials of the surfaces")
            params, named, _ = search_slabs(params, problem, config, config.spectra)
            report["search"] = dataclasses.asdict(named)
            if config.spurious_spectra and data.snapshots is not None:
                params, problem, absent = search_absent(params, problem, config, say)
                report["absent"] = dataclasses.asdict(absent)
                if absent.centres:
                    field, prepared = problem.field, problem.prepared
                    params, named, _ = search_slabs(params, problem, config, config.spectra)
                    report["search"] = dataclasses.asdict(named)
            say("calibration: delay by walls, curvature of waves")
            for _ in range(sweeps):
                params = self._idealisations(params, problem, report)
                params, changed = self._antennas(params, problem, report) if config.antenna_rounds else (params, False)
                if not changed:
                    break
                params, _ = search_materials(params, problem, config.propagation_spectra, config)
            say("calibration: accuracy of the mesh")
            _, uncertainty = search_placement(params, problem.scores(config.position_std_spectra, "covariances"))
            report["doubt"] = dataclasses.asdict(uncertainty)
            field = self._tuning(params, problem, report)
            problem = dataclasses.replace(problem, field=field)
            if config.geometry and uncertainty.spread_mm > 1e3 * config.geometry_position_std:
                place, moved = learn_geometry(Place(field, params, prepared), data, context.train, config, rng, say)
                report["geometry"] = dataclasses.asdict(moved)
                if "antennas" in report:  # the alignment may have reverted some of them
                    found = report["antennas"]["taken"].items()
                    kept = {end: name for end, name in found if same(getattr(params, end), getattr(place.params, end))}
                    report["antennas"]["taken"] = kept
                params, field, prepared = place.params, place.field, place.prepared
                problem = CalibrationProblem(field, prepared, data, spectra)
                field = self._tuning(params, problem, report)
                problem = dataclasses.replace(problem, field=field)
            params, uncertainty = search_placement(params, problem.scores(config.position_std_spectra, "spectra"))
            report["placement"] = dataclasses.asdict(uncertainty)
            params, field = self._clutter(params, problem, report, rng, say)
            thick = unknown_mm(params.materials, np.asarray(problem.field.known_thickness))
            report["search"] |= {"taken": entries_of(params.materials), "thickness_mm": thick}  # materials may have changed
        level = 0.0 if data.snapshots is None else unusual_level(problem)
        if level or one_element:
            problem = dataclasses.replace(problem, field=field)  # which may have an absorption grid now
            params, report["gain_db"] = search_gain(params, problem.scores(config.position_std_spectra, "powers"), level)
        return Edit(params, (), None, report, field, prepared)

    def _antennas(self, params: WaveParams, problem: CalibrationProblem, report: dict[str, Any]) -> tuple[WaveParams, bool]:
        """Returns parameters with calibrated antennas, and whether any antenna has changed."""
        count, known = self.config.antenna_spectra, is_directional(problem.data.receivers.antenna)
        score, tx_index, pair = problem.scores(count), problem.tx_index(count), dict[str, str]()
        if "antennas" not in report:
            before = float(score([params]).mean())
            params, pair = search_pair(params, score, tx_index, known)
            report["antennas"] = {"before": before, "taken": pair}
        params, found = search_antennas(params, score, tx_index, self.config, known)
        report["antennas"] |= {"after": found.after, "taken": report["antennas"]["taken"] | found.taken}
        return params, bool(pair or found.taken)

    def _tuning(self, params: WaveParams, problem: CalibrationProblem, report: dict[str, Any]) -> Calibratable:
        """Returns the field with calibrated array gains, which needs at least two transmitters."""
        count = self.config.array_gain_spectra
        if problem.data.snapshots is None or not count or np.ptp(problem.tx_index(count)) == 0:
            return problem.field
        field, found = search_tuning(params, problem, self.config)
        report["tuning"] = [*report.get("tuning", []), dataclasses.asdict(found)]
        return field

    def _clutter(
        self, params: WaveParams, problem: CalibrationProblem, report: dict[str, Any], rng: np.random.Generator, say: Say
    ) -> tuple[WaveParams, Calibratable]:
        """Returns parameters and field with an absorption grid, if it fits better."""
        if not self.config.absorption_spectra:
            return params, problem.field
        say("calibration: obstacles that the mesh lacks")
        params, problem, found = search_clutter(params, problem, self.config, rng)
        if found:
            report["clutter"] = dataclasses.asdict(found)
        return params, problem.field

    def _idealisations(self, params: WaveParams, problem: CalibrationProblem, report: dict[str, Any]) -> WaveParams:
        """Returns parameters with calibrated propagation options."""
        params, found = search_idealisations(params, problem, self.config)
        named = {name: dataclasses.asdict(one) for name, one in found.items()}
        report["idealisations"] = report.get("idealisations", {}) | named
        return params
