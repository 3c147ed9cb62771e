"""Import and export of propagation paths in the form of Sionna RT (`sionna.rt.Paths`); the simulator itself is not needed.

Names, axes and conventions are Sionna's: R receivers, T transmitters, K paths, up to D interactions. Angles are radians in the
world frame, theta from +z, phi from +x, pointing outwards at both ends: the directions of departure and towards the arriving
wave. The coefficients `a` do not contain the carrier phase of the delay: the channel at frequency f is the sum of a exp(-2 pi j
f tau).

Paths must be physically plausible: delays that fit the positions, angles in radians, gains without amplification. Otherwise
they are probably in another unit, and the error names the array.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex, Float, Int, Integer

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax.interchange.matlab import read_mat_or_npz
from wbgs_jax.propagation.paths import InteractionType, is_vertex
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.radio.channel import free_space_db
from wbgs_jax.types import LOWEST_OF_PATHS_HZ, MAX_FREQUENCY_HZ

NONE, SPECULAR, DIFFUSE = (kind.sionna for kind in (InteractionType.NONE, InteractionType.REFLECTED, InteractionType.SCATTERED))
REFRACTION, DIFFRACTION = InteractionType.TRANSMITTED.sionna, InteractionType.DIFFRACTED.sionna
"""Values of `sionna.rt.InteractionType`."""
NEEDED = ("a", "tau", "theta_t", "phi_t", "theta_r", "phi_r")
OF_PATHS = (*NEEDED, "valid", "interactions", "vertices")
SINGLE, ARRAYS = 3, 5
"""Number of axes: receivers, transmitters, paths; and with an axis of antennas after each of the first two."""
SAME_FREQUENCY = 1e-3
"""Relative difference up to which frequencies count as the same, for rounding."""


@dataclass(frozen=True)
class RayPaths:
    """Paths between single antennas, radians and metres."""

    a: Complex[np.ndarray, "r t k"]
    tau: Float[np.ndarray, "r t k"]
    """Delay, seconds; -1 for padding."""
    theta_t: Float[np.ndarray, "r t k"]
    phi_t: Float[np.ndarray, "r t k"]
    theta_r: Float[np.ndarray, "r t k"]
    phi_r: Float[np.ndarray, "r t k"]
    interactions: Int[np.ndarray, "d r t k"]
    """`NONE`, `SPECULAR`, `DIFFUSE`, `REFRACTION`, `DIFFRACTION`."""
    vertices: Float[np.ndarray, "d r t k 3"]
    """Points of interaction, metres; NaN if unknown."""
    valid: Bool[np.ndarray, "r t k"]
    sources: Float[np.ndarray, "t 3"]
    """Transmitters, metres."""
    targets: Float[np.ndarray, "r 3"]
    """Receivers, metres."""
    frequency_hz: float
    """Carrier frequency of the coefficients."""

    def channel(self, frequency_hz: float | None = None) -> Complex[np.ndarray, "r t"]:
        """Returns the channel between single antennas. At another frequency than the paths' own, the phases follow the delays
        and the coefficients are unchanged."""
        frequency = self.frequency_hz if frequency_hz is None else frequency_hz
        return np.where(self.valid, self.a * carrier(frequency, self.tau), 0).sum(-1)

    def reversed(self) -> "RayPaths":
        """Returns the paths from receivers to transmitters: channels are reciprocal."""

        def swapped(values: np.ndarray, axis: int = 0) -> np.ndarray:
            return np.swapaxes(values, axis, axis + 1)

        return RayPaths(
            a=swapped(self.a),
            tau=swapped(self.tau),
            theta_t=swapped(self.theta_r),
            phi_t=swapped(self.phi_r),
            theta_r=swapped(self.theta_t),
            phi_r=swapped(self.phi_t),
            interactions=swapped(backwards(self.interactions, self.interactions), 1),
            vertices=swapped(backwards(self.vertices, self.interactions), 1),
            valid=swapped(self.valid),
            sources=self.targets,
            targets=self.sources,
            frequency_hz=self.frequency_hz,
        )

    def as_sionna(self) -> dict[str, np.ndarray]:
        """Returns arrays with the names and axes of `sionna.rt.Paths` between single antennas (synthetic arrays)."""
        arrays = {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}
        return arrays | {"a": self.a[:, None, :, None, :]}


def from_sionna(paths: Any, frequency_hz: float | None = None, antennas: tuple[int, int] | None = None) -> RayPaths:
    """Returns the paths of a `sionna.rt.Paths` object, or of a mapping with its arrays, between single antennas.

    For snapshots of antenna arrays use `sionna_arrays.scene_of_sionna`.

    Args:
        paths: an object with `a`, `tau`, `theta_t`, `phi_t`, `theta_r`, `phi_r`, and optionally `valid`, `interactions`,
            `vertices`, `sources` and `targets`, as attributes or keys.
        frequency_hz: of the carrier, which Sionna keeps in its scene; needed if the paths do not record it.
        antennas: indices of the receivers' and of the transmitters' antenna, if devices have several. With a synthetic array
            the coefficients contain the phase of the antenna's offset from the device's position.

    Returns:
        The paths, in radians and seconds.

    Raises:
        UserError: an array is missing or has other axes, the frequency is unknown or contradicts the recorded one, or devices
            have several antennas and none is chosen.
    """
    found = {name: values for name in OF_PATHS if (values := array_of(paths, name)) is not None}
    if "interactions" not in found:
        found.pop("vertices", None)  # positions of unknown interactions
    check_arrays(found, "these paths")
    frequency = frequency_of(array_of(paths, "frequency_hz"), frequency_hz, "this set of paths")
    if found["a"].ndim == ARRAYS:
        several = found["a"].shape[1], found["a"].shape[3]
        if antennas is None and several != (1, 1):
            raise UserError(f"these paths are between {several[0]} and {several[1]} antennas of a device; choose one of each")
    single = {name: _of_antennas(name, values, antennas or (0, 0)) for name, values in found.items()}
    shape = single["a"].shape
    real = {name: np.asarray(single[name], np.float64) for name in NEEDED[1:]}
    met = np.asarray(single.get("interactions", np.zeros((0, *shape))), np.int32)
    return RayPaths(
        a=np.asarray(single["a"], np.complex128),
        **real,
        interactions=met,
        vertices=np.asarray(single.get("vertices", np.full((*met.shape, 3), np.nan)), np.float64),
        valid=np.asarray(single.get("valid", (real["tau"] >= 0) & (single["a"] != 0)), bool),
        sources=_places(paths, "sources", shape[1], (antennas or (0, 0))[1]),
        targets=_places(paths, "targets", shape[0], (antennas or (0, 0))[0]),
        frequency_hz=frequency,
    )


def check_arrays(arrays: Mapping[str, np.ndarray], what: str) -> None:
    """Raises a `UserError` for arrays of `OF_PATHS` that are missing, not numeric (`a`: complex), or do not have the receivers,
    transmitters and paths of `a`, with or without axes of antennas.

    Args:
        arrays: by name.
        what: description of their source, for messages.
    """
    if missing := [name for name in NEEDED if name not in arrays]:
        raise UserError(f"{what} have no {missing[0]}; give a sionna.rt.Paths object or its arrays by name")
    for name, values in arrays.items():
        kinds, wanted, advice = ("c", "complex", ", or a_real and a_imag") if name == "a" else ("fiub", "numeric", "")
        if values.dtype.kind not in kinds:
            raise UserError(f"{name} of {what} is not {wanted} but {values.dtype}; write it again{advice}")
    of_a = arrays["a"].shape
    if len(of_a) not in (SINGLE, ARRAYS) or 0 in of_a[:-1]:
        raise UserError(f"a of {what} has shape {of_a}; expected receivers, transmitters and paths")
    for name, values in arrays.items():
        shape = values.shape[int(name in ("interactions", "vertices")) :][: -1 if name == "vertices" else None]
        known = arrays["interactions"].shape if "interactions" in arrays else values.shape[:-1]
        if name == "vertices" and values.shape != (*known, 3):
            shape = ()
        ends = shape[::2] if len(shape) == ARRAYS else shape
        if ends != (of_a[::2] if len(of_a) == ARRAYS else of_a) or 0 in shape[:-1]:
            raise UserError(f"{name} of {what} has shape {values.shape}, which does not fit a with {of_a}")


def backwards(values: np.ndarray, interactions: Integer[np.ndarray, "d ..."]) -> np.ndarray:
    """Returns interactions, or their vertices, in the order from the receiver to the transmitter; padding stays at the end."""
    number = (interactions != NONE).sum(0)
    place = np.arange(len(interactions)).reshape(-1, *[1] * number.ndim)
    order = np.where(place < number, number - 1 - place, place)
    return np.take_along_axis(values, order.reshape(order.shape + (1,) * (values.ndim - order.ndim)), 0)


def from_paths(arrivals: Any, tx_positions: Any, rx_position: Any, frequency_hz: float) -> RayPaths:
    """Returns the paths predicted by a field (`fields.base.paths_of`) from T transmitters at one frequency to a single element
    at the centre of the receiver's array.

    Transmissions have no position (NaN): a field records which walls a path crosses, and where it is reflected or diffracted.

    Args:
        arrivals: `wbgs_jax.radio.channel.Paths` with a leading axis T.
        tx_positions: (T, 3), metres, world frame.
        rx_position: (3,), metres, world frame.
        frequency_hz: frequency of the arrivals.

    Returns:
        The paths with one receiver, in radians and seconds.
    """
    amplitude, length = np.asarray(arrivals.amplitude, np.complex128), np.asarray(arrivals.length, np.float64)
    tau = length / SPEED_OF_LIGHT
    theta_t, phi_t = _angles(np.asarray(arrivals.departure, np.float64))
    theta_r, phi_r = _angles(-np.asarray(arrivals.arrival, np.float64))
    own = np.asarray(arrivals.interaction)
    met = np.zeros_like(own)
    for kind in InteractionType:
        met = np.where(own == kind, kind.sionna, met)
    valid = np.abs(amplitude) > 0
    one = {"tau": np.where(valid, tau, -1), "theta_t": theta_t, "phi_t": phi_t, "theta_r": theta_r, "phi_r": phi_r}
    return RayPaths(
        (amplitude / carrier(frequency_hz, tau))[None],
        **{name: values[None] for name, values in one.items()},
        interactions=np.moveaxis(met, -1, 0)[:, None],
        vertices=np.moveaxis(_vertices(own, arrivals.points), -2, 0)[:, None],
        valid=valid[None],
        sources=np.asarray(tx_positions, np.float64),
        targets=np.asarray(rx_position, np.float64)[None],
        frequency_hz=frequency_hz,
    )


def save_paths(path: Path | str, paths: RayPaths) -> None:
    """Writes paths as an .npz file with the arrays of `RayPaths.as_sionna`.

    Args:
        path: of the file.
        paths: to be written.
    """
    arrays: dict[str, Any] = paths.as_sionna()
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **arrays)


def load_paths(path: Path | str, frequency_hz: float | None = None) -> RayPaths:
    """Returns the paths of an .npz file with the arrays of `sionna.rt.Paths` by name, between single antennas; `a` may be
    complex, or `a_real` and `a_imag`.

    Args:
        path: of the file.
        frequency_hz: of the carrier; needed if the file does not record it.

    Returns:
        The paths, in radians and seconds.

    Raises:
        UserError: the file is missing, damaged, or does not contain paths.
    """
    return from_sionna(read_paths(path), frequency_hz)


def read_paths(path: Path | str) -> dict[str, np.ndarray]:
    """Returns the arrays of an .npz or .mat file by name, with complex `a`.

    Raises:
        UserError: the file is missing or damaged.
    """
    arrays = read_mat_or_npz(Path(path), "check the path, or write it again")
    if "a_real" in arrays and "a_imag" in arrays:
        arrays["a"] = _complex(arrays.pop("a_real"), arrays.pop("a_imag"), f"a of {path}")
    return arrays


def array_of(paths: Any, name: str) -> np.ndarray | None:
    """Returns an array by key or attribute; a pair of arrays for `a`, as Sionna has it, becomes a complex one, also if it
    was saved as one real array."""
    value = paths.get(name) if isinstance(paths, Mapping) else getattr(paths, name, None)
    if value is None:
        return None
    stacked = isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.ndim == 1 + ARRAYS
    if name == "a" and (isinstance(value, tuple | list) or stacked) and len(value) == 2:
        real, imaginary = map(np.asarray, value)
        return _complex(real, imaginary, "a of these paths")
    return np.asarray(value)


def _complex(real: np.ndarray, imaginary: np.ndarray, what: str) -> np.ndarray:
    """Returns a complex array from its two parts."""
    if not {real.dtype.kind, imaginary.dtype.kind} <= set("fiu") or real.shape != imaginary.shape:
        parts = " and ".join(f"{part.dtype} of shape {part.shape}" for part in (real, imaginary))
        raise UserError(f"{what} has the parts {parts}; give real numbers of one shape for both")
    return real + 1j * imaginary


def frequency_of(recorded: Any, given: float | None, what: str) -> float:
    """Returns the frequency (hertz) that paths record, or the given one if they record nothing.

    Raises:
        UserError: neither exists, they differ, or several frequencies are recorded.
    """
    if recorded is None and given is None:
        raise UserError(f"{what} does not record its frequency; give --ghz, the frequency of the scene that was traced")
    try:
        every = np.asarray(given if recorded is None else recorded, np.float64).reshape(-1)
    except (ValueError, TypeError):
        every = np.zeros(0)
    found = float(every[0]) if len(every) else np.nan
    if not LOWEST_OF_PATHS_HZ <= found <= MAX_FREQUENCY_HZ:
        raise UserError(f"the frequency of {what} is {found:g} Hz; give hertz, such as 28e9 for 28 GHz")
    if not np.allclose(every, found, rtol=SAME_FREQUENCY, atol=0):
        raise UserError(
            f"{what} is for several frequencies, {every.min() / 1e9:g} to {every.max() / 1e9:g} GHz; give one file each"
        )
    if given is not None and not np.isclose(given, found, rtol=SAME_FREQUENCY, atol=0):
        raise UserError(f"{what} is for {found / 1e9:g} GHz, not {given / 1e9:g}; leave out --ghz")
    return found


def _of_antennas(name: str, values: np.ndarray, antennas: tuple[int, int]) -> np.ndarray:
    """Returns an array at the chosen antennas, without the axes of antennas, which follow those of receivers and transmitters.
    These axes may be shorter if several antennas share the values."""
    before, after = (1, 0) if name == "interactions" else (1, 1) if name == "vertices" else (0, 0)
    if values.ndim == before + after + ARRAYS:
        received, sent = (number % values.shape[before + axis] for number, axis in zip(antennas, (1, 3), strict=True))
        return values[(slice(None),) * (before + 1) + (received, slice(None), sent)]
    return values


def _places(paths: Any, name: str, count: int, antenna: int) -> np.ndarray:
    """Returns positions (n, 3), that of the chosen antenna if devices have several."""
    found = array_of(paths, name)
    if found is None:
        return np.full((count, 3), np.nan)
    places = places_of(found, not isinstance(paths, Mapping), name)
    if not len(places) or len(places) % count:
        raise UserError(f"{name} of these paths has shape {np.shape(found)}; expected ({count}, 3): one position for each")
    several = len(places) // count
    return places[antenna % several :: several]


def places_of(found: np.ndarray, columns: bool, name: str) -> Float[np.ndarray, "n 3"]:
    """Returns positions (n, 3). With `columns`, a 3 x 3 array is transposed: Sionna's objects have shape (3, n)."""
    if found.dtype.kind not in "fiu":
        raise UserError(f"{name} of these paths is not numeric but {found.dtype}; write it again")
    places = np.asarray(found, np.float64)
    if places.ndim == 2 and (places.shape[1] != 3 or (len(places) == 3 and columns)):
        places = places.T
    if places.ndim != 2 or places.shape[1] != 3:
        raise UserError(f"{name} of these paths has shape {np.shape(found)}; expected (n, 3): one position for each")
    return places


