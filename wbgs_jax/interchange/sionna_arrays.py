"""Array snapshots from paths of Sionna RT (`sionna.rt.Paths`), computed from Sionna's own coefficients, and impulse responses
in the form of Sionna PHY.

`a` has axes receivers, their antennas, transmitters, their antennas, paths. With a synthetic array all antennas of a device
share its paths, and the coefficients contain the phases of the antenna positions; otherwise each antenna has paths of its own.
Antennas of two polarisations are ordered by polarisation.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.spatial.transform import Rotation

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.scene_file import Room, SceneFile
from wbgs_jax.interchange.ray_paths import (
    ARRAYS,
    OF_PATHS,
    array_of,
    backwards,
    carrier,
    check_arrays,
    check_paths,
    directions_of,
    frequency_of,
    from_sionna,
    places_of,
)
from wbgs_jax.interchange.scenes import scene_of_paths, scene_of_snapshots
from wbgs_jax.propagation.transport import element_voltages
from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array
from wbgs_jax.radio.channel import Paths
from wbgs_jax.types import Receiver

DEFAULT = 4, 4
"""Rows and columns of the default array."""
OFF_WAVELENGTHS = 0.02
"""Maximum distance between antenna positions of arrays that count as the same, wavelengths."""

Shape = tuple[int, int]


class _Device(NamedTuple):
    """Position (metres), orientation (quaternion wxyz) and elements (wavelengths, local frame) of a receiver."""

    place: Float[np.ndarray, "3"]
    orientation: Float[np.ndarray, "4"]
    elements: Float[np.ndarray, "e 3"]


@jax.jit
def cir_of_paths(
    paths: Paths, receiver: Receiver, frequency_hz: Float[Array, ""] | float, gains: Any = 1.0
) -> tuple[Complex[Array, "b 1 elements 1 1 k 1"], Float[Array, "b 1 1 k"]]:
    """Returns impulse responses as Sionna PHY's channel models and its `CIRDataset` have them, for one receiver with all of its
    elements, one transmitter with one antenna, and one instant.

    The coefficients contain the phase of the carrier over the whole length of a path, and delays count from the first path of a
    link, as those of Sionna RT's `Paths.cir(normalize_delays=True)`.

    Args:
        paths: of B links at one receiver and one frequency (`predict_paths`).
        receiver: the receiver.
        frequency_hz: of the carrier.
        gains: (elements,), complex gains of the receiver's elements (`predict_gains`); by default they are ideal.

    Returns:
        Coefficients `a` (B, 1, elements, 1, 1, k, 1), and 0 for padding; delays `tau` (B, 1, 1, k), seconds, and 0 for padding.

    Example:
        >>> a, tau = cir_of_paths(predict_paths(trained, receiver, places, 28e9), receiver, 28e9)  # doctest: +SKIP
    """
    hertz = jnp.asarray(frequency_hz, jnp.float32)
    voltages = jax.vmap(lambda one: element_voltages(one, receiver, hertz))(jax.tree.map(jnp.asarray, paths))
    _, delays = paths.cir()
    voltages = voltages * gains
    return voltages.swapaxes(1, 2)[:, None, :, None, None, :, None], jnp.maximum(delays, 0)[:, None, None]


def scene_of_sionna(
    paths: Any,
    name: str,
    frequency_hz: float | None = None,
    shape: Shape | None = None,
    port: int | None = None,
    tx_antenna: int | None = None,
    swap: bool = False,
    room: Room | None = None,
    source: str = "",
) -> SceneFile:
    """Returns the snapshots of the receivers' arrays for every transmitter, as a scene to train on.

    For receivers with a single antenna, plane waves over an array of `shape` are used instead.

    Args:
        paths: a `sionna.rt.Paths` object, or a mapping with its arrays.
        name: of the scene.
        frequency_hz: of the carrier, if the paths do not record it.
        shape: rows and columns of the receivers' arrays, half a wavelength apart; by default that of the paths, or else 4x4.
        port: for antennas with two polarisations: 1 or 2.
        tx_antenna: for transmitters with several antennas: 1, 2, ...
        swap: whether to exchange transmitters and receivers.
        room: the scene's surfaces (`load_room`).
        source: name of the paths in error messages; by default the name of the scene.

    Returns:
        The scene, for `save_scene`.

    Raises:
        UserError: something is missing or contradictory, or several antennas require a choice.
    """
    what = source or name
    arrays = {key: found for key in OF_PATHS if (found := array_of(paths, key)) is not None}
    if "a" in arrays and arrays["a"].ndim > ARRAYS:
        raise UserError(
            f"a of {what} has {arrays['a'].ndim} axes, including time, as that of paths.cir() and of Sionna before 1.0; "
            "give `paths.a` of Sionna RT 1.0 or later"
        )
    check_arrays(arrays, f"the paths of {what}")
    for end in ("sources", "targets"):
        if (found := array_of(paths, end)) is not None:
            arrays[end] = places_of(found, not isinstance(paths, Mapping), f"{end} of {what}")
    frequency = frequency_of(array_of(paths, "frequency_hz"), frequency_hz, what)
    arrays = _swapped(arrays) if swap else arrays
    if arrays["a"].ndim < ARRAYS:
        single = from_sionna(arrays, frequency)
        check_paths(single, what)
        return scene_of_paths([single], planar_array(*(shape or DEFAULT)), name, room=room)
    tx_index = _chosen(arrays["a"].shape[3], tx_antenna, f"the transmitters of {what} have", "--tx-antenna")
    chosen, shape = _elements(arrays["a"], shape, port, what)
    first = from_sionna(arrays, frequency, antennas=(int(chosen[0]), tx_index))
    shared = arrays["tau"].ndim < ARRAYS
    across = int(chosen[-1]), arrays["a"].shape[3] - 1 - tx_index
    check_paths(first, what, from_sionna(arrays, frequency, antennas=across).a if shared else None)
    if len(chosen) == 1:
        return scene_of_paths([first], planar_array(*(shape or DEFAULT)), name, room=room)
    a, tau, direction = _of_antennas(arrays, chosen, tx_index)
    valid = np.isfinite(a) & (tau >= 0)
    snapshots = np.where(valid, a * carrier(first.frequency_hz, tau), 0).sum(-1)  # receiver, antenna, transmitter
    if not shared:
        places = np.asarray(arrays.get("targets", np.full((a.shape[0], 3), np.nan)), np.float64)
        devices = _by_places(places, a.shape[:2], shape, SPEED_OF_LIGHT / first.frequency_hz, what)
    else:
        assert shape is not None, "_elements returns a shape for synthetic arrays"
        turns = _orientations(np.where(valid, a, 0), direction, shape, what)
        devices = [_Device(place, turn, planar_array(*shape)) for place, turn in zip(first.targets, turns, strict=True)]
    return scene_of_snapshots(
        np.moveaxis(snapshots, (0, 1, 2), (1, 2, 0))[:, :, None],
        first.sources,
        np.array([first.frequency_hz]),
        np.stack([one.place for one in devices]),
        np.stack([one.orientation for one in devices]),
        devices[0].elements,
        name,
        room=room,
    )


def _chosen(count: int, wanted: int | None, what: str, option: str) -> int:
    """Returns the index of one of several antennas."""
    if wanted is None and count > 1:
        raise UserError(f"{what} {count} antennas; choose one: {option} 1 to {count}")
    if wanted is not None and not 1 <= wanted <= count:
        raise UserError(f"{what} {count} antennas; {option} {wanted} is out of range")
    return 0 if wanted is None else wanted - 1


def _elements(
    a: Complex[np.ndarray, "r e t s k"], shape: Shape | None, port: int | None, name: str
) -> tuple[Any, Shape | None]:
    """Returns the indices of a receiver's antennas that form its array, and the array's rows and columns if known."""
    count, form = a.shape[1], shape
    if shape is None and count in (1, 2, 16, 32):
        form = DEFAULT
    size = 0 if form is None else form[0] * form[1]
    ports, elements = {size: (1, size), 2 * size: (2, size), 1: (1, 1), 2: (2, 1)}.get(count, (0, 0))
    if not ports and (shape is not None or (count % 2 == 0 and port is not None)):
        raise UserError(
            f"the receivers of {name} have {count} antennas; --array {shape} does not fit: give its rows and columns"
        )
    if not ports:  # an array of any geometry
        return np.arange(count), None
    if ports == 1:
        return np.arange(elements), form
    power = [f"{10 * np.log10(np.mean(np.abs(half) ** 2) + 1e-30):.0f} dB" for half in np.split(a, 2, 1)]
    if port not in (1, 2):
        raise UserError(
            f"the receivers of {name} have {count} antennas: two polarisations of {elements} (mean power of a path "
            f"{power[0]} and {power[1]}); choose --port 1 or --port 2, or give the shape of the array, --array ROWSxCOLUMNS"
        )
    return np.arange(elements) + (port - 1) * elements, form


def _of_antennas(arrays: dict[str, np.ndarray], chosen: Any, tx_index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns coefficients and delays (receiver, antenna, transmitter, path), and the directions of arrival (receiver,
    transmitter, path, 3) if all antennas of a device share them."""
    a = np.asarray(arrays["a"][:, :, :, tx_index][:, chosen], np.complex128)
    if arrays["tau"].ndim < ARRAYS:
        valid = np.asarray(arrays.get("valid", arrays["tau"] >= 0), bool)
        tau = np.where(valid, np.asarray(arrays["tau"], np.float64), -1)[:, None]
        angles = (np.asarray(arrays[angle], np.float64) for angle in ("theta_r", "phi_r"))
        return a, np.broadcast_to(tau, a.shape), directions_of(*angles)
    own = np.asarray(chosen) % arrays["tau"].shape[1]  # polarisations may share their delays
    tau = np.asarray(arrays["tau"], np.float64)[:, :, :, min(tx_index, arrays["tau"].shape[3] - 1)][:, own]
    if "valid" in arrays:
        tau = np.where(np.asarray(arrays["valid"], bool)[:, :, :, min(tx_index, arrays["valid"].shape[3] - 1)][:, own], tau, -1)
    return a, tau, np.zeros((len(a), 0, 0, 3))


