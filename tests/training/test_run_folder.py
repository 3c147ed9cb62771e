"""The run folder's configuration: there and back through JSON, and what does not belong there."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import pytest
from synthetic import tiny_dataset, tiny_settings

from wbgs_jax.config import PRESETS, Settings, from_dict, to_dict
from wbgs_jax.data.surface import make_surface
from wbgs_jax._util.errors import UserError
from wbgs_jax.fields import wideband
from wbgs_jax.training.run_folder import RunConfig, difference, load_trained, read_config, write_config

CONFIG = RunConfig("scene.npz", "wideband", "smoke", 3, 2.4, PRESETS["smoke"])


@pytest.mark.parametrize("preset", PRESETS)
def test_round_trip_through_the_folder(tmp_path, preset):
    config = dataclasses.replace(CONFIG, preset=preset, settings=PRESETS[preset], frequency_ghz=None)
    write_config(tmp_path / "run", config)
    assert read_config(tmp_path / "run") == config
    assert isinstance(read_config(tmp_path / "run").settings.wideband.radiance_widths, tuple)


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
    settings = dataclasses.replace(CONFIG.settings, optim=dataclasses.replace(CONFIG.settings.optim, batch=99))
    changed = difference(CONFIG, dataclasses.replace(CONFIG, settings=settings))
    assert changed == f"settings.optim.batch: {CONFIG.settings.optim.batch}, not 99"


def test_every_setting_counts_in_a_difference():
    """A resumed run must not silently go on with other settings, whichever they are."""
    values = to_dict(CONFIG.settings)
    for section, fields in values.items():
        for name, value in fields.items():
            other = {**values, section: {**fields, name: not value if isinstance(value, bool) else (value, "other")}}
            changed = dataclasses.replace(CONFIG, settings=unchecked(other))
            assert difference(CONFIG, changed).startswith(f"settings.{section}.{name}: "), (section, name)


def unchecked(values):
    """`from_dict` without looking at types."""
    sections = {name: object.__new__(type(getattr(Settings(), name))) for name in values}
    for name, section in sections.items():
        for key, value in values[name].items():
            object.__setattr__(section, key, value)
    settings = object.__new__(Settings)
    for name, section in sections.items():
        object.__setattr__(settings, name, section)
    return settings


def test_settings_survive_a_dictionary():
    settings = tiny_settings(wideband={"relative": False}, optim={"means_lr": 1 / 3})
    assert from_dict(json.loads(json.dumps(to_dict(settings)))) == settings


def test_the_skeleton_of_parameters_has_the_shapes_of_real_ones():
    settings = tiny_settings()
    surface = jax.tree.map(jnp.asarray, make_surface(tiny_dataset(), 20, seed=0))
    params = jax.jit(wideband.init, static_argnums=(2, 3))(jax.random.key(0), surface, settings.wideband, 32)
    assert wideband.sizes(params) == {"gaussians": 32}
    abstract = wideband.skeleton(settings.wideband, {"gaussians": 32})
    assert jax.tree.structure(abstract) == jax.tree.structure(params)
    for a, b in zip(jax.tree.leaves(abstract), jax.tree.leaves(params), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
