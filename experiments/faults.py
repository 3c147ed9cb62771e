"""Faults of users' data and scene descriptions, one at a time: a data set with the fault in it.

The truth of the test stays as it is, except for errors of the receiver: phase errors of the array are in all its snapshots.
"""

import dataclasses
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Bool, Complex, Float, Int
from scipy.spatial.transform import Rotation

from wbgs_jax._util.errors import UserError
from wbgs_jax.data import Dataset
from wbgs_jax.data.dataset import Materials

FURNITURE_M = 3.0
"""Parts whose bounding box has a shorter diagonal are furniture."""
PAS_AT_ONCE = 512


@dataclass(frozen=True)
class Fault:
    """Sizes of faults. Lengths and angles are standard deviations along each axis, unless stated otherwise."""

    displaced_m: float = 0
    """Every part of the mesh stands elsewhere ..."""
    tilted_deg: float = 0
    """... and is turned about its centre."""
    missing: float = 0
    """Share of the furniture that the mesh lacks ..."""
    added: float = 0
    """... and share of it that stands in a second place too."""
    thickness_unknown: bool = False
    one_material: bool = False
    """All parts are said to be of one material."""
    wrong_materials: float = 0
    """Share of the parts that are said to be of a material drawn at random."""
    receiver_m: float = 0
    """The receiver stands elsewhere, by so much in a random direction, ..."""
    receiver_deg: float = 0
    """... and is turned by so much about a random axis."""
    array_deg: float = 0
    """Phases of the elements."""
    pattern_unknown: bool = False
    """The elements are said to be isotropic."""
    snr_db: float | None = None
    """Signal-to-noise ratio of the training snapshots."""
    tx: int | None = None
    """Training transmitters."""
    images_only: bool = False
    """8-bit pictures of the spectra instead of snapshots."""


def faulty(dataset: Dataset, fault: Fault, seed: int) -> Dataset:
    """Returns the data set with a fault; equal seeds draw equal faults.

    Raises:
        UserError: the data do not have what is to be wrong.
    """
    _check(dataset, fault)
    dataset = with_wrong_mesh(dataset, fault, np.random.default_rng([seed, 7]))
    dataset = with_wrong_materials(dataset, fault, np.random.default_rng([seed, 8]))
    dataset = with_wrong_receiver(dataset, fault, np.random.default_rng([seed, 9]))
    dataset = with_wrong_snapshots(dataset, fault, np.random.default_rng([seed, 10]))
    if fault.tx is not None:
        kept = np.random.default_rng([seed, 11]).permutation(np.unique(dataset.tx_index[dataset.train]))[: fault.tx]
        dataset = dataclasses.replace(dataset, train=dataset.train[np.isin(dataset.tx_index[dataset.train], kept)])
    return as_images(dataset) if fault.images_only else dataset


def _check(dataset: Dataset, fault: Fault) -> None:
    lacks = {
        "mesh": _of_mesh(fault) and not len(dataset.faces),
        "materials": (fault.one_material or fault.wrong_materials or fault.thickness_unknown) and dataset.materials is None,
        "snapshots": (fault.snr_db is not None or fault.array_deg) and not dataset.has("snapshots"),
    }
    for what, lacking in lacks.items():
        if lacking:
            raise UserError(f"{dataset.name} has no {what} that could be wrong; choose another variant")


def _of_mesh(fault: Fault) -> bool:
    return bool(fault.displaced_m or fault.tilted_deg or fault.missing or fault.added)


def with_wrong_mesh(dataset: Dataset, fault: Fault, rng: np.random.Generator) -> Dataset:
    """Returns it with parts that stand elsewhere, are turned, are missing or stand there twice."""
    if not _of_mesh(fault):
        return dataset
    part, vertices = parts_of(dataset), dataset.vertices.astype(np.float64)
    shift = rng.normal(0, fault.displaced_m, (part.max() + 1, 3))
    turn = np.deg2rad(rng.normal(0, fault.tilted_deg, (part.max() + 1, 3)))
    centre = np.array([vertices[part == k].mean(0) for k in range(part.max() + 1)])
    arm = vertices - centre[part]
    vertices = centre[part] + Rotation.from_rotvec(turn[part]).apply(arm) + shift[part]
    dataset = dataclasses.replace(dataset, vertices=vertices.astype(np.float32))
    sizes = {int(k): np.linalg.norm(np.ptp(arm[part == k], axis=0)) for k in np.unique(part[dataset.faces])}
    movable = rng.permutation([k for k, size in sizes.items() if size < FURNITURE_M]).astype(int)
    gone, doubled = (movable[: round(share * len(movable))] for share in (fault.missing, fault.added))
    if len(doubled):
        dataset = _doubled(dataset, part, doubled, rng)
    return _without(dataset, np.isin(part[dataset.faces[:, 0] % len(part)], gone) & (dataset.faces[:, 0] < len(part)))


def parts_of(dataset: Dataset) -> Int[np.ndarray, " vertices"]:
    """Returns the number of the connected part that every vertex belongs to."""
    corners = trimesh.Trimesh(dataset.vertices, dataset.faces, process=False)
    return trimesh.graph.connected_component_labels(corners.edges, node_count=len(dataset.vertices))


