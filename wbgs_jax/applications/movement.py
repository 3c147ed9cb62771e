"""The channel over time while transmitters, the receiver and bodies of the scene move.

Paths are traced again at every instant, and phases follow from their exact lengths: the channel is sampled as a sounder would.
Doppler shifts are not computed, they are what the samples show. A rate above 4 v / lambda resolves the waves that one body
moving at v reflects.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Complex, Float

from wbgs_jax._util.cli import point_words
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import map_blocks
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import MaterialProperties, Params
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import WavePlan, arrivals_at, moved_plan
from wbgs_jax.mesh.facets import facets_from_mesh
from wbgs_jax.propagation.displacement import Motion
from wbgs_jax.propagation.image_method import ImageTree
from wbgs_jax.propagation.mechanisms import sizes_of, trace_paths
from wbgs_jax.radio.channel import Paths, decibels
from wbgs_jax.types import SPEED_OF_LIGHT, Mesh, Query, Receiver

SKIN = 7.98, 36.4
"""Relative permittivity and conductivity (S/m) of dry skin at 60 GHz (Gabriel et al., Phys. Med. Biol. 41, 1996)."""
COLUMNS = 12
"""Windows, not counting those that overlap, of the spectrogram of a short channel."""
REACH = 1.0
"""Distance within which a point names a body, metres."""


def person(
    position: Float[np.ndarray, "3"] | Any, height: float = 1.75, width: float = 0.5, depth: float = 0.24, azimuth: float = 0.0
) -> Float[np.ndarray, "8 3"]:
    """Returns the corners of a standard person: an upright prism with a rhombus as its cross-section.

    Both ends of a link see the same edge of a rhombus on either side, so that one diffraction carries the wave around it.
    Around a box it takes two, which a coherent field does not trace.

    Args:
        position: between the feet, world frame, metres.
        height, width, depth: metres.
        azimuth: direction in which the person looks, radians; at 0 towards +x, with the shoulders along y.

    Returns:
        Corners (8, 3), world frame, metres.
    """
    half = np.array([[depth, 0], [0, width], [-depth, 0], [0, -width]]) / 2
    turn = np.array([[np.cos(azimuth), -np.sin(azimuth)], [np.sin(azimuth), np.cos(azimuth)]])
    level = np.pad(half @ turn.T, ((0, 0), (0, 1)))
    return np.concatenate([level, level + np.array([0, 0, height])]) + np.asarray(position, float)


def add_body(
    field: Field,
    params: Params,
    corners: Float[np.ndarray, "n 3"],
    permittivity: float = SKIN[0],
    conductivity: float = SKIN[1],
) -> tuple[Field, Params, int]:
    """Returns a field with paths, its parameters and the number of a convex body that is added to it.

    Its two sides are slabs of half its smallest width each, so that a wave that crosses it crosses all of its material.

    Args:
        field, params: a trained field, of which the receiver-independent part is used.
        corners: of the body, world frame, metres (`person`).
        permittivity: relative permittivity, above 1.
        conductivity: S/m, at all frequencies; by default those of skin at 60 GHz.

    Returns:
        The field, its parameters, and the number of the body in `make_movement`.

    Raises:
        UserError: the field does not trace paths, the corners span no body, or no material has these properties.
    """
    field, params = _tracing(field, params)
    if not (permittivity > 1 and conductivity >= 0):
        given = f"a body of relative permittivity {permittivity:g} and conductivity {conductivity:g} S/m"
        raise UserError(f"{given} is no material; give a permittivity above 1 and a conductivity of at least 0")
    points = np.asarray(corners, float)
    if np.linalg.matrix_rank(points - points.mean(0), tol=1e-4) < 3:
        raise UserError("the corners of the body lie in one plane; give at least four corners that span a volume, in metres")
    hull = trimesh.Trimesh(points, process=False).convex_hull
    one, thickness = np.zeros(len(hull.faces), np.int32), np.array([np.ptp(points @ hull.face_normals.T, axis=0).min() / 2])
    mesh = Mesh(*(jnp.asarray(a) for a in (np.float32(hull.vertices), np.int32(hull.faces), one, one, np.float32(thickness))))
    material = MaterialProperties(np.array([permittivity]), np.array([conductivity]), np.zeros(1), thickness)
    field, params = field.with_body(params, facets_from_mesh(mesh), material)
    return field, params, len(field.motion.shift) - 1


def _tracing(field: Field, params: Params) -> tuple[Calibratable, Params]:
    """Returns the part of a field that traces paths; a field without one is a `UserError`."""
    field, params = field.receiver_independent(params)
    if not isinstance(field, Calibratable):
        raise _untraced(field)
    return field, params


def _untraced(field: Field) -> UserError:
    return UserError(f"the {field.name} field traces no paths; train one that does, on data with a mesh")


def make_movement(
    field: Field,
    instants: int,
    shift: Mapping[int, Any] | None = None,
    turn: Mapping[int, Any] | None = None,
    receiver_shift: Any = None,
    receiver_turn: Any = None,
) -> Motion:
    """Returns the displacements of everything from where a field has it, at T instants.

    Args:
        field: that of `plan_movement`.
        instants: number of instants T.
        shift: displacements (T, 3) of bodies by their numbers, metres, world frame. The number of a body is that of `add_body`,
            or its `Facets.mover` in `field.facets`.
        turn: rotation vectors (T, 3) of bodies about their centres (means of the corners of their facets), radians.
        receiver_shift, receiver_turn: displacements and rotation vectors (T, 3) of the receiver.

    Returns:
        The movement, with a leading axis of instants.

    Raises:
        ValueError: a body that the field does not have, or an array of another shape.
    """
    own = field.ability(Calibratable)
    bodies = 0 if own is None else len(own.field.motion.shift)

    def of_all(some: Mapping[int, Any] | None) -> Float[np.ndarray, "t m 3"]:
        rows = np.zeros((instants, bodies, 3), np.float32)
        for number, values in (some or {}).items():
            if not 0 <= number < bodies:
                raise ValueError(f"there is no body {number}; the field has {bodies}")
            if np.shape(values) != (instants, 3):
                raise ValueError(f"displacements of body {number} have shape {np.shape(values)}; expected ({instants}, 3)")
            rows[:, number] = values
        return rows

    ends = [np.zeros((instants, 3)) if rows is None else rows for rows in (receiver_shift, receiver_turn)]
    return Motion(of_all(shift), of_all(turn), *(np.broadcast_to(np.float32(rows), (instants, 3)) for rows in ends))


def plan_movement(field: Field, params: Params, receiver: Receiver, tx_position: Any, motion: Motion) -> WavePlan:
    """Returns the part of `paths_over_time` that is found on the host: all reflection sequences that may occur.

    Args:
        field, params: a field with paths.
        receiver: at its nominal position.
        tx_position: of the transmitter at T instants (T, 3), or (3,) at rest, world frame, metres.
        motion: of bodies and receiver (`make_movement`).

    Returns:
        The plan, for this movement or for others that stay within 0.25 m of it.

    Raises:
        UserError: the field does not trace paths.
    """
    places = np.broadcast_to(np.asarray(tx_position, np.float32), (len(motion.shift), 3))
    return _tracing(field, params)[0].plan_movement(receiver, places, motion)


@jax.jit
def paths_over_time(params: Any, plan: WavePlan, query: Query, motion: Motion) -> Paths:
    """Returns the paths at T instants, traced and computed anew at each of them.

    Args:
        params: parameters of the field.
        plan: of this movement (`plan_movement`).
        query: the transmitter and the frequency at each instant (`make_query` with T positions).
        motion: where bodies and receiver are at each instant.

    Returns:
        `Paths` with arrays (T, k, ...): `cfr` with delays that are not normalised is the channel over time.
    """

    def at(instant: tuple[Query, Motion]) -> Paths:
        link, moved = instant
        here = moved_plan(plan, moved)
        assert isinstance(here.surfaces, ImageTree), "of `plan_movement`"
        return arrivals_at(params, here, trace_paths(here.surfaces, link.tx_position, sizes_of(plan.config)), link)

    found: Paths = jax.lax.map(at, (query, motion))
    return found


def channel_over_time(
    field: Field,
    params: Params,
    receiver: Receiver,
    query: Query,
    motion: Motion,
    rate_hz: float,
    at_once: int = 200,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, np.ndarray]:
    """Returns the channel at T instants with its paths and its Doppler spectrogram, computed in blocks (host).

    Args:
        field, params: a field with paths, with the bodies that move.
        receiver: at its nominal position.
        query: the transmitter and the frequency at each instant.
        motion: where bodies and receiver are at each instant.
        rate_hz: instants per second.
        at_once: number of instants that are computed together.
        advance: called after every block.

    Returns:
        response (T,), complex, at an element at the array's centre, relative to the transmitted amplitude; power_db (T,);
        path_amplitude (T, k) and path_delay_s (T, k), with amplitude 0 where a path does not exist; doppler_hz (f,),
        doppler_time_s (s,) and doppler_db (f, s) (`doppler_spectrogram`).

    Raises:
        UserError: the field does not trace paths.
    """
    plan = plan_movement(field, params, receiver, query.tx_position, motion)
    _, params = _tracing(field, params)

    def block(rows: tuple[Query, Motion]) -> tuple[Array, Array]:
        found = jax.block_until_ready(paths_over_time(params, plan, *rows))
        advance()
        return found.amplitude, found.length

    amplitude, length = map_blocks(block, (query, motion), at_once)
    kept = (amplitude != 0).any(0)
    response = amplitude.sum(-1)
    window = min(max(len(response) // COLUMNS, 16), 128)
    hertz, seconds, power = doppler_spectrogram(jnp.asarray(response), rate_hz, window)
    return {
        "response": response,
        "power_db": np.asarray(decibels(jnp.abs(response) ** 2)),
        "path_amplitude": amplitude[:, kept],
        "path_delay_s": length[:, kept] / SPEED_OF_LIGHT,
        "doppler_hz": np.asarray(hertz),
        "doppler_time_s": np.asarray(seconds),
        "doppler_db": np.asarray(power),
    }


def position_along(places: Float[np.ndarray, "n 3"], share: Float[np.ndarray, " t"]) -> Float[np.ndarray, "t 3"]:
    """Returns where something is that passes places (metres) at constant speed, after shares of the time (0 to 1)."""
    passed = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    return np.stack([np.interp(share * passed[-1], passed, column) for column in places.T], axis=1)


def nearest_body(field: Field, point: Float[np.ndarray, "3"]) -> int:
    """Returns the number of the body of which a corner or a centre of a facet is nearest to a point (world frame, metres).

    Raises:
        UserError: the field does not trace paths, or no body is within `REACH` of the point.
    """
    own = field.ability(Calibratable)
    if own is None:
        raise _untraced(field)
    corners, number = np.asarray(own.field.facets.corners), np.asarray(own.field.facets.mover)
    samples = np.concatenate([corners, corners.mean(1, keepdims=True)], 1)
    distance = np.linalg.norm(samples - point, axis=-1).min(1)
    if not distance.min() <= REACH:
        raise UserError(
            f"no body of the mesh is within {REACH:g} m of {point_words(point)}; give a point at the one that moves"
        )
    return int(number[distance.argmin()])


def doppler_spectrogram(
    response: Complex[Array, " t"], rate_hz: float, window: int = 128
) -> tuple[Float[Array, " f"], Float[Array, " s"], Float[Array, "f s"]]:
    """Returns the short-time Doppler spectrum of a channel: the power over Doppler shift and time.

    Args:
        response: the channel at one frequency over time.
        rate_hz: samples per second.
        window: samples of a Hann window, at most those of the response; neighbouring ones overlap by three quarters.

    Returns:
        Doppler shifts (f,), hertz, ascending, positive where paths get shorter; times (s,), seconds; decibels (f, s). The mean
        of the powers over time is the Doppler spectrum (Welch 1967).
    """
    window = min(window, len(response))
    hertz, seconds, found = jax.scipy.signal.stft(
        response,
        rate_hz,
        nperseg=window,
        noverlap=window - max(window // 4, 1),
        return_onesided=False,
        boundary=None,
        padded=False,
    )
    power = jnp.fft.fftshift(jnp.abs(found) ** 2, 0)
    return jnp.fft.fftshift(hertz), seconds, decibels(power)
