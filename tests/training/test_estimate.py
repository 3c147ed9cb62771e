"""How long a training will take: where one like it has been timed, and in words."""

import jax
import pytest

from wbgs_jax.fields import Field, default_field, get_field
from wbgs_jax.training import progress
from wbgs_jax.training.progress import duration_words, expected_seconds


@pytest.fixture
def cache(tmp_path):
    """An empty cache of compiled programs."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def test_a_slower_machine_takes_longer(monkeypatch, cache):
    monkeypatch.setattr(progress, "_probe", lambda: 2 * progress.PROBE_SECONDS)
    field = get_field(default_field())
    known = field.seconds["cpu"]
    assert expected_seconds(field, "cpu") == 2 * sum(known)
    assert expected_seconds(field, "cpu", 0.25) == 2 * sum(known) - 1.5 * known.steps
    assert expected_seconds(Field, "cpu") is None and expected_seconds(field, "gpu") is None


def test_programs_of_a_training_shorten_the_next(monkeypatch, cache):
    monkeypatch.setattr(progress, "_probe", lambda: progress.PROBE_SECONDS)
    field, known = get_field("wave"), get_field("wave").seconds["smoke"]
    (cache / "jit__observe-01-cache").touch()  # of an evaluation
    assert expected_seconds(field, "smoke") == sum(known)
    (cache / "jit_run_epoch-02-cache").touch()
    assert expected_seconds(field, "smoke") == known.steps + known.others
    jax.config.update("jax_compilation_cache_dir", None)
    assert expected_seconds(field, "smoke") == sum(known)


def test_a_remaining_time_that_has_run_out_is_not_shown(monkeypatch):
    """Programs that are compiled between two steps take longer than the steps that were timed."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    shown = progress.TrainingProgress(100, shown=False)
    for step in (20, 40, 60):
        now[0] += 10
        shown.update({"step": step, "loss": 0.5})
    assert shown._line() == "step 60/100  loss 0.5  2.0 steps/s  20 s left (30 s)"
    now[0] += 15
    assert "  5 s left (45 s)" in shown._line()
    now[0] += 30
    assert "left" not in shown._line() and shown._line().endswith("2.0 steps/s (75 s)")
    shown.stage("validation: weights")
    assert shown._line() == "validation: weights (75 s)"


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