def carrier(frequency_hz: float, tau: Float[np.ndarray, "*n"]) -> Complex[np.ndarray, "*n"]:
    """Returns the phasors of the carrier after delays (seconds)."""
    return np.exp(-2j * np.pi * np.mod(frequency_hz * tau, 1))


def directions_of(theta: Float[np.ndarray, "*n"], phi: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    """Returns unit vectors from angles (radians)."""
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], -1)


def _angles(directions: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    return np.arccos(np.clip(directions[..., 2], -1, 1)), np.arctan2(directions[..., 1], directions[..., 0])


def _vertices(interaction: Int[np.ndarray, "t k d"], points: Any) -> Float[np.ndarray, "t k d 3"]:
    """Returns the points of interaction: those between the ends belong to reflections and diffractions, in order."""
    found = np.full((*interaction.shape, 3), np.nan)
    if points is None:
        return found
    has_place = np.asarray(is_vertex(interaction))
    number = np.minimum(np.cumsum(has_place, -1), np.shape(points)[-2] - 1)
    placed = np.take_along_axis(np.asarray(points, np.float64), number[..., None], -2)
    return np.where(has_place[..., None], placed, found)


SLACK, SLACK_M = 1e-3, 0.1
"""Relative and absolute amount by which a path may be shorter than the straight line, for rounding and off-centre elements."""


def check_paths(paths: RayPaths, name: str, opposite: Complex[np.ndarray, "r t k"] | None = None) -> None:
    """Raises a `UserError` for paths that contradict physics or their positions.

    Args:
        paths: to check.
        name: of the paths, for messages.
        opposite: coefficients of the antennas on the other side of the arrays' centres, if antennas share their delays.
    """
    valid = paths.valid
    if not valid.any():
        raise UserError(f"{name} has no valid path")
    largest_gain = 3.0  # maximum amplitude of a path, for antennas a hand's breadth apart
    if not np.isfinite(paths.a[valid]).all() or (gain := np.abs(paths.a[valid]).max()) > largest_gain:
        found = "not finite" if not np.isfinite(paths.a[valid]).all() else f"{gain:.3g}"
        raise UserError(f"{name}: a path amplifies (|a| is {found}); give amplitudes, not decibels")
    for column in NEEDED[1:]:
        if not np.isfinite(getattr(paths, column)[valid]).all():
            raise UserError(f"{name}: {column} of a valid path is not finite; give its value, or valid=False")
    rounding = 1e-3  # by which angles may exceed their range, radians
    for angle in ("theta_t", "phi_t", "theta_r", "phi_r"):
        values = getattr(paths, angle)[valid]
        if (largest := np.abs(values).max()) > 2 * np.pi + rounding:
            raise UserError(f"{name}: {angle} is {largest:.3g}; give radians, not degrees")
        if angle.startswith("theta") and (values.min() < -rounding or values.max() > np.pi + rounding):
            raise UserError(f"{name}: {angle} is {values.min():.3g} to {values.max():.3g}; give angles from +z, 0 to pi")
    length = SPEED_OF_LIGHT * paths.tau
    longest_m = 1e6  # maximum length of a path
    if (longest := length[valid].max()) > longest_m:
        raise UserError(f"{name}: a path is {longest:.3g} m long (tau {paths.tau[valid].max():.3g}); give delays in seconds")
    straight = np.linalg.norm(paths.targets[:, None] - paths.sources[None], axis=-1)
    short = valid & (length < straight[..., None] * (1 - SLACK) - SLACK_M)
    if short.any():
        r, t, k = np.argwhere(short)[0]
        raise UserError(
            f"{name}: a path is {length[r, t, k]:.3g} m long although transmitter {t + 1} and receiver {r + 1} are "
            f"{straight[r, t]:.3g} m apart; give delays in seconds from the transmitter on (Sionna: normalize_delays=False), "
            "positions in metres, and a row of three numbers for every position"
        )
    # Ratio to the straight line that all paths together exceed only if positions have another unit; vertices are more exact.
    times, apart = 3.0, valid & (straight[..., None] > 0)
    if not np.isfinite(paths.vertices).any() and apart.any() and (length > times * straight[..., None])[apart].all():
        r, t, k = np.argwhere(apart)[0]
        raise UserError(
            f"{name}: every path is more than {times:g} times as long as the line between its ends, such as "
            f"{length[r, t, k]:.3g} m from transmitter {t + 1} to receiver {r + 1}, which are {straight[r, t]:.3g} m apart; "
            "give positions in metres"
        )
    _check_vertices(paths, name, length)
    _check_line_of_sight(paths, name, length, straight[..., None], paths.a if opposite is None else opposite)


def _check_vertices(paths: RayPaths, name: str, length: Float[np.ndarray, "r t k"]) -> None:
    """Raises a `UserError` if most paths differ in length from the line through their vertices, or from the straight line if
    they have none, or in direction from their first and last vertices."""
    if not len(paths.interactions):  # not recorded
        return
    here, along = np.broadcast_to(paths.sources[None, :, None], (*length.shape, 3)), np.zeros(length.shape)
    for met, there in zip(paths.interactions != NONE, paths.vertices, strict=True):
        along = along + np.where(met, np.linalg.norm(there - here, axis=-1), 0)
        here = np.where(met[..., None], there, here)
    along = along + np.linalg.norm(paths.targets[:, None, None] - here, axis=-1)
    complete = paths.valid & np.isfinite(along)
    other = complete & (np.abs(length - along) > length * SLACK + SLACK_M)
    if other.sum() > complete.sum() / 2:
        r, t, k = np.argwhere(other)[0]
        long, drawn = length[r, t, k], along[r, t, k]
        raise UserError(
            f"{name}: a path from transmitter {t + 1} to receiver {r + 1} is {long:.3g} m long, but {drawn:.3g} m "
            "through its vertices; give positions in metres, in one frame, with a row of three numbers for every position"
        )
    first = np.where(paths.interactions[0][..., None] != NONE, paths.vertices[0], paths.targets[:, None, None])
    bent = complete & (paths.interactions != NONE).any(0)
    _check_directions(paths, name, bent, {"r": here, "t": first}, "of reflected and diffracted paths", "the nearest vertex")


def _check_line_of_sight(
    paths: RayPaths,
    name: str,
    length: Float[np.ndarray, "r t k"],
    straight: Float[np.ndarray, "r t 1"],
    opposite: Complex[np.ndarray, "r t k"],
) -> None:
    """Raises a `UserError` if lines of sight do not arrive from the other end, or have phases that follow their delays."""
    same, same_m = 1e-4, 0.01  # relative and absolute tolerance within which a path counts as the line of sight
    sight = paths.valid & (np.abs(length - straight) <= straight * same + same_m)
    ends = {"r": paths.sources[None, :, None], "t": paths.targets[:, None, None]}
    _check_directions(paths, name, sight, ends, "of lines of sight", "the other end")
    # The phases of antennas on opposite sides of a centre cancel in the product of their coefficients, as do the signs of
    # polarised ones.
    direct = sight & ~(paths.interactions != NONE).any(0)
    _note_gains(paths, name, direct)
    product, turn = (paths.a * opposite)[direct], carrier(2 * paths.frequency_hz, paths.tau[direct])
    product, turn = product[product != 0], turn[product != 0]
    alike, different, fewest = 0.9, 0.7, 5  # lengths of mean phasors that agree and that differ, and number of lines of sight
    if len(product) < fewest:
        return
    given, with_it, conjugated = (abs((product / np.abs(product) * one).mean()) for one in (1, turn.conj(), turn))
    if given < different and max(with_it, conjugated) > alike:
        raise UserError(
            f"{name}: a contains the phase of the carrier, as that of Sionna's paths.cir() does: lines of sight turn with "
            "their delays; give paths.a"
        )


def _note_gains(paths: RayPaths, name: str, direct: Bool[np.ndarray, "r t k"]) -> None:
    """Warns of lines of sight whose gains are implausible between antennas in free space: far off, or off by one factor, as at
    another frequency."""
    amplitude, length = np.abs(paths.a[direct]), SPEED_OF_LIGHT * paths.tau[direct]
    received = (amplitude > 0) & (length > 0)
    # Lines of sight, usual range of their gains, and least gain and largest deviations of those that are off by one factor.
    fewest, usual_db, factor_db, alike_db = 5, (-40.0, 25.0), 3.0, 0.5
    if received.sum() < fewest:
        return
    gains = 20 * np.log10(amplitude[received]) - np.asarray(free_space_db(length[received], paths.frequency_hz))
    middle = float(np.median(gains))
    alike = np.abs(gains - middle).max() < alike_db
    if not usual_db[0] < middle < usual_db[1] or (alike and abs(middle) > factor_db):
        warnings.warn(
            f"{name}: lines of sight are {abs(middle):.3g} dB {'stronger' if middle > 0 else 'weaker'} than between isotropic "
            f"antennas at {paths.frequency_hz / 1e9:g} GHz; check the frequency, and give gains relative to the transmitted "
            "power, as amplitudes",
            stacklevel=4,
        )


def _check_directions(
    paths: RayPaths, name: str, chosen: Bool[np.ndarray, "r t k"], seen: dict[str, np.ndarray], which: str, where: str
) -> None:
    """Raises a `UserError` if most of the chosen paths do not begin and end in the directions of the points `seen` from the
    receivers ("r") and transmitters ("t")."""
    aside_degrees, nearest_m = 10.0, 0.5  # maximum deviation, and minimum distance of the points
    for end, place in (("r", paths.targets[:, None, None]), ("t", paths.sources[None, :, None])):
        offset = np.broadcast_to(seen[end] - place, (*chosen.shape, 3))
        distance = np.linalg.norm(offset, axis=-1)
        far = chosen & (distance > nearest_m)
        if not far.any():
            continue
        found = directions_of(getattr(paths, f"theta_{end}"), getattr(paths, f"phi_{end}"))
        cosine = np.sum(found * offset, -1)[far] / distance[far]
        if (aside := np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1)))) > aside_degrees:
            raise UserError(
                f"{name}: theta_{end}, phi_{end} {which} deviate {aside:.0f} degrees from {where}; give angles "
                "in the frame of the positions, theta from +z, phi from +x, outwards at both ends"
            )
