"""The folder layout in which spectra are published (NeRF2, WRF-GS, Wideband3DGS): import, and export of any scene file.

    spectrum/00001.png ...       8-bit grey PAS, 90 x 360, with pixels in one of two orders (`wbgs_jax.data.conventions`)
    tx_pos.csv                   header x,y,z; row k belongs to image k, both counted from 1; metres
    gateway_info.yml             the receiver: position [x, y, z] in metres, orientation quaternion [x, y, z, w]; optional:
                                 frequency (GHz), convention (of the spectra)
    freq.txt                     optional: one frequency (GHz) per spectrum
    train_, test_index.txt       optional: image names without .png, zero-padded or not; also validation_index.txt
    point_cloud.ply              optional: the surface, or ...
    room.npz                     ... optional: a room with its objects and materials (`wbgs-jax convert room.glb`)

Frames: transmitters, receiver and room.npz share the world frame. The mesh is z-up while that frame is y-up: a mesh point (x,
y, z) lies at (x, z, -y) in the world. The layout does not specify the array; the 4x4 half-wavelength one with an unknown
element pattern is assumed.

    wbgs-jax layout SCENE.npz FOLDER      writes a scene file as such a folder
"""

import contextlib
import itertools
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from jaxtyping import Float, UInt8
from PIL import Image

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_text, read_yaml, safe_name
from wbgs_jax.data.conventions import (
    CONVENTIONS,
    ConventionName,
    Evidence,
    array_of,
    contradiction,
    find_convention,
    to_pas,
    turned,
    unrelated,
)
from wbgs_jax.data.dataset import Dataset, group_places, group_transmitters, note_shared_transmitters, tx_disjoint_split
from wbgs_jax.data.load import check_surroundings, materials_of, scaled_spectra, scene_dataset
from wbgs_jax.data.scene_file import Room, SceneFile, check_mesh, load_room
from wbgs_jax.mesh.bodies import share_in_box
from wbgs_jax.mesh.ply import read_ply, write_ply
from wbgs_jax.observation_kinds import KINDS
from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.types import (
    LARGEST_COORDINATE_M,
    LOWEST_OF_PATHS_HZ,
    MAX_FREQUENCY_HZ,
    make_receiver,
    stack_receivers,
)


class Gateway(NamedTuple):
    """Content of gateway_info.yml; None for missing entries."""

    name: str | None
    position: list[float]
    orientation: tuple[float, float, float, float]
    """w x y z."""
    frequency_hz: float | None
    convention: ConventionName | None


def read_gateway(path: Path) -> Gateway:
    """Returns the information about the dataset and its first gateway.

    Raises:
        UserError: the file is missing or invalid.
    """
    wanted = "write 'gateway1:' with position [x, y, z] and orientation [x, y, z, w]"
    if not path.exists():
        raise UserError(f"{path}, with the position of the receiver, is missing; {wanted}")
    content = read_yaml(path)
    entries = content if isinstance(content, dict) else {}
    gateways = {str(k): v for k, v in entries.items() if isinstance(v, dict) and "position" in v}
    if not gateways:
        raise UserError(f"{path} names no gateway; {wanted}")
    first, gateway = next(iter(gateways.items()))
    if len(gateways) > 1:
        warnings.warn(f"{path} has {len(gateways)} gateways; the first one, {first!r}, is used as the receiver", stacklevel=3)
    position = vector(gateway.get("position"), 3, f"{path}: position")
    x, y, z, w = vector(gateway.get("orientation"), 4, f"{path}: orientation (quaternion x, y, z, w)")
    shortest, longest = 1e-6, 1e6  # range of quaternion norms that are accepted
    if not shortest < np.linalg.norm(np.array([x, y, z, w]) / longest) * longest < longest:
        raise UserError(f"{path}: orientation is all zeros or out of range; write the quaternion [0, 0, 0, 1] for no rotation")
    frequency = entries.get("frequency", gateway.get("frequency"))
    name, convention = entries.get("dataset_name"), entries.get("convention", gateway.get("convention"))
    if convention not in (None, *CONVENTIONS):
        raise UserError(f"{path}: convention is {str(convention)[:40]!r}; it must be {' or '.join(CONVENTIONS)}")
    return Gateway(
        name=None if name is None else safe_name(str(name)),
        position=position,
        orientation=(w, x, y, z),
        frequency_hz=None if frequency is None else ghz_to_hz(str(frequency), path),
        convention=convention,
    )


