"""Blocks of queries answered by a trained field: spectra, or any other quantity that `wbgs-jax predict --what` names.

The whole channel of links: tables of paths, responses over a band, and matrices between two arrays.

What a coherent field knows of a link beyond what its receiver's array sees of it, asked for transmitters at frequencies.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields import Field, field_names, get_field
from wbgs_jax.fields.base import outputs_of, paths_of
from wbgs_jax.inference.answers import Options
from wbgs_jax.inference.intervals import expect_many
from wbgs_jax.inference.kriging import for_receiver
from wbgs_jax.inference.predictor import BLOCK, Trained, observe_queries
from wbgs_jax.inference.quantities import ask_channel
from wbgs_jax.inference.queries import Product
from wbgs_jax.inference.results_file import SHARED
from wbgs_jax.propagation.paths import DIFFRACTED, REFLECTED, TRANSMITTED
from wbgs_jax.propagation.transport import mimo_matrix
from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array
from wbgs_jax.radio.channel import Arrivals, decibels, doppler_hz
from wbgs_jax.types import Query, Receiver, make_query

WORDS = {TRANSMITTED: "through", REFLECTED: "off", DIFFRACTED: "around"}
"""What a wave does: through a wall, off a floor, around a cabinet's edge."""
SIGHT = "line of sight"


def check_paths(trained: Trained) -> None:
    """Raises a `UserError` where a field knows no paths."""
    if "paths" not in outputs_of(trained.field):
        able = " or ".join(name for name in field_names() if "paths" in get_field(name).outputs)
        raise UserError(f"the {trained.field.name} field of this run knows no paths; train --field {able} on data with a mesh")


def ask_paths(
    trained: Trained,
    dataset: Dataset,
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
    tx_velocity: Float[np.ndarray, "3"],
    rx_velocity: Float[np.ndarray, "3"],
) -> dict[str, np.ndarray]:
    """Returns a table with a row a path, its columns by name: which link it belongs to, what it meets, length, delay, angles,
    amplitudes and Doppler shift; of each link the strongest path first.

    Angles of arrival are in the receiver's frame, those of departure in the world's, zenith 0 upwards. Amplitudes are relative
    to the transmitted one, carrier phase included: what an element of the array sees, and what isotropic elements would see
    that are polarised along theta-hat and phi-hat. They add up to the snapshot where waves are plane.

    Args:
        trained: the field.
        dataset: it was trained on, which names the materials.
        receiver: at which it is asked.
        tx_positions: world frame, metres.
        frequencies_hz: of the carrier.
        tx_velocity, rx_velocity: metres a second, world frame.

    Raises:
        UserError: the field knows no paths.
    """
    check_paths(trained)
    plan, tables = trained.field.plan(trained.params, receiver), []
    velocities = jnp.asarray(tx_velocity, jnp.float32), jnp.asarray(rx_velocity, jnp.float32)
    for number, position in enumerate(tx_positions):
        for frequency in frequencies_hz:
            found, shift = _link(trained.field, trained.params, plan, make_query(position[None], frequency[None]), *velocities)
            link = {"tx": number, "x": position[0], "y": position[1], "z": position[2], "frequency_ghz": frequency / 1e9}
            tables.append(_rows(jax.tree.map(np.asarray, found), np.asarray(shift), link, names_of(dataset)))
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def arrivals_of(trained: Trained, receiver: Receiver, tx_positions: Float[np.ndarray, "tx 3"], frequency_hz: float) -> Arrivals:
    """Returns what arrives over every path from transmitters at one frequency, as NumPy arrays with a leading axis for them.

    Raises:
        UserError: the field knows no paths.
    """
    check_paths(trained)
    plan, parts, count = trained.field.plan(trained.params, receiver), [], len(tx_positions)
    size = min(BLOCK, count)
    for start in range(0, count, size):
        index = np.minimum(np.arange(start, start + size), count - 1)  # the last one fills the last block up
        query = make_query(tx_positions[index], np.full(size, frequency_hz))
        found = jax.tree.map(np.asarray, _arrivals(trained.field, trained.params, plan, query))
        parts.append(jax.tree.map(lambda leaf, start=start: leaf[: count - start], found))
    together: Arrivals = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return together


