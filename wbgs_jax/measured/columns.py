"""Which column of a table belongs to which receiver: by its name, in any usual spelling."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from wbgs_jax._util.errors import UserError

Tokens = tuple[str, ...]


def match_columns(where: Path, columns: Sequence[str], ids: Sequence[str] | int) -> list[str]:
    """Returns the columns in the order of the receivers that they name; of so many receivers without names those that are
    numbered from 1, or from 0.

    Names are compared without case, separators and leading zeros, then without what all of them share (`rssi_`, `ap`), then as
    parts of each other.

    Raises:
        UserError: a column names no receiver, or one names several, or several name one.
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
    """Returns the words and numbers of a name, in small letters, numbers without leading zeros."""
    return tuple(word.lstrip("0") or "0" if word.isdigit() else word for word in re.findall(r"[^\W\d_]+|\d+", name.lower()))


def distinguishing(names: list[Tokens]) -> list[Tokens]:
    """Returns names without what they all begin or all end with."""
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
    """Returns whether the longest of the receivers' names that a column begins or ends with is that of a receiver."""

    def holds(column: Tokens, name: Tokens) -> bool:
        return bool(name) and (column[: len(name)] == name or column[-len(name) :] == name)

    longest = [max((len(name) for name in wanted if holds(column, name)), default=0) for column in own]
    return lambda k, r: holds(own[k], wanted[r]) and len(wanted[r]) == longest[k]


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
