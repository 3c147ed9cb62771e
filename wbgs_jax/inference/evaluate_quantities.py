"""Computes the quantities of `quantities.QUANTITIES` from a trained field at one receiver, for transmitters at frequencies;
tables and descriptions of paths."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

import wbgs_jax
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import map_blocks
from wbgs_jax.data.dataset import Dataset, without_test
from wbgs_jax.data.scene import DatasetScene, closed_bodies
from wbgs_jax.fields import Field, field_names, get_field
from wbgs_jax.fields.base import Params, outputs_of, paths_of
from wbgs_jax.fields.calibratable import gains_in
from wbgs_jax.inference.domain import Domain
from wbgs_jax.inference.intervals import expect_many, expected_power
from wbgs_jax.inference.kriging import for_receiver
from wbgs_jax.inference.predictor import BLOCK, check_power, check_spectra, observe_queries, trained_band
from wbgs_jax.inference.quantities import QUANTITIES, Options
from wbgs_jax.inference.queries import Product, Queries, flatten
from wbgs_jax.inference.results_file import SHARED
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.propagation.paths import InteractionType
from wbgs_jax.propagation.transport import mimo_matrix, snapshots_from_paths
from wbgs_jax.radio import channel
from wbgs_jax.radio.array import SPEED_OF_LIGHT, best_beams, cbf, pas_directions, planar_array, steering_vector
from wbgs_jax.radio.channel import Paths, decibels, doppler_hz
from wbgs_jax.types import LOWEST_OF_PATHS_HZ, MIN_FREQUENCY_HZ, Query, Receiver, make_query

SIGHT = "line of sight"


def path_table(
    field: Field,
    params: Params,
    plan: Any,
    queries: Query,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
    rx_velocity: Float[np.ndarray, "3"],
    materials: tuple[str, ...],
) -> dict[str, np.ndarray]:
    """Returns a table with one row per path as columns by name: link, interactions, length, delay, angles, amplitudes and
    Doppler shift. The paths of each link are sorted by power, the strongest first.

    Angles of arrival are in the receiver's frame, angles of departure in the world frame; zenith 0 is upwards. Amplitudes are
    relative to the transmitted amplitude and include the carrier phase: at an element of the array, and at isotropic elements
    that are polarised along theta-hat and phi-hat. Their sum is the snapshot if the waves are plane. `points_m` (rows, 5, 3)
    are transmitter, points of reflection or diffraction, and receiver, which fills the rest; world frame.

    Args:
        field: a field that predicts paths.
        params: its parameters.
        plan: its plan for the receiver.
        queries: of every transmitter at every frequency, which varies fastest.
        tx_positions: world frame, metres.
        frequencies_hz: carrier frequencies.
        rx_velocity: velocity of the receiver, metres per second, world frame.
        materials: names of the materials by index; materials without a name are numbered.
    """
    moving, tables = jnp.asarray(rx_velocity, jnp.float32), []
    for number, position in enumerate(tx_positions):
        for column, frequency in enumerate(frequencies_hz):
            row = number * len(frequencies_hz) + column
            found, shift = _link(field, params, plan, jax.tree.map(lambda leaf, i=row: leaf[i : i + 1], queries), moving)
            link = {"tx": number, "x": position[0], "y": position[1], "z": position[2], "frequency_ghz": frequency / 1e9}
            tables.append(_rows(jax.tree.map(np.asarray, found), np.asarray(shift), link, materials))
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


@jax.jit
def _link(
    field: Field, params: Params, plan: Any, query: Query, rx_velocity: Float[Array, "3"]
) -> tuple[Paths, Float[Array, " k"]]:
    """Returns the paths of one query and their Doppler shifts."""
    found: Any = jax.tree.map(lambda leaf: leaf[0], paths_of(field, params, plan, query))
    velocity = query.transmitter.velocity
    tx_velocity = jnp.zeros(3) if velocity is None else velocity[0]
    return found, doppler_hz(found, query.frequency_hz[0], tx_velocity, rx_velocity)


def _rows(found: Any, shift: np.ndarray, link: dict[str, Any], materials: tuple[str, ...]) -> dict[str, np.ndarray]:
    power = np.asarray(decibels(jnp.asarray(np.abs(found.amplitude) ** 2)))
    order = np.argsort(-power, kind="stable")
    order = order[(np.abs(found.polarised[order]) > 0).any(-1)]
    columns: dict[str, np.ndarray] = {name: np.full(len(order), value) for name, value in link.items()}
    columns["interactions"] = np.array(
        [describe_interactions(found.interaction[i], found.material[i], materials) for i in order], dtype=np.str_
    )
    columns["length_m"] = found.length[order]
    columns["delay_ns"] = found.length[order] / SPEED_OF_LIGHT * 1e9
    for end, direction in (("arrival", found.direction), ("departure", found.departure)):
        zenith = np.degrees(np.arccos(np.clip(direction[order, 2], -1, 1)))
        azimuth = np.degrees(np.arctan2(direction[order, 1], direction[order, 0]))
        columns |= {f"{end}_zenith_deg": zenith, f"{end}_azimuth_deg": azimuth}
    columns["power_db"] = power[order]
    parts = {"element": found.amplitude, "theta": found.polarised[:, 0], "phi": found.polarised[:, 1]}
    for name, amplitude in parts.items():
        columns |= {f"{name}_re": amplitude[order].real, f"{name}_im": amplitude[order].imag}
    return columns | {"doppler_hz": shift[order]} | ({} if found.points is None else {"points_m": found.points[order]})


def describe_interactions(
    kinds: Int[np.ndarray, " steps"], materials: Int[np.ndarray, " steps"], names: tuple[str, ...]
) -> str:
    """Returns a description of the interactions of a path, such as "off concrete, through glass"."""
    met = [
        f"{InteractionType(kind).word} {names[material] if material < len(names) else f'material {material}'}"
        for kind, material in zip(kinds, materials, strict=True)
        if kind != InteractionType.NONE
    ]
    return ", ".join(met) or SIGHT


Answer = dict[str, np.ndarray]
"""Arrays by name, with leading axes (tx, freq), or the columns of a table."""
DEFAULTS = Options()
OfPaths = Callable[[Paths, Receiver, Any, Any], Array]
"""(paths of one link, receiver, frequency_hz, gains of its elements) -> a quantity of the link."""


@dataclass(frozen=True)
class LoadedField:
    """A trained field at one receiver."""

    trained: TrainedField
    """The field for this receiver (`trained_field.at_receiver`)."""
    dataset: Dataset
    """The data that it was trained on."""
    receiver: Receiver
    options: Options = DEFAULTS

    @cached_property
    def plan(self) -> Any:
        """The part of the computation that does not depend on the query."""
        return self.trained.field.plan(self.trained.params, self.receiver)

    @cached_property
    def domain(self) -> Domain:
        """Positions and frequencies that the training covered."""
        return domain_of(self.dataset)

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the materials of the data; empty if unknown."""
        return () if self.dataset.materials is None else self.dataset.materials.names

    @property
    def source(self) -> dict[str, Any]:
        """Provenance of the predictions: scene, field, step, version, receiver, and levels of the prediction intervals."""
        receiver = {name: np.asarray(getattr(self.receiver, name)).tolist() for name in ("position", "orientation")}
        origin = {name: value for name, value in self.trained.origin().items() if name in ("field", "step")}
        learned = {"interval_level": self.trained.intervals, "power_interval_level": self.trained.power_intervals}
        levels = {name: round(float(own.level), 4) for name, own in learned.items() if own is not None}
        return {"scene": self.dataset.name, "version": wbgs_jax.__version__, "receiver": receiver} | origin | levels

    def query(self, tx_positions: Float[np.ndarray, "tx 3"], frequencies_hz: Float[np.ndarray, " freq"]) -> Query:
        """Returns queries for every transmitter at every frequency, which varies fastest."""
        velocity = self.options.tx_velocity if np.any(self.options.tx_velocity) else None
        return make_query(*Queries(tx_positions, frequencies_hz).flat(), velocity=velocity)

    def evaluate(
        self, what: str, tx_positions: Float[np.ndarray, "tx 3"], frequencies_hz: Float[np.ndarray, " freq"]
    ) -> Answer:
        """Returns a quantity for every transmitter at every frequency: {name with unit: values (tx, freq, ...)}, with NaN for
        invalid intervals, and the arrays of `results_file.SHARED`; for paths, the columns of a table.

        Args:
            what: a name of `QUANTITIES`.
            tx_positions: world frame, metres.
            frequencies_hz: carrier frequencies.

        Raises:
            UserError: the field does not provide this quantity.
        """
        check_quantity(what, self.trained.field, self.dataset)
        queries = np.asarray(tx_positions), np.asarray(frequencies_hz)
        return self.domain.without_intervals(EVALUATE[what](self, *queries), *queries, paired=False)

    def answer(self, what: str, block: list[Product]) -> Answer:
        """Returns the predictions (`evaluate`) for a block of queries: arrays whose leading axis is the queries in order, or a
        table in the order of the queries, whose column `tx` is the index of the transmitter."""
        found = [self.evaluate(what, product.tx_positions, product.frequencies_hz) for product in block]
        if QUANTITIES[what].form == "table":
            for product, table in zip(block, found, strict=True):
                table["tx"] = product.tx_numbers[table["tx"]]
            order = np.argsort(np.concatenate([table["tx"] for table in found]), kind="stable")
            return {name: np.concatenate([table[name] for table in found])[order] for name in found[0]}
        order, _, _ = flatten(block)
        return {
            name: values
            if name in SHARED
            else np.concatenate([own[name].reshape(-1, *own[name].shape[2:]) for own in found])[order]
            for name, values in found[0].items()
        }