def _by_places(
    places: Float[np.ndarray, "n 3"], count: tuple[int, int], shape: Shape | None, wavelength: float, name: str
) -> list[_Device]:
    """Returns receivers computed from the positions of their antennas."""
    receivers, antennas = count
    if len(places) % receivers or len(places) // receivers not in (antennas, 2 * antennas):
        raise UserError(
            f"{name} has {len(places)} targets for {receivers} receivers of {antennas} antennas; give all positions"
        )
    if not np.isfinite(places).all():
        raise UserError(f"{name} does not record the positions of its antennas; give targets")
    own = places.reshape(receivers, -1, 3)[:, :antennas]
    centres = own.mean(1)
    offsets = (own - centres[:, None]) / wavelength
    if shape is not None:
        regular = planar_array(*shape)
        turns = [Rotation.align_vectors(one, regular)[0] for one in offsets]
        worst = max(np.abs(turn.apply(regular) - one).max() for turn, one in zip(turns, offsets, strict=True))
        if worst < OFF_WAVELENGTHS:
            return [_Device(place, _quaternion(turn), regular) for place, turn in zip(centres, turns, strict=True)]
    if np.abs(offsets - offsets[0]).max() > OFF_WAVELENGTHS:
        raise UserError(f"the receivers of {name} have arrays of different shapes or orientations; give --array ROWSxCOLUMNS")
    level = np.array([1.0, 0, 0, 0])
    return [_Device(place, level, offsets[0]) for place in centres]


