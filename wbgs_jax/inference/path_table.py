"""Tables and verbal descriptions of the paths of links."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params, paths_of
from wbgs_jax.propagation.paths import InteractionType
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.radio.channel import Paths, decibels, doppler_hz
from wbgs_jax.types import Query

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