def records_frequency(source: str | Path) -> bool:
    """Returns whether data need no frequency from the caller: a folder that records its own, or a scene."""
    folder = Path(source)
    if not folder.is_dir() or (folder / FREQUENCIES).exists():
        return True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # `load_layout` repeats them
        return (folder / GATEWAY).exists() and read_gateway(folder / GATEWAY).frequency_hz is not None


def vector(value: Any, length: int, what: str) -> list[float]:
    """Returns `length` numbers.

    Args:
        value: a list.
        length: number of entries.
        what: description for the message.

    Raises:
        UserError: `value` is not such a list, or has entries that are too large.
    """
    try:
        vector = [float(v) for v in value] if isinstance(value, list) else []  # YAML reads 1e-3 as text
    except (TypeError, ValueError, OverflowError):
        vector = []
    if len(vector) != length or not (np.abs(vector) <= LARGEST_COORDINATE_M).all():
        unit = " metres, relative to a point on the site" if length == 3 else ""
        raise UserError(f"{what} is {repr(value)[:80]}; it must be {length} numbers of at most {LARGEST_COORDINATE_M:g}{unit}")
    return vector


def ghz_to_hz(word: str, where: Path) -> float:
    """Returns hertz, computed with decimals instead of a factor 1e9, so that equal frequencies stay equal despite rounding."""
    try:
        hertz = float(Decimal(word).scaleb(9))
    except (ArithmeticError, ValueError):
        hertz = np.nan
    if not LOWEST_OF_PATHS_HZ <= hertz <= MAX_FREQUENCY_HZ:
        raise UserError(f"{where}: the frequency {word[:40]!r} is not a number of GHz from 0.3 to 100; write 0.92 for 920 MHz")
    return hertz


NOMINAL_FREQUENCY_HZ = 1e9
"""Frequency used for a folder without one: without a mesh, a model of a single frequency only needs some constant."""

SPECTRA, POSITIONS, GATEWAY, FREQUENCIES = "spectrum", "tx_pos.csv", "gateway_info.yml", "freq.txt"
MESH, ROOM = "point_cloud.ply", "room.npz"
INDEX = {part: f"{part}_index.txt" for part in ("train", "validation", "test")}


