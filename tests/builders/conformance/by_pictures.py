"""Folders of spectra and clouds of Gaussians: pixels at their directions, Gaussians as their format has them, or refused."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from builders.conformance.entries import entries
from wbgs_jax.data import load_dataset
from wbgs_jax.interchange.gaussian_ply import SH_CONSTANT, read_gaussians
from wbgs_jax.radio.array import pas_directions

RECEIVER = np.array([1.0, 2.0, 0.5])
TRANSMITTERS = RECEIVER + np.array(
    [[3, 1, 1.5], [2, -2, 2], [-1, 3, 1], [-3, -1, 2.5], [0.5, 4, 3], [4, 0.3, 4], [-2, 2.5, 2], [1.5, -3, 1.2], [-4, 0.4, 2]]
)
WIDTH = 20.0
"""Degrees of a spot around the transmitter."""


def spots(directions: np.ndarray) -> np.ndarray:
    """Returns spectra with a spot towards every transmitter, 0 to 255; the receiver is turned a quarter about the vertical."""
    towards = TRANSMITTERS - RECEIVER
    local = np.stack([towards[:, 1], -towards[:, 0], towards[:, 2]], -1) / np.linalg.norm(towards, axis=1)[:, None]
    angle = np.degrees(np.arccos(np.clip(np.einsum("hwi,ni->nhw", directions, local), -1, 1)))
    return np.round(255 * np.exp(-((angle / WIDTH) ** 2) / 2)).astype(np.uint8)


def by_zenith() -> np.ndarray:
    """Returns directions of rows of zenith angles and columns from -180 degrees on."""
    zenith, azimuth = np.meshgrid(np.linspace(0, np.pi / 2, 90), np.linspace(-np.pi, np.pi, 360), indexing="ij")
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], -1)


def by_elevation() -> np.ndarray:
    """Returns directions of rows of elevations and columns from 0 on, a degree each, as NeRF2 has them."""
    elevation, azimuth = np.meshgrid(np.radians(np.arange(90)), np.radians(np.arange(360)), indexing="ij")
    return np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)


@dataclass
class Spectra:
    """A folder of images; what is compared is where the spots are."""

    path: Path
    measure: str = field(default="directions", init=False)
    tolerance: float = 1.0 / 90
    """A degree of the quarter that images span, which one order of pixels costs."""

    def difference(self) -> float:
        """Returns the largest angle between a spot's middle and the transmitter, in units of a right angle."""
        dataset = load_dataset(self.path)
        if not np.allclose(dataset.tx_positions, TRANSMITTERS) or not dataset.has("pas"):
            return float("inf")
        directions = np.asarray(pas_directions()).reshape(90, 360, 3)
        expected = spots(directions).astype(float)
        found = dataset.observations["pas"].astype(float)
        middle = [self.middle(own, directions) for own in (found, expected)]
        return float(np.degrees(np.arccos(np.clip((middle[0] * middle[1]).sum(-1), -1, 1))).max()) / 90

    @staticmethod
    def middle(images: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Returns the mean direction of bright pixels, each by its solid angle."""
        weight = np.where(images > 128, images, 0) * np.sqrt(1 - directions[..., 2] ** 2)
        total = np.einsum("nhw,hwi->ni", weight, directions)
        return total / np.linalg.norm(total, axis=1, keepdims=True)


def folder_of(
    write: Callable[[np.ndarray, Path], Any],
    order: str = "zenith",
    named: bool = True,
    first: int = 1,
    suffix: str = ".png",
    index: str | None = None,
    header: str = "x,y,z",
) -> Callable[[Path], Spectra]:
    """Returns a maker of a folder in the published layout."""

    def make(folder: Path) -> Spectra:
        path = folder / "spectra"
        (path / "spectrum").mkdir(parents=True)
        directions = by_zenith() if order == "zenith" else by_elevation()
        for number, image in enumerate(spots(directions), first):
            write(image, path / "spectrum" / f"{number:05d}{suffix}")
        np.savetxt(path / "tx_pos.csv", TRANSMITTERS, "%.6f", ",", header=header, comments="")
        half = np.sqrt(0.5)
        lines = [f"convention: {order}"] * named
        lines += ["gateway1:", f"  position: {RECEIVER.tolist()}", f"  orientation: [0.0, 0.0, {half}, {half}]"]
        (path / "gateway_info.yml").write_text("\n".join(lines) + "\n")
        if index is not None:
            (path / "train_index.txt").write_text("\n".join(index.format(i) for i in range(1, 8)))
            (path / "test_index.txt").write_text("\n".join(index.format(i) for i in range(8, 10)))
        return Spectra(path)

    return make


def by_pillow(mode: str = "L", **how: Any) -> Callable[[np.ndarray, Path], Any]:
    """Returns what writes an image of some mode."""

    def write(image: np.ndarray, path: Path) -> None:
        from PIL import Image

        made = Image.fromarray(image.astype(np.uint16) * 257 if mode == "I;16" else image)
        (made if mode in ("L", "I;16") else made.convert(mode)).save(path, **how)

    return write


def by_imageio(image: np.ndarray, path: Path) -> None:
    """Writes an image."""
    import imageio.v3

    imageio.v3.imwrite(path, image)


def by_imageio_wide(image: np.ndarray, path: Path) -> None:
    """Writes an image of 16 bits."""
    import imageio.v3

    imageio.v3.imwrite(path, image.astype(np.uint16) * 257)


def by_skimage(image: np.ndarray, path: Path) -> None:
    """Writes an image."""
    import skimage.io

    skimage.io.imsave(path, image, check_contrast=False)


def by_matplotlib(image: np.ndarray, path: Path) -> None:
    """Writes an image in grey, as Matplotlib does: in colours with opacity."""
    from matplotlib.image import imsave

    imsave(path, image, cmap="gray")


def larger(image: np.ndarray, path: Path) -> None:
    """Writes an image with a row and a column more."""
    by_pillow()(np.pad(image, ((0, 1), (0, 1)), mode="edge"), path)


PICTURES = {
    ("spectra", "zenith angles, named"): folder_of(by_pillow()),
    ("spectra", "zenith angles, not named"): folder_of(by_pillow(), named=False),
    ("spectra", "elevations, named"): folder_of(by_pillow(), "elevation"),
    ("spectra", "elevations, not named"): folder_of(by_pillow(), "elevation", named=False),
    ("spectra", "split by names"): folder_of(by_pillow(), index="{:05d}"),
    ("spectra", "split by names of files"): folder_of(by_pillow(), index="{}.png"),
    ("spectra", "optimised images"): folder_of(by_pillow(optimize=True)),
    ("spectra", "16 bits"): (folder_of(by_pillow("I;16")), "refused"),
    ("spectra", "colours"): (folder_of(by_pillow("RGB")), "refused"),
    ("spectra", "a palette"): (folder_of(by_pillow("P")), "refused"),
    ("spectra", "black and white"): (folder_of(by_pillow("1")), "refused"),
    ("spectra", "JPEG"): (folder_of(by_pillow(), suffix=".jpg"), "refused"),
    ("spectra", "JPEG in name alone PNG"): (folder_of(by_pillow(format="JPEG")), "refused"),
    ("spectra", "numbered from 0"): (folder_of(by_pillow(), first=0), "refused"),
    ("spectra", "91 rows"): (folder_of(larger), "refused"),
    ("spectra", "positions with numbers of rows"): (folder_of(by_pillow(), header="n,x,y,z"), "refused"),
}
ENTRIES = [
    *entries("Pillow", PICTURES, ("PIL",), "pillow"),
    *entries("scikit-image", {("spectra", "zenith angles"): folder_of(by_skimage)}, ("skimage",), "scikit-image"),
    *entries("Matplotlib", {("spectra", "colours"): (folder_of(by_matplotlib), "refused")}, ("matplotlib",), "matplotlib"),
    *entries(
        "imageio",
        {("spectra", "zenith angles"): folder_of(by_imageio), ("spectra", "16 bits"): (folder_of(by_imageio_wide), "refused")},
        ("imageio",),
        "imageio",
    ),
]


@dataclass
class Splats:
    """A file of Gaussians."""

    path: Path
    truth: dict[str, np.ndarray]
    measure: str = field(default="gaussians", init=False)
    tolerance: float = 1e-5

    def difference(self) -> float:
        """Returns the largest difference of places, scales, turns, opacities and colours."""
        found, colours = read_gaussians(self.path)
        own = {
            "means": found.means,
            "log_scales": found.log_scales,
            "quats": found.quats,
            "opacity_logits": found.opacity_logits,
        }
        own["colours"] = colours
        return max(float(np.abs(np.asarray(own[name]) - values).max()) for name, values in self.truth.items())


def splats(rest: int = 45, order: int = 1, kind: str = "f4", leave_out: str = "", **how: Any) -> Callable[[Path], Splats]:
    """Returns a maker of Gaussians in the layout of Kerbl et al."""

    def make(folder: Path) -> Splats:
        from plyfile import PlyData, PlyElement

        rng = np.random.default_rng(5)
        truth = {"means": rng.normal(size=(7, 3)), "colours": rng.uniform(size=(7, 3)), "opacity_logits": rng.normal(size=7)}
        truth |= {"log_scales": rng.normal(-3, 1, (7, 3)), "quats": rng.normal(size=(7, 4))}
        truth["quats"] /= np.linalg.norm(truth["quats"], axis=1, keepdims=True)
        columns = dict(zip("xyz", truth["means"].T, strict=True))
        columns |= {f"f_dc_{i}": (truth["colours"][:, i] - 0.5) / SH_CONSTANT for i in range(3)}
        columns |= {f"f_rest_{i}": np.zeros(7) for i in range(rest)} | {"opacity": truth["opacity_logits"]}
        columns |= {f"scale_{i}": truth["log_scales"][:, i] for i in range(3)}
        columns |= {f"rot_{i}": truth["quats"][:, i] for i in range(4)}
        kept = {name: values for name, values in list(columns.items())[::order] if not name.startswith(leave_out or "-")}
        rows = np.zeros(7, [(name, kind) for name in kept])
        for name, values in kept.items():
            rows[name] = values
        PlyData([PlyElement.describe(rows, "vertex")], **how).write(folder / "splats.ply")
        return Splats(folder / "splats.ply", truth)

    return make


SPLATS = {
    ("Gaussians (ply)", "as the paper's code writes them"): splats(),
    ("Gaussians (ply)", "constant colours alone"): splats(rest=0),
    ("Gaussians (ply)", "text"): splats(text=True),
    ("Gaussians (ply)", "big endian"): splats(byte_order=">"),
    ("Gaussians (ply)", "double precision, columns in another order"): splats(order=-1, kind="f8"),
    ("Gaussians (ply)", "without scales"): (splats(leave_out="scale"), "refused"),
    ("Gaussians (ply)", "without turns"): (splats(leave_out="rot"), "refused"),
}
ENTRIES += entries("plyfile", SPLATS, ("plyfile",), "plyfile")
