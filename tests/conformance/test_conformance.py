"""Files of other programs are read as their owners mean them, or refused in one line: never silently otherwise.

`make conformance` installs the writers that are not in the usual environment, runs this and writes what was found; a new format
comes with its entries.
"""

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.conformance.by_trimesh import FILES
from builders.conformance.catalogue import catalogue
from builders.conformance.entries import Entry, Unavailable, check
from builders.conformance.shapes import CABINET, Geometry, extent_of

from wbgs_jax._util.errors import UserError

LEDGER = "WBGS_CONFORMANCE_LEDGER"
"""Environment variable: a file to which a line of JSON is added for every entry."""


def parameters() -> list:
    """Returns all entries by name."""
    return [pytest.param(one, id=one.name, marks=[pytest.mark.heavy] * one.heavy) for one in catalogue()]


def note(**line: Any) -> None:
    """Adds a line to the ledger."""
    if ledger := os.environ.get(LEDGER):
        with Path(ledger).open("a") as stream:
            stream.write(json.dumps(line) + "\n")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("entry", parameters())
def test_a_file_is_right_or_refused(entry: Entry, tmp_path: Path):
    missing: list[str] | Unavailable = entry.missing()
    try:
        row = None if missing else check(entry, tmp_path)
    except Unavailable as error:
        row, missing = None, error
    if row is None:
        note(writer=entry.writer)
        pytest.skip(f"{entry.writer} cannot write here: {missing}")
    note(**dataclasses.asdict(row))
    assert row.outcome == entry.outcome, f"off by {row.difference}; {row.message}"


def test_the_catalogue_is_wide():
    """At least a hundred files by a dozen writers, each with a name of its own, and most of them read right."""
    entries = catalogue()
    assert len({entry.name for entry in entries}) == len(entries) >= 100
    assert len({entry.writer for entry in entries}) >= 12
    assert sum(entry.outcome == "right" for entry in entries) > len(entries) / 2


@pytest.mark.parametrize(
    "change",
    [
        lambda extent: extent._replace(area=1.001 * extent.area),
        lambda extent: extent._replace(bounds=extent.bounds + np.array([0, 0, 1e-3])),
        lambda extent: extent._replace(centroid=extent.centroid - 1e-3),
    ],
)
def test_a_small_difference_of_one_object_is_found(change, tmp_path):
    case = FILES[("glb", "a scene")](tmp_path)
    assert case.difference() < case.tolerance
    case.truth["cabinet"] = change(extent_of(CABINET))
    assert case.tolerance < case.difference() < 2e-3
    case.truth["another"] = case.truth.pop("cabinet")
    assert case.difference() == np.inf


class Failing(Geometry):
    """A file whose reader ends otherwise than it should."""

    failure: Exception

    def difference(self) -> float:
        raise self.failure


@pytest.mark.parametrize(
    ("failure", "outcome"),
    [
        (UserError("a.glb has a skin; export it without"), "refused"),
        (UserError("it has a skin; export it without"), "different"),
        (UserError("a.glb has a skin"), "different"),
        (IndexError("a.glb: export it again"), "different"),
    ],
)
def test_a_refusal_names_the_file_and_what_to_do(failure, outcome, tmp_path):
    case = Failing(tmp_path / "a.glb", {})
    case.failure = failure
    assert check(Entry("somebody", "glb", "nothing", lambda folder: case), tmp_path).outcome == outcome