def load_layout(
    folder: Path | str,
    frequency_hz: float | None = None,
    seed: int = 0,
    test_fraction: float = 0.2,
    convention: ConventionName | None = None,
) -> Dataset:
    """Loads a folder of the published layout; spectrum i is image i + 1.

    Without freq.txt all spectra have one frequency: `frequency_hz`, else `frequency` (GHz) in gateway_info.yml, else
    `NOMINAL_FREQUENCY_HZ`. Without index files, `test_fraction` of the transmitters (drawn with `seed`) are the test. The
    pixels are in the order of `convention`, else of `convention` in gateway_info.yml, else of the one inferred from the
    training spectra, which a warning names.

    Raises:
        UserError: a file is missing, damaged, or inconsistent with the others, or the convention cannot be inferred.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder; give one that contains {SPECTRA}/, {POSITIONS} and {GATEWAY}")
    images = _read_images(folder / SPECTRA)
    positions = _read_positions(folder / POSITIONS, len(images))
    images = _scaled(images, folder)
    gateway = read_gateway(folder / GATEWAY)
    tx_index = group_transmitters(positions)
    room = _read_room(folder)
    if (folder / MESH).exists():
        _check_axes(folder / MESH, room.vertices, np.vstack([positions, gateway.position]))
    if any((folder / name).exists() for name in INDEX.values()):
        split = _read_split(folder, tx_index, positions)
    else:
        train, test = tx_disjoint_split(group_places(positions, tx_index), test_fraction, seed)
        split = {"train": train, "validation": train[:0], "test": test}
    trained = np.sort(np.concatenate([split["train"], split["validation"]]))
    shown = images[trained], make_receiver(gateway.position, gateway.orientation), positions[trained], tx_index[trained]
    named = _agreed(convention, gateway.convention, folder) or _inferred(folder, find_convention(*shown))
    if reason := contradiction(shown[0], named):
        warnings.warn(
            f"{folder}: the convention {named} is given, but {reason}; check it, and whether images are upside down",
            stacklevel=2,
        )
    elif turned(*shown, named):
        warnings.warn(
            f"{folder / GATEWAY}: lines of sight fit the spectra clearly better if the orientation is w, x, y, z; write it as "
            "x, y, z, w, [0, 0, 0, 1] for no rotation",
            stacklevel=2,
        )
    elif unrelated(*shown, named):
        warnings.warn(
            f"{folder}: spectra are no brighter towards their own transmitters than towards others; row k of {POSITIONS} must "
            f"belong to image k, bright pixels be strong directions, and {GATEWAY} have the receiver's orientation",
            stacklevel=2,
        )
    receiver = make_receiver(gateway.position, gateway.orientation, array_of(named))
    dataset = Dataset(
        name=gateway.name or safe_name(folder.resolve().name),
        receivers=stack_receivers([receiver]),
        tx_positions=positions,
        frequencies_hz=_read_frequencies(
            folder / FREQUENCIES, len(images), frequency_hz, gateway.frequency_hz, len(room.faces) > 0
        ),
        receiver_index=np.zeros(len(images), int),
        tx_index=tx_index,
        train=split["train"],
        validation=split["validation"],
        test=split["test"],
        observations={"pas": to_pas(images, named)},
        vertices=room.vertices,
        faces=room.faces,
        face_part=room.face_part if room.parts else None,
        materials=materials_of(room, str(folder / ROOM)),
        convention=named,
    )
    return check_surroundings(dataset)


def export_layout(scene: SceneFile, folder: Path | str) -> None:
    """Writes a scene as a folder of the published layout, atomically.

    Loading it gives the scene's queries, split and mesh, and its PAS rounded to 8 bits; snapshots and array are not kept.

    Raises:
        UserError: `folder` exists and is not empty, or cannot be written; or the scene has several receivers, only powers, or
            no training or no test spectra, which the layout cannot represent.
    """
    dataset = scene_dataset(scene)
    if dataset.n_receivers > 1 or not dataset.has_spectra:
        what = f"{dataset.n_receivers} receivers" if dataset.has_spectra else f"only {dataset.observed.words}"
        raise UserError(f"scene {scene.name} has {what}, which the layout cannot represent; keep the scene file")
    if len(dataset.train) == 0 or len(dataset.test) == 0:
        raise UserError(
            f"scene {scene.name} lacks {'test' if len(dataset.train) else 'training'} spectra; its split needs both"
        )
    with _new_folder(Path(folder)) as target:
        (target / SPECTRA).mkdir()
        for start in range(0, len(dataset), 256):  # in blocks: all spectra of a scene in float32 take a gigabyte
            index = np.arange(start, min(start + 256, len(dataset)))
            for number, pas in zip(index + 1, np.asarray(dataset.pas(index)), strict=True):
                Image.fromarray(np.round(pas * 255).astype(np.uint8)).save(target / SPECTRA / f"{number:05d}.png")
        rows = (",".join(map(repr, row)) for row in dataset.tx_positions.tolist())
        (target / POSITIONS).write_text("\n".join(["x,y,z", *rows]) + "\n")
        (target / FREQUENCIES).write_text("".join(f"{_hz_to_ghz(f)}\n" for f in dataset.frequencies_hz))
        for part, name in INDEX.items():
            if len(index := getattr(dataset, part)):
                (target / name).write_text("".join(f"{number:05d}\n" for number in index + 1))
        w, x, y, z = scene.rx_orientation[0].tolist()
        gateway = {"position": scene.rx_position[0].tolist(), "orientation": [x, y, z, w]}
        content = {"dataset_name": scene.name, "convention": CONVENTIONS[0], "gateway1": gateway}
        (target / GATEWAY).write_text(yaml.safe_dump(content, sort_keys=False))
        if len(scene.vertices):
            write_ply(target / MESH, world_to_mesh(scene.vertices), scene.faces)


def mesh_to_world(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Returns points of the layout's z-up mesh in the y-up world frame of its transmitters: (x, y, z) -> (x, z, -y)."""
    x, y, z = points.T
    return np.stack([x, z, -y], -1)


