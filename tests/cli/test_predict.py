"""`wbgs-jax predict`: spectra and pictures, exported fields, and what it says when something is wrong."""

import json
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import call
from PIL import Image
from synthetic import tiny_scene
from toys import RippleConfig, RippleField, registered, toy_settings
from untrained import State, make_coherent_run, make_run

from wbgs_jax import predict as predict_command
from wbgs_jax._util.pytree import pytree
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.fields import Observation
from wbgs_jax.inference.confidence import PowerConfidence, write_confidence
from wbgs_jax.inference.export import load_exported
from wbgs_jax.training import checkpoint
from wbgs_jax.training.run_folder import RunConfig, write_config

INSIDE = ["1,0.5,1.5", "-1,1,1.2"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "box")


def predict(*arguments):
    """Exit code, stdout and lines on stderr."""
    result = call(predict_command.main, *arguments)
    result.lines = result.err.splitlines()
    return result


def test_spectra_and_export_agree(run, tmp_path):
    out, picture, field = tmp_path / "spectra.npz", tmp_path / "new" / "spectra.png", tmp_path / "field.zip"
    files = ["--out", out, "--picture", picture, "--export", field]
    result = predict("--run", run, "--tx", *INSIDE, "--ghz", 28, 1, *files)
    assert (result.code, result.out, len(result.lines)) == (0, "", 3), result.lines
    assert [line.split(":")[0] for line in result.lines] == ["exported", "spectra", "picture"]
    with np.load(out) as archive:
        assert (archive["pas"].shape, archive["pas"].dtype) == ((2, 2, 90, 360), np.float32)
        np.testing.assert_array_equal(archive["tx_positions"], [[1, 0.5, 1.5], [-1, 1, 1.2]])
        np.testing.assert_allclose(archive["frequencies_hz"], [28e9, 1e9])
        assert json.loads(str(archive["meta"]))["scene"] == "box"
        expected = load_exported(field)(archive["tx_positions"][:, None], archive["frequencies_hz"])
        np.testing.assert_allclose(archive["pas"], expected, atol=1e-5)
    with Image.open(picture) as image:
        assert image.format == "PNG" and np.asarray(image.convert("L")).std() > 5


def test_what_the_field_was_not_trained_for_is_a_warning(run, tmp_path):
    result = predict("--run", run, "--tx", INSIDE[0], "9,0,1.5", "--ghz", 28, 100, "--out", tmp_path / "spectra.npz")
    assert result.code == 0
    warnings = [line for line in result.lines if line.startswith("warning: ")]
    assert len(warnings) == 2
    assert "(9, 0, 1.5) m lies outside the box" in warnings[0] and "100 GHz lies outside" in warnings[1]
    assert (tmp_path / "spectra.npz").exists()


ASK = ["--tx", INSIDE[0], "--ghz", "28"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["nothing to do", "--export"]),
        (ASK, ["--out"]),
        (["--tx", INSIDE[0], "--out", "OUT/a.npz"], ["--ghz"]),
        (["--ghz", "28", "--out", "OUT/a.npz"], ["--tx"]),
        (["--out", "OUT/a.npz", "--export", "OUT/a.zip"], ["--tx"]),
        (["--tx", "1,2", "--ghz", "28", "--out", "OUT/a.npz"], ["--tx 1,2 "]),
        (["--tx", "1,2,x", "--ghz", "28", "--out", "OUT/a.npz"], ["1,2,x"]),
        (["--tx", "1,2,nan", "--ghz", "28", "--out", "OUT/a.npz"], ["1,2,nan"]),
        (["--tx", INSIDE[0], "--ghz", "28", "0.9", "--out", "OUT/a.npz"], ["from 1 GHz on, not at 0.9 GHz", "wave or hybrid"]),
        (["--tx", INSIDE[0], "--ghz", "28e9", "--out", "OUT/a.npz"], ["2.8e+10", "0.3 to 100 GHz"]),
        (["--tx", INSIDE[0], "--ghz", "nan", "--out", "OUT/a.npz"], ["nan"]),
        ([*ASK, "--out", "OUT/a.csv"], ["--out", ".npz"]),
        ([*ASK, "--picture", "OUT/a.jpg"], ["--picture", ".png"]),
        (["--export", "OUT/a.bin"], ["--export", ".zip"]),
        ([*ASK, "--rx", "1,2", "--out", "OUT/a.npz"], ["--rx 1,2 "]),
        ([*ASK, "--rx", "1,2,nan", "--out", "OUT/a.npz"], ["1,2,nan"]),
        ([*ASK, "--rx", "1,2,1,0,0,0,0", "--out", "OUT/a.npz"], ["quaternion"]),
        ([*ASK, "--rx", "1,1,1", "--out", "OUT/a.npz"], ["the wideband field knows no receivers but", "wave or hybrid"]),
        (["--export", "RUN/config.json/a.zip"], ["cannot write"]),
    ],
)
def test_what_cannot_be_asked(run, tmp_path, arguments, words):
    places = (word.replace("OUT", str(tmp_path)).replace("RUN", str(run)) for word in arguments)
    result = predict("--run", run, *places)
    assert (result.code, result.out) == (2, "")
    (line,) = result.lines
    assert line.startswith("error: ")
    for word in words:
        assert word in line
    assert list(tmp_path.iterdir()) == []


