"""Converts paths of other programs, and measured snapshots, to scene files on which a field can be trained."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float, Inexact

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import group_places, group_transmitters, tx_disjoint_split
from wbgs_jax.data.scene_file import TEST, TRAIN, Room, SceneFile
from wbgs_jax.interchange.ray_paths import RayPaths, carrier, directions_of

FEWEST = 5
"""Minimum number of transmitters."""


def scene_of_paths(
    paths: Sequence[RayPaths],
    element_positions: Float[np.ndarray, "elements 3"],
    name: str,
    vertices: Float[np.ndarray, "vertices 3"] | None = None,
    faces: np.ndarray | None = None,
    seed: int = 0,
    room: Room | None = None,
) -> SceneFile:
    """Returns a scene from paths between the same positions at one or more frequencies: snapshots of an array at every
    receiver, with the world's axes as its local frame. A fifth of the transmitters is used for testing.

    Waves are plane over the array, and its elements are identical: the coefficients `a` already contain the antennas.

    Args:
        paths: one entry per frequency.
        element_positions: of the receivers' arrays, wavelengths.
        name: of the scene.
        vertices: of the scene's surfaces, metres; none by default.
        faces: triangles.
        seed: of the split.
        room: the scene's surfaces with objects and materials (`load_room`), instead of `vertices` and `faces`.

    Returns:
        The scene, for `save_scene`.

    Raises:
        UserError: positions are unknown or differ, or there are too few transmitters.
    """
    first, count = paths[0], len(paths[0].sources)
    places = np.concatenate([first.sources, first.targets])
    if not np.isfinite(places).all():
        raise UserError(
            f"the paths of {name} do not record the positions of transmitters and receivers; give sources and targets"
        )
    if any(not np.allclose(p.sources, first.sources) or not np.allclose(p.targets, first.targets) for p in paths):
        raise UserError(
            f"the paths of {name} at different frequencies have different ends; give the same ones in the same order"
        )
    if count < FEWEST:
        raise UserError(
            f"{name} has {count} transmitters, but training needs {FEWEST}; exchange the ends if it has many receivers"
        )
    order = np.argsort([p.frequency_hz for p in paths])
    snapshots = np.stack([snapshots_of(paths[i], element_positions) for i in order], 2)
    frequencies = np.array([paths[i].frequency_hz for i in order])
    level = np.tile([1.0, 0, 0, 0], (len(first.targets), 1))
    return scene_of_snapshots(
        snapshots, first.sources, frequencies, first.targets, level, element_positions, name, vertices, faces, seed, room
    )


def scene_of_snapshots(
    snapshots: Inexact[np.ndarray, "tx rx freq elements"],
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
    rx_position: Float[np.ndarray, "rx 3"],
    rx_orientation: Float[np.ndarray, "rx 4"],
    element_positions: Float[np.ndarray, "elements 3"],
    name: str,
    vertices: Float[np.ndarray, "vertices 3"] | None = None,
    faces: np.ndarray | None = None,
    seed: int = 0,
    room: Room | None = None,
) -> SceneFile:
    """Returns a scene from measured array snapshots, to be written with `save_scene`. A fifth of the transmitters is used for
    testing.

    Args:
        snapshots: complex voltages of the elements. Only phases between the elements of one snapshot and relative powers
            between snapshots matter. A common gain is learned, so they need not be relative to the transmitted power.
        tx_positions: world frame, metres.
        frequencies_hz: hertz, ascending.
        rx_position: world frame, metres.
        rx_orientation: quaternions (wxyz) from the arrays' frame to the world's; 1 0 0 0 faces +x.
        element_positions: of the receivers' arrays, wavelengths, in their own frame (`planar_array`).
        name: of the scene.
        vertices: of the scene's surfaces, metres; none by default.
        faces: triangles.
        seed: of the split.
        room: the scene's surfaces with objects and materials (`load_room`), instead of `vertices` and `faces`.

    Returns:
        The scene, for `save_scene`.

    Raises:
        UserError: there are too few transmitters, the shapes do not match, or the snapshots are real.
    """
    count, receivers = len(tx_positions), len(rx_position)
    wanted = count, receivers, len(frequencies_hz), len(element_positions)
    if np.shape(snapshots) != wanted:
        raise UserError(
            f"the snapshots of {name} have shape {np.shape(snapshots)}; by transmitter, receiver, frequency and element it "
            f"must be {wanted}"
        )
    if not np.iscomplexobj(snapshots):
        raise UserError(f"the snapshots of {name} are real; give complex voltages, not magnitudes or powers")
    transmitter = group_places(tx_positions, group_transmitters(tx_positions))  # repeated measurements at one place count once
    if (places := len(np.unique(transmitter))) < FEWEST:
        raise UserError(f"{name} has {places} transmitters, but training needs {FEWEST}")
    split = np.full(count, TRAIN, np.int8)
    split[tx_disjoint_split(transmitter, test_fraction=0.2, seed=seed)[1]] = TEST
    surfaces = room or _one_surface(vertices, faces)
    return SceneFile(
        name=name,
        tx_positions=tx_positions,
        frequencies_hz=frequencies_hz,
        rx_position=rx_position,
        rx_orientation=rx_orientation,
        element_positions=np.tile(element_positions, (receivers, 1, 1)),
        vertices=surfaces.vertices,
        faces=surfaces.faces,
        face_part=surfaces.face_part,
        split=split,
        snapshots=np.asarray(snapshots, np.complex64),
        meta={"parts": surfaces.parts} if surfaces.parts else {},
    )


def _one_surface(vertices: np.ndarray | None, faces: np.ndarray | None) -> Room:
    """Returns surfaces without further information; empty if there are no triangles."""
    if vertices is None or faces is None:
        return Room(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.int32))
    part = {"name": "surface", "material": "unknown", "thickness": 0}
    return Room(np.asarray(vertices, np.float32), np.asarray(faces, np.int32), np.zeros(len(faces), np.int32), [part])


def snapshots_of(paths: RayPaths, element_positions: Float[np.ndarray, "elements 3"]) -> Complex[np.ndarray, "t r elements"]:
    """Returns the voltages of the elements of every receiver's array (wavelengths, world frame), including the carrier
    phase."""
    voltage = np.where(paths.valid, paths.a * carrier(paths.frequency_hz, paths.tau), 0)
    direction = directions_of(paths.theta_r, paths.phi_r)
    steering = np.exp(2j * np.pi * np.nan_to_num(direction) @ np.asarray(element_positions).T)
    return np.einsum("rtk,rtke->tre", voltage, steering)
