"""The console script, and what commands say of themselves: help that fits a screen, settings of one field, refusals."""

import re

import pytest
from builders.commands import assert_error_for_people, call, in_a_process
from builders.synthetic import tiny_scene
from builders.toys import RippleField, registered

import wbgs_jax
from wbgs_jax.commands import main as cli
from wbgs_jax.commands import train as train_command
from wbgs_jax.config import sections
from wbgs_jax.data.image_folder import load_layout
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.fields import field_names, get_field

LINES, COLUMNS = 40, 100
"""Of a screen."""


@pytest.fixture(autouse=True)
def screen(monkeypatch):
    monkeypatch.setenv("COLUMNS", str(COLUMNS))


@pytest.fixture
def script(monkeypatch):
    """`wbgs-jax ARGUMENTS` in this process."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["wbgs-jax", *map(str, arguments)])
        return call(lambda _: cli.dispatch())

    return run


def rows(text):
    """Lines of a screen that a text takes."""
    return sum(max(1, -(-len(line.rstrip()) // COLUMNS)) for line in text.splitlines())


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_the_script_lists_its_commands(script, arguments):
    result = script(*arguments)
    assert (result.code, result.err) == (0, "")
    for name, entry in cli.COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(entry.help)}$", result.out, re.MULTILINE)
    assert rows(result.out) <= LINES


def test_the_script_says_its_version(script):
    result = script("--version")
    assert (result.code, result.out, result.err) == (0, f"{wbgs_jax.__version__}\n", "")


@pytest.mark.parametrize("word", ["fly", "--fly", "Train"])
def test_an_unknown_command_is_refused(script, word):
    assert_error_for_people(script(word), repr(word), *cli.COMMANDS)


def test_the_script_in_a_process_of_its_own():
    """Quickly: nothing is loaded to say what there is."""
    result = in_a_process("wbgs_jax", "fly")
    assert_error_for_people(result, "fly", *cli.COMMANDS)


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_helps_on_one_screen(script, name):
    result = script(name, "--help")
    assert (result.code, result.err) == (0, "")
    assert f"wbgs-jax {name}" in result.out.splitlines()[0]
    assert rows(result.out) <= LINES


def test_the_help_of_a_training_says_where_the_settings_are(script):
    result = script("train", "--field", "wave", "--help")
    assert "--field wave --help-settings" in " ".join(result.out.split())
    assert "--wave." not in result.out and "--optim." not in result.out


def settings_in(text):
    return set(re.findall(r"--([a-z0-9]+)\.[a-z]", text))


@pytest.mark.parametrize("field", field_names())
def test_the_settings_that_are_listed_are_those_of_the_field_alone(script, field):
    result = script("train", "--field", field, "--help-settings")
    assert (result.code, result.err) == (0, "")
    parts = sections(get_field(field).presets["cpu"], field)
    assert settings_in(result.out) == set(parts)
    for name, part in parts.items():
        for setting in vars(part):
            assert f"--{name}.{setting.replace('_', '-')}" in result.out
    assert "--scene" in result.out  # beside the command's own


def test_the_settings_of_a_field_of_ones_own_are_listed_too(script):
    with registered(RippleField):
        result = script("train", "--field=ripple", "--help-settings")
    assert settings_in(result.out) == {"ripple", "optim", "loop"} and "--ripple.learning-rate" in result.out


@pytest.mark.parametrize("preset", ["smoke", "cpu", "gpu"])
def test_defaults_are_those_of_the_preset(preset):
    command, settings = train_command.parse(["--scene", "1", "--preset", preset, "--field", "wave"])
    assert settings == get_field("wave").presets[preset]
    assert (command.field, command.preset, command.scene) == ("wave", preset, "1")


def test_a_setting_of_the_field_and_one_of_the_optimiser():
    _, settings = train_command.parse(
        ["--scene=1", "--field=wideband", "--preset=cpu", "--wideband.width", "7", "--optim.steps", "50"]
    )
    default = get_field("wideband").presets["cpu"]
    assert (settings.field.width, settings.optim.steps) == (7, 50)
    assert settings.density == default.density and settings.loop == default.loop


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--field", "wideband", "--wave.permittivity", "9"], "--wave.permittivity"),
        (["--field", "wave", "--wideband.width", "9"], "--wideband.width"),
        (["--field", "nerf2", "--density.every", "9"], "--density.every"),
        (["--wideband.no-such-setting", "9"], "--wideband.no-such-setting"),
        (["--no-such-option"], "--no-such-option"),
        (["--wideband.width", "wide"], "wide"),
        (["--seed", "one"], "one"),
    ],
)
def test_options_that_there_are_not_are_refused(tmp_path, arguments, named):
    """One message, exit code 2, and nothing is written."""
    result = call(train_command.main, "--scene", "1", "--out", tmp_path / "run", *arguments)
    assert (result.code, result.out) == (2, "")
    assert named in result.err and len(result.err.splitlines()) <= 10 and "Traceback" not in result.err
    assert list(tmp_path.iterdir()) == []


def test_a_scene_file_becomes_a_folder_of_spectra(script, tmp_path):
    save_scene(tmp_path / "box.npz", tiny_scene())
    result = script("layout", tmp_path / "box.npz", tmp_path / "folder")
    assert (result.code, result.out) == (0, ""), result.err
    assert len(load_layout(tmp_path / "folder")) == 18
    assert_error_for_people(script("layout", tmp_path / "box.npz"), "SCENE.npz FOLDER")
    assert_error_for_people(script("layout", tmp_path / "gone.npz", tmp_path / "other"), "gone.npz")
    assert not (tmp_path / "other").exists()
