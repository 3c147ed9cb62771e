"""Timings and figures. Competitors take turns, so that a busy moment hits all of them."""

import dataclasses
import os
import time
from collections.abc import Callable, Hashable, Mapping
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Float

from wbgs_jax._util.cli import say

Seconds = Float[np.ndarray, " rounds"]
Name = TypeVar("Name", bound=Hashable)

MIN_ROUNDS = 3
SHORT_S, SHORT_REPEATS = 0.05, 5
"""A call that takes less counts with the median of this many in a row: a moment's pause would be most of it."""
TOLERANCE = {"x": 0.25}
"""Share by which a figure of this unit may be worse than the baseline's: a ratio of two times measured side by side ..."""
ABSOLUTE_TOLERANCE = 0.5
"""... or anything that depends on the machine's mood."""


def half_the_memory_gb() -> float:
    """Half of what the device has (a CPU: the machine), in GB."""
    statistics = jax.devices()[0].memory_stats()
    total = statistics["bytes_limit"] if statistics else os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return round(total / 2e9, 1)


@dataclasses.dataclass(frozen=True)
class Effort:
    """Time to spend."""

    repeats: int = 9
    """Rounds of timed calls, after compilation."""
    seed: int = 0
    quick: bool = False
    """Sizes so small that the figures mean nothing: does the suite work?"""
    budget_s: float = 120.0
    """No further round begins after this time, but `MIN_ROUNDS` are always done."""
    call_limit_s: float = 30.0
    """A competitor whose call takes longer is left out."""
    memory_limit_gb: float = dataclasses.field(default_factory=half_the_memory_gb)
    """A competitor that needs more is left out."""


@dataclasses.dataclass
class Report:
    """Figures that were measured, and names of those that were not."""

    metrics: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    skipped: dict[str, str] = dataclasses.field(default_factory=dict)
    """Reasons."""

    def add(self, name: str, value: float, unit: str, direction: str, spread: float = 0.0) -> None:
        """One figure; `direction` says whether "lower" or "higher" is better, `spread` is the interquartile range."""
        tolerance = TOLERANCE.get(unit, ABSOLUTE_TOLERANCE)
        figures = {"value": _rounded(value, 4), "unit": unit, "direction": direction, "spread": _rounded(spread, 3)}
        self.metrics[name] = figures | {"tolerance": tolerance}

    def add_sample(self, name: str, sample: Seconds, unit: str, direction: str = "lower") -> None:
        """Median and interquartile range of a sample."""
        low, middle, high = np.quantile(sample, [0.25, 0.5, 0.75])
        self.add(name, middle, unit, direction, high - low)

    def add_time(self, name: str, seconds: Seconds) -> None:
        """A sample of seconds, in milliseconds."""
        self.add_sample(name, 1e3 * seconds, "ms")

    def skip(self, name: str, reason: str) -> None:
        """Say what is missing, and why."""
        self.skipped[name] = reason
        say(f"  {name} left out: {reason}")


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


def timed(call: Callable[[], Any]) -> float:
    """Seconds of one call, its results ready."""
    begin = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - begin


def timed_often(call: Callable[[], Any]) -> float:
    """Seconds of a call; of a short one, the median of several."""
    first = timed(call)
    return first if first > SHORT_S else float(np.median([first] + [timed(call) for _ in range(SHORT_REPEATS - 1)]))


def interleaved(competitors: Mapping[Name, Callable[[], Any]], effort: Effort) -> dict[Name, Seconds]:
    """Seconds of every call, round by round; a competitor whose call exceeds the limit is missing."""
    for call in competitors.values():
        timed(call)  # compiles
    bearable = {name: call for name, call in competitors.items() if timed(call) <= effort.call_limit_s}
    begin = time.perf_counter()
    rounds: list[list[float]] = []
    while len(rounds) < effort.repeats and (len(rounds) < MIN_ROUNDS or time.perf_counter() - begin < effort.budget_s):
        rounds.append([])
        for call in bearable.values():
            timed(call)  # pays for the memory that the competitor before it gave back
            rounds[-1].append(timed_often(call))
    return dict(zip(bearable, np.array(rounds).T, strict=True))
