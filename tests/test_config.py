"""Settings: presets, JSON, limits."""

import dataclasses
import json

import pytest

from experiments.choices import CHANGES, changed_settings
from wbgs_jax.config import PRESETS, Settings, check, from_dict, limit_steps, to_dict
from wbgs_jax._util.errors import UserError


@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_are_valid_and_survive_json(name):
    check(PRESETS[name])
    assert from_dict(json.loads(json.dumps(to_dict(PRESETS[name])))) == PRESETS[name]


@pytest.mark.parametrize("name", list(CHANGES))
def test_every_measured_choice_is_a_valid_configuration_and_changes_something(name):
    settings = changed_settings(name, 1000)
    check(settings)
    assert settings.optim.steps == 1000
    assert (settings != changed_settings("default", 1000)) == (name != "default")


def test_small_data_sets_get_fewer_steps():
    settings = PRESETS["cpu"]
    assert limit_steps(settings, 10**6).optim.steps == settings.optim.steps
    assert limit_steps(settings, 8).optim.steps == settings.optim.min_steps
    some = limit_steps(settings, 1500).optim.steps
    assert some == settings.optim.max_epochs * 1500 / settings.optim.batch and some % settings.loop.epoch_steps == 0


@pytest.mark.parametrize(
    ("group", "change", "message"),
    [
        ("optim", {"steps": 0}, "optim.steps"),
        ("optim", {"steps": 75}, "multiple"),
        ("optim", {"batch": 0}, "optim.batch"),
        ("optim", {"ssim_weight": 1.5}, "between 0 and 1"),
        ("wideband", {"gaussians": 3}, "at least 4"),
        ("wideband", {"tx_octaves": -1}, "tx-octaves"),
        ("wideband", {"fusion": 4}, "fusion"),
        ("loop", {"keep_checkpoints": 0}, "keep-checkpoints"),
    ],
)
def test_settings_that_cannot_work_are_refused(group, change, message):
    settings = Settings()
    broken = dataclasses.replace(settings, **{group: dataclasses.replace(getattr(settings, group), **change)})
    with pytest.raises(UserError, match=message):
        check(broken)


def test_settings_of_another_version_are_refused():
    values = to_dict(Settings())
    values["optim"]["momentum"] = 0.9
    with pytest.raises(UserError, match="momentum"):
        from_dict(values)
    del values["optim"]["momentum"], values["optim"]["batch"]
    with pytest.raises(UserError, match="batch"):
        from_dict(values)
    del values["optim"]
    with pytest.raises(UserError, match="optim"):
        from_dict(values)
