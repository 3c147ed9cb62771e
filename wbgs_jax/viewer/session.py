"""Predictions for the viewer: all quantities for one transmitter at one frequency, compiled once; and a walk, a closed route
along some of the transmitters of the data."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Ability, GaussianState, MaterialProperties, Params, outputs_of
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.inference.evaluate_quantities import LoadedField, describe_interactions
from wbgs_jax.inference.intervals import expected_power, expected_ssim
from wbgs_jax.inference.kriging import correct, for_receiver
from wbgs_jax.inference.predictor import as_observed, check_power
from wbgs_jax.inference.radio_map import Plane, evaluate_plane, pieces
from wbgs_jax.inference.trained_field import at_receiver, receiver_number
from wbgs_jax.metrics import ssim
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.radio.channel import NO_PATH_DB, Paths, decibels, delay_spread_s, k_factor_db
from wbgs_jax.types import Query, Receiver


@dataclass(frozen=True)
class PathList:
    """Paths of one link that carry power, the strongest first."""

    points: Float[np.ndarray, "k 5 3"]
    """Transmitter, points of reflection or diffraction, receiver; the receiver fills the rest. World frame, metres."""
    amplitude: Complex[np.ndarray, " k"]
    power_db: Float[np.ndarray, " k"]
    length: Float[np.ndarray, " k"]
    """Metres."""
    direction: Float[np.ndarray, "k 3"]
    """Directions of arrival, unit vectors in the receiver's frame."""
    interaction: Int[np.ndarray, "k 5"]
    """Types of interaction (`propagation.paths`)."""
    words: tuple[str, ...]
    """Descriptions of the interactions, such as "off concrete, through glass"."""
    k_factor_db: float
    delay_spread_s: float

    @property
    def delay_ns(self) -> Float[np.ndarray, " k"]:
        """Delays, nanoseconds."""
        return self.length / SPEED_OF_LIGHT * 1e9

    def frequency_response_db(self, offsets_hz: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Returns the response of an element at frequencies relative to the carrier, dB relative to the transmitted power. The
        amplitudes of the paths at the carrier are used, which are nearly constant over bands of a few percent."""
        # `Paths.cfr` on the host: the number of paths differs between queries, and JAX would compile anew for each.
        turns = np.exp(-2j * np.pi * offsets_hz[:, None] * (self.length / SPEED_OF_LIGHT))
        return np.asarray(decibels(jnp.asarray(np.abs(turns @ self.amplitude) ** 2)))


@dataclass(frozen=True)
class Answer:
    """Prediction of a field for one transmitter at one frequency."""

    pas: Float[np.ndarray, "90 360"]
    power_db: float | None
    """Received power relative to the transmitted power; None if the field does not predict it, or if nothing is received."""
    within_db: float | None
    """Bound on the error of the power, ..."""
    power_level: float | None
    """... and its probability; None without a valid interval, as those that follow."""
    expected: tuple[float, float, float] | None
    """Expected SSIM and the ends of its interval, ..."""
    level: float | None
    """... and the probability of this interval."""
    paths: PathList | None
    outside: bool
    """Whether the transmitter is outside of the scene or inside a closed body."""
    warnings: tuple[str, ...]
    """Warnings that the prediction is unreliable, one line each."""


@dataclass(frozen=True)
class Sample:
    """The observed spectrum of the nearest transmitter of the data, at the nearest frequency."""

    pas: Float[np.ndarray, "90 360"]
    position: Float[np.ndarray, "3"]
    frequency_hz: float
    distance_m: float
    part: str
    """"training", "validation" or "test"."""
    ssim: float
    """SSIM of the prediction of the field for this link."""


@dataclass(frozen=True)
class LinkBudget:
    """Transmitted power and noise, which make received powers absolute."""

    transmitter_dbm: float
    """Transmitted power, dBm."""
    noise_dbm: float
    """Noise in the bandwidth of the receiver, dBm."""

    def received_dbm(self, power_db: Any) -> Any:
        """Returns received powers in dBm from powers relative to the transmitted one (dB)."""
        return power_db + self.transmitter_dbm

    def snr_db(self, power_db: float) -> float:
        """Returns the ratio of signal and noise (dB) of an element."""
        return power_db + self.transmitter_dbm - self.noise_dbm


class Session:
    """A trained field that is queried for single transmitters at one receiver.

    The receiver, and material properties and thicknesses can be changed; everything else is as trained.
    """

    def __init__(self, loaded: LoadedField):
        self.dataset, self._whole = loaded.dataset, loaded.trained
        self._samples: dict[tuple[int, int], Sample] = {}
        self.version = 0
        """Number of changes of receiver and materials."""
        self._use(loaded)

    def _use(self, loaded: LoadedField) -> None:
        self.loaded, self.trained, self.receiver, self.plan = loaded, loaded.trained, loaded.receiver, loaded.plan
        learned = self.trained.correction, self.trained.intervals
        self._neighbours, self._confidence = (for_receiver(one, self.receiver) for one in learned)
        self._spectra = self._links_with_spectra()
        self._changed()

    def _changed(self) -> None:
        self.version += 1

    def use_receiver(self, receiver: Receiver) -> None:
        """Uses a receiver for later queries (`trained_field.at_receiver`), with materials as trained.

        Raises:
            UserError: the field does not predict this receiver.
        """
        trained = at_receiver(self._whole, receiver, self.dataset)
        self._use(dataclasses.replace(self.loaded, trained=trained, receiver=receiver))

    @property
    def altered(self) -> bool:
        """Whether materials are not as trained, so that no interval applies."""
        return self.trained is not self.loaded.trained

    @property
    def movable(self) -> bool:
        """Whether the field predicts receivers that are not in its data."""
        try:
            self._whole.field.receiver_independent(self._whole.params)
        except UserError:
            return False
        return True

    @property
    def has_paths(self) -> bool:
        """Whether the field predicts paths."""
        return "paths" in outputs_of(self.trained.field)

    @property
    def has_gaussians(self) -> bool:
        """Whether the field has Gaussians."""
        return "gaussians" in self.trained.field.inspect(self.trained.params).sizes

    @property
    def has_power(self) -> bool:
        """Whether the field predicts received power."""
        try:
            check_power(self.trained.field, self.dataset)
        except UserError:
            return False
        return True

    def predict(self, position: Float[np.ndarray, "3"], frequency_hz: float) -> Answer:
        """Returns the prediction for a transmitter (world frame, metres)."""
        learned = self._neighbours, self._confidence, self.trained.power_intervals
        query = self._query(position, frequency_hz)
        found = _predict(self.trained.field, self.trained.params, self.plan, query, self.receiver, *learned, self.has_paths)
        pas, power, within, expected, paths = jax.tree.map(np.asarray, found)
        place, hertz, domain = np.asarray(position, np.float64)[None], np.array([frequency_hz]), self.loaded.domain
        outside = bool(domain.outside(place)[0])
        valid = not (outside or self.altered or domain.out_of_band(hertz)[0])
        sure = valid and expected is not None and np.isfinite(expected[0])
        received = power is not None and self.has_power and power > NO_PATH_DB
        return Answer(
            pas=pas,
            power_db=float(power) if received else None,
            within_db=float(within) if received and valid and within is not None and np.isfinite(within) else None,
            power_level=None if learned[2] is None else float(learned[2].level),
            expected=tuple(float(value) for value in expected) if sure else None,  # type: ignore[arg-type]
            level=None if learned[1] is None else float(learned[1].level),
            paths=None if paths is None else self._listed(*paths),
            outside=outside,
            warnings=(
                *domain.warnings(np.asarray(self.receiver.position), place, hertz),
                *["materials are not as trained, so that no interval is known"] * self.altered,
            ),
        )

    def _query(self, position: Float[np.ndarray, "3"], frequency_hz: float) -> Query:
        return self.loaded.query(np.asarray(position)[None], np.array([frequency_hz]))

    def nearest_sample(self, position: Float[np.ndarray, "3"], frequency_hz: float) -> Sample | None:
        """Returns the observed spectrum nearest to a transmitter and frequency; None if the receiver has no spectra."""
        if not len(self._spectra):
            return None
        data, index = self.dataset, self._spectra
        away = np.linalg.norm(data.tx_positions[index] - position, axis=1)
        octaves = np.abs(np.log2(data.frequencies_hz[index] / frequency_hz))
        nearest = away <= away.min() + 1e-6
        link = int(index[nearest][np.argmin(octaves[nearest])])
        key, most = (link, self.version), 256  # the version is read first: a late sample of a former one is not of this one
        sample = self._samples.get(key)
        if sample is None:
            sample = self._sample(link)
            if len(self._samples) >= most:
                self._samples.clear()
            self._samples[key] = sample
        return dataclasses.replace(sample, distance_m=float(away.min()))

    def gaussians(self, position: Float[np.ndarray, "3"], frequency_hz: float) -> GaussianState | None:
        """Returns the Gaussians with attenuation and signal (NumPy); None if the field has none."""
        query = self._query(position, frequency_hz)
        found = self.trained.field.inspect(self.trained.params, self.plan, query).gaussians
        return jax.tree.map(np.asarray, found)

    def power_plane(
        self, plane: Plane, frequency_hz: float, progress: Callable[[float], None] = lambda share: None
    ) -> Float[np.ndarray, "ny nx"]:
        """Returns the received power from transmitters all over a plane, dB relative to the transmitted power; NaN where none
        is received. `progress` receives the completed fraction; what it raises ends the work."""
        frequencies, done = np.array([frequency_hz]), 0
        total = pieces(plane, frequencies)

        def advance() -> None:
            nonlocal done
            done += 1
            progress(done / total)

        now = dataclasses.replace(self.loaded, trained=self.trained)
        power = evaluate_plane("power", now, plane, frequencies, advance)["power_db"][0]
        return np.where(power > NO_PATH_DB, power, np.nan)

    def materials(self) -> tuple[tuple[str, ...], MaterialProperties] | None:
        """Returns the names and properties of the materials; None if the field has none."""
        found = self.trained.field.inspect(self.trained.params).materials
        if found is None:
            return None
        names = self.loaded.materials or ("everything",)
        return tuple(name or f"material {number}" for number, name in enumerate(names[: len(found.permittivity)])), found

    def change_material(self, number: int, permittivity: float, conductivity: float) -> None:
        """Changes the permittivity and conductivity of a material at 1 GHz (S/m) for later queries."""
        found = self._calibratable()
        own = found.field.with_material(found.of(self.trained.params), number, permittivity, conductivity)
        params = found.put(self.trained.params, own)
        self.trained = dataclasses.replace(self.trained, params=params)
        self._changed()

    def change_thickness(self, number: int, metres: float) -> None:
        """Changes the thickness of all walls of a material for later queries."""
        found = self._calibratable()
        own, planned = found.field.with_thickness(found.of(self.plan), number, metres)
        field, self.plan = found.put(self.trained.field, own), found.put(self.plan, planned)
        self.trained = dataclasses.replace(self.trained, field=field)
        self._changed()

    def _calibratable(self) -> Ability[Calibratable]:
        found = self.trained.field.ability(Calibratable)
        assert found is not None, "only called for fields with `materials`"
        return found

    def restore(self) -> None:
        """Uses the materials as trained for later queries."""
        self.trained, self.plan = self.loaded.trained, self.loaded.plan
        self._changed()

    def _links_with_spectra(self) -> Int[np.ndarray, " n"]:
        """Returns the indices of the links of this receiver with observed spectra."""
        if not self.dataset.has_spectra:
            return np.zeros(0, int)
        return np.flatnonzero(self.dataset.receiver_index == receiver_number(self.dataset, self.receiver))

    def _sample(self, link: int) -> Sample:
        data, index = self.dataset, np.array([link])
        position, frequency = data.tx_positions[link], float(data.frequencies_hz[link])
        truth = np.asarray(data.pas(index))
        predicted = as_observed(self.trained.field, self.trained.params, self.predict(position, frequency).pas[None])
        parts = {"training": data.train, "validation": data.validation, "test": data.test}
        part = next((name for name, links in parts.items() if link in links), "other")
        return Sample(truth[0], position, frequency, 0.0, part, float(ssim(predicted, truth)[0]))

    def _listed(self, arrived: Paths, k_factor: np.ndarray, spread: np.ndarray) -> PathList:
        power = np.asarray(decibels(jnp.asarray(np.abs(arrived.amplitude) ** 2)))
        order = np.argsort(-power, kind="stable")
        order = order[power[order] > NO_PATH_DB]
        kinds, materials = np.asarray(arrived.interaction)[order], np.asarray(arrived.material)[order]
        names = self.loaded.materials
        words = tuple(describe_interactions(*met, names) for met in zip(kinds, materials, strict=True))
        points = np.asarray(arrived.points)[order]
        amplitude, length, direction = (np.asarray(a)[order] for a in (arrived.amplitude, arrived.length, arrived.direction))
        return PathList(points, amplitude, power[order], length, direction, kinds, words, float(k_factor), float(spread))


@partial(jax.jit, static_argnames="with_paths")
def _predict(
    field: Field,
    params: Params,
    plan: Any,
    query: Query,
    receiver: Receiver,
    neighbours: Any,
    confidence: Any,
    of_power: Any,
    with_paths: bool,
) -> tuple[Any, ...]:
    """Returns spectrum, power, the bound on its error, expected SSIM, and paths with K-factor and delay spread, for a batch of
    one query, without the batch axis."""
    seen = field.render(params, plan, query)
    pas = correct(neighbours, seen.pas, query)
    expected = None if confidence is None else expected_ssim(confidence, pas, query, seen.power_db)
    within = None
    if of_power is not None and seen.power_db is not None:
        within = expected_power(of_power, seen.power_db, query, receiver.position).within_db
    paths = None
    if with_paths:
        arrived = seen.paths
        assert arrived is not None, "the field predicts paths"
        paths = arrived, k_factor_db(arrived), delay_spread_s(arrived)
    return jax.tree.map(lambda leaf: leaf[0], (pas, seen.power_db, within, expected, paths))


def stops_of_walk(tx_positions: Float[np.ndarray, "n 3"], count: int = 8, seed: int = 0) -> Float[np.ndarray, "count 3"]:
    """Returns transmitters that are far apart, in the order of a short round trip."""
    places = np.unique(tx_positions, axis=0)
    chosen = [int(np.random.default_rng(seed).integers(len(places)))]
    away = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < min(count, len(places)):
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(places - places[chosen[-1]], axis=1))
    left, way = places[chosen], [places[chosen[0]]]
    left = left[1:]
    while len(left):
        nearest = int(np.argmin(np.linalg.norm(left - way[-1], axis=1)))
        way.append(left[nearest])
        left = np.delete(left, nearest, axis=0)
    return np.array(way)


def place_on_walk(way: Float[np.ndarray, "n 3"], distance_m: float) -> Float[np.ndarray, "3"]:
    """Returns the position after a distance along a closed route."""
    closed = np.concatenate([way, way[:1]])
    lengths = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    total = lengths.sum()
    if total <= 0:
        return way[0]
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    return np.array([np.interp(distance_m % total, along, closed[:, axis]) for axis in range(3)])
