"""Damaged files: a whole one, and one to three things done to it that its kind suggests. All draws come from one `Random`."""

import io
import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

NUMBERS = ("nan", "inf", "-1", "0", "1e39", "-1e300", "1e999999", "9" * 5000, "0x10", "1_0", "1e-400", "2147483648", "٣")
WORDS = (*NUMBERS, "", "x", "../../x", "/etc/passwd", "\x00", "null", "true", "[1, 2, 3]", "{}", "!!python/object:os.system x")
VALUES = (None, True, -1, 0, 10**30, 1e300, -1e39, "", "x", "../../x", "9" * 5000, [], {}, [[]], [None], {"x": {}}, ["x"] * 50)
TYPES = ("U3", "S3", "?", "i1", "u8", "f2", "f8", "c8", "c16", "M8[s]", "O", "V4", [("a", "f4"), ("b", "O")])
EXTREMES = (np.nan, np.inf, -np.inf, -1, 1e5, 1e39, -1e300, 2**31, -(2**63), 1e-300)


def damage_bytes(draw: Random, whole: bytes) -> bytes:
    """Bits flipped, bytes overwritten, left out, doubled or cut off at the end."""
    if not whole:
        return draw.randbytes(8)
    start = draw.randrange(len(whole))
    stop = min(start + draw.choice((1, 2, 8, 200)), len(whole))
    match draw.randrange(6):
        case 0:
            return whole[:start] + bytes([whole[start] ^ (1 << draw.randrange(8))]) + whole[start + 1 :]
        case 1:
            return whole[:start] + draw.randbytes(stop - start) + whole[stop:]
        case 2:
            return whole[:start] + whole[stop:]
        case 3:
            return whole[:stop] + whole[start:]
        case 4:
            return whole[:start]
        case _:
            return whole[:start] + draw.choice((b"\xff" * 8, b"\x00" * 8, b"\x7f\xff\xff\xff")) + whole[start + 8 :]


def damage_text(draw: Random, whole: bytes) -> bytes:
    """Words and numbers replaced by others, lines doubled, left out or swapped; now and then bytes."""
    text = whole.decode(errors="replace")
    lines, numbers = text.splitlines(), [*re.finditer(r"[-+\w.]+", text)]
    match draw.randrange(5):
        case 0 if numbers:
            found = draw.choice(numbers)
            text = text[: found.start()] + draw.choice(WORDS) + text[found.end() :]
        case 1 if lines:
            lines.insert(draw.randrange(len(lines)), draw.choice(lines))
            text = "\n".join(lines)
        case 2 if lines:
            lines.pop(draw.randrange(len(lines)))
            text = "\n".join(lines)
        case 3:
            place = draw.randrange(len(text) + 1)
            text = (
                text[:place]
                + draw.choice((",", ":", "\n", "[", "]", "{", '"', "&a", "*a", "#", ";", "\t", "\ufeff"))
                + text[place:]
            )
        case _:
            return damage_bytes(draw, whole)
    return text.encode(errors="replace")


def damage_json(draw: Random, whole: bytes) -> bytes:
    """One value, at any depth, replaced, left out or given another name; now and then text."""
    if draw.randrange(6) == 0:
        return damage_text(draw, whole)
    value = json.loads(whole)
    places = [*_places(value, None, None)]
    parent, key = draw.choice(places)
    if parent is None:
        value = draw.choice(VALUES)
    elif draw.randrange(5) == 0:
        del parent[key]
    else:
        parent[key] = draw.choice(VALUES)
    return json.dumps(value).encode()


def _places(value: Any, parent: Any, key: Any) -> list[tuple[Any, Any]]:
    found = [(parent, key)]
    if isinstance(value, dict | list):
        for inner in list(value) if isinstance(value, dict) else range(len(value)):
            found += _places(value[inner], value, inner)
    return found


