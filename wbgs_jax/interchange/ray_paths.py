"""Propagation paths as Sionna RT has them (`sionna.rt.Paths`), in and out; the simulator itself is not needed.

Names, axes and conventions are Sionna's: R receivers, T transmitters, K paths, up to D interactions. Angles are radians in the
world frame, theta from +z, phi from +x, at both ends outwards: where the wave leaves to, and where it comes from. Coefficients
`a` lack the carrier phase of the delay: the channel at frequency f is the sum of a exp(-2 pi j f tau).
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from wbgs_jax._util.archives import read_arrays
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax.propagation.paths import DIFFRACTED, REFLECTED, TRANSMITTED
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.types import HIGHEST_FREQUENCY_HZ, LOWEST_FREQUENCY_HZ

NONE, SPECULAR, DIFFUSE, REFRACTION, DIFFRACTION = 0, 1, 2, 4, 8
"""`sionna.rt.InteractionType`."""
INTERACTION = {TRANSMITTED: REFRACTION, REFLECTED: SPECULAR, DIFFRACTED: DIFFRACTION}
NEEDED = ("a", "tau", "theta_t", "phi_t", "theta_r", "phi_r")
SINGLE = 3
"""Axes of what has none for antennas: receivers, transmitters, paths."""


@dataclass(frozen=True)
class RayPaths:
    """Paths between single antennas."""

    a: Complex[np.ndarray, "r t k"]
    tau: Float[np.ndarray, "r t k"]
    """Seconds; -1 of what is no path."""
    theta_t: Float[np.ndarray, "r t k"]
    phi_t: Float[np.ndarray, "r t k"]
    theta_r: Float[np.ndarray, "r t k"]
    phi_r: Float[np.ndarray, "r t k"]
    interactions: Int[np.ndarray, "d r t k"]
    """`NONE`, `SPECULAR`, `DIFFUSE`, `REFRACTION`, `DIFFRACTION`."""
    vertices: Float[np.ndarray, "d r t k 3"]
    """Where they happen, metres; NaN where that is not known."""
    valid: Bool[np.ndarray, "r t k"]
    sources: Float[np.ndarray, "t 3"]
    """Transmitters, metres."""
    targets: Float[np.ndarray, "r 3"]
    """Receivers."""
    frequency_hz: float
    """At which the coefficients hold."""

    def channel(self, frequency_hz: float | None = None) -> Complex[np.ndarray, "r t"]:
        """Returns the channel between single antennas; at other frequencies than the paths' own phases follow the delays, and
        the coefficients stay."""
        frequency = self.frequency_hz if frequency_hz is None else frequency_hz
        return np.where(self.valid, self.a * np.exp(-2j * np.pi * np.mod(frequency * self.tau, 1)), 0).sum(-1)

    def reversed(self) -> "RayPaths":
        """Returns the paths from receivers to transmitters: channels are reciprocal."""

        def swapped(values: np.ndarray, axis: int = 0) -> np.ndarray:
            return np.swapaxes(values, axis, axis + 1)

        number = (self.interactions != NONE).sum(0)
        place = np.arange(len(self.interactions))[:, None, None, None]
        backwards = np.where(place < number, number - 1 - place, place)
        return RayPaths(
            a=swapped(self.a),
            tau=swapped(self.tau),
            theta_t=swapped(self.theta_r),
            phi_t=swapped(self.phi_r),
            theta_r=swapped(self.theta_t),
            phi_r=swapped(self.phi_t),
            interactions=swapped(np.take_along_axis(self.interactions, backwards, 0), 1),
            vertices=swapped(np.take_along_axis(self.vertices, backwards[..., None], 0), 1),
            valid=swapped(self.valid),
            sources=self.targets,
            targets=self.sources,
            frequency_hz=self.frequency_hz,
        )

    def as_sionna(self) -> dict[str, np.ndarray]:
        """Returns arrays with the names and axes of `sionna.rt.Paths` between single antennas (synthetic arrays)."""
        arrays = {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}
        return arrays | {"a": self.a[:, None, :, None, :]}


def from_sionna(paths: Any, frequency_hz: float | None = None) -> RayPaths:
    """Returns the paths of a `sionna.rt.Paths` object, or of a mapping with its arrays; of antenna arrays those between the
    first antennas.

    Args:
        paths: whatever has `a`, `tau`, `theta_t`, `phi_t`, `theta_r`, `phi_r`, and perhaps `valid`, `interactions`, `vertices`,
            `sources` and `targets`, as attributes or keys.
        frequency_hz: of the carrier, which Sionna keeps in its scene; for what does not say it itself.

    Raises:
        UserError: an array is missing, or has other axes.
    """
    optional = {name: _array(paths, name) for name in (*NEEDED, "valid", "interactions", "vertices", "frequency_hz")}
    found = {name: values for name, values in optional.items() if values is not None}
    if missing := [name for name in NEEDED if name not in found]:
        raise UserError(f"these paths have no {missing[0]}; give a sionna.rt.Paths object or its arrays by name")
    known = found.pop("frequency_hz", None)
    frequency = known if frequency_hz is None else frequency_hz
    if frequency is None:
        raise UserError("these paths do not say their frequency; give it: that of the scene that they were traced in")
    single = {name: _first_antennas(name, values) for name, values in found.items()}
    shape = single["a"].shape
    if "interactions" not in single:
        single.pop("vertices", None)  # places of nobody knows what
    for name, values in single.items():
        if values.dtype.kind not in ("cfiu" if name == "a" else "fiub"):
            raise UserError(f"{name} of these paths holds no numbers but {values.dtype}; write them again")
    if len(shape) != SINGLE:
        raise UserError(f"a of these paths has shape {found['a'].shape}; expected receivers, transmitters and paths")
    for name, values in single.items():
        axes = values.shape[1:] if name == "interactions" else values.shape[1:-1] if name == "vertices" else values.shape
        if name == "vertices" and (values.shape[-1:] != (3,) or len(values) != len(single.get("interactions", values))):
            axes = ()
        if axes != shape:
            raise UserError(
                f"{name} of these paths has shape {found[name].shape}, which does not fit a with {found['a'].shape}"
            )
    real = {name: np.asarray(single[name], np.float64) for name in NEEDED[1:]}
    met = np.asarray(single.get("interactions", np.zeros((0, *shape))), np.int32)
    return RayPaths(
        a=np.asarray(single["a"], np.complex128),
        **real,
        interactions=met,
        vertices=np.asarray(single.get("vertices", np.full((*met.shape, 3), np.nan)), np.float64),
        valid=np.asarray(single.get("valid", (real["tau"] >= 0) & (single["a"] != 0)), bool),
        sources=_places(paths, "sources", shape[1]),
        targets=_places(paths, "targets", shape[0]),
        frequency_hz=_frequency(frequency),
    )


def from_arrivals(arrivals: Any, tx_positions: Any, rx_position: Any, frequency_hz: float) -> RayPaths:
    """Returns what a field with paths says (`Field.arrivals`) of T transmitters at one frequency, as seen by one element of the
    receiver's array at its centre.

    Transmissions have no place (NaN): a field knows which walls a path passes, and where it is reflected or diffracted.

    Args:
        arrivals: `wbgs_jax.radio.channel.Arrivals` with a leading axis T.
        tx_positions: (T, 3) metres, world frame.
        rx_position: (3,).
        frequency_hz: that was asked for.
    """
    amplitude, length = np.asarray(arrivals.amplitude, np.complex128), np.asarray(arrivals.length, np.float64)
    tau = length / SPEED_OF_LIGHT
    theta_t, phi_t = _angles(np.asarray(arrivals.departure, np.float64))
    theta_r, phi_r = _angles(-np.asarray(arrivals.arrival, np.float64))
    own = np.asarray(arrivals.interaction)
    met = np.zeros_like(own)
    for kind, name in INTERACTION.items():
        met = np.where(own == kind, name, met)
    valid = np.abs(amplitude) > 0
    one = {"tau": np.where(valid, tau, -1), "theta_t": theta_t, "phi_t": phi_t, "theta_r": theta_r, "phi_r": phi_r}
    return RayPaths(
        (amplitude * np.exp(2j * np.pi * np.mod(frequency_hz * tau, 1)))[None],
        **{name: values[None] for name, values in one.items()},
        interactions=np.moveaxis(met, -1, 0)[:, None],
        vertices=np.moveaxis(_vertices(own, arrivals.points), -2, 0)[:, None],
        valid=valid[None],
        sources=np.asarray(tx_positions, np.float64),
        targets=np.asarray(rx_position, np.float64)[None],
        frequency_hz=frequency_hz,
    )


def save_paths(path: Path | str, paths: RayPaths) -> None:
    """Writes paths as an .npz file of `RayPaths.as_sionna`."""
    arrays: dict[str, Any] = paths.as_sionna()
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **arrays)


def load_paths(path: Path | str, frequency_hz: float | None = None) -> RayPaths:
    """Returns the paths of an .npz file with the arrays of `sionna.rt.Paths` by name; `a` may be complex, or `a_real` and
    `a_imag`.

    Raises:
        UserError: the file is missing, damaged, or holds no paths.
    """
    arrays = read_arrays(Path(path), "", "check the path, or write it again")
    if "a_real" in arrays and "a_imag" in arrays:
        arrays["a"] = arrays.pop("a_real") + 1j * arrays.pop("a_imag")
    return from_sionna(arrays, frequency_hz)


def _array(paths: Any, name: str) -> np.ndarray | None:
    """Returns an array by its name as a key or an attribute; a pair of arrays, as Sionna's `a`, is a complex one."""
    value = paths.get(name) if isinstance(paths, Mapping) else getattr(paths, name, None)
    if value is None:
        return None
    if isinstance(value, tuple | list) and len(value) == 2:
        return np.asarray(value[0]) + 1j * np.asarray(value[1])
    return np.asarray(value)


