"""Tables written by users: CSV files with headers in any case and empty cells, whose errors are reported on one line;
assignment of columns to receivers by name, in any usual spelling; values that stand for "not received", units as files state
them, and plausibility of positions and powers.
"""

import csv
import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from wbgs_jax._util.cli import parse_number
from wbgs_jax._util.errors import UserError

_SPELLINGS = {
    1.0: "m meter meters metre metres",
    0.1: "dm decimeter decimeters decimetre decimetres",
    0.01: "cm centimeter centimeters centimetre centimetres",
    0.001: "mm millimeter millimeters millimetre millimetres",
    0.0254: "in inch inches",
    0.3048: "ft foot feet",
    0.9144: "yd yard yards",
}
METRES = {word: metres for metres, words in _SPELLINGS.items() for word in words.split()}
"""Metres per unit, by the spelling of the unit."""
_STATED = re.compile(
    r"^\s*(?:#|comment\s).*?(?:\bunits?\b\s*(?:[:=]|is\b|are\b|in\b)?\s*[\"']?(\w+)|\buses\s+(\w+)\s+as\s+units\b)",
    re.IGNORECASE | re.MULTILINE,
)


def stated_unit(file: Path) -> tuple[str, float] | None:
    """Returns the unit that the comments at the beginning of a file state, and its length in metres; None if they state no
    known one."""
    beginning = 4096  # bytes: comments of that kind stand in front of the geometry
    with file.open("rb") as stream:
        text = stream.read(beginning).decode("latin-1").replace("\r", "\n")
    for stated in _STATED.finditer(text):
        word = (stated[1] or stated[2]).lower()
        if word in METRES:
            return word, METRES[word]
    return None


Tokens = tuple[str, ...]


def match_columns(where: Path, columns: Sequence[str], ids: Sequence[str] | int) -> list[str]:
    """Returns the columns in the order of the receivers that they name; for receivers without names, the columns must be
    numbered from 1 or from 0.

    Names are compared ignoring case, separators and leading zeros, then without their common parts (`rssi_`, `ap`), then as
    parts of each other.

    Args:
        where: file, for messages.
        columns: names of the columns.
        ids: names or number of the receivers.

    Raises:
        UserError: columns and receivers do not correspond one to one.
    """
    own = [tokens(name) for name in columns]
    if isinstance(ids, int):
        first = 0 if ("0",) in distinguishing(own) else 1
        ids = [str(number) for number in range(first, first + ids)]
    wanted = [tokens(name) for name in ids]
    for rule in (_equal(own, wanted), _equal(distinguishing(own), distinguishing(wanted)), _within(own, wanted)):
        found = [[k for k, _ in enumerate(columns) if rule(k, r)] for r, _ in enumerate(ids)]
        if all(len(one) == 1 for one in found) and len({one[0] for one in found}) == len(columns) == len(ids):
            return [columns[k] for (k,) in found]
    raise UserError(
        f"{where}: its columns of powers ({_listed(columns)}) do not each name one of the receivers ({_listed(ids)}); name "
        f"them {_listed(['rssi_' + name for name in ids])}"
    )


def tokens(name: str) -> Tokens:
    """Returns the words and numbers of a name, in lower case, numbers without leading zeros."""
    return tuple(word.lstrip("0") or "0" if word.isdigit() else word for word in re.findall(r"[^\W\d_]+|\d+", name.lower()))


def distinguishing(names: list[Tokens]) -> list[Tokens]:
    """Returns names without their common beginning and end."""
    if len(names) < 2:
        return names
    while all(names) and len({one[0] for one in names}) == 1:
        names = [one[1:] for one in names]
    while all(names) and len({one[-1] for one in names}) == 1:
        names = [one[:-1] for one in names]
    return names


def _equal(own: list[Tokens], wanted: list[Tokens]) -> Callable[[int, int], bool]:
    return lambda k, r: own[k] == wanted[r]


def _within(own: list[Tokens], wanted: list[Tokens]) -> Callable[[int, int], bool]:
    """Returns a predicate: the longest receiver name that a column begins or ends with is that of the receiver."""

    def holds(column: Tokens, name: Tokens) -> bool:
        return bool(name) and (column[: len(name)] == name or column[-len(name) :] == name)

    longest = [max((len(name) for name in wanted if holds(column, name)), default=0) for column in own]
    return lambda k, r: holds(own[k], wanted[r]) and len(wanted[r]) == longest[k]


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def found(folder: Path, names: tuple[str, ...]) -> Path:
    """Returns the first of these files that exists.

    Raises:
        UserError: none of them exists.
    """
    for name in names:
        if (folder / name).exists():
            return folder / name
    raise UserError(f"{folder} has no {' or '.join(names)}; create it as described in docs/measured.md")


