"""Predictions for the viewer: all quantities for one transmitter at one frequency, compiled once."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Ability, GaussianState, MaterialProperties, outputs_of
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.inference.evaluate_quantities import LoadedField
from wbgs_jax.inference.intervals import Expected, expected_ssim
from wbgs_jax.inference.kriging import SAME_PLACE_M, correct, for_receiver
from wbgs_jax.inference.path_table import describe_interactions
from wbgs_jax.inference.predictor import as_observed, check_power
from wbgs_jax.inference.radio_map import Plane, evaluate_plane, pieces
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.metrics import ssim
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.radio.channel import Paths, decibels, delay_spread_s, k_factor_db
from wbgs_jax.types import Query, make_query


@dataclass(frozen=True)
class PathList:
    """Paths of one link, the strongest first."""

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


@dataclass(frozen=True)
class Answer:
    """Prediction of a field for one transmitter at one frequency."""

    pas: Float[np.ndarray, "90 360"]
    power_db: float | None
    """Received power relative to the transmitted power; None if the field does not predict it."""
    expected: tuple[float, float, float] | None
    """Expected SSIM and the ends of its interval, ..."""
    level: float | None
    """... and the probability of this interval."""
    paths: PathList | None
    doubts: tuple[str, ...]
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


class Asker:
    """A trained field that is queried for single transmitters.

    Material properties and thicknesses can be changed; everything else is as trained.
    """

    def __init__(self, loaded: LoadedField):
        self.loaded, self.trained, self.dataset, self.receiver = loaded, loaded.trained, loaded.dataset, loaded.receiver
        self.plan = loaded.plan
        self._neighbours, self._confidence = (
            for_receiver(learned, self.receiver) for learned in (self.trained.correction, self.trained.intervals)
        )
        self._spectra = self._links_with_spectra()
        self._samples: dict[int, Sample] = {}

    @property
    def knows_paths(self) -> bool:
        """Whether the field predicts paths."""
        return "paths" in outputs_of(self.trained.field)

    @property
    def knows_power(self) -> bool:
        """Whether the field predicts received power."""
        try:
            check_power(self.trained.field, self.dataset)
        except UserError:
            return False
        return True

    def ask(self, position: Float[np.ndarray, "3"], frequency_hz: float) -> Answer:
        """Returns the prediction for a transmitter (world frame, metres)."""
        query = make_query(np.asarray(position)[None], np.array([frequency_hz]))
        learned = self._neighbours, self._confidence
        found = _ask(self.trained.field, self.trained.params, self.plan, query, *learned, self.knows_paths)
        pas, power, expected, paths = jax.tree.map(np.asarray, found)
        place = np.asarray(position, np.float64)[None]
        unreliable = self.loaded.domain.warnings(np.asarray(self.receiver.position), place, np.array([frequency_hz]))
        expected = None if self.loaded.domain.outside(place)[0] else expected
        return Answer(
            pas,
            float(power) if power is not None and self.knows_power else None,
            None if expected is None else tuple(float(value) for value in expected),  # type: ignore[arg-type]
            None if self._confidence is None or expected is None else float(self._confidence.level),
            None if paths is None else self._listed(*paths),
            tuple(unreliable),
        )

    def nearest_sample(self, position: Float[np.ndarray, "3"], frequency_hz: float) -> Sample | None:
        """Returns the observed spectrum nearest to a transmitter and frequency; None if the receiver has no spectra."""
        if not len(self._spectra):
            return None
        data, index = self.dataset, self._spectra
        away = np.linalg.norm(data.tx_positions[index] - position, axis=1)
        octaves = np.abs(np.log2(data.frequencies_hz[index] / frequency_hz))
        nearest = away <= away.min() + 1e-6
        link = int(index[nearest][np.argmin(octaves[nearest])])
        if link not in self._samples:
            self._samples[link] = self._sample(link)
        return dataclasses.replace(self._samples[link], distance_m=float(away.min()))

    def splatted(self, position: Float[np.ndarray, "3"], frequency_hz: float) -> GaussianState | None:
        """Returns the Gaussians with attenuation and signal (NumPy); None if the field has none."""
        query = make_query(np.asarray(position)[None], np.array([frequency_hz]))
        found = self.trained.field.inspect(self.trained.params, self.plan, query).gaussians
        return jax.tree.map(np.asarray, found)

    def power_plane(
        self, plane: Plane, frequency_hz: float, progress: Callable[[float], None] = lambda share: None
    ) -> Float[np.ndarray, "ny nx"]:
        """Returns the received power (dB) from transmitters all over a plane; `progress` receives the completed fraction."""
        frequencies, done = np.array([frequency_hz]), 0
        total = pieces(plane, frequencies)

        def advance() -> None:
            nonlocal done
            done += 1
            progress(done / total)

        now = dataclasses.replace(self.loaded, trained=self.trained)
        return evaluate_plane("power", now, plane, frequencies, advance)["power_db"][0]

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
        self._samples.clear()

    def change_thickness(self, number: int, metres: float) -> None:
        """Changes the thickness of all walls of a material for later queries."""
        found = self._calibratable()
        own, planned = found.field.with_thickness(found.of(self.plan), number, metres)
        field, self.plan = found.put(self.trained.field, own), found.put(self.plan, planned)
        self.trained = dataclasses.replace(self.trained, field=field)
        self._samples.clear()

    def _calibratable(self) -> Ability[Calibratable]:
        found = self.trained.field.ability(Calibratable)
        assert found is not None, "only called for fields with `materials`"
        return found

    def restore(self, trained: TrainedField) -> None:
        """Uses `trained` for later queries, without changes of materials."""
        self.trained, self.plan = trained, self.loaded.plan
        self._samples.clear()

    def _links_with_spectra(self) -> Int[np.ndarray, " n"]:
        """Returns the indices of the links of this receiver with observed spectra."""
        if not self.dataset.has_spectra:
            return np.zeros(0, int)
        places = np.asarray(self.dataset.receivers.position)
        away = np.linalg.norm(places - np.asarray(self.receiver.position), axis=1)
        return np.flatnonzero((self.dataset.receiver_index == np.argmin(away)) & (away.min() < SAME_PLACE_M))

    def _sample(self, link: int) -> Sample:
        data, index = self.dataset, np.array([link])
        position, frequency = data.tx_positions[link], float(data.frequencies_hz[link])
        truth = np.asarray(data.pas(index))
        predicted = as_observed(self.trained.field, self.trained.params, self.ask(position, frequency).pas[None])
        parts = {"training": data.train, "validation": data.validation, "test": data.test}
        part = next((name for name, links in parts.items() if link in links), "other")
        return Sample(truth[0], position, frequency, 0.0, part, float(ssim(predicted, truth)[0]))

    def _listed(self, arrived: Paths, k_factor: np.ndarray, spread: np.ndarray) -> PathList:
        power = np.asarray(decibels(jnp.asarray(np.abs(arrived.amplitude) ** 2)))
        order = np.argsort(-power, kind="stable")
        order = order[np.abs(arrived.amplitude[order]) > 0]
        kinds, materials = np.asarray(arrived.interaction)[order], np.asarray(arrived.material)[order]
        names = self.loaded.materials
        words = tuple(describe_interactions(*met, names) for met in zip(kinds, materials, strict=True))
        points = np.asarray(arrived.points)[order]
        amplitude, length, direction = (np.asarray(a)[order] for a in (arrived.amplitude, arrived.length, arrived.direction))
        return PathList(points, amplitude, power[order], length, direction, kinds, words, float(k_factor), float(spread))


def _answer(
    field: Field, params: Any, plan: Any, query: Query, neighbours: Any, confidence: Any, with_paths: bool
) -> tuple[Any, Any, Any, Any]:
    """Returns spectrum, power, expected SSIM, and paths with K-factor and delay spread, for a batch of one query, without the
    batch axis."""
    seen = field.render(params, plan, query)
    pas = correct(neighbours, seen.pas, query)
    expected: Expected | None = None if confidence is None else expected_ssim(confidence, pas, query, seen.power_db)
    paths = None
    if with_paths:
        arrived = seen.paths
        assert arrived is not None, "the field predicts paths"
        paths = arrived, k_factor_db(arrived), delay_spread_s(arrived)
    return jax.tree.map(lambda leaf: leaf[0], (pas, seen.power_db, expected, paths))


_ask = jax.jit(_answer, static_argnames="with_paths")