def _orientations(
    a: Complex[np.ndarray, "r e t k"], direction: Float[np.ndarray, "r t k 3"], shape: Shape, name: str
) -> list[Float[np.ndarray, "4"]]:
    """Returns the orientations (wxyz) of the receivers' planar arrays; a receiver without any path has that of the others if
    these agree."""
    found = {r: _orientation(one, direction[r], shape, name) for r, one in enumerate(a) if one.any()}
    own = np.array([_rotation(one).apply(planar_array(*shape)) for one in found.values()])
    silent = [r for r in range(len(a)) if r not in found]
    if silent and (not found or np.abs(own - own[0]).max() > OFF_WAVELENGTHS):
        raise UserError(
            f"receiver {silent[0] + 1} of {name} has no path, so that the orientation of its array is unknown; remove it, or "
            "trace with synthetic_array=False"
        )
    return [found.get(r, next(iter(found.values()))) for r in range(len(a))]


def _orientation(
    a: Complex[np.ndarray, "e t k"], direction: Float[np.ndarray, "t k 3"], shape: Shape, name: str
) -> Float[np.ndarray, "4"]:
    """Returns the orientation (wxyz) of a planar array, computed from the phases between neighbours: at half a wavelength,
    these are the direction cosines."""
    rows, columns = shape
    received = np.isfinite(a).all(0) & (np.abs(a) > 0).all(0)
    own, towards = a[:, received].reshape(columns, rows, -1), direction[received]
    measured = []
    for axis, neighbours, sign in ((1, own[1:] * own[:-1].conj(), 1.0), (2, own[:, 1:] * own[:, :-1].conj(), -1.0)):
        if neighbours.size:
            measured.append((axis, sign * np.angle(neighbours.sum((0, 1))) / np.pi))
    turn = _turn(measured, towards, np.abs(own[0, 0]))
    candidates = [Rotation.identity(), *([] if turn is None else [turn])]
    fits = [_fit(own.reshape(rows * columns, -1), towards, one.apply(planar_array(rows, columns))) for one in candidates]
    least_fit = 0.995  # minimum correlation of a path's coefficients with the steering vector of an array
    if max(fits) < least_fit:
        raise UserError(
            f"the phases of {name} do not fit a {rows}x{columns} array of half a wavelength (correlation {max(fits):.3f}); "
            "give its shape, --array ROWSxCOLUMNS, or trace with synthetic_array=False"
        )
    unrotated = fits[0] >= least_fit and fits[0] >= max(fits) - 1e-4
    return _quaternion(candidates[0 if unrotated else int(np.argmax(fits))])