def domain_of(dataset: Dataset) -> Domain:
    """Returns the positions and frequencies that a training on a dataset covers."""
    box = np.asarray(DatasetScene(without_test(dataset)).box, np.float64)
    beyond = 0.0 if len(dataset.faces) else 0.5 * float(np.linalg.norm(box[1] - box[0]))
    return Domain(dataset.name, box, trained_band(dataset), beyond, closed_bodies(dataset))


def lowest_frequency(field: Field, dataset: Dataset) -> float:
    """Returns the lowest frequency (hertz) at which a field can be queried: the lower of the model's band edge and the lowest
    training frequency; fields with paths can be queried down to `LOWEST_OF_PATHS_HZ`."""
    if "paths" in outputs_of(field):
        return LOWEST_OF_PATHS_HZ
    return min(MIN_FREQUENCY_HZ, trained_band(dataset)[0])


def check_quantity(what: str, field: Field, dataset: Dataset | None = None) -> None:
    """Raises a `UserError` if a field does not provide a quantity or could not learn it from the data."""
    needs = set(QUANTITIES[what].needs)
    if not needs & set(outputs_of(field)):
        able = " or ".join(name for name in field_names() if needs & set(get_field(name).outputs))
        if needs == {"paths"}:
            lacks = (
                "does not predict paths" if what == "paths" else f"does not provide {what}, because it does not predict paths"
            )
            raise UserError(f"the {field.name} field {lacks}; train --field {able} on data with a mesh")
        has = ", ".join(outputs_of(field)).replace("pas", "spectra")
        mesh = "" if "power" in needs else " on data with a mesh"
        raise UserError(f"the {field.name} field does not provide {what}, only {has}; train --field {able}{mesh}")
    if dataset is not None and "pas" in needs:
        check_spectra(field, dataset)
    if dataset is not None and "power" in needs:
        check_power(field, dataset)


