"""A disk that is full, read-only or broken at any write: one line, exit code 2, nothing half-written, and the same command ends
as if nothing had been once there is room."""

import os
import subprocess
from pathlib import Path

import pytest
from builders.reliability.faults import ERRORS, Fault
from builders.reliability.forking import Ended
from builders.reliability.ledger import count
from builders.reliability.outcomes import outcome

WRITERS = (
    "generate data",
    "write checkpoints",
    "lay out",
    "convert to DeepMIMO",
    "convert to paths",
    "predict powers",
    "predict spectra",
    "export",
    "map",
    "measure",
    "evaluate",
    "train nerf2",
    "run experiments",
)
TRIES = 5
"""Of a piece of work: writes that fail, the first and the last among them."""


def assert_told(ended: Ended) -> None:
    lines = ended.err.splitlines()
    assert ended.code == 2 and "Traceback" not in ended.err, ended.err
    assert lines[-1].startswith("error: "), ended.err


def assert_nothing_half_written(folder: Path) -> None:
    names = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    strange = [name for name in names if any(part.startswith(".") or "tmp" in part for part in Path(name).parts)]
    assert not strange


def refuse(work: str, kind: str, at: int, forks, fresh, undisturbed) -> None:
    _, expected = undisturbed(work)
    folder = fresh(work)
    ended = forks.run(work, folder, Fault(kind, at=at))
    if ended.code != 0:
        assert_told(ended)
        if kind == "full":  # the others do not let anybody tidy up
            assert_nothing_half_written(folder)
    again = forks.run(work, folder)
    assert again.code == 0, again.err
    assert outcome(folder) == expected
    count("disks that refuse a write", f"{work}, {kind}", 1)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["full", "read-only"])
@pytest.mark.parametrize("work", ["generate data"])
def test_a_disk_that_refuses_a_write(work, kind, forks, fresh, undisturbed, rng):
    whole, _ = undisturbed(work)
    refuse(work, kind, int(rng.integers(1, whole.writes + 1)), forks, fresh, undisturbed)


@pytest.mark.slow
@pytest.mark.parametrize("work", WRITERS)
def test_disks_that_refuse_any_write(work, forks, fresh, undisturbed, rng):
    whole, _ = undisturbed(work)
    places = {1, whole.writes, *rng.integers(1, whole.writes + 1, TRIES - 2).tolist()}
    for number, at in enumerate(sorted(places)):
        refuse(work, [*ERRORS][(number + len(work)) % len(ERRORS)], at, forks, fresh, undisturbed)


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 500 kB: a real one, which the C++ below Orbax fills like everybody else."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=500k", "tmpfs", place], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("mounting a small disk takes the rights of root")
    yield place
    subprocess.run(["umount", "-l", place], check=True)


def test_a_checkpoint_on_a_full_disk(small_disk, forks, fresh, undisturbed):
    """Two checkpoints of 400 kB have no room: the first one stays, whole."""
    _, expected = undisturbed("write checkpoints")
    folder = small_disk / "w"
    folder.mkdir()
    ended = forks.run("write checkpoints", folder)
    assert_told(ended)
    assert "the checkpoint of step 1 is intact" in ended.err or "there is no checkpoint yet" in ended.err
    assert [path.name for path in (folder / "kept").iterdir()] in (["1"], [])
    count("disks that are full", "write checkpoints", 1)
    subprocess.run(["mount", "-o", "remount,size=20m", small_disk], check=True)
    assert forks.run("write checkpoints", folder).code == 0
    kept = {name: value for name, value in outcome(folder).items() if name.startswith("kept")}
    assert kept == {name: value for name, value in expected.items() if name.startswith("kept")}
    assert os.statvfs(small_disk).f_bfree > 0