def damage_array(draw: Random, array: np.ndarray) -> np.ndarray:
    """Another type, shape or value."""
    match draw.randrange(5):
        case 0:
            with np.errstate(all="ignore"):
                try:
                    return array.astype(draw.choice(TYPES))
                except (ValueError, TypeError):
                    return np.zeros(array.shape, draw.choice(TYPES))
        case 1:
            return array[None] if draw.randrange(2) else array[..., None]
        case 2:
            return draw.choice((array[:0], array[:1], array.reshape(-1), array.T, array.sum())) if array.ndim else array[None]
        case 3:
            return np.zeros(draw.choice(((), (0,), (1, 0, 3), (2, 3), (7,), (3, 4, 5, 6))), array.dtype)
        case _:
            changed = np.array(array)
            if changed.size and changed.dtype.kind in "fciu":
                with np.errstate(all="ignore"):
                    extreme = np.array(draw.choice(EXTREMES)).astype(changed.dtype)
                changed.reshape(-1)[draw.randrange(changed.size)] = extreme
            return changed


def damage_npz(draw: Random, whole: bytes) -> bytes:
    """One array damaged, lost, or another beside it; the JSON text of `meta` damaged as such; a header, with the right checksum
    of the archive; or the archive's bytes."""
    kind = draw.randrange(8)
    if kind == 0:
        return damage_bytes(draw, whole)
    with np.load(io.BytesIO(whole)) as archive:
        arrays = dict(archive.items())
    name = draw.choice([*arrays])
    if kind == 1:
        return _archive({f"{key}.npy": _npy(array) for key, array in arrays.items()}, draw, f"{name}.npy")
    if kind == 2:
        arrays.pop(name)
    elif arrays[name].dtype.kind == "U" and str(arrays[name])[:1] == "{":
        arrays[name] = np.array(damage_json(draw, str(arrays[name]).encode()).decode(errors="replace"))
    else:
        arrays[name] = damage_array(draw, arrays[name])
    return _archive({f"{key}.npy": _npy(array) for key, array in arrays.items()})


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(array), allow_pickle=True)
    return stream.getvalue()


def _archive(members: dict[str, bytes], draw: Random | None = None, damaged: str = "") -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in members.items():
            changed = draw is not None and name == damaged
            archive.writestr(name, _damage_header(draw, content) if changed and draw is not None else content)
    return stream.getvalue()


def damage_npy(draw: Random, whole: bytes) -> bytes:
    """An array file: its header or its bytes."""
    return _damage_header(draw, whole) if draw.randrange(2) else damage_bytes(draw, whole)


def _damage_header(draw: Random, whole: bytes) -> bytes:
    """A number or word of an .npy header is another one, or bytes of it are."""
    head = whole[:128]
    found = draw.choice([*re.finditer(rb"[\w<>|]+", head)])
    other = draw.choice((b"99999999999999", b"-1", b"<f8", b"|O", b"False", b"(" * 60, b"1" * 4000, draw.randbytes(3)))
    if draw.randrange(3) == 0:
        return damage_bytes(draw, whole)
    return head[: found.start()] + other + head[found.end() :] + whole[128:]


def damage_zip(draw: Random, whole: bytes) -> bytes:
    """A member of an archive that holds JSON and binary data; the checksums of the archive are right."""
    if draw.randrange(3) == 0:
        return damage_bytes(draw, whole)
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = draw.choice([*members])
    if draw.randrange(8) == 0:
        members.pop(name)
    else:
        members[name] = damage_json(draw, members[name]) if name.endswith(".json") else damage_bytes(draw, members[name])
    return _archive(members)


KINDS: dict[str, Callable[[Random, bytes], bytes]] = {
    ".npz": damage_npz,
    ".npy": damage_npy,
    ".json": damage_json,
    ".zip": damage_zip,
    ".csv": damage_text,
    ".yml": damage_text,
    ".txt": damage_text,
    ".toml": damage_text,
    ".xml": damage_text,
    ".obj": damage_text,
    ".jsonl": damage_text,
}


def damage(draw: Random, name: str, whole: bytes) -> bytes:
    """Returns a file's content, damaged as its ending suggests: bytes where that says nothing. At least once."""
    once = KINDS.get(Path(name).suffix, damage_text if whole[:3] == b"ply" and b"ascii" in whole[:20] else damage_bytes)
    changed = once(draw, whole)
    if draw.randrange(4) == 0:
        changed = damage_bytes(draw, changed)
    return changed
