"""How long a training will take: where one like it has been timed, and in words."""

import pytest

from wbgs_jax.fields import Field, default_field, get_field
from wbgs_jax.training import progress
from wbgs_jax.training.progress import duration_words, expected_seconds


def test_a_slower_machine_takes_longer(monkeypatch):
    monkeypatch.setattr(progress, "_probe", lambda: 2 * progress.PROBE_SECONDS)
    field = get_field(default_field())
    whole = expected_seconds(field, "cpu")
    assert whole == 2 * field.seconds["cpu"]
    assert expected_seconds(field, "cpu", 0.25) == whole / 4
    assert expected_seconds(Field, "cpu") is None and expected_seconds(field, "gpu") is None


def test_the_probe_takes_a_moment():
    assert 0 < progress._probe() < 5


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (3.0, "about 10 seconds"),
        (97.0, "about 100 seconds"),
        (200.0, "about 3.5 minutes"),
        (700.0, "about 12 minutes"),
        (14400.0, "about 4.0 hours"),
    ],
)
def test_words(seconds, words):
    assert duration_words(seconds) == words