def known_quantities(field: Field, dataset: Dataset) -> list[str]:
    """Returns the names of the quantities that a field provides."""
    found = []
    for what in QUANTITIES:
        with contextlib.suppress(UserError):
            check_quantity(what, field, dataset)
            found.append(what)
    return found


def _shaped(found: Any, tx_positions: np.ndarray, frequencies_hz: np.ndarray) -> np.ndarray:
    values = np.asarray(found)
    return values.reshape(len(tx_positions), len(frequencies_hz), *values.shape[1:])


def _spectra(at: LoadedField, tx_positions: np.ndarray, frequencies_hz: np.ndarray) -> Answer:
    """Returns spectra `pas` (tx, freq, 90, 360) and, with prediction intervals, `expected` (tx, freq, 3): the expected SSIM and
    the ends of its interval."""
    query = at.query(tx_positions, frequencies_hz)
    seen = observe_queries(at.trained, at.receiver, query)
    answer = {"pas": _shaped(seen.pas, tx_positions, frequencies_hz)}
    confidence = for_receiver(at.trained.intervals, at.receiver)
    if confidence is not None:
        power = None if seen.power_db is None else np.asarray(seen.power_db)
        expected = expect_many(
            confidence, np.asarray(seen.pas), np.asarray(query.tx_position), np.asarray(query.frequency_hz), power
        )
        answer["expected"] = _shaped(np.stack(expected, -1), tx_positions, frequencies_hz)
    return answer