def _turn(
    measured: list[tuple[int, np.ndarray]], towards: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"]
) -> Rotation | None:
    """Returns the rotation whose axes have the measured direction cosines; None if the directions do not determine it."""
    axes, found = [], []
    wrapped = 0.95  # direction cosine between neighbours (phase in half turns) beyond which the phase may have wrapped
    # Smallest singular value of the directions of paths; below it they lie in a plane and determine at most two axes of an
    # array.
    span = 1e-3
    for axis, cosine in measured:
        reliable = np.abs(cosine) < wrapped
        scale = np.sqrt(weight[reliable] / max(weight[reliable].max(initial=0), 1e-300))[:, None]
        if reliable.sum() < 3 or np.linalg.svd(scale * towards[reliable], compute_uv=False)[-1] < span:
            return None
        solution = np.linalg.lstsq(scale * towards[reliable], scale[:, 0] * cosine[reliable], rcond=None)[0]
        axes.append(np.eye(3)[axis])
        found.append(solution / np.linalg.norm(solution))
    return Rotation.align_vectors(np.array(found), np.array(axes))[0] if found else None


def _fit(a: Complex[np.ndarray, "e n"], towards: Float[np.ndarray, "n 3"], elements: Float[np.ndarray, "e 3"]) -> float:
    """Returns the power-weighted correlation of coefficients with steering vectors, over all paths."""
    steering = np.exp(2j * np.pi * elements @ towards.T)
    matched = np.abs((a * steering.conj()).sum(0)) ** 2 / len(a)
    return float(np.sqrt(matched.sum() / max((np.abs(a) ** 2).sum(), 1e-300)))


def _quaternion(turn: Rotation) -> Float[np.ndarray, "4"]:
    return np.roll(turn.as_quat(), 1)


def _rotation(quaternion: Float[np.ndarray, "4"]) -> Rotation:
    return Rotation.from_quat(np.roll(quaternion, -1))


def _swapped(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns the paths with transmitters and receivers exchanged."""
    other = {"theta_t": "theta_r", "phi_t": "phi_r", "sources": "targets"}
    other |= {value: key for key, value in other.items()}

    def exchanged(name: str, values: np.ndarray) -> np.ndarray:
        if name in ("sources", "targets"):
            return values
        before = int(name in ("interactions", "vertices"))
        if before and "interactions" in arrays:
            values = backwards(values, arrays["interactions"])
        antennas = values.ndim - before - int(name == "vertices") == ARRAYS
        pairs = ((0, 2), (1, 3)) if antennas else ((0, 1),)
        for one, two in pairs:
            values = np.swapaxes(values, before + one, before + two)
        return values

    return {other.get(name, name): exchanged(name, values) for name, values in arrays.items()}
