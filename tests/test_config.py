"""Settings: presets, JSON, limits."""

import dataclasses
import json

import pytest
from builders.synthetic import tiny_settings

from wbgs_jax._util.errors import UserError
from wbgs_jax.config import PRESETS, changed, check, from_dict, from_sections, limit_steps, present_option, sections, to_dict
from wbgs_jax.fields import field_names, get_field
from wbgs_jax.fields.base import check_config

SETTINGS = get_field("wideband").presets["cpu"]


def check_all(field, settings):
    """What a command line checks before any work is done."""
    check(settings)
    check_config(field, settings.field)


@pytest.mark.parametrize(
    ("field", "preset"), [(field, preset) for field in field_names() for preset in get_field(field).presets]
)
def test_presets_are_valid_and_survive_json(field, preset):
    settings = get_field(field).presets[preset]
    check_all(field, settings)
    values = json.loads(json.dumps(to_dict(settings, field)))
    assert from_dict(values, get_field(field).presets["cpu"], field) == settings


@pytest.mark.parametrize("field", field_names())
def test_a_field_has_its_own_settings_and_those_of_the_controls_that_it_asks_for(field):
    assert get_field(field).presets.keys() >= PRESETS.keys()
    for settings in get_field(field).presets.values():
        parts = sections(settings, field)
        own = (
            {"wave": settings.field.wave, "wideband": settings.field.wideband} if field == "hybrid" else {field: settings.field}
        )
        hooks = {name.rpartition(".")[2] for name in get_field(field).hooks} - {"expert_weights"}  # which has no settings
        assert parts.keys() == {*own, "optim", "loop", *hooks}
        assert all(parts[name] is section for name, section in own.items())
        assert from_sections(parts, settings, field) == settings


def test_the_papers_preset_is_its_own_form():
    """Every value that the paper or the authors' code gives (docs/baselines.md), and as many steps on any data."""
    paper = get_field("wideband").presets["paper"]
    inputs = (paper.field.gaussian_octaves, paper.field.tx_octaves, paper.field.frequency_octaves, paper.field.frequency_scale)
    assert inputs == (10, 10, 10, "ghz") and not paper.field.relative and paper.field.fusion == 0
    assert (paper.field.width, paper.field.depth, paper.field.skip, paper.field.radiance_widths) == (128, 8, 4, (128, 64))
    assert (paper.field.network_lr, paper.field.opacity_lr, paper.field.log_scales_lr) == (8e-4, 0.025, 0.005)
    assert (paper.field.means_lr, paper.field.gaussians, paper.field.ssim_weight) == (0, 0, 0.2)
    assert paper.field.network_lr * paper.optim.final_fraction == pytest.approx(1e-6)
    control = paper.density
    assert (control.every, control.start, control.stop_fraction * paper.optim.steps) == (100, 500, 15_000)
    assert (control.gradient_threshold, control.prune_attenuation) == (2e-4, 0.005)
    assert (control.reset_every, control.reset_attenuation) == (3000, 0.01)
    assert limit_steps(paper, 100).optim.steps == paper.optim.steps == 200_000 and paper.optim.batch == 1


def test_small_data_sets_get_fewer_steps():
    assert limit_steps(SETTINGS, 10**6).optim.steps == SETTINGS.optim.steps
    assert limit_steps(SETTINGS, 8).optim.steps == SETTINGS.optim.min_steps
    some = limit_steps(SETTINGS, 1000).optim.steps
    assert some == SETTINGS.optim.max_epochs * 1000 / SETTINGS.optim.batch and some % SETTINGS.loop.epoch_steps == 0


def test_fields_with_paths_converge_sooner():
    """Their share of the steps counts unless they predict no paths, the data are few, or more steps are demanded."""
    own = get_field("hybrid").presets["cpu"]
    assert [limit_steps(own, 10**6, no_paths).optim.steps for no_paths in (False, True)] == [1400, 2400]
    assert limit_steps(own, 8).optim.steps == 1000
    assert limit_steps(changed(own, {"optim": {"min_steps": 2400}}), 10**6).optim.steps == 2400
    assert limit_steps(changed(own, {"optim": {"steps": 500}}), 10**6).optim.steps == 500


@pytest.mark.parametrize(
    ("field", "section", "change", "message"),
    [
        ("wideband", "optim", {"steps": 0}, "optim.steps"),
        ("wideband", "optim", {"steps": 75}, "multiple"),
        ("wideband", "optim", {"batch": 0}, "optim.batch"),
        ("wideband", "density", {"every": 130}, "density.every 130 is not a multiple"),
        ("wideband", "density", {"reset_every": 130}, "density.reset-every 130 is not a multiple"),
        ("wideband", "optim", {"virtual": 2.0}, "optim.virtual .* between 0 and 1"),
        ("wideband", "optim", {"warmup": 2.0}, "optim.warmup .* between 0 and 1"),
        ("wideband", "optim", {"curriculum": 3.0}, "optim.curriculum .* between 0 and 1"),
        ("wideband", "optim", {"final_fraction": -1.0}, "optim.final-fraction .* between 0 and 1"),
        ("wideband", "optim", {"max_epochs": -1.0}, "optim.max-epochs .* at least 0"),
        ("wideband", "density", {"reset_attenuation": 0.0}, "density.reset-attenuation .* strictly between 0 and 1"),
        ("wideband", "density", {"reset_attenuation": 1.0}, "density.reset-attenuation .* strictly between 0 and 1"),
        ("wideband", "density", {"max_gaussians": -5}, "density.max-gaussians .* at least 1"),
        ("wideband", "density", {"prune_attenuation": 2.0}, "density.prune-attenuation .* between 0 and 1"),
        ("wideband", "field", {"network_lr": -1e-3}, "--wideband.network-lr is -0.001; it must be at least 0"),
        ("wave", "field", {"materials_lr": -1e-3}, "wave.materials-lr"),
        ("nerf2", "field", {"network_lr": -1e-3}, "nerf2.network-lr"),
        ("wideband", "loop", {"keep_checkpoints": 0}, "keep-checkpoints"),
        ("wideband", "field", {"ssim_weight": 1.5}, "wideband.ssim-weight .* between 0 and 1"),
        ("wideband", "field", {"gaussians": 3}, "wideband.gaussians .* at least 4"),
        ("wideband", "field", {"tx_octaves": -1}, "wideband.tx-octaves"),
        ("wideband", "field", {"fusion": 4}, "wideband.fusion"),
        ("wideband", "field", {"width": 0}, "wideband.width"),
        ("wrfgs", "field", {"fusion": 4}, "wrfgs.fusion"),
        ("wrfgs", "field", {"radiance_frequency": True}, "no frequency input"),
        ("wave", "field", {"max_facets": 10**6}, "wave.max-facets"),
        ("wave", "calibration", {"spectra": 0}, "calibration.spectra"),
        ("nerf2", "field", {"directions": 10**6}, "nerf2.directions"),
        ("nerf2", "field", {"point_octaves": -1}, "nerf2.point-octaves"),
    ],
)
def test_settings_that_cannot_work_are_refused(field, section, change, message):
    broken = changed(get_field(field).presets["cpu"], {section: change})
    with pytest.raises(UserError, match=message):
        check_all(field, broken)


