"""The JSON file of a piece: every figure is in the file as soon as it is known, whatever ends the process afterwards."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from wbgs_jax._util.files import read_json, write_json

MEASUREMENTS = ("parity", "renderer")
TRAININGS = ("paper_scene1", "paper_scene4", "wrfgs_scene1", "wrfgs_scene4", "default_scene1", "default_scene4")
PIECES = (*MEASUREMENTS, *TRAININGS)
"""In their order."""
Name = Literal[
    "parity",
    "renderer",
    "paper_scene1",
    "paper_scene4",
    "wrfgs_scene1",
    "wrfgs_scene4",
    "default_scene1",
    "default_scene4",
]
PART = 75
"""Exit code of a piece that another call continues."""
State = Literal["running", "done", "part", "failed"]
"""`part`: another call continues it. A process that was killed leaves `running`, which means the same."""
NEEDED = ("splatting", "arrays", "images", "wideband", "wave")
"""Rooms of `cases.py`: parity holds if it holds wherever it was tried, and all of these were."""
NEEDED_OF_STAND_IN = ("splatting", "arrays")
"""The same without a GPU; tests/gpu/test_lowering.py compares the others."""


@dataclass(frozen=True)
class Record:
    """The file of a piece. One process writes at a time: that of the piece while it runs, else the one that started it."""

    path: Path

    def read(self) -> dict[str, Any]:
        """Returns all of it."""
        return read_json(self.path)

    @property
    def figures(self) -> dict[str, Any]:
        """Figures so far."""
        return self.read()["figures"]

    def add(self, name: str, figures: Any) -> None:
        """Keeps a figure; of a group of figures those that were there already stay."""
        whole = self.read()
        own = whole["figures"]
        own[name] = own.get(name, {}) | figures if isinstance(figures, dict) else figures
        write_json(self.path, whole)

    def leave_out(self, name: str, reason: str) -> None:
        """Keeps what was not done, and why."""
        whole = self.read()
        whole["left_out"][name] = reason
        write_json(self.path, whole)

    def describe_call(self, **more: Any) -> None:
        """Keeps what belongs to the present call alone."""
        whole = self.read()
        whole["calls"][-1] |= more
        write_json(self.path, whole)

    def finish(self, state: State, seconds: float, reason: str = "") -> None:
        """Keeps how the piece stands after a call, and what the call took."""
        whole = self.read()
        whole["calls"][-1] |= {"state": state, "seconds": round(seconds, 1)}
        whole["seconds"] = round(sum(call["seconds"] for call in whole["calls"]), 1)
        write_json(self.path, whole | {"state": state, "reason": reason})


def begin(path: Path, name: str, device: dict[str, Any], earlier: dict[str, Any] | None) -> Record:
    """Starts a call of a piece: one that continues an earlier call keeps its figures and adds to the list of calls."""
    environment = device["environment"]
    kept = earlier or {"calls": [], "figures": {}, "seconds": 0.0}
    whole = {
        "piece": name,
        "command": f"python -m experiments.gpu_check --only {name}",
        "stand_in": device["platform"] == "cpu",
        "state": "running",
        "reason": "",
        "device": {key: value for key, value in device.items() if key != "environment"},
        "provenance": environment,
        "seconds": kept["seconds"],
        "calls": [*kept["calls"], {**environment, "state": "running", "seconds": 0.0}],
        "figures": kept["figures"],
        "left_out": {},
    }
    write_json(path, whole)
    return Record(path)


def rounded(value: float, digits: int = 4) -> float:
    """Returns a figure with so many digits."""
    return float(f"{value:.{digits}g}")


def parity_holds(result: dict[str, Any]) -> bool:
    """Whether values and gradients agree wherever that was tried, and it was tried where it must be."""
    needed = NEEDED_OF_STAND_IN if result["stand_in"] else NEEDED
    figures = result["figures"]
    compared = set(needed) <= set(figures.get("rooms", {}))
    return compared and all(case["holds"] for case in figures.get("cases", {}).values())
