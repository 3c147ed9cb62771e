"""The one JSON of a check: every figure is in the file as soon as it is known, whatever ends the process afterwards."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from wbgs_jax._util.files import read_json, write_json

State = Literal["running", "done", "cut", "failed", "left out"]

NEEDED = ("splatting", "arrays", "images", "wideband", "wave")
"""Rooms of `cases.py`: parity holds if it holds wherever it was tried, and all of these were."""


@dataclass(frozen=True)
class Record:
    """A section of the file. One process writes at a time: that of the section while it runs, else the one that started it."""

    path: Path
    section: str

    def _update(self, **changes: Any) -> None:
        whole = read_json(self.path)
        own = whole["sections"].setdefault(self.section, {"state": "running", "figures": {}, "left_out": {}})
        for name, value in changes.items():
            own[name] = own.get(name, {}) | value if isinstance(value, dict) else value
        write_json(self.path, whole)

    def begin(self, commit: str | None) -> None:
        """Starts the section anew: nothing stays of an earlier run."""
        whole = read_json(self.path)
        whole["sections"][self.section] = {"state": "running", "commit": commit, "figures": {}, "left_out": {}}
        write_json(self.path, whole)

    def add(self, name: str, figures: Any) -> None:
        """Keeps a figure, or a row of them by name."""
        self._update(figures={name: figures})

    def leave_out(self, name: str, reason: str) -> None:
        """Keeps what was not done, and why."""
        self._update(left_out={name: reason})

    def set_state(self, state: State, **more: Any) -> None:
        """Keeps how the section stands; `more` are its reason and its seconds."""
        self._update(state=state, **more)


def rounded(value: float, digits: int = 4) -> float:
    """Returns a figure with so many digits."""
    return float(f"{value:.{digits}g}")


def not_done(sections: dict[str, Any]) -> list[str]:
    """Returns a line for everything that was cut, failed or left out."""
    lines = []
    for name, section in sections.items():
        if section["state"] != "done":
            lines.append(f"{name}: {section['state']}, {section.get('reason', '')}")
        lines += [f"{name}, {what}: {reason}" for what, reason in section["left_out"].items()]
    return lines


def parity_holds(sections: dict[str, Any]) -> bool:
    """Whether values and gradients agree wherever that was tried, and it was tried where it must be."""
    parity = sections.get("parity", {"figures": {}})
    return all(case["holds"] for case in parity["figures"].values()) and set(NEEDED) <= set(parity.get("rooms", {}))