def test_settings_of_another_version_are_refused():
    def read(values):
        return from_dict(values, SETTINGS, "wideband")

    values = to_dict(SETTINGS, "wideband")
    values["optim"]["momentum"] = 0.9
    with pytest.raises(UserError, match="momentum"):
        read(values)
    del values["optim"]["momentum"], values["optim"]["batch"]
    with pytest.raises(UserError, match="batch"):
        read(values)
    del values["optim"]
    with pytest.raises(UserError, match="optim"):
        read(values)
    with pytest.raises(UserError, match="wideband"):
        from_dict(to_dict(SETTINGS, "wideband"), get_field("wave").presets["cpu"], "wave")


def test_a_setting_that_files_did_not_have_has_the_value_of_then():
    """A run from before there was a precision was trained in that of its device."""
    values = to_dict(SETTINGS, "wideband")
    del values["wideband"]["precision"]
    assert from_dict(values, SETTINGS, "wideband") == SETTINGS and SETTINGS.field.precision == "device"
    values["wideband"]["precision"] = "bfloat16"
    assert from_dict(values, SETTINGS, "wideband").field.precision == "bfloat16"


def test_settings_survive_a_dictionary():
    settings = tiny_settings(field={"relative": False, "means_lr": 1 / 3})
    assert from_dict(json.loads(json.dumps(to_dict(settings, "wideband"))), SETTINGS, "wideband") == settings


def test_some_settings_are_changed_and_all_others_stay():
    after = changed(SETTINGS, {"field": {"width": 7}, "optim": {"steps": 50}})
    assert (after.field.width, after.optim.steps) == (7, 50)
    assert dataclasses.replace(after, field=SETTINGS.field, optim=SETTINGS.optim) == SETTINGS
    assert dataclasses.replace(after.field, width=SETTINGS.field.width) == SETTINGS.field
    with pytest.raises(TypeError, match="no_such_setting"):
        changed(SETTINGS, {"optim": {"no_such_setting": 1}})


OLD_CALIBRATION = {
    "sure": "n_sigma",
    "antenna_sure": "antenna_n_sigma",
    "absent_spectra": "spurious_spectra",
    "absent_glance": "spurious_glance",
    "ideal_spectra": "propagation_spectra",
    "tuning_spectra": "array_gain_spectra",
    "geometry_doubt": "geometry_position_std",
    "placement_spectra": "position_std_spectra",
    "clutter_spectra": "absorption_spectra",
    "clutter_steps": "absorption_steps",
}
"""Earlier names of settings, in the section `search`, with their present names."""


def test_the_calibration_of_an_old_run_is_read():
    settings = changed(
        get_field("wave").presets["cpu"], {"calibration": {"n_sigma": 2.5, "geometry": False, "absorption_steps": 7}}
    )
    values = to_dict(settings, "wave")
    old = {new: name for name, new in OLD_CALIBRATION.items()}
    values["search"] = {old.get(name, name): value for name, value in values.pop("calibration").items()}
    assert {"sure", "clutter_steps", "rounds"} <= values["search"].keys()
    assert from_dict(json.loads(json.dumps(values)), get_field("wave").presets["cpu"], "wave") == settings


@pytest.mark.parametrize(
    ("word", "present"),
    [
        *((f"--search.{old}", f"--calibration.{new}") for old, new in OLD_CALIBRATION.items()),
        ("--search.no-geometry", "--calibration.no-geometry"),
        ("--search.sure=3", "--calibration.n-sigma=3"),
        ("--calibration.n-sigma", "--calibration.n-sigma"),
        ("--wave.clutter-cells", "--wave.clutter-cells"),
        ("--out=runs/search.sure", "--out=runs/search.sure"),
        ("--out", "--out"),
        ("search.sure", "search.sure"),
    ],
)
def test_an_old_option_is_the_present_one(word, present):
    assert present_option(word.replace("_", "-") if word.startswith("--s") else word) == present.replace("_", "-")
    calibration = sections(get_field("wave").presets["cpu"], "wave")["calibration"]
    if present.startswith("--calibration.") and present[-8:] != "geometry":
        assert hasattr(calibration, present[len("--calibration.") :].partition("=")[0].replace("-", "_"))
