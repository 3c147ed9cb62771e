"""The bench of rays: its halls, how tracers are compared, and that missing ones are told and left out."""

import dataclasses

import numpy as np
import pytest
from builders.synthetic import tiny_dataset

from experiments.bench import rays, timing, tracers
from experiments.bench.tracers import Found, compare
from wbgs_jax.fields import coherent
from wbgs_jax.fields.coherent import WaveConfig


@pytest.mark.parametrize("facets", [30, 500])
def test_a_hall_has_the_facets_that_are_asked_for(facets, rng):
    field = coherent.make_field(rays.hall(facets, rng), WaveConfig(max_facets=facets + 100))
    corners = np.asarray(field.facets.corners).reshape(-1, 3)
    assert facets - 6 < len(field.facets.offset) <= facets
    assert (corners >= -1e-5).all() and (corners <= rays.HALL + 1e-5).all()


def found(rng, paths=5, frequencies=3) -> Found:
    return Found(np.cumsum(rng.uniform(0.5, 2, paths)), rng.uniform(0.5, 1, (frequencies, paths)).astype(np.complex64))


def values(ours, theirs):
    return {name: value for name, (value, *_) in compare(ours, theirs).items()}


def test_a_tracer_agrees_with_itself_whatever_the_order(rng):
    one = [found(rng), found(rng)]
    turned = [Found(each.length_m[::-1], each.amplitude[:, ::-1] * np.exp(1j)) for each in one]
    result = values(one, turned)
    assert (result["found_of_ours"], result["ours_found_of"], result["paths_compared"]) == (1, 1, 10)
    assert result["amplitude_90_percent"] < 1e-6 and result["delay_largest"] == 0


def test_differences_and_missing_paths_are_counted(rng):
    one = found(rng)
    longer = Found(one.length_m + 3e-4, 1.02 * one.amplitude)  # metres: a picosecond
    result = values([one], [longer])
    assert result["delay_largest"] == pytest.approx(1.0, rel=1e-2)
    assert result["amplitude_median"] == pytest.approx(0.02, rel=1e-3)
    fewer = Found(one.length_m[1:], one.amplitude[:, 1:])
    result = values([one], [fewer])
    assert result["found_of_ours"] == pytest.approx(0.8) and result["ours_found_of"] == 1
    faint = Found(one.length_m, one.amplitude * np.array([1e-4, 1, 1, 1, 1]))  # not at the mercy of rounding
    assert values([faint], [fewer])["found_of_ours"] == 1


def test_who_hears_nothing_agrees_with_who_hears_nothing(rng):
    silent, one = Found(np.zeros(0), np.zeros((3, 0), np.complex64)), found(rng)
    assert values([silent, one], [silent, one])["paths_compared"] == 5
    for sides in (([silent], [one]), ([one], [silent]), ([silent], [silent])):
        assert values(*sides)["paths_compared"] == 0


def test_tracers_that_are_not_installed_are_left_out(monkeypatch):
    monkeypatch.setattr(tracers, "RIVALS", {"nobody": ("no_such_tracer", None)})
    monkeypatch.setattr(rays, "load_dataset", lambda _: tiny_dataset())
    report = timing.Report()
    rays._measure_rivals(report, timing.Effort(quick=True), "1")
    assert not report.metrics and "pip install no_such_tracer" in report.skipped["rays_scene1_nobody"]


@pytest.mark.heavy
def test_our_side_finds_the_line_of_sight_and_two_reflections():
    dataset = tiny_dataset()
    dataset = dataclasses.replace(dataset, materials=None)
    ours = tracers.Ours(dataset, rays.RIVAL_CONFIG)
    tx, frequencies = dataset.tx_positions[:1], np.array([2.4e9, 28e9])
    (one,) = ours.paths(tx, frequencies)
    sight = np.linalg.norm(tx[0] - np.asarray(dataset.receiver().position))
    assert one.amplitude.shape == (2, len(one.length_m)) and len(one.length_m) > 1
    np.testing.assert_allclose(one.length_m.min(), sight, rtol=1e-5)
    friis = 299_792_458.0 / frequencies / (4 * np.pi * sight)
    departing = (tx[0] - np.asarray(dataset.receiver().position)) / sight
    assert np.all(np.abs(one.amplitude[:, one.length_m.argmin()]) <= friis * 1.001) and abs(departing[2]) <= 1
