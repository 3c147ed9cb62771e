"""The tracer against itself: the same rays give the same spectra, fewer rays others."""

import dataclasses

import pytest

from data_gen import repeatability
from data_gen.scenes import get_scene
from data_gen.settings import SolverSettings

pytestmark = pytest.mark.usefixtures("simulator_backend")

QUICK = SolverSettings(max_depth=2, samples_per_src=2000, max_paths_per_src=20_000, tx_per_call=2)


@pytest.mark.parametrize("few", [2000, 20])
def test_spectra_are_compared_with_those_of_more_rays(monkeypatch, few):
    rays = {1.0: few, 3.0: 2000}
    monkeypatch.setattr(repeatability, "settings", lambda effort: dataclasses.replace(QUICK, samples_per_src=rays[effort]))
    spec = dataclasses.replace(get_scene(2), frequencies_hz=(1e9,))
    found = repeatability.repeatability(spec, 2, 3.0)
    assert found["n_tx"] == 2 and list(found["median_ssim"]) == ["1"]
    assert (found["median_ssim"]["1"] == 1.0) == (few == 2000)
    assert found["p10_ssim"]["1"] <= found["median_ssim"]["1"]
