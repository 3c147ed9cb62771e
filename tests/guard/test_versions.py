"""Every supported version of JAX computes the same: `make lowest` and `make newest` run this with theirs.

Every pure public function, values and gradients, against what values.json holds. `python tests/guard/test_versions.py` writes
that file anew, where a change of results is meant.
"""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from experiments.gpu_check.cases import ROOMS, Case
from experiments.gpu_check.parity import TOLERANCE

FILE = Path(__file__).with_name("values.json")
QUICK = ("splatting", "arrays", "images", "statistics", "powers")
"""Rooms of `make test`; `make test-slow` compares all."""


def summary(case: Case) -> dict[str, list[list[float]]]:
    """Of values and of gradients, leaf by leaf: how many numbers are finite, their norm, and two weighted sums."""
    made = jax.jit(case.program())(*case.arguments)
    values, gradients = (made, ()) if not case.differentiable else made
    return {
        "values": list(map(measured, jax.tree.leaves(values))),
        "gradients": list(map(measured, jax.tree.leaves(gradients))),
    }


def measured(leaf: Any) -> list[float]:
    flat = np.asarray(leaf).ravel()
    flat = np.concatenate([flat.real, flat.imag]) if np.iscomplexobj(flat) else flat
    flat = flat[np.isfinite(flat)].astype(float)
    waves = [np.cos(0.37 * (k + 1) * np.arange(len(flat)) + k) for k in range(2)]
    return [float(f"{number:.7g}") for number in (len(flat), np.linalg.norm(flat), *(wave @ flat for wave in waves))]


def distance(found: list[float], expected: list[float]) -> float:
    """How far two summaries are from each other, by the norm; infinite where other numbers are finite."""
    if found[0] != expected[0]:
        return np.inf
    difference = max(abs(a - b) for a, b in zip(found[1:], expected[1:], strict=True))
    return difference / expected[1] if expected[1] else difference


@pytest.mark.heavy
@pytest.mark.parametrize("room", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in ROOMS])
def test_values_and_gradients_are_those_of_other_versions(room):
    known = json.loads(FILE.read_text())
    for case in ROOMS[room]():
        found, expected = summary(case), known[case.name]
        for part, tolerance in TOLERANCE.items():
            assert len(found[part]) == len(expected[part]), case.name
            for number, (here, there) in enumerate(zip(found[part], expected[part], strict=True)):
                assert distance(here, there) < tolerance, (case.name, part, number, here, there)


if __name__ == "__main__":
    FILE.write_text(json.dumps({case.name: summary(case) for make in ROOMS.values() for case in make()}) + "\n")