def with_wrong_materials(dataset: Dataset, fault: Fault, rng: np.random.Generator) -> Dataset:
    """Returns it with parts said to be of other materials, or of unknown thickness."""
    known = dataset.materials
    if known is None:
        return dataset
    if fault.one_material:
        known = Materials(np.zeros_like(known.material), ("all",), np.zeros(1))
    if fault.wrong_materials:
        part = parts_of(dataset)[dataset.faces[:, 0]]
        wrong = rng.random(part.max() + 1) < fault.wrong_materials
        other = rng.integers(len(known.names), size=part.max() + 1)
        material = np.where(wrong[part], other[part], known.material).astype(np.int32)
        known = dataclasses.replace(known, material=material)
    if fault.thickness_unknown:
        known = dataclasses.replace(known, thickness=np.zeros_like(known.thickness))
    return dataclasses.replace(dataset, materials=known)


def with_wrong_receiver(dataset: Dataset, fault: Fault, rng: np.random.Generator) -> Dataset:
    """Returns it with a receiver that is said to stand elsewhere, to be turned, or to have isotropic elements."""
    receivers, n = dataset.receivers, dataset.n_receivers
    step, axis = (_directions(rng, n) for _ in range(2))
    turn = Rotation.from_rotvec(np.deg2rad(fault.receiver_deg) * axis)
    xyzw = (turn * Rotation.from_quat(np.roll(receivers.orientation, -1, axis=1))).as_quat()
    exponents = receivers.antenna.exponents * (0 if fault.pattern_unknown else 1)
    wrong = dataclasses.replace(
        receivers,
        position=jnp.asarray(np.asarray(receivers.position) + fault.receiver_m * step, jnp.float32),
        orientation=jnp.asarray(np.roll(xyzw, 1, axis=1), jnp.float32),
        antenna=dataclasses.replace(receivers.antenna, exponents=exponents),
    )
    return dataclasses.replace(dataset, receivers=wrong)


def with_wrong_snapshots(dataset: Dataset, fault: Fault, rng: np.random.Generator) -> Dataset:
    """Returns it with noise on the training snapshots, and with phase errors of the elements on all."""
    if not dataset.has("snapshots"):
        return dataset
    snapshots = dataset.observations["snapshots"]
    if fault.array_deg:
        snapshots = snapshots * np.exp(1j * np.deg2rad(rng.normal(0, fault.array_deg, snapshots.shape[-1])))
    if fault.snr_db is not None:
        snapshots = snapshots.copy()
        snapshots[dataset.train] += _noise(snapshots[dataset.train], fault.snr_db, rng)
    return dataset.with_observations(snapshots=snapshots.astype(np.complex64))


def as_images(dataset: Dataset) -> Dataset:
    """Returns it with the spectra as 8-bit pictures."""
    blocks = [
        np.asarray(dataset.pas(np.arange(start, min(start + PAS_AT_ONCE, len(dataset)))))
        for start in range(0, len(dataset), PAS_AT_ONCE)
    ]
    images = np.concatenate([(255 * block).round().astype(np.uint8) for block in blocks])
    return dataset.with_observations(pas=images)


def _without(dataset: Dataset, gone: Bool[np.ndarray, " faces"]) -> Dataset:
    """Returns it without some triangles."""
    kept = np.flatnonzero(~gone)
    return _with_triangles(dataset, dataset.faces[kept], kept)


def _doubled(
    dataset: Dataset, part: Int[np.ndarray, " vertices"], chosen: Int[np.ndarray, " k"], rng: np.random.Generator
) -> Dataset:
    """Returns it with copies of some parts elsewhere in the room, at their height."""
    vertices, faces, copied = [dataset.vertices], [dataset.faces], [np.arange(len(dataset.faces))]
    low, high = dataset.vertices.min(0), dataset.vertices.max(0)
    for k in chosen:
        own, triangles = np.flatnonzero(part == k), np.flatnonzero(part[dataset.faces[:, 0]] == k)
        place = rng.uniform(low, high) - dataset.vertices[own].mean(0)
        number = np.zeros(len(part), np.int64)
        number[own] = sum(map(len, vertices)) + np.arange(len(own))
        vertices.append((dataset.vertices[own] + [*place[:2], 0]).astype(np.float32))
        faces.append(number[dataset.faces[triangles]].astype(np.int32))
        copied.append(triangles)
    dataset = dataclasses.replace(dataset, vertices=np.concatenate(vertices))
    return _with_triangles(dataset, np.concatenate(faces), np.concatenate(copied))


def _with_triangles(dataset: Dataset, faces: Int[np.ndarray, "k 3"], like: Int[np.ndarray, " k"]) -> Dataset:
    """Returns it with other triangles, each of the part and material that an old one has."""
    known, part = dataset.materials, dataset.face_part
    return dataclasses.replace(
        dataset,
        faces=faces,
        face_part=None if part is None else part[like],
        materials=known and dataclasses.replace(known, material=known.material[like]),
    )


def _noise(
    snapshots: Complex[np.ndarray, "n elements"], snr_db: float, rng: np.random.Generator
) -> Complex[np.ndarray, "n elements"]:
    """Returns complex normal noise, so many decibels below the mean power of every snapshot."""
    power = np.mean(np.abs(snapshots) ** 2, -1, keepdims=True) * 10 ** (-snr_db / 10)
    return np.sqrt(power / 2) * (rng.normal(size=snapshots.shape) + 1j * rng.normal(size=snapshots.shape))


def _directions(rng: np.random.Generator, n: int) -> Float[np.ndarray, "n 3"]:
    drawn = rng.normal(size=(n, 3))
    return drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)
