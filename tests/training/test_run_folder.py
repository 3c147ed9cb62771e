"""The run folder's configuration: there and back through JSON, and what does not belong there."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from builders.synthetic import tiny_scene, tiny_settings
from builders.untrained import STEP, make_field, make_params, make_run

import wbgs_jax
from wbgs_jax._util.errors import UserError
from wbgs_jax.config import PRESETS, changed, from_sections, sections
from wbgs_jax.data import save_scene
from wbgs_jax.data.image_folder import export_layout
from wbgs_jax.fields import field_names, get_field
from wbgs_jax.training.run_folder import (
    RunConfig,
    difference,
    load_trained,
    prepare_folder,
    read_config,
    write_config,
)

CONFIG = RunConfig("scene.npz", "wideband", "smoke", 3, 2.4, get_field("wideband").presets["smoke"])


@pytest.mark.parametrize("field", field_names())
@pytest.mark.parametrize("preset", PRESETS)
def test_round_trip_through_the_folder(tmp_path, preset, field):
    settings = get_field(field).presets[preset]
    config = dataclasses.replace(CONFIG, preset=preset, field=field, settings=settings, frequency_ghz=None)
    write_config(tmp_path / "run", config)
    again = read_config(tmp_path / "run")
    assert again == config
    assert type(again.settings.field) is type(settings.field)
    assert json.loads((tmp_path / "run" / "config.json").read_text())["version"] == wbgs_jax.__version__


def test_what_is_not_a_default_comes_back_too(tmp_path):
    config = dataclasses.replace(
        CONFIG, train_ghz=(1.0, 94.0), train_tx=3, validation=0.25, receiver=1, test_box=(0.0, 0.0, 0.0, 1.0, 2.0, 3.5)
    )
    write_config(tmp_path / "run", config)
    assert read_config(tmp_path / "run") == config
    assert isinstance(read_config(tmp_path / "run").train_ghz, tuple)
    assert isinstance(read_config(tmp_path / "run").settings.field.radiance_widths, tuple)


def test_other_data_have_the_frequency_that_they_record(tmp_path):
    """Without one, that of the run."""
    folder = tmp_path / "box"
    export_layout(tiny_scene(kind="pas"), folder)
    config = dataclasses.replace(CONFIG, source=str(folder))
    assert set(config.other_data(str(folder)).frequencies_hz) == {1e9, 10e9, 94e9}
    (folder / "freq.txt").unlink()
    assert set(config.other_data(str(folder)).frequencies_hz) == {2.4e9}
    gateway = folder / "gateway_info.yml"
    gateway.write_text(f"frequency: 5\n{gateway.read_text()}")
    assert set(config.other_data(str(folder)).frequencies_hz) == {5e9}
    assert set(config.dataset().frequencies_hz) == {2.4e9}, "as it was trained"
    save_scene(tmp_path / "box.npz", tiny_scene())
    assert set(config.other_data(str(tmp_path / "box.npz")).frequencies_hz) == {1e9, 10e9, 94e9}


def edited(tmp_path, edit):
    """A run folder whose config.json was tampered with."""
    write_config(tmp_path, CONFIG)
    values = json.loads((tmp_path / "config.json").read_text())
    edit(values)
    (tmp_path / "config.json").write_text(json.dumps(values))
    return tmp_path


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (lambda v: v["settings"]["optim"].update(momentum=0.9), "momentum"),
        (lambda v: v["settings"].update(wavelet={}), "wavelet"),
        (lambda v: v["settings"].pop("density"), "density"),
        (lambda v: v.pop("seed"), "seed"),
        (lambda v: v.update(settings=[]), "settings"),
        (lambda v: v["settings"].update(optim=7), "settings"),
    ],
)
def test_settings_of_another_version_are_named(tmp_path, edit, named):
    with pytest.raises(UserError, match=named) as error:
        read_config(edited(tmp_path, edit))
    assert "version" in str(error.value)


@pytest.mark.parametrize("content", ["", "{", "[]", "7", "null"])
def test_a_config_that_is_none(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(UserError, match=r"config\.json"):
        read_config(tmp_path)


@pytest.mark.parametrize("place", ["missing", "empty", "file"])
def test_a_folder_without_a_config(tmp_path, place):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="not a run folder"):
        load_trained(tmp_path / place)


def test_no_checkpoint_yet(tmp_path):
    write_config(tmp_path, CONFIG)
    with pytest.raises(UserError, match=r"no checkpoint yet.*--resume"):
        load_trained(tmp_path)


def test_difference_names_the_first_setting():
    assert difference(CONFIG, CONFIG) == ""
    assert difference(CONFIG, dataclasses.replace(CONFIG, seed=4)) == "seed: 3, not 4"
    assert difference(CONFIG, dataclasses.replace(CONFIG, validation=0.2)) == "validation: 0.1, not 0.2"
    settings = changed(CONFIG.settings, {"optim": {"batch": 99}})
    changed_batch = difference(CONFIG, dataclasses.replace(CONFIG, settings=settings))
    assert changed_batch == f"settings.optim.batch: {CONFIG.settings.optim.batch}, not 99"


@pytest.mark.parametrize("field", field_names())
def test_every_setting_counts_in_a_difference(field):
    """A resumed run must not silently go on with other settings, whichever they are."""
    config = dataclasses.replace(CONFIG, field=field, settings=get_field(field).presets["smoke"])
    for section, part in sections(config.settings, field).items():
        for setting in dataclasses.fields(part):
            value = getattr(part, setting.name)
            other = not value if isinstance(value, bool) else (value, "other")
            edited = sections(config.settings, field) | {section: unchecked(part, **{setting.name: other})}
            settings = from_sections(edited, config.settings, field)
            found = difference(config, dataclasses.replace(config, settings=settings))
            assert found.startswith(f"settings.{section}.{setting.name}: "), (section, setting.name)


def unchecked(value, **changes):
    """`dataclasses.replace` without looking at types."""
    made = object.__new__(type(value))
    for field in dataclasses.fields(value):
        object.__setattr__(made, field.name, changes.get(field.name, getattr(value, field.name)))
    return made


def test_a_folder_belongs_to_one_run(tmp_path):
    """It is made, or it is the run's own and to be resumed; anything else in it stays as it is."""
    prepare_folder(tmp_path / "run", CONFIG, resume=False)
    assert read_config(tmp_path / "run") == CONFIG
    prepare_folder(tmp_path / "run", CONFIG, resume=True)
    with pytest.raises(UserError, match="already holds this run; add --resume"):
        prepare_folder(tmp_path / "run", CONFIG, resume=False)
    with pytest.raises(UserError, match=r"another configuration \(seed: 3, not 4\)"):
        prepare_folder(tmp_path / "run", dataclasses.replace(CONFIG, seed=4), resume=True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="holds other files"):
        prepare_folder(tmp_path / "other", CONFIG, resume=True)
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["notes.txt"]


def test_a_trained_field_is_the_one_that_was_saved(tmp_path):
    """Parameters and what never changes, without the data: they may be gone."""
    folder = make_run(tmp_path / "box")
    folder.with_suffix(".npz").unlink()
    trained = load_trained(folder)
    assert (trained.step, trained.seconds) == (STEP, 1.0)
    assert trained.origin() == {"field": "wideband", "preset": "smoke", "seed": 0, "step": STEP}
    for own, expected in ((trained.params, make_params()), (trained.field, make_field())):
        assert jax.tree.structure(own) == jax.tree.structure(expected)
        for x, y in zip(jax.tree.leaves(own), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(x, y)
            assert x.dtype == y.dtype
    with pytest.raises(UserError, match=r"the data of this training, .*box\.npz, are missing; put them back"):
        trained.dataset()


def test_a_checkpoint_of_other_settings_does_not_fit(tmp_path):
    folder = make_run(tmp_path / "box")
    settings = tiny_settings(field={"width": 16})
    write_config(folder, dataclasses.replace(read_config(folder), settings=settings))
    with pytest.raises(UserError, match="does not fit this configuration"):
        load_trained(folder)
