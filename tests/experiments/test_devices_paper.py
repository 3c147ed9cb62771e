"""What is calculated for more devices than there are."""

import numpy as np
import pytest

from experiments.studies.devices_paper import DEVICES, LINKS, on_paper, scaling, step_s

PARTS = {"shared_s": 0.01, "spectrum_s": 0.004, "gradient_bytes": 400_000}


@pytest.mark.parametrize("link", LINKS)
def test_one_device_exchanges_nothing(link):
    assert step_s(PARTS, 1, 8, link) == pytest.approx(0.01 + 8 * 0.004)


def test_scaling_begins_at_one_and_falls_behind():
    for link in LINKS:
        found = scaling(PARTS, link, 1.0)
        strong, weak = (np.array([found[kind][str(n)] for n in DEVICES]) for kind in ("strong_speedup", "weak_efficiency"))
        assert strong[0] == weak[0] == 1
        assert (strong <= DEVICES).all() and (np.diff(weak) <= 0).all()


def test_the_exchange_weighs_more_on_faster_devices():
    slow, fast = (scaling(PARTS, "between_machines", faster)["strong_speedup"]["64"] for faster in (1.0, 50.0))
    assert fast < slow


def test_the_part_that_all_do_limits_what_many_gain():
    report = on_paper({"wideband": PARTS})
    of = report["wideband"]["cpu"]
    assert of["within_a_machine"]["strong_speedup"]["64"] < of["limit"] == pytest.approx(1 + 64 * 0.4)
    assert report["thousand_scenes_hours"]["1"] == pytest.approx(194.4, abs=0.1)