def world_to_mesh(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Returns the inverse of `mesh_to_world`: (x, y, z) -> (x, -z, y)."""
    x, y, z = points.T
    return np.stack([x, -z, y], -1)


def _read_room(folder: Path) -> Room:
    """Returns the surfaces of a folder in the frame of its transmitters; without triangles if there are only points or
    nothing."""
    mesh, room = folder / MESH, folder / ROOM
    if room.exists():
        if mesh.exists():
            raise UserError(f"{folder} has both {MESH} and {ROOM}; keep only one of them")
        return load_room(room)
    _note_unread(folder)
    vertices, faces = read_ply(mesh) if mesh.exists() else (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    arrays = {"vertices": mesh_to_world(vertices), "faces": faces, "face_part": np.zeros(len(faces), np.int32)}
    return Room(**check_mesh(arrays, str(mesh)))


def _note_unread(folder: Path) -> None:
    """Warns of models of the room in other formats, unless the folder has a mesh that is read."""
    models = (".glb", ".gltf", ".obj", ".ply", ".xml", ".stl", ".pcd", ".dae", ".fbx")
    unread = [path.name for path in sorted(folder.iterdir()) if path.suffix.lower() in models and path.name != MESH]
    if unread and not (folder / MESH).exists():
        warnings.warn(
            f"{folder}: {unread[0]} is not read; if it is a model of the room, convert it: wbgs-jax convert {unread[0]} "
            f"--out {ROOM}",
            stacklevel=4,
        )


def _check_axes(path: Path, vertices: Float[np.ndarray, "v 3"], antennas: Float[np.ndarray, "n 3"]) -> None:
    """Raises a `UserError` if antennas lie outside of a mapped mesh and all of them inside of it as it was written."""
    most = 0.9  # share of antennas; a few stand outside of many rooms
    if len(vertices) and share_in_box(antennas, vertices) < most and share_in_box(antennas, world_to_mesh(vertices)) == 1:
        raise UserError(
            f"{path} surrounds the antennas as written, but not when turned from z-up to the layout's y-up frame: they share "
            f"one frame; write it as {ROOM} instead (wbgs-jax convert)"
        )


def _read_images(folder: Path) -> UInt8[np.ndarray, "n 90 360"]:
    files = [path for path in folder.glob("*") if path.suffix.lower() == ".png"]
    numbered = sorted((_image_number(path.stem, folder), path) for path in files)
    if not numbered:
        raise UserError(f"{folder} has no .png spectra; add 00001.png, 00002.png, ...")
    for expected, (number, path) in enumerate(numbered, 1):
        if number != expected:
            raise UserError(f"{path} is in the place of image {expected:05d}; number images from 1, without gaps or duplicates")
    images = np.stack([_read_image(path) for _, path in numbered])
    if fault := KINDS["pas"].fault(images):
        raise UserError(f"{folder} contains {fault}; write its images again")
    return images


def _scaled(images: UInt8[np.ndarray, "n 90 360"], folder: Path) -> UInt8[np.ndarray, "n 90 360"]:
    """Returns spectra scaled to their maximum; a black image is a `UserError`."""
    if (black := images.max((1, 2)) == 0).any():
        raise UserError(
            f"image {1 + black.argmax():05d} of {folder / SPECTRA} is black; remove images without spectra ({black.sum()} of "
            f"{len(images)}) with their rows of {POSITIONS} and {FREQUENCIES}, and number the others from 1"
        )
    return scaled_spectra(images, str(folder))


def _read_image(path: Path) -> UInt8[np.ndarray, "90 360"]:
    try:
        with Image.open(path, formats=["PNG"]) as image:
            if image.size != (PAS_WIDTH, PAS_HEIGHT) or image.mode != "L":
                found = f"{image.height} x {image.width} pixels of mode {image.mode}"
                raise UserError(f"{path} has {found}; spectra have {PAS_HEIGHT} x {PAS_WIDTH} pixels, 8-bit grey (mode L)")
            return np.asarray(image)
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as error:  # documented by Pillow
        raise UserError(f"{path} is truncated or not a PNG image ({error}); copy or create it again") from error


def _read_positions(path: Path, n: int) -> Float[np.ndarray, "n 3"]:
    text = read_text(path).replace('"', "")  # some programs write the names of columns, or all cells, between quotation marks
    header, *rows = [line for line in text.splitlines() if line.strip()] or [""]
    if header.lower().replace(" ", "") != "x,y,z":
        raise UserError(f"{path} starts with {header[:40]!r}; its first line must be x,y,z")
    if len(rows) != n:
        raise UserError(f"{path} has {len(rows)} rows for {n} images in {SPECTRA}/; row k must belong to image k")
    return np.array([vector(row.split(","), 3, f"{path}: row {number}") for number, row in enumerate(rows, 1)])


def _read_frequencies(
    path: Path, n: int, wanted_hz: float | None, gateway_hz: float | None, walls: bool
) -> Float[np.ndarray, " n"]:
    if not path.exists():
        single = wanted_hz if wanted_hz is not None else gateway_hz
        if single is None:
            wrong = ", or paths will be wrong" if walls else ""
            warnings.warn(
                f"{path.parent} does not record a frequency, and {NOMINAL_FREQUENCY_HZ / 1e9:g} GHz is assumed; otherwise give "
                f"--frequency-ghz, {FREQUENCIES}, or `frequency` (GHz) in {GATEWAY}{wrong}",
                stacklevel=3,
            )
        single = NOMINAL_FREQUENCY_HZ if single is None else single
        if not LOWEST_OF_PATHS_HZ <= single <= MAX_FREQUENCY_HZ:
            raise UserError(f"the frequency of {path.parent} is {single / 1e9:g} GHz; the valid range is 0.3 to 100 GHz")
        return np.full(n, single, np.float64)
    if wanted_hz is not None:
        raise UserError(f"{path} has the frequencies; leave out the {wanted_hz:g} Hz, or delete that file")
    words = read_text(path).split()
    if len(words) != n:
        raise UserError(f"{path} has {len(words)} frequencies for {n} images in {SPECTRA}/; give one (GHz) for each")
    return np.array([ghz_to_hz(word, path) for word in words])


def _agreed(wanted: ConventionName | None, named: ConventionName | None, folder: Path) -> ConventionName | None:
    """Returns the convention that the caller or the folder specifies, if any."""
    if wanted is not None and named is not None and wanted != named:
        raise UserError(f"{folder / GATEWAY} specifies the convention {named}; leave out {wanted}, or correct that file")
    return named if wanted is None else wanted


def _inferred(folder: Path, found: Evidence) -> ConventionName:
    """Returns the convention inferred from the spectra outside the test, with a warning."""
    choices = " or ".join(CONVENTIONS)
    if found.convention is None:
        raise UserError(
            f"{folder} does not record the order of its pixels, and its spectra do not reveal it ({found.reason}): give "
            f"--convention {choices}, or write `convention: ...` in {GATEWAY} (docs/formats.md)"
        )
    warnings.warn(
        f"{folder} does not record the order of its pixels: {found.convention} is used, because {found.reason}; "
        f"`convention: {choices}` in {GATEWAY} sets it",
        stacklevel=3,
    )
    return found.convention


def _read_split(folder: Path, tx_index: np.ndarray, positions: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the indices of every part of the split; only the validation may be missing."""
    optional = [] if (folder / INDEX["validation"]).exists() else ["validation"]
    split = {p: np.zeros(0, int) if p in optional else _read_index(folder / INDEX[p], len(tx_index)) for p in INDEX}
    for first, second in itertools.combinations(INDEX, 2):
        both = np.intersect1d(split[first], split[second])
        if len(both):
            raise UserError(f"image {both[0] + 1:05d} is in both {folder / INDEX[first]} and {INDEX[second]}; keep it in one")
    note_shared_transmitters(str(folder), tx_index, split, positions)
    return split


def _read_index(path: Path, n: int) -> np.ndarray:
    """Returns the indices of the spectra named in an index file: at least one, and none twice."""
    numbers = [_image_number(word.removesuffix(".png"), path) for word in read_text(path).split()]
    absent = [number for number in numbers if not 1 <= number <= n]
    if absent:
        raise UserError(f"{path} names image {absent[0]:05d}, but {SPECTRA}/ has images 1 to {n}; correct the index")
    if not numbers or len(set(numbers)) < len(numbers):
        raise UserError(f"{path} names {'an image twice' if numbers else 'no image'}; correct it, or delete all index files")
    return np.array(numbers) - 1


def _image_number(word: str, where: Path) -> int:
    digits = 9  # maximum number of digits of an image number
    if not (word.isascii() and word.isdigit() and len(word) <= digits):
        raise UserError(f"{where}: {word[:40]!r} is not an image number; images are named by numbers, 00001 for example")
    return int(word)


def _hz_to_ghz(hertz: float) -> str:
    return f"{Decimal(repr(float(hertz))).scaleb(-9).normalize():f}"


@contextlib.contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """Yields a temporary folder beside `folder`, which replaces it if the block succeeds and is removed otherwise."""
    temporary = None
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UserError(f"{folder} exists and is not an empty folder; choose another one")
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        yield temporary
        os.umask(umask := os.umask(0))
        temporary.chmod(0o777 & ~umask)  # mkdtemp makes folders accessible only to their owner
        temporary.rename(folder)
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror}; choose another folder or fix its permissions") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
