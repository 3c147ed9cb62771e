"""What tests of the runner share."""

import jax
import pytest

from experiments import runner


@pytest.fixture
def command(tmp_path):
    """A command line that leaves everything in the test's folder."""
    return runner.Command(profile="smoke", results=tmp_path / "results", runs=tmp_path / "runs")


@pytest.fixture
def compilation_cache():
    """What the benchmark switches off is on again for the tests that follow."""
    used = jax.config.jax_enable_compilation_cache
    yield
    jax.config.update("jax_enable_compilation_cache", used)