@jax.jit
def _arrivals(field: Field, params: Any, plan: Any, query: Query) -> Arrivals:
    return paths_of(field, params, plan, query)


@jax.jit
def _link(
    field: Field, params: Any, plan: Any, query: Query, tx_velocity: Any, rx_velocity: Any
) -> tuple[Arrivals, Float[jax.Array, " k"]]:
    """Returns the paths of one query, and their Doppler shifts."""
    found: Any = jax.tree.map(lambda leaf: leaf[0], paths_of(field, params, plan, query))
    return found, doppler_hz(found, query.frequency_hz[0], tx_velocity, rx_velocity)


def names_of(dataset: Dataset) -> tuple[str, ...]:
    """Returns the names of a data set's materials; none where it has none."""
    return () if dataset.materials is None else dataset.materials.names


def _rows(found: Any, shift: np.ndarray, link: dict[str, Any], names: tuple[str, ...]) -> dict[str, np.ndarray]:
    power = np.asarray(decibels(jnp.asarray(np.abs(found.amplitude) ** 2)))
    order = np.argsort(-power, kind="stable")
    order = order[(np.abs(found.polarised[order]) > 0).any(-1)]
    columns: dict[str, np.ndarray] = {name: np.full(len(order), value) for name, value in link.items()}
    columns["interactions"] = np.array(
        [describe_interactions(found.interaction[i], found.material[i], names) for i in order], dtype=np.str_
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
    return columns | {"doppler_hz": shift[order]}


def describe_interactions(kinds: np.ndarray, materials: np.ndarray, names: tuple[str, ...]) -> str:
    """Returns what a path meets: "off concrete, through glass"."""
    met = [
        f"{WORDS[int(kind)]} {names[material] if material < len(names) else f'material {material}'}"
        for kind, material in zip(kinds, materials, strict=True)
        if int(kind) in WORDS
    ]
    return ", ".join(met) or SIGHT


def ask_response(
    trained: Trained,
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
    band_hz: float,
    points: int,
) -> dict[str, np.ndarray]:
    """Returns the response of every element over a band around each carrier, (tx, freq, points, elements), and its inverse
    Fourier transform over the delays that the band can tell apart (no window).

    Every frequency of the band is asked for by itself, so materials may change over it.

    Raises:
        UserError: the field knows no paths.
    """
    check_paths(trained)
    offsets = (np.arange(points) - points // 2) * band_hz / points
    asked = frequencies_hz[:, None] + offsets
    shape = len(tx_positions), *asked.shape
    query = make_query(np.repeat(tx_positions, asked.size, 0), np.tile(asked.reshape(-1), shape[0]))
    response = observe_queries(trained, receiver, query, "snapshots").reshape(*shape, -1)
    return {
        "frequency_response": response,
        "impulse_response": np.fft.ifft(np.fft.ifftshift(response, 2), axis=2).astype(np.complex64),
        "offsets_hz": offsets,
        "delays_s": np.arange(points) / band_hz,
        "tx_positions": tx_positions,
        "frequencies_hz": frequencies_hz,
    }


def ask_mimo(
    trained: Trained,
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
    tx_elements: Float[np.ndarray, "m 3"],
) -> dict[str, np.ndarray]:
    """Returns the matrix between all elements of the receiver and M of each transmitter, (tx, freq, elements, m).

    `tx_elements` are in wavelengths around the transmitter's position, world frame; each is like the antenna it replaces.

    Raises:
        UserError: the field knows no paths.
    """
    check_paths(trained)
    plan, elements = trained.field.plan(trained.params, receiver), jnp.asarray(tx_elements, jnp.float32)
    queries = [make_query(tx[None], frequency[None]) for tx in tx_positions for frequency in frequencies_hz]
    found = np.array([_matrix(trained.field, trained.params, plan, query, receiver, elements) for query in queries])
    matrices = found.reshape(len(tx_positions), len(frequencies_hz), *found.shape[1:])
    return {"mimo": matrices, "tx_elements": tx_elements, "tx_positions": tx_positions, "frequencies_hz": frequencies_hz}


@jax.jit
def _matrix(field: Field, params: Any, plan: Any, query: Query, receiver: Receiver, elements: Any) -> Any:
    found: Any = jax.tree.map(lambda leaf: leaf[0], paths_of(field, params, plan, query))
    return mimo_matrix(found, receiver, query.frequency_hz[0], elements)


def as_rows(table: dict[str, np.ndarray]) -> list[list[Any]]:
    """Returns columns of one length as rows with a header; numbers have seven digits."""
    body = [
        [f"{value:.7g}" if isinstance(value, np.floating) else value for value in row]
        for row in zip(*table.values(), strict=True)
    ]
    return [list(table), *body]


PATHS = "paths"
ASKED = ("tx_positions", "frequencies_hz")
"""What answers repeat of the question."""


def answer_block(
    what: str, trained: Trained, dataset: Dataset, receiver: Receiver, options: Options, block: list[Product]
) -> dict[str, np.ndarray]:
    """Returns the answers to a block of queries by name, their leading axis the queries in order, and `results_file.SHARED`
    arrays; of paths a table, in the queries' order, whose `tx` says which transmitter a row belongs to."""
    ask, found = _asker(what, trained, dataset, receiver, options), []
    for product in block:
        answer = ask(product.tx_positions, product.frequencies_hz)
        if what == PATHS:
            answer["tx"] = product.tx_numbers[answer["tx"]]
        found.append({name: values for name, values in answer.items() if name not in ASKED and values is not None})
    if what == PATHS:
        order = np.argsort(np.concatenate([answer["tx"] for answer in found]), kind="stable")
        return {name: np.concatenate([answer[name] for answer in found])[order] for name in found[0]}
    order = np.argsort(np.concatenate([product.rows for product in block]))
    return {
        name: found[0][name]
        if name in SHARED
        else np.concatenate([answer[name].reshape(-1, *answer[name].shape[2:]) for answer in found])[order]
        for name in found[0]
    }


def _asker(
    what: str, trained: Trained, dataset: Dataset, receiver: Receiver, options: Options
) -> Callable[[Any, Any], dict[str, np.ndarray]]:
    """Returns a function of transmitters and frequencies, every one at every other."""
    if what == "spectra":
        return lambda tx, freq: ask_spectra(trained, receiver, tx, freq)
    if what == PATHS:
        velocities = options.tx_velocity, options.rx_velocity
        return lambda tx, freq: ask_paths(trained, dataset, receiver, tx, freq, *velocities)
    if what == "frequency-response":
        return lambda tx, freq: ask_response(trained, receiver, tx, freq, options.band_hz, options.points)
    if what == "mimo":
        return lambda tx, freq: ask_mimo(trained, receiver, tx, freq, planar_array(*options.tx_array))
    return lambda tx, freq: ask_channel(what, trained, dataset, receiver, tx, freq)


def ask_spectra(
    trained: Trained,
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
) -> dict[str, np.ndarray]:
    """Returns the spectra `pas` (tx, freq, 90, 360) of every transmitter at every frequency, and `expected` (tx, freq, 3): the
    SSIM that is expected of each, and the ends of its interval, where the run knows how sure it is."""
    shape = len(tx_positions), len(frequencies_hz)
    tx, frequency = np.repeat(tx_positions, shape[1], axis=0), np.tile(frequencies_hz, shape[0])
    seen = observe_queries(trained, receiver, make_query(tx, frequency))
    pas, power = np.asarray(seen.pas), None if seen.power_db is None else np.asarray(seen.power_db)
    answer = {"pas": pas.reshape(*shape, *pas.shape[1:])}
    confidence = for_receiver(trained.confidence, receiver)
    if confidence is not None:
        expected = np.stack(expect_many(confidence, pas, tx, frequency, power), -1)
        answer["expected"] = expected.reshape(*shape, 3)
    return answer
