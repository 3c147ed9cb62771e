"""How long a training will take: where one like it has been timed, and in words."""

import jax
import pytest

from wbgs_jax.fields import Field, default_field, get_field
from wbgs_jax.training import progress
from wbgs_jax.training.progress import duration_words, expected_seconds


def test_a_slower_machine_takes_longer(monkeypatch):
    monkeypatch.setattr(progress, "_probe", lambda: 2 * progress.PROBE_SECONDS)
    monkeypatch.setattr(progress, "has_compiled", lambda _: False)
    field = get_field(default_field())
    whole = expected_seconds(field, "cpu")
    assert whole == 2 * field.seconds["cpu"][1]
    assert expected_seconds(field, "cpu", 0.25) == whole / 4
    assert expected_seconds(Field, "cpu") is None and expected_seconds(field, "gpu") is None


def test_compiled_programs_shorten_it(tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "_probe", lambda: progress.PROBE_SECONDS)
    before = jax.config.jax_compilation_cache_dir
    try:
        for folder in (None, str(tmp_path), str(tmp_path)):
            jax.config.update("jax_compilation_cache_dir", folder)
            assert expected_seconds(get_field("wave"), "smoke") == get_field("wave").seconds["smoke"][1]
            (tmp_path / "jit__observe-01-cache").touch()
        (tmp_path / "jit_run_epoch-02-cache").touch()
        assert expected_seconds(get_field("wave"), "smoke") == get_field("wave").seconds["smoke"][0]
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.parametrize("name", ["hybrid", "wave", "wideband"])
def test_compilation_takes_part_of_the_time(name):
    assert all(0.4 * whole < compiled < whole for compiled, whole in get_field(name).seconds.values())


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