def test_runs_that_are_none(tmp_path):
    result = predict("--run", tmp_path / "gone", *ASK, "--out", tmp_path / "a.npz")
    assert result.code == 2
    assert result.lines == [
        f"error: {tmp_path / 'gone'} is not a run folder: it has no config.json; train first (make train SCENE=1)"
    ]
    assert list(tmp_path.iterdir()) == []


@pytree
class HearingField(RippleField):
    """Knows powers and snapshots, and no paths."""

    name: ClassVar[str] = "hearing"
    gives: ClassVar = ("pas", "power", "snapshots")

    def render(self, params, plan, query):
        power_db = -60 + query.tx_position[:, 0] + query.frequency_hz / 1e9
        return Observation(super().render(params, plan, query).pas, query.tx_position[:, :1] * jnp.ones(16) * 1j, power_db)


def make_toy_run(folder, field):
    """As `untrained.make_run`, of a toy field."""
    save_scene(folder.with_suffix(".npz"), tiny_scene())
    write_config(folder, RunConfig(str(folder.with_suffix(".npz")), field.name, "smoke", 0, None, toy_settings()))
    state = State(field.init(jax.random.key(0)))
    checkpoint.save(folder / "checkpoints", 3, state, field, {"limits": None, "seconds": 1.0}, keep=1)
    return folder


def test_what_a_field_gives_is_what_can_be_asked_for(tmp_path):
    """Powers and snapshots of a field without paths; nothing of one that knows spectra alone."""
    with registered(HearingField, RippleField):
        run = make_toy_run(tmp_path / "hearing", HearingField(RippleConfig()))
        ask = ["--run", run, "--tx", "1,2,1", "-1,0,2", "--ghz", 2, 5, 9]
        for what, name, expected in (
            ("power", "power_db", -60 + np.array([[1], [-1]]) + np.array([2, 5, 9])),
            ("snapshot", "snapshots", np.broadcast_to(np.array([1j, -1j])[:, None, None], (2, 3, 16))),
        ):
            result = predict(*ask, "--what", what, "--out", tmp_path / f"{what}.npz")
            assert result.code == 0, result.err
            with np.load(tmp_path / f"{what}.npz") as answer:
                np.testing.assert_allclose(answer[name], expected, atol=1e-5)
                assert json.loads(str(answer["meta"]))["field"] == "hearing"
        refused = predict(*ask, "--what", "k-factor", "--out", tmp_path / "k.npz")
        assert (refused.code, len(refused.lines)) == (2, 1)
        assert "the hearing field has no k-factor" in refused.err and "wave" in refused.err
        blind = make_toy_run(tmp_path / "ripple", RippleField(RippleConfig()))
        refused = predict("--run", blind, *ASK, "--what", "power", "--out", tmp_path / "none.npz")
        assert refused.code == 2 and "the ripple field has no power, only spectra" in refused.err
        assert "hearing" in refused.err  # among those that have it
        assert not (tmp_path / "k.npz").exists() and not (tmp_path / "none.npz").exists()


