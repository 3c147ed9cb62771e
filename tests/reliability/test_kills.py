"""Kill -9 at writes and at random times, again and again: the last restart ends with what an undisturbed run ends with, bit for
bit, and nothing else lies about."""

import dataclasses
import signal

import pytest
from builders.reliability.faults import Fault
from builders.reliability.ledger import count
from builders.reliability.outcomes import outcome
from builders.synthetic import FIELDS

KILLS = {
    **{f"train {field}": 3 for field in FIELDS},
    "write checkpoints": 25,
    "generate data": 20,
    "predict": 6,
    "run experiments": 5,
}
"""How often a piece of work is killed before it may end: together more than 60 times."""


def disturb(work: str, kills: int, forks, fresh, undisturbed, rng) -> None:
    whole, expected = undisturbed(work)
    folder, killed, at_writes = fresh(work), 0, 0
    for number in range(kills * 3):
        if killed == kills:
            break
        fault = Fault("kill", at=1 + int(rng.integers(whole.writes)))
        if number % 3 == 2:
            fault = Fault(after_s=float(rng.uniform(0.2, 0.9) * whole.seconds))
        ended = forks.run(work, folder, fault)
        assert ended.killed or ended.code == 0, ended.err
        killed += ended.killed
        at_writes += ended.killed and fault.kind == "kill"
        if not ended.killed:  # the work was done before: it begins anew
            assert_equal(outcome(folder), expected)
            folder = fresh(work)
    last = forks.run(work, folder)
    assert last.code == 0, last.err
    assert_equal(outcome(folder), expected)
    assert killed
    count("kills at writes", work, at_writes)
    count("kills at random times", work, killed - at_writes)


def assert_equal(found, expected) -> None:
    assert sorted(found) == sorted(expected)
    for name, value in expected.items():
        assert found[name] == value, name


@pytest.mark.parametrize("work", ["generate data", "write checkpoints"])
def test_a_few_kills(work, forks, fresh, undisturbed, rng):
    disturb(work, 3, forks, fresh, undisturbed, rng)


@pytest.mark.slow
@pytest.mark.parametrize("work", KILLS)
def test_many_kills(work, forks, fresh, undisturbed, rng):
    disturb(work, KILLS[work], forks, fresh, undisturbed, rng)


@pytest.mark.slow
def test_signals_end_a_training_that_goes_on(forks, fresh, undisturbed, rng):
    """Ctrl-C and the signal of a batch system: saved, told in one line, and gone on with."""
    work = "train nerf2"
    whole, expected = undisturbed(work)
    folder = fresh(work)
    for number in (signal.SIGINT, signal.SIGTERM):
        fault = Fault("kill", at=int(rng.integers(whole.writes // 4, whole.writes // 2)), signal=number)
        ended = forks.run(work, folder, fault)
        assert ended.code in (0, 2, 130, -signal.SIGTERM) and "Traceback" not in ended.err, ended.err
        count("signals", number.name, 1)
    assert forks.run(work, folder).code == 0
    assert_equal(outcome(folder), expected)


def test_a_clock_that_jumps_changes_nothing(forks, fresh, undisturbed):
    """Files of the future and of the past are files."""
    import os

    work = "write checkpoints"
    _, expected = undisturbed(work)
    folder = fresh(work)
    forks.run(work, folder, dataclasses.replace(Fault("kill"), at=60))
    for number, path in enumerate(sorted(folder.rglob("*"))):
        os.utime(path, (0, 0) if number % 2 else (4e9, 4e9))
    assert forks.run(work, folder).code == 0
    assert_equal(outcome(folder), expected)
    count("clocks", work, 1)
