"""Lines that show the progress of long work in a log."""

import re
import time

import pytest

from wbgs_jax._util import progress_lines
from wbgs_jax._util.progress_lines import CountProgress, Pulse


def test_a_long_call_is_seen_to_be_alive(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """While one call lasts, lines appear at intervals, and none after it."""
    monkeypatch.setattr(progress_lines, "LOG_INTERVAL", 0.05)
    with Pulse(lambda: "compiling"):
        time.sleep(0.4)
    during = capsys.readouterr().err.splitlines()
    time.sleep(0.2)
    assert len(during) >= 3 and set(during) == {"compiling"} and capsys.readouterr().err == ""


def test_remaining_time_leaves_out_the_first_step(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The first of several steps compiles: the remaining time follows from the later ones."""
    monkeypatch.setattr(progress_lines, "LOG_INTERVAL", 1e6)
    with CountProgress("blocks", 4) as progress:
        time.sleep(1.0)
        for _ in range(2):
            progress.advance()
            time.sleep(0.01)
        progress.pulse.print()
        progress.advance(2)
    middle, last = capsys.readouterr().err.splitlines()
    left = re.fullmatch(r"blocks: 2/4  (\d+) s left", middle)
    assert left and int(left[1]) == 0 and last == "blocks: 4/4  0 s left"


def test_nothing_is_printed_unless_wanted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither lines at intervals nor the last one."""
    monkeypatch.setattr(progress_lines, "LOG_INTERVAL", 0.01)
    with CountProgress("blocks", 2, shown=False) as progress:
        time.sleep(0.1)
        progress.advance(2)
    assert capsys.readouterr().err == ""
