"""What a person waits for: announced durations are read from lines of the terminal."""

import pytest

from experiments.studies.waiting_times import announced_seconds
from wbgs_jax.training.progress import duration_words


@pytest.mark.parametrize(("seconds", "read"), [(45.0, 40), (130.0, 120), (200.0, 210), (350.0, 360), (7200.0, 7200)])
def test_announced_durations_are_those_of_the_command(seconds, read):
    assert announced_seconds(f"1400 steps, {duration_words(seconds)} on this machine; Ctrl-C stops it") == read


def test_other_lines_announce_nothing():
    assert announced_seconds("step 50/1400  loss 0.2  90 s left") is None
