"""A made-up room that needs no simulator: the line of sight and one mirror image in closed form, at three frequencies."""

import dataclasses

import numpy as np

from wbgs_jax.config import CalibrationConfig, DensityConfig, LoopConfig, OptimConfig, Settings, changed
from wbgs_jax.data import scene_dataset
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.scene_file import SceneFile
from wbgs_jax.fields import get_field
from wbgs_jax.fields.coherent import WaveConfig
from wbgs_jax.fields.hybrid import HybridConfig
from wbgs_jax.fields.nerf2 import Nerf2Config
from wbgs_jax.fields.wideband import WidebandConfig
from wbgs_jax.fields.wrfgs import without_frequency
from wbgs_jax.radio.array import planar_array
from wbgs_jax.types import ElementUnit

FREQUENCIES_HZ = np.array([1e9, 10e9, 94e9])
RX = np.array([0.3, -0.2, 1.0])
RECEIVERS = np.stack([RX, [-2.2, 1.9, 1.4], [2.1, -1.5, 0.8]])
TURNS = (0.0, -0.7, 2.1)
"""Of the receivers about the vertical, radians."""
FIXED_ARRAY_HZ = 10e9
ROOM = np.array([[-3.0, -2.0, 0.0], [3.0, 2.5, 2.8]])
SPEED_OF_LIGHT = 299_792_458.0
REFLECTION = -0.6


def tiny_scene(
    n_tx: int = 6, seed: int = 0, n_rx: int = 1, kind: str = "snapshot", unit: ElementUnit = "wavelengths"
) -> SceneFile:
    """A box-shaped room with one reflecting wall at the largest x; every third transmitter is a test one.

    An array in metres has its elements half a wavelength apart at `FIXED_ARRAY_HZ`.
    """
    tx = np.random.default_rng(seed).uniform(ROOM[0] + 0.3, ROOM[1] - 0.3, (n_tx, 3))
    corners = np.stack(np.meshgrid(*ROOM.T, indexing="ij"), -1).reshape(-1, 3)  # x slowest: corner 4 i + 2 j + k
    quads = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
    faces = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    elements = planar_array() * (1 if unit == "wavelengths" else SPEED_OF_LIGHT / FIXED_ARRAY_HZ)
    heard = np.stack([snapshots(tx, rx, turn, unit) for rx, turn in zip(RECEIVERS[:n_rx], TURNS, strict=False)], 1)
    scene = SceneFile(
        name="box",
        snapshots=heard.astype(np.complex64),
        tx_positions=tx,
        frequencies_hz=FREQUENCIES_HZ,
        rx_position=RECEIVERS[:n_rx],
        rx_orientation=np.array([[np.cos(turn / 2), 0, 0, np.sin(turn / 2)] for turn in TURNS[:n_rx]]),
        element_positions=np.stack([elements] * n_rx),
        element_unit=unit,
        vertices=corners.astype(np.float32),
        faces=faces.astype(np.int32),
        face_part=np.zeros(len(faces), np.int32),
        split=(np.arange(n_tx) % 3 == 2).astype(np.int8),
        meta={"parts": [{"name": "box", "material": "concrete", "thickness": 0.1}]},
    )
    if kind == "snapshot":
        return scene
    if kind == "power":
        power_db = 10 * np.log10((np.abs(heard) ** 2).mean(-1))
        return dataclasses.replace(scene, snapshots=None, power_db=power_db.astype(np.float32))
    dataset = scene_dataset(scene)
    pas = np.round(255 * np.asarray(dataset.pas(np.arange(len(dataset))))).astype(np.uint8)
    return dataclasses.replace(scene, snapshots=None, pas=pas.reshape(*heard.shape[:3], *pas.shape[1:]))


def snapshots(tx: np.ndarray, rx: np.ndarray = RX, turn: float = 0.0, unit: ElementUnit = "wavelengths") -> np.ndarray:
    """Path by path: amplitude / distance, carrier phase, array phases; the receiver is turned about z by `turn` (radians)."""
    mirrored = tx * [-1, 1, 1] + [2 * ROOM[1, 0], 0, 0]
    to_local = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]]).T
    scale = np.ones(len(FREQUENCIES_HZ)) if unit == "wavelengths" else FREQUENCIES_HZ / FIXED_ARRAY_HZ
    total = np.zeros((len(tx), len(FREQUENCIES_HZ), 16), complex)
    for source, amplitude in ((tx, 1.0), (mirrored, REFLECTION)):
        distance = np.linalg.norm(source - rx, axis=1)
        array_phase = 2 * np.pi * (source - rx) @ to_local @ planar_array().T / distance[:, None]
        carrier_phase = -2 * np.pi * FREQUENCIES_HZ * distance[:, None] / SPEED_OF_LIGHT
        gain = amplitude / distance[:, None] * np.exp(1j * carrier_phase)
        total += gain[:, :, None] * np.exp(1j * array_phase[:, None] * scale[:, None])
    return total


def tiny_dataset(n_tx: int = 6, **changes) -> Dataset:
    """`tiny_scene` as a data set."""
    return scene_dataset(tiny_scene(n_tx, **changes))


FIELDS = {
    "wideband": WidebandConfig(
        gaussians=60, width=8, depth=2, skip=1, radiance_widths=(8,), gaussian_octaves=2, tx_octaves=2, frequency_octaves=2
    ),
    "nerf2": Nerf2Config(samples=3, directions=12, width=8, depth=2, skip=1, radiance_widths=(8,), point_octaves=2),
    "wave": WaveConfig(mirror_areas=(0.0, 0.0), specular_tried=64, specular_kept=32, diffracted_tried=32, diffracted_kept=16),
}
FIELDS["wrfgs"] = without_frequency(FIELDS["wideband"])
FIELDS["hybrid"] = HybridConfig(FIELDS["wave"], FIELDS["wideband"])


def tiny_settings(field_name: str = "wideband", **changes) -> Settings:
    """Settings that train within seconds; keywords replace values of a section: `field={"width": 4}`."""
    hooks = [name.rpartition(".")[2] for name in get_field(field_name).hooks]
    settings = Settings(
        field=FIELDS[field_name],
        optim=OptimConfig(steps=8, batch=2, final_fraction=1.0, virtual=0.0),
        loop=LoopConfig(epoch_steps=2, evaluate_every=8, evaluate_spectra=2, checkpoint_every=4, keep_checkpoints=2),
        density=DensityConfig(every=0, reset_every=0) if "density" in hooks else None,
        calibration=CalibrationConfig(rounds=0, antenna_rounds=0, spurious_spectra=0, geometry=False, absorption_spectra=0)
        if "calibration" in hooks
        else None,
    )
    return changed(settings, changes)