def _frequency(value: Any) -> float:
    """Returns hertz, of several the first."""
    try:
        found = float(np.reshape(value, -1)[0])
    except (ValueError, TypeError, IndexError):
        found = np.nan
    if not LOWEST_FREQUENCY_HZ <= found <= HIGHEST_FREQUENCY_HZ:
        raise UserError(f"the frequency of these paths is {found:g} Hz; give hertz, 28e9 for 28 GHz")
    return found


def _first_antennas(name: str, values: np.ndarray) -> np.ndarray:
    """Returns an array without axes of antennas, which stand behind receivers and transmitters."""
    before, after = (1, 0) if name == "interactions" else (1, 1) if name == "vertices" else (0, 0)
    if values.ndim == before + after + SINGLE + 2:
        return values[(slice(None),) * (before + 1) + (0, slice(None), 0)]
    return values


def _places(paths: Any, name: str, count: int) -> np.ndarray:
    """Returns positions (n, 3), of several antennas at a place the first; objects of Sionna have them the other way round."""
    found = _array(paths, name)
    if found is None:
        return np.full((count, 3), np.nan)
    if found.dtype.kind not in "fiu":
        raise UserError(f"{name} of these paths holds no numbers but {found.dtype}; write them again")
    places = np.asarray(found, np.float64)
    if places.ndim == 2 and (places.shape[1] != 3 or (len(places) == 3 and not isinstance(paths, Mapping))):
        places = places.T
    if places.ndim != 2 or places.shape[1] != 3 or not len(places) or len(places) % count:
        raise UserError(f"{name} of these paths has shape {np.shape(found)}; expected ({count}, 3): a place for each of them")
    return places[:: len(places) // count]


def _angles(directions: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    return np.arccos(np.clip(directions[..., 2], -1, 1)), np.arctan2(directions[..., 1], directions[..., 0])


def _vertices(interaction: Int[np.ndarray, "t k d"], points: Any) -> Float[np.ndarray, "t k d 3"]:
    """Returns where every interaction happens: points between the ends belong to reflections and diffractions, in order."""
    found = np.full((*interaction.shape, 3), np.nan)
    if points is None:
        return found
    has_place = (interaction == REFLECTED) | (interaction == DIFFRACTED)
    number = np.minimum(np.cumsum(has_place, -1), np.shape(points)[-2] - 1)
    placed = np.take_along_axis(np.asarray(points, np.float64), number[..., None], -2)
    return np.where(has_place[..., None], placed, found)