def read_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Returns the lines of a CSV file with their numbers; the cells of empty ones are empty.

    Raises:
        UserError: the file is missing or not a CSV file.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            return [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except UnicodeDecodeError:
        raise UserError(f"{path} is not a text file in UTF-8; save it as CSV in UTF-8") from None
    except (OSError, csv.Error) as error:
        raise UserError(f"{path} cannot be read: {error}; check the path, or save it again as CSV") from None


def read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Returns the header of a CSV file in lower case, and its rows, all of the same length.

    Raises:
        UserError: the file is missing, not a CSV file, or has no rows.
    """
    lines = [(number, row) for number, row in read_lines(path) if any(row)]
    if len(lines) < 2:
        raise UserError(f"{path} has no rows after its header")
    if lines[0][1][0].lower().startswith(("#", "sep=")):
        begin = ",".join(lines[0][1])[:40]
        raise UserError(f"{path} begins with {begin!r}; its first line must name the columns, without '#' or 'sep='")
    header = [_plain(path, name) for name in lines[0][1]]
    for sign, name in ((";", "';'"), ("\t", "tabs")):
        if len(header) == 1 and sign in header[0]:
            raise UserError(f"{path} has {name} between its cells; separate them by commas")
    if len(set(header)) < len(header):
        raise UserError(f"{path} has two columns of the same name: {', '.join(header)}")
    if "" in header[1:]:  # the first one may hold numbers of rows
        raise UserError(f"{path} has a column without a name, number {1 + header.index('', 1)}; name it, or remove it")
    for number, row in lines[1:]:
        if len(row) != len(header):
            raise UserError(f"{path}, line {number} has {len(row)} cells, but the header has {len(header)}")
    return header, [row for _, row in lines[1:]]


def _plain(path: Path, name: str) -> str:
    """Returns the name of a column in lower case; that of a coordinate without its unit, which must be the metre."""
    found = re.fullmatch(r"([xyz][12]?)\s*[\[(/_ ]\s*([a-z]+)\s*[\])]?", name.lower())
    if found is None or found[2] not in METRES:
        return name.lower()
    if METRES[found[2]] != 1:
        raise UserError(f"{path} has the column {name!r}; convert it to metres, and name it {found[1]!r}")
    return found[1]


def numbers(path: Path, header: list[str], rows: list[list[str]], columns: list[str]) -> Float[np.ndarray, "n k"]:
    """Returns columns as numbers; empty cells become NaN.

    Raises:
        UserError: a column is missing, or a cell is not a number.
    """
    if missing := [name for name in columns if name not in header]:
        raise UserError(f"{path} has no column {missing[0]!r}; its columns are {', '.join(header)}")
    where, values = [header.index(name) for name in columns], np.full((len(rows), len(columns)), np.nan)
    for i, row in enumerate(rows):
        for k, column in enumerate(where):
            try:
                values[i, k] = parse_number(row[column]) if row[column] else np.nan
            except ValueError:
                comma = "," in row[column]
                hint = "write decimal points" if comma else "leave cells empty where nothing was received"
                raise UserError(f"{path}, row {i + 1}: {row[column]!r} is not a number; {hint}") from None
    return values


DEGREES, TINY = (180.0, 90.0), 0.3
"""Largest longitude and latitude, and largest extent of a site, degrees."""


def not_received(where: Path, powers: Float[np.ndarray, "n r"]) -> Float[np.ndarray, "n r"]:
    """Returns powers with NaN in place of numbers that mean "not received"; a warning names these numbers, and another one the
    level below which readings are missing, if there is one (dBm)."""
    powers = np.where(np.isneginf(powers), np.nan, powers)
    # Numbers that devices write if they received nothing ...
    sentinels = (
        0.0, 1.0, 100.0, 127.0, 255.0,
        -100.0, -110.0, -120.0, -127.0, -128.0, -140.0, -150.0, -174.0, -199.0, -200.0, -999.0,
    )  # fmt: skip
    apart_db = 8.0  # ... if they are this far from all other values, as any lowest number is, or highest above ...
    strong_dbm, repeated = -10.0, 5  # ... this power (others are readings beside a receiver), that occurs this often; ...
    often = 0.2  # ... or if at least this fraction of the readings equals the lowest value.
    while True:
        values, counts = np.unique(powers[~np.isnan(powers)], return_counts=True)
        for end, following in ((0, 1), (-1, -2)) if len(values) > 1 else ():
            number, count = values[end], counts[end]
            listed = number in sentinels
            apart = abs(number - values[following]) > apart_db and (
                listed or (count >= repeated and (end == 0 or number > strong_dbm))
            )
            floor = listed and end == 0 and count >= often * (counts.sum() - count)
            if apart or floor:
                share = 100 * count / powers.size
                warnings.warn(f"{where}: {number:g} is taken as not received ({share:.0f} % of the powers)", stacklevel=2)
                powers = np.where(powers == number, np.nan, powers)
                break
        else:
            _note_cut(where, values, counts)
            return powers


def _note_cut(where: Path, values: Float[np.ndarray, " v"], counts: Int[np.ndarray, " v"]) -> None:
    """Warns of different powers (dBm, ascending) and their counts if many readings equal the lowest one."""
    next_db, factor, share = 3.0, 3.0, 0.1  # more than three times the readings in the next 3 dB, and a tenth of all
    if len(values) < 2:
        return
    above = counts[1:][values[1:] <= values[0] + next_db].sum()
    if counts[0] > factor * above and counts[0] >= share * counts.sum() and counts[0] > 1:
        warnings.warn(
            f"{where}: readings end at {values[0]:g} dBm: weaker ones are missing, so that the map is too high there; "
            "leave cells empty where nothing was received",
            stacklevel=3,
        )


def check_powers(where: Path, powers: Float[np.ndarray, "n r"]) -> None:
    """Raises a `UserError` for numbers that are not powers in dBm."""
    received = powers[~np.isnan(powers)]
    if not len(received):
        raise UserError(f"{where}: nothing was received anywhere")
    if received.min() >= 0:
        raise UserError(
            f"{where}: powers are {received.min():g} to {received.max():g}, which is not plausible in dBm; convert milliwatts "
            "(10 log10), give magnitudes their sign, and leave cells empty where nothing was received"
        )
    for number, column in enumerate(powers.T, 1):
        own = column[~np.isnan(column)]
        if len(own) >= 5 and own.min() >= 0:  # fewer may all be strong
            raise UserError(f"{where}: the powers of receiver {number} are all positive; give magnitudes their sign (dBm)")
    powers_dbm = (-200.0, 50.0)  # range of plausible powers
    if not ((received >= powers_dbm[0]) & (received <= powers_dbm[1])).all():
        span = " to ".join(f"{power:g}" for power in powers_dbm)
        raise UserError(f"{where}: powers must be dBm, {span}; leave cells empty where nothing was received")


def check_positions(what: str, positions: Float[np.ndarray, "*n k"]) -> None:
    """Raises a `UserError` for invalid positions."""
    furthest = 1e4  # largest coordinate, metres
    if not (inside := np.abs(positions) < furthest).all():
        number = int(np.argwhere(~np.atleast_2d(inside))[0, 0])
        raise UserError(
            f"{what} must be coordinates in metres, each less than {furthest:g} m from the origin; number {number + 1} is "
            f"{np.atleast_2d(positions)[number].tolist()}"
        )


def check_metres(what: str, positions: Float[np.ndarray, "n k"]) -> None:
    """Raises a `UserError` for positions whose first two coordinates are longitude and latitude."""
    plane = positions[:, :2]
    extent, offset = np.ptp(plane, axis=0).max(), np.abs(plane.mean(0)).max()
    ranged = (np.abs(plane) <= DEGREES).all() or (np.abs(plane) <= DEGREES[::-1]).all()
    far = 20.0  # minimum ratio of the distance of a site in degrees from the origin to its extent
    if len(plane) > 1 and ranged and extent < TINY and offset > far * max(extent, 1e-12):
        raise UserError(
            f"{what} all lie within {extent:.2g}, {offset:.3g} from the origin: degrees of longitude and latitude; project "
            "them to metres (for example UTM), relative to an origin on the site"
        )


def check_frame(what: str, places: Float[np.ndarray, "n 3"], receivers: Float[np.ndarray, "r 3"]) -> None:
    """Raises a `UserError` for positions in degrees with receivers in metres, and for heights in another unit than the
    receivers'."""
    every = np.concatenate([places, receivers])
    tower = 100.0  # metres: height above the readings that only another unit explains, if it is also their largest extent
    aside = float(np.linalg.norm(np.ptp(every[:, :2], axis=0)))
    low, high = sorted((places[:, 2], receivers[:, 2]), key=np.mean)
    if (gap := float(high.min() - low.max())) > max(tower, 3 * aside):
        raise UserError(
            f"{what} and receivers are {gap:.3g} m apart in height, but at most {aside:.3g} m in plan; give heights z of both "
            "in metres, from one origin"
        )
    plane = np.unique(places[:, :2], axis=0)
    extent = np.ptp(plane, axis=0).max()
    nearest = np.linalg.norm(receivers[:, :2] - plane.mean(0), axis=1).min()
    # Minimum number of positions, and minimum ratio of the distance to the nearest receiver (metres) to their extent (degrees).
    fewest, elsewhere = 5, 50.0
    if len(plane) >= fewest and extent < TINY and nearest > elsewhere * extent and (np.abs(plane) <= max(DEGREES)).all():
        raise UserError(
            f"{what} all lie within {extent:.2g}, {nearest:.3g} m from the nearest receiver: degrees of longitude and "
            "latitude; project them to metres (for example UTM), relative to the origin of the receivers"
        )


def note_of_powers(
    what: str, places: Float[np.ndarray, "n 3"], powers: Float[np.ndarray, "n r"], receivers: Float[np.ndarray, "r 3"]
) -> None:
    """Warns of powers (dBm) that rise with the distance from their receivers, of those that fit the places of other receivers
    or exchanged coordinates clearly better, and of receivers without powers, or with only one value."""
    fewest = 20  # readings of a receiver
    for number, own in enumerate(powers.T, 1):
        received = own[~np.isnan(own)]
        if not len(received):
            warnings.warn(f"{what}: receiver {number} has received nothing; its map is that of the others", stacklevel=2)
        elif len(received) >= fewest and np.ptp(received) == 0:
            warnings.warn(
                f"{what}: all {len(received)} powers of receiver {number} are {received[0]:g} dBm; check whether they were "
                "measured",
                stacklevel=2,
            )
    varied = [k for k, own in enumerate(powers.T) if np.isfinite(own).sum() >= fewest and np.nanstd(own) > 0]
    if not varied:
        return

    def fit(points: Float[np.ndarray, "r 3"]) -> Float[np.ndarray, "k k"]:
        """Returns the correlations of powers with falling logarithms of distances, by columns of powers and by receivers."""
        near = 0.1  # metres, within which the law of the distance does not hold
        closeness = -np.log(np.maximum(np.linalg.norm(places[:, None] - points[varied], axis=-1), near))
        both = [np.column_stack([powers[:, k], closeness])[~np.isnan(powers[:, k])] for k in varied]
        with np.errstate(invalid="ignore"):  # of places at one distance
            return np.nan_to_num([np.corrcoef(own, rowvar=False)[0, 1:] for own in both])

    clear, sure = 0.4, 0.6  # gain in the mean correlation, and correlation, of what is right
    table = fit(receivers)
    own = float(np.diag(table).mean())
    order = linear_sum_assignment(-table)[1]
    swapped = float(np.diag(fit(receivers[:, [1, 0, 2]])).mean())
    assigned = float(table[np.arange(len(order)), order].mean())
    if max(assigned, swapped) > max(sure, own + clear):
        moved = int(np.argmax(order != np.arange(len(order))))
        other = f"powers of receiver {varied[moved] + 1} fit the place of receiver {varied[order[moved]] + 1}"
        axes = "powers fit clearly better if x and y of the receivers are exchanged; give both in one frame"
        columns = f"the {other} clearly better; check which column belongs to which receiver"
        warnings.warn(f"{what}: {columns if assigned >= swapped else axes}", stacklevel=2)
    elif own < -0.5 * clear:
        warnings.warn(
            f"{what}: powers rise with the distance from their receivers (correlation {own:.2f}); check their sign, and the "
            "positions of the receivers",
            stacklevel=2,
        )