def _snapshots(at: LoadedField, tx_positions: np.ndarray, frequencies_hz: np.ndarray) -> Answer:
    found = observe_queries(at.trained, at.receiver, at.query(tx_positions, frequencies_hz), "snapshots")
    return {"snapshots": _shaped(found, tx_positions, frequencies_hz)}


def _power(at: LoadedField, tx_positions: np.ndarray, frequencies_hz: np.ndarray) -> Answer:
    """Returns received powers, dB relative to the transmitted power, and their prediction intervals if the run has them."""
    query, learned = at.query(tx_positions, frequencies_hz), at.trained.power_intervals
    power = observe_queries(at.trained, at.receiver, query, "power_db")
    answer = {"power_db": power}
    if learned is not None:
        interval = expected_power(learned, jnp.asarray(power, jnp.float32), query, at.receiver.position)
        answer |= {"expected_error_db": np.asarray(interval.error_db), "within_db": np.asarray(interval.within_db)}
    return {name: _shaped(values, tx_positions, frequencies_hz) for name, values in answer.items()}


def _best_beams(at: LoadedField, tx_positions: np.ndarray, frequencies_hz: np.ndarray) -> Answer:
    """Returns the indices of the beams of `radio.array.codebook` with the highest received power."""
    spectra = observe_queries(at.trained, at.receiver, at.query(tx_positions, frequencies_hz), "pas")
    return {"best_beam": _shaped(best_beams(spectra), tx_positions, frequencies_hz)}


def _from_arrivals(
    name: str, function: OfPaths, at: LoadedField, tx_positions: np.ndarray, frequencies_hz: np.ndarray
) -> Answer:
    """Returns a quantity that is computed from the paths of each link."""
    found = map_blocks(
        lambda block: _measure(at.trained.field, at.trained.params, at.plan, at.receiver, block, function),
        at.query(tx_positions, frequencies_hz),
        BLOCK,
    )
    return {name: _shaped(found, tx_positions, frequencies_hz)}


@partial(jax.jit, static_argnames=("function",))
def _measure(field: Field, params: Params, plan: Any, receiver: Receiver, query: Query, function: OfPaths) -> Any:
    arrivals, gains = paths_of(field, params, plan, query), gains_in(field, plan)
    return jax.vmap(lambda one, hertz: function(one, receiver, hertz, gains))(arrivals, query.frequency_hz)


def _beamforming_gain(arrivals: Paths, receiver: Receiver, frequency_hz: Any, gains: Any) -> Array:
    y = snapshots_from_paths(arrivals, receiver, frequency_hz) * gains
    directions = jnp.asarray(pas_directions(), jnp.float32)
    strongest = jnp.max(cbf(y, steering_vector(receiver.element_wavelengths(frequency_hz), directions)))
    return jnp.where(strongest > 0, channel.beamforming_gain_db(y, strongest), jnp.nan)  # NaN without any path


def _k_factor(arrivals: Paths, *_: Any) -> Array:
    return channel.k_factor_db(arrivals)


def _angular_spread(arrivals: Paths, *_: Any) -> Array:
    return channel.angular_spread_deg(arrivals)


def _delay_spread(arrivals: Paths, *_: Any) -> Array:
    return channel.delay_spread_s(arrivals)


def _paths(at: LoadedField, tx_positions: np.ndarray, frequencies_hz: np.ndarray) -> Answer:
    """Returns a table (`path_table`)."""
    field, params = at.trained.field, at.trained.params
    query = at.query(tx_positions, frequencies_hz)
    return path_table(field, params, at.plan, query, tx_positions, frequencies_hz, at.options.rx_velocity, at.materials)


