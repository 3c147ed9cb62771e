"""What is known of the truth's own repeatability, for every released scene."""

import pytest

from wbgs_jax.data.load import load_dataset, released_scenes
from wbgs_jax.evaluation.score import repeatability


@pytest.mark.parametrize("number", [n for n in released_scenes() if n.isdecimal()])
def test_every_released_scene_says_how_well_it_repeats_itself(number):
    ghz = load_dataset(number).frequencies_hz / 1e9
    each = [repeatability(f"scene{number}", [f]) for f in sorted(set(ghz))]
    assert all(0.8 < value <= 1 for value in each)
    assert repeatability(f"scene{number}", sorted(set(ghz))) == pytest.approx(sum(each) / len(each))


def test_nothing_is_said_of_other_scenes_and_frequencies():
    assert repeatability("kitchen", [1.0]) is None
    assert repeatability("scene1", [1.0, 3.3]) is None and repeatability("scene1", []) is None