def test_powers_come_with_how_sure_they_are(tmp_path):
    sure = PowerConfidence(jnp.zeros((1, 3)), jnp.zeros(4), jnp.ones(4), jnp.zeros(5), jnp.log(4.0), jnp.asarray(2.0))
    with registered(HearingField):
        run = make_toy_run(tmp_path / "hearing", HearingField(RippleConfig()))
        write_confidence(run, None, sure)
        ask = ["--run", run, "--tx", "1,2,1", "-1,0,2", "--ghz", 2, 5, "--what", "power"]
        result = predict(*ask, "--out", tmp_path / "power.npz")
    assert result.code == 0, result.err
    lines = [line for line in result.err.splitlines() if "within" in line]
    assert len(lines) == 4
    assert lines[1] == "TX (1, 2, 1) m at 5 GHz: -54.0 dB of the transmitted power; expected 1.9 dB off, 90 % within 3.9 dB"
    with np.load(tmp_path / "power.npz") as answer:
        np.testing.assert_allclose(answer["within_db"], np.full((2, 2), 3.9), rtol=1e-5)
        np.testing.assert_allclose(answer["expected_error_db"], np.full((2, 2), 1.9), rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--what", "power"], ["nothing to do"]),
        ([*ASK, "--what", "power"], ["--out"]),
        ([*ASK, "--what", "power", "--picture", "OUT/a.png", "--out", "OUT/a.npz"], ["no --picture"]),
    ],
)
def test_numbers_are_written_and_not_drawn(run, tmp_path, arguments, words):
    test_what_cannot_be_asked(run, tmp_path, arguments, words)


@pytest.fixture(scope="module")
def coherent(tmp_path_factory):
    """A run of the coherent field, untrained."""
    return make_coherent_run(tmp_path_factory.mktemp("runs") / "coherent")


def test_below_the_band_only_paths_answer(coherent, tmp_path):
    out = tmp_path / "low.npz"
    result = predict("--run", coherent, "--tx", INSIDE[0], "--ghz", 0.4, "--what", "power", "--out", out)
    assert result.code == 0
    assert [line for line in result.lines if line.startswith("warning: 0.4 GHz lies below 1 GHz: rays")]
    with np.load(out) as answer:
        assert -80 < answer["power_db"][0, 0] < 0
    result = predict("--run", coherent, "--tx", INSIDE[0], "--ghz", 0.2, "--out", out)
    assert result.code == 2 and "0.3 to 100 GHz" in result.err


def test_the_whole_channel(coherent, tmp_path):
    ask = ["--run", coherent, "--tx", *INSIDE, "--ghz", 2.4, 28]
    for what, options, shapes in (
        ("paths", ["--tx-velocity", "1,0,0"], {}),
        ("frequency-response", ["--band-mhz", 20, "--points", 8], {"frequency_response": (2, 2, 8, 16), "delays_s": (8,)}),
        ("mimo", ["--tx-array", "2x1"], {"mimo": (2, 2, 16, 2), "tx_elements": (2, 3)}),
        ("angular-spread", [], {"angular_spread_deg": (2, 2, 2)}),
    ):
        out = tmp_path / f"{what}.npz"
        result = predict(*ask, "--what", what, *options, "--out", out)
        assert result.code == 0, result.err
        with np.load(out) as answer:
            for name, shape in shapes.items():
                assert answer[name].shape == shape, name
            assert json.loads(str(answer["meta"]))["field"] == "wave"
    with np.load(tmp_path / "paths.npz") as table:
        assert {*table["tx"]} == {0, 1} and np.abs(table["doppler_hz"]).max() > 1
        assert "line of sight" in table["interactions"]
        rows = len(table["tx"])
    result = predict(*ask, "--what", "paths", "--out", tmp_path / "paths.csv")
    assert result.code == 0, result.err
    assert len((tmp_path / "paths.csv").read_text().splitlines()) == 1 + rows


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--what", "paths"], ["knows no paths", "wave or hybrid"]),
        (["--what", "mimo"], ["knows no paths"]),
        (["--what", "frequency-response"], ["knows no paths"]),
        (["--what", "mimo", "--tx-array", "4"], ["--tx-array 4 is no array"]),
        (["--what", "mimo", "--tx-array", "0x3"], ["--tx-array 0x3"]),
        (["--what", "paths", "--tx-velocity", "1,2"], ["--tx-velocity 1,2 is no velocity"]),
        (["--what", "frequency-response", "--points", "1"], ["is no band"]),
        (["--what", "frequency-response", "--band-mhz", "-5"], ["is no band"]),
        (["--what", "frequency-response", "--band-mhz", "100000"], ["reaches -22 GHz"]),
        (["--what", "paths", "--export", "OUT/a.csv"], ["does not end in .zip"]),
    ],
)
def test_what_of_the_channel_cannot_be_asked(run, tmp_path, arguments, words):
    test_what_cannot_be_asked(run, tmp_path, [*ASK, "--out", "OUT/a.npz", *arguments], words)
