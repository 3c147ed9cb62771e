"""Maps of a channel quantity over transmitters on a horizontal plane, maps of several transmitters over receivers there, and
the cross-section of the walls with that plane."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.inference.evaluate_quantities import LoadedField
from wbgs_jax.inference.quantities import Network
from wbgs_jax.radio.array import codebook, pas_directions
from wbgs_jax.radio.channel import noise_dbm, sinr_db, throughput_bps
from wbgs_jax.radio.geometry import direction_to_angles


@dataclass(frozen=True)
class Plane:
    """Transmitters on a horizontal grid, world frame, metres."""

    xs: Float[np.ndarray, " nx"]
    ys: Float[np.ndarray, " ny"]
    height: float

    def positions(self) -> Float[np.ndarray, "places 3"]:
        """Returns all positions; x varies fastest."""
        y, x = np.meshgrid(self.ys, self.xs, indexing="ij")
        return np.stack([x, y, np.full(x.shape, self.height)], -1).reshape(-1, 3)


def plane_over(low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"], height: float, step: float) -> Plane:
    """Returns the centres of the squares of about `step` metres that fill a rectangle."""
    counts = np.maximum(np.round((high - low) / step), 1).astype(int)
    xs, ys = (a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low, high, counts, strict=True))
    return Plane(xs, ys, height)


def evaluate_plane(
    what: str,
    field: LoadedField,
    plane: Plane,
    frequencies_hz: Float[np.ndarray, " freq"],
    advance: Callable[[], None] = lambda: None,
) -> dict[str, np.ndarray]:
    """Returns maps {name with unit: values (freq, ny, nx)} over the transmitters of a plane, and `xs`, `ys`, `height` and
    `frequencies_hz`.

    Args:
        what: a name of `quantities.QUANTITIES` that `wbgs-jax map` supports.
        field: the trained field at the receiver.
        plane: positions of the transmitters.
        frequencies_hz: carrier frequencies.
        advance: called after each of the `pieces(plane, frequencies_hz)` pieces of work.

    Raises:
        UserError: the field does not provide this quantity.
    """
    parts = []
    for some in np.array_split(plane.positions(), pieces(plane, frequencies_hz)):
        parts.append(field.evaluate(what, some, frequencies_hz))
        advance()
    shape = len(plane.ys), len(plane.xs)
    maps = {}
    for name in parts[0]:
        values = np.moveaxis(np.concatenate([part[name] for part in parts]), 1, 0)
        maps[name] = values.reshape(len(frequencies_hz), *shape, *values.shape[2:])
    more = beam_angles() if what == "best-beam" else {}
    return maps | more | {"xs": plane.xs, "ys": plane.ys, "height": np.array(plane.height), "frequencies_hz": frequencies_hz}


def evaluate_network(
    fields: list[LoadedField],
    plane: Plane,
    frequencies_hz: Float[np.ndarray, " freq"],
    network: Network,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, np.ndarray]:
    """Returns maps of several transmitters over the receivers of a plane: `received_dbm` (tx, freq, ny, nx) of each,
    `tx_power_dbm` (tx,), all quantities of `quantities.NETWORK` by name with unit, (freq, ny, nx), and what `evaluate_plane`
    adds.

    Channels are reciprocal: what a receiver of the plane receives from a transmitter equals what that transmitter would receive
    from it. So every transmitter is the receiver of a field, and the plane holds the transmitters of the field.

    Args:
        fields: the trained field at each transmitter.
        plane: positions of the receivers.
        frequencies_hz: carrier frequencies.
        network: transmitted powers, loads and noise.
        advance: called after each of the `len(fields) * pieces(plane, frequencies_hz)` pieces of work.

    Raises:
        UserError: the field does not predict power.
    """
    maps = [evaluate_plane("power", field, plane, frequencies_hz, advance) for field in fields]
    power = np.broadcast_to(np.asarray(network.power_dbm, np.float64), len(fields))
    received = np.stack([one["power_db"] for one in maps]) + power[:, None, None, None]
    noise = noise_dbm(network.bandwidth_hz, network.noise_figure_db)
    each = jnp.moveaxis(jnp.asarray(received, jnp.float32), 0, -1)
    server, strongest = np.argmax(received, 0), received.max(0)
    ratios = sinr_db(each, noise, jnp.asarray(network.load, jnp.float32))
    best = jnp.take_along_axis(ratios, server[..., None], -1)[..., 0]  # with unequal loads, others may have larger ones
    found = {"rsrp_dbm": strongest, "sinr_db": best, "best_server": server}
    found |= {"throughput_bps": throughput_bps(best, network.bandwidth_hz), "received_dbm": received, "tx_power_dbm": power}
    shared = {name: maps[0][name] for name in ("xs", "ys", "height", "frequencies_hz")}
    return {name: np.asarray(values) for name, values in found.items()} | shared


def pieces(plane: Plane, frequencies_hz: Float[np.ndarray, " freq"]) -> int:
    """Returns the number of pieces into which the work is divided."""
    places = len(plane.xs) * len(plane.ys)
    at_once = 512  # links evaluated, and kept in memory, per step of the progress bar
    return -(-places // max(at_once // len(frequencies_hz), 1))


def beam_angles() -> dict[str, np.ndarray]:
    """Returns the directions of the codebook's beams, degrees in the receiver's frame."""
    azimuth, zenith = direction_to_angles(jnp.asarray(pas_directions().reshape(-1, 3)[codebook()], jnp.float32))
    return {"beam_azimuth_deg": np.degrees(azimuth), "beam_zenith_deg": np.degrees(zenith)}


def cut_at(dataset: Dataset, height: float) -> Float[np.ndarray, "n 2 2"]:
    """Returns the line segments (x and y of both ends, metres) in which a horizontal plane cuts the surfaces; or none."""
    if not len(dataset.faces):
        return np.zeros((0, 2, 2))
    mesh = trimesh.Trimesh(dataset.vertices, dataset.faces, process=False)
    lines = trimesh.intersections.mesh_plane(mesh, [0, 0, 1], [0, 0, height])
    return np.asarray(lines).reshape(-1, 2, 3)[..., :2]
