"""A made-up room that needs no simulator: the line of sight and one mirror image in closed form, at three frequencies."""

import dataclasses
import functools

import numpy as np

from wbgs_jax import optim, train_step
from wbgs_jax.array import planar_array
from wbgs_jax.config import DensityConfig, LoopConfig, OptimConfig, Settings, WidebandConfig
from wbgs_jax.data import scene_dataset
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.schema import SceneFile

FREQUENCIES_HZ = np.array([1e9, 10e9, 94e9])
RX = np.array([0.3, -0.2, 1.0])
ROOM = np.array([[-3.0, -2.0, 0.0], [3.0, 2.5, 2.8]])
SPEED_OF_LIGHT = 299_792_458.0
REFLECTION = -0.6


def tiny_scene(n_tx: int = 6, seed: int = 0) -> SceneFile:
    """A box-shaped room with one reflecting wall at the largest x; every third transmitter is a test one."""
    tx = np.random.default_rng(seed).uniform(ROOM[0] + 0.3, ROOM[1] - 0.3, (n_tx, 3))
    corners = np.stack(np.meshgrid(*ROOM.T, indexing="ij"), -1).reshape(-1, 3)  # x slowest: corner 4 i + 2 j + k
    quads = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
    faces = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return SceneFile(
        name="box",
        snapshots=snapshots(tx).astype(np.complex64),
        tx_positions=tx,
        frequencies_hz=FREQUENCIES_HZ,
        rx_position=RX,
        rx_orientation=np.array([1.0, 0, 0, 0]),
        element_positions=planar_array(),
        vertices=corners.astype(np.float32),
        faces=faces.astype(np.int32),
        face_part=np.zeros(len(faces), np.int32),
        split=(np.arange(n_tx) % 3 == 2).astype(np.int8),
        meta={"parts": [{"name": "box", "material": "concrete", "thickness": 0.1}]},
    )


def snapshots(tx: np.ndarray) -> np.ndarray:
    """Path by path: amplitude / distance, the carrier phase, and the array's phases."""
    mirrored = tx * [-1, 1, 1] + [2 * ROOM[1, 0], 0, 0]
    total = np.zeros((len(tx), len(FREQUENCIES_HZ), 16), complex)
    for source, amplitude in ((tx, 1.0), (mirrored, REFLECTION)):
        distance = np.linalg.norm(source - RX, axis=1)
        array_phase = 2 * np.pi * (source - RX) @ planar_array().T / distance[:, None]
        carrier_phase = -2 * np.pi * FREQUENCIES_HZ * distance[:, None] / SPEED_OF_LIGHT
        gain = amplitude / distance[:, None] * np.exp(1j * carrier_phase)
        total += gain[:, :, None] * np.exp(1j * array_phase)[:, None]
    return total


def tiny_dataset(n_tx: int = 6) -> Dataset:
    """`tiny_scene` as a data set."""
    return scene_dataset(tiny_scene(n_tx))


def tiny_settings(**changes) -> Settings:
    """Settings that train within seconds; keywords replace fields of a section: `density={"every": 2}`."""
    settings = Settings(
        wideband=WidebandConfig(
            gaussians=60, width=8, depth=2, skip=1, radiance_widths=(8,), gaussian_octaves=2, tx_octaves=2, frequency_octaves=2
        ),
        optim=OptimConfig(steps=8, batch=2, final_fraction=1.0),
        density=DensityConfig(every=0, reset_every=0),
        loop=LoopConfig(epoch_steps=2, evaluate_every=8, evaluate_spectra=2, checkpoint_every=4, keep_checkpoints=2),
    )
    sections = {name: dataclasses.replace(getattr(settings, name), **values) for name, values in changes.items()}
    return dataclasses.replace(settings, **sections)


make_optimizer = functools.cache(optim.make_optimizer)
make_epoch = functools.cache(train_step.make_epoch)
"""As the originals, but equal arguments share one compilation within a process."""
