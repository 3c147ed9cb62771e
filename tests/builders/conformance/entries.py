"""What the conformance suite is made of: files that real programs write, and what their owners know of them.

An entry makes one file, or a folder that is read as one, by its writer's own exporter, and hands it over as a case: the path,
and the truth by the owner's program or by a closed form. Reading a case gives how far this library is off.
"""

import importlib.util
import platform
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, Protocol

from wbgs_jax._util.errors import UserError

Outcome = Literal["right", "refused", "different"]
REMEDY = re.compile(
    r"\b(give|export|write|make|choose|name|convert|leave|separate|mend|project|trace|save|copy|read it|subtract|number|scale"
    r"|goe?s? (in)?to|must (be|hold)|put|spectra have|its first line|are named|check|reconstruct|replace|create|add|needs)\b"
)
"""Words of what is to be done."""


TOLERANCES = {"geometry": 1e-4, "channels": 1e-3}
"""Largest relative differences of what is right."""


class Unavailable(Exception):
    """A program is installed, and does not run here."""


class Case(Protocol):
    """A file and what is true of it."""

    path: Path
    measure: str
    """What is compared: geometry, channels, ..."""
    tolerance: float

    def difference(self) -> float:
        """Returns the largest relative difference of what is read from what is true; infinity where something is missing."""


@dataclass(frozen=True)
class Entry:
    """One file of the suite."""

    writer: str
    """The program, as people call it."""
    form: str
    varies: str
    make: Callable[[Path], Case]
    outcome: Outcome = "right"
    needs: tuple[str, ...] = ()
    """Modules that make it, by what is outermost of their names: looking for it must not load anything."""
    package: str = ""
    """Whose version is the writer's; none: Python's own."""
    heavy: bool = False

    @property
    def name(self) -> str:
        """Returns what tests call it."""
        return f"{self.writer}, {self.form}: {self.varies}"

    def missing(self) -> list[str]:
        """Returns the modules that are not installed."""
        return [module for module in self.needs if importlib.util.find_spec(module) is None]

    def version(self) -> str:
        """Returns the version of the writer."""
        return version(self.package) if self.package else platform.python_version()


@dataclass(frozen=True)
class Row:
    """What became of an entry."""

    writer: str
    version: str
    form: str
    varies: str
    expected: Outcome
    outcome: Outcome
    measure: str
    difference: float | None
    """The largest relative one; None of what was refused."""
    approximate: bool
    """Whether more of it is allowed than of others of its kind: of round shapes."""
    message: str


def check(entry: Entry, folder: Path) -> Row:
    """Returns what becomes of an entry's file when it is read: "different" is what is neither right nor refused in a line that
    names place and remedy."""
    case = entry.make(folder)
    found: float | None = None
    try:
        found = case.difference()
        outcome: Outcome = "right" if found <= case.tolerance else "different"
        message = ""
    except UserError as error:
        message = str(error).replace(f"{folder}", folder.name).replace(f"{folder.name}/", "")
        places = [case.path, *(case.path.rglob("*") if case.path.is_dir() else [])]
        names_place = any(place.name in message for place in places)
        outcome = "refused" if names_place and "\n" not in message and REMEDY.search(message) else "different"
    except Exception as error:  # a crash of a reader is what the suite looks for
        outcome, message = "different", f"{type(error).__name__}: {error}"
    approximate = case.tolerance > TOLERANCES.get(case.measure, case.tolerance)
    of_entry = entry.writer, entry.version(), entry.form, entry.varies, entry.outcome
    return Row(*of_entry, outcome, case.measure, found, approximate, message)


def entries(
    writer: str, makers: Mapping[tuple[str, str], Any], needs: tuple[str, ...] = (), package: str = "", heavy: bool = False
) -> list[Entry]:
    """Returns the entries of a writer; makers by format and variant, with their outcome where it is not "right"."""
    found = []
    for (form, varies), made in makers.items():
        make, outcome = made if isinstance(made, tuple) else (made, "right")
        found.append(Entry(writer, form, varies, make, outcome, needs, package, heavy))
    return found