def _frequency_response(at: LoadedField, tx_positions: np.ndarray, frequencies_hz: np.ndarray) -> Answer:
    """Returns the response of every element over a band around each carrier, (tx, freq, points, elements), and its inverse
    Fourier transform over the delays that the band resolves (no window). Every frequency of the band is a separate query, so
    that material properties may vary over the band."""
    band_hz, points = at.options.band_hz, at.options.points
    offsets = (np.arange(points) - points // 2) * band_hz / points
    bands = frequencies_hz[:, None] + offsets
    query = at.query(tx_positions, bands.reshape(-1))
    response = observe_queries(at.trained, at.receiver, query, "snapshots").reshape(len(tx_positions), *bands.shape, -1)
    return {
        "frequency_response": response,
        "impulse_response": np.fft.ifft(np.fft.ifftshift(response, 2), axis=2).astype(np.complex64),
        "offsets_hz": offsets,
        "delays_s": np.arange(points) / band_hz,
    }


def _mimo(at: LoadedField, tx_positions: np.ndarray, frequencies_hz: np.ndarray) -> Answer:
    """Returns the matrices between the receiver's elements and those of a planar array at each transmitter, (tx, freq,
    elements, m). `tx_elements` are in wavelengths relative to the transmitter's position, world frame; each element has the
    properties of the transmitter's antenna."""
    elements = planar_array(*at.options.tx_array)
    return {"mimo": mimo_matrices(at, tx_positions, frequencies_hz, elements), "tx_elements": elements}


def mimo_matrices(
    at: LoadedField,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
    tx_elements: Float[np.ndarray, "m 3"],
) -> Complex[np.ndarray, "tx freq elements m"]:
    """Returns the matrices between the receiver's elements and M elements, in wavelengths relative to each transmitter."""
    elements = jnp.asarray(tx_elements, jnp.float32)
    found = map_blocks(
        lambda block: _matrices(at.trained.field, at.trained.params, at.plan, block, at.receiver, elements),
        at.query(tx_positions, frequencies_hz),
        1,
    )
    return _shaped(found, tx_positions, frequencies_hz)


@jax.jit
def _matrices(field: Field, params: Params, plan: Any, query: Query, receiver: Receiver, elements: Any) -> Any:
    arrivals, gains = paths_of(field, params, plan, query), jnp.reshape(gains_in(field, plan), (-1, 1))
    return jax.vmap(lambda one, hertz: gains * mimo_matrix(one, receiver, hertz, elements))(arrivals, query.frequency_hz)


EVALUATE: dict[str, Callable[[LoadedField, np.ndarray, np.ndarray], Answer]] = {
    "spectra": _spectra,
    "snapshot": _snapshots,
    "power": _power,
    "beamforming-gain": partial(_from_arrivals, "beamforming_gain_db", _beamforming_gain),
    "k-factor": partial(_from_arrivals, "k_factor_db", _k_factor),
    "angular-spread": partial(_from_arrivals, "angular_spread_deg", _angular_spread),
    "delay-spread": partial(_from_arrivals, "delay_spread_s", _delay_spread),
    "best-beam": _best_beams,
    "paths": _paths,
    "frequency-response": _frequency_response,
    "mimo": _mimo,
}
"""Functions of `quantities.QUANTITIES` by name: (field, tx_positions (tx, 3), frequencies_hz (freq,)) -> `Answer`."""


def predict_paths(trained: TrainedField, receiver: Receiver, tx_positions: Any, frequency_hz: Any) -> Paths:
    """Returns the paths from transmitters at one frequency, as NumPy arrays with a leading axis of transmitters.

    Args:
        trained: a field that predicts paths.
        receiver: receiver; for one that is not in the training data, call `at_receiver` first.
        tx_positions: (tx, 3), or (3,) for one transmitter, world frame, metres.
        frequency_hz: of the carrier; one or (tx,).

    Returns:
        `wbgs_jax.Paths` with arrays (tx, k, ...), whose methods `cir`, `cfr` and `taps` are the channel.

    Raises:
        UserError: the field does not predict paths.

    Example:
        >>> paths = predict_paths(trained, trained.dataset().receiver(), positions, 28e9)  # doctest: +SKIP
        >>> response = paths.cfr(jnp.linspace(-200e6, 200e6, 64))  # (tx, 64)  # doctest: +SKIP
    """
    check_quantity("paths", trained.field)
    plan = trained.field.plan(trained.params, receiver)
    query = make_query(tx_positions, frequency_hz)
    found: Paths = map_blocks(lambda block: paths_of(trained.field, trained.params, plan, block), query, BLOCK)
    return found


def predict_gains(trained: TrainedField, receiver: Receiver) -> Complex[Array, " elements"]:
    """Returns the complex gains of a receiver's elements relative to ideal ones, which the calibration has estimated.

    Args:
        trained: the field, whose `predict_paths` are those to ideal elements.
        receiver: a receiver of the training data; the elements of any other one are ideal.

    Returns:
        Gains (elements,); 1 for ideal elements.

    Example:
        >>> gains = predict_gains(trained, trained.dataset().receiver())  # doctest: +SKIP
    """
    gains = gains_in(trained.field, trained.field.plan(trained.params, receiver))
    return jnp.broadcast_to(jnp.asarray(gains, jnp.complex64), len(receiver.element_positions))
