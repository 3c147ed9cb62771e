"""What tests of the runner share."""

import dataclasses

import jax
import numpy as np
import pytest
from builders import synthetic

from experiments import runner
from experiments.paper import GHZ_10
from wbgs_jax.data.scene_file import save_scene


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


@pytest.fixture
def scene(monkeypatch, tmp_path):
    """A tiny scene 1 with the ten frequencies, which other processes find too; what is compiled stays compiled."""
    monkeypatch.setattr(runner.jax, "clear_caches", lambda: None)
    monkeypatch.setattr(synthetic, "FREQUENCIES_HZ", np.array(GHZ_10) * 1e9)
    monkeypatch.setenv("WBGS_DATA", str(tmp_path / "data"))
    save_scene(tmp_path / "data" / "scene1.npz", dataclasses.replace(synthetic.tiny_scene(), name="scene1"))
