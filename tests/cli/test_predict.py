"""`wbgs-jax predict`: spectra and pictures, exported fields, and what it says when something is wrong."""

import dataclasses
import json
import os
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.commands import assert_error_for_people, call
from builders.synthetic import tiny_scene
from builders.toys import RippleConfig, RippleField, registered, toy_settings
from builders.untrained import SETTINGS, State, make_coherent_run, make_run
from PIL import Image

from wbgs_jax._util.pytree import pytree
from wbgs_jax.commands import map as map_command
from wbgs_jax.commands import predict as predict_command
from wbgs_jax.commands import view as view_command
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.fields import Observation
from wbgs_jax.inference.evaluate_quantities import LoadedField
from wbgs_jax.inference.export import load_exported
from wbgs_jax.inference.intervals import Confidence, PowerConfidence, write_confidence
from wbgs_jax.inference.trained_field import RunConfig
from wbgs_jax.training import checkpoint
from wbgs_jax.training.fit_intervals import SETS
from wbgs_jax.training.run_folder import write_config

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
        (
            ["--tx", INSIDE[0], "--ghz", "28", "0.9", "--out", "OUT/a.npz"],
            ["from 1 GHz upwards, not at 0.9 GHz", "wave or hybrid"],
        ),
        (["--tx", INSIDE[0], "--ghz", "28e9", "--out", "OUT/a.npz"], ["2.8e+10", "0.3 to 100 GHz"]),
        (["--tx", INSIDE[0], "--ghz", "nan", "--out", "OUT/a.npz"], ["nan"]),
        ([*ASK, "--out", "OUT/a.csv"], ["--out", ".npz"]),
        ([*ASK, "--picture", "OUT/a.jpg"], ["--picture", ".png or .svg or .pdf"]),
        (["--export", "OUT/a.bin"], ["--export", ".zip"]),
        ([*ASK, "--rx", "1,2", "--out", "OUT/a.npz"], ["--rx 1,2 "]),
        ([*ASK, "--rx", "1,2,nan", "--out", "OUT/a.npz"], ["1,2,nan"]),
        ([*ASK, "--rx", "1,2,1,0,0,0,0", "--out", "OUT/a.npz"], ["quaternion"]),
        ([*ASK, "--rx", "1,1,1", "--out", "OUT/a.npz"], ["the wideband field predicts only the receivers", "wave or hybrid"]),
        (["--export", "RUN/config.json/a.zip"], ["cannot write"]),
        (["--export", "OUT/a.zip", "--rx", "1,1,1"], ["first receiver", "without --rx"]),
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


def test_a_field_has_to_be_named_once(run, tmp_path):
    for named, words in (([], ["--example", "--run RUN"]), (["--run", run, "--example"], ["exclude each other"])):
        for main in (predict_command.main, map_command.main, view_command.main):
            asked = [] if main is view_command.main else ["--ghz", 28, "--picture", tmp_path / "a.png"]
            more = ["--tx", INSIDE[0]] if main is predict_command.main else []
            assert_error_for_people(call(main, *named, *asked, *more), *words)


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
    outputs: ClassVar = ("pas", "power", "snapshots")

    def render(self, params, plan, query):
        power_db = -60 + query.tx_position[:, 0] + query.frequency_hz / 1e9
        return Observation(super().render(params, plan, query).pas, query.tx_position[:, :1] * jnp.ones(16) * 1j, power_db)


def make_toy_run(folder, field, scene=None):
    """As `untrained.make_run`, of a toy field."""
    save_scene(folder.with_suffix(".npz"), scene or tiny_scene())
    write_config(folder, RunConfig(str(folder.with_suffix(".npz")), field.name, "smoke", 0, None, toy_settings()))
    state = State(field.init(jax.random.key(0)))
    checkpoint.save(folder / "checkpoints", 3, state, field, {"limits": None, "seconds": 1.0}, keep=1)
    return folder


def test_the_trained_band_can_be_asked_for_wherever_it_lies(tmp_path):
    """Tags answer at 915 MHz."""
    with registered(HearingField):
        scene = dataclasses.replace(tiny_scene(), frequencies_hz=np.array([0.915e9, 2e9, 5e9]))
        run = make_toy_run(tmp_path / "tags", HearingField(RippleConfig()), scene)
        answered = predict("--run", run, "--tx", "1,0,1", "--ghz", 0.915, "--out", tmp_path / "pas.npz")
        assert answered.code == 0 and not [line for line in answered.lines if line.startswith("warning")], answered.err
        refused = predict("--run", run, "--tx", "1,0,1", "--ghz", 0.9, "--out", tmp_path / "no.npz")
        assert refused.code == 2 and "of this run can be queried from 0.915 GHz upwards, not at 0.9 GHz" in refused.err


def test_where_powers_alone_were_learned_there_are_no_spectra(tmp_path):
    with registered(HearingField):
        run = make_toy_run(tmp_path / "powers", HearingField(RippleConfig()), tiny_scene(kind="power"))
        for wanted in (["--out", tmp_path / "pas.npz", *ASK], ["--export", tmp_path / "field.zip"]):
            refused = predict("--run", run, *wanted)
            assert refused.code == 2 and "from which the hearing field learned no spectra; use --what power" in refused.err
        refused = call(map_command.main, "--run", run, "--ghz", 28, "--what", "best-beam", "--out", tmp_path / "beams.npz")
        assert refused.code == 2 and "learned no spectra" in refused.err
        assert predict("--run", run, *ASK, "--what", "power", "--out", tmp_path / "power.npz").code == 0
        assert not [name for name in ("pas.npz", "field.zip", "beams.npz") if (tmp_path / name).exists()]


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
        assert "the hearing field does not provide k-factor" in refused.err and "wave" in refused.err
        blind = make_toy_run(tmp_path / "ripple", RippleField(RippleConfig()))
        refused = predict("--run", blind, *ASK, "--what", "power", "--out", tmp_path / "none.npz")
        assert refused.code == 2 and "the ripple field does not provide power, only spectra" in refused.err
        assert "hearing" in refused.err  # among those that have it
        assert not (tmp_path / "k.npz").exists() and not (tmp_path / "none.npz").exists()


def intervals():
    """Of spectra and of powers: the same for every query."""
    k, numbers = SETS[-1], (jnp.log(4.0), jnp.asarray(2.0), jnp.asarray(0.9))
    of_spectra = (np.zeros(3), np.eye(3), np.zeros(k), np.ones(k), np.full(k + 1, -0.1), (-1, 1), 1.2, 0.9, ())
    of_powers = jnp.zeros((1, 3)), jnp.zeros(4), jnp.ones(4), jnp.zeros(5)
    return Confidence(*(jnp.asarray(part, jnp.float32) for part in of_spectra)), PowerConfidence(*of_powers, *numbers)


def test_powers_come_with_how_sure_they_are(tmp_path):
    with registered(HearingField):
        run = make_toy_run(tmp_path / "hearing", HearingField(RippleConfig()))
        write_confidence(run, None, intervals()[1])
        ask = ["--run", run, "--tx", "1,2,1", "-1,0,2", "--ghz", 2, 5, "--what", "power"]
        result = predict(*ask, "--out", tmp_path / "power.npz")
    assert result.code == 0, result.err
    lines = [line for line in result.err.splitlines() if "within" in line]
    assert len(lines) == 4
    assert (
        lines[1]
        == "TX (1, 2, 1) m at 5 GHz: -54.0 dB relative to the transmitted power; expected error 1.9 dB, 90 % within 3.9 dB"
    )
    with np.load(tmp_path / "power.npz") as answer:
        np.testing.assert_allclose(answer["within_db"], np.full((2, 2), 3.9), rtol=1e-5)
        np.testing.assert_allclose(answer["expected_error_db"], np.full((2, 2), 1.9), rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--what", "power"], ["nothing to do"]),
        ([*ASK, "--what", "power"], ["--out"]),
        ([*ASK, "--what", "snapshot", "--out", "OUT/a.csv"], ["--out", ".npz"]),
        ([*ASK, "--line", "0,0,1:1,0,1:5", "--out", "OUT/a.npz"], ["--tx and --line exclude each other"]),
        ([*ASK, "--sweep", "1:9:5", "--out", "OUT/a.npz"], ["--ghz and --sweep exclude each other"]),
        ([*ASK, "--queries", "OUT/q.csv", "--out", "OUT/a.npz"], ["--tx and --queries exclude each other"]),
        (["--queries", "OUT/q.csv", "--out", "OUT/a.npz"], ["cannot read", "q.csv"]),
        (["--tx", INSIDE[0], "--sweep", "1:900:5", "--out", "OUT/a.npz"], ["--sweep", "0.3 to 100 GHz"]),
        (["--grid", "0,0,1:1,0,1:5", "--ghz", "28", "--out", "OUT/a.npz"], ["--grid", "NXxNYxNZ"]),
        (["--line", "0,0,1:1,0,1:700000", "--sweep", "1:9:2", "--out", "OUT/a.npz"], ["1,400,000 queries"]),
    ],
)
def test_numbers_that_cannot_be_asked_for(run, tmp_path, arguments, words):
    test_what_cannot_be_asked(run, tmp_path, arguments, words)


@pytest.fixture
def hearing(tmp_path):
    """`--run RUN` of a toy field that answers at once: power -60 + x + GHz."""
    with registered(HearingField):
        yield ["--run", make_toy_run(tmp_path / "hearing", HearingField(RippleConfig()))]


def test_a_line_a_sweep_and_a_grid(hearing, tmp_path):
    out, picture = tmp_path / "a.csv", tmp_path / "a.png"
    line = ["--line", "0,0,1:2,0,1:5"]
    result = predict(*hearing, *line, "--ghz", 2, 5, "--what", "power", "--out", out, "--picture", picture)
    assert result.code == 0, result.err
    rows = [row.split(",") for row in out.read_text().splitlines()]
    assert rows[0] == ["x", "y", "z", "ghz", "power_db"] and len(rows) == 11
    assert [float(value) for value in rows[2]] == [0, 0, 1, 5, -55] and float(rows[-1][-1]) == -53
    with Image.open(picture) as image:
        assert np.asarray(image.convert("L")).std() > 5
    out = tmp_path / "a.npz"
    sweep = predict(*hearing, "--tx", "1,0,1", "--sweep", "1:100:3", "--what", "power", "--out", out, "--picture", picture)
    assert sweep.code == 0, sweep.err
    with np.load(out) as answer:
        np.testing.assert_allclose(answer["frequencies_hz"], [1e9, 1e10, 1e11])
        np.testing.assert_allclose(answer["power_db"], [[-58, -49, 41]], rtol=1e-5)
    assert predict(*hearing, "--grid", "0,0,1:1,1,1:2x3x1", "--ghz", 2, "--out", out).code == 0
    with np.load(out) as answer:
        assert answer["pas"].shape == (6, 1, 90, 360)


def test_a_file_of_queries(hearing, tmp_path):
    queries, out, picture = tmp_path / "q.csv", tmp_path / "a.csv", tmp_path / "a.png"
    queries.write_text("x,y,z,ghz\n1,0,1,5\n-1,0,1,2\n0,0,1234.56789012,2.4123456789\n")
    files = ["--out", out, "--picture", picture]
    assert predict(*hearing, "--queries", queries, "--what", "power", *files).code == 0
    assert out.read_text().splitlines()[1:] == ["1,0,1,5,-54", "-1,0,1,2,-59", "0,0,1234.56789012,2.4123456789,-57.58765"]
    result = predict(*hearing, "--queries", queries, "--out", tmp_path / "a.npz")
    assert result.code == 0 and "(3 queries)" in result.err
    with np.load(tmp_path / "a.npz") as answer:
        assert answer["pas"].shape == (3, 90, 360) and answer["tx_positions"].shape == (3, 3)


@pytest.mark.heavy
def test_paths_of_a_file_of_queries(coherent, tmp_path):
    queries, out = tmp_path / "q.csv", tmp_path / "a.csv"
    queries.write_text("x,y,z,ghz\n1.23456789,0.5,1.5,28\n1,0.5,1.5,2.412345678\n-1,1,1.2,28\n")
    result = predict("--run", coherent, "--queries", queries, "--what", "paths", "--out", out)
    assert result.code == 0, result.err
    rows = [row.split(",") for row in out.read_text().splitlines()[1:]]
    numbers = [int(row[0]) for row in rows]
    assert numbers == sorted(numbers) and {*numbers} == {0, 1, 2}
    assert {(int(row[0]), float(row[4])) for row in rows} == {(0, 28.0), (1, 2.412345678), (2, 28.0)}
    assert rows[0][1:4] == ["1.23456789", "0.5", "1.5"]


def test_what_was_interrupted_goes_on(hearing, tmp_path, monkeypatch):
    """And gives, to the byte, the answers of a command that was not; those that are done are not asked for again."""
    monkeypatch.setattr(predict_command, "BLOCK", 4)
    whole, out, part = tmp_path / "whole.npz", tmp_path / "a.npz", tmp_path / "a.npz.part"
    ask = [*hearing, "--line", "0,0,1:2,0,1:5", "--ghz", 2, 5, "--what", "power"]
    assert predict(*ask, "--out", whole).code == 0
    real, asked = LoadedField.answer, []

    def interrupted(*arguments):
        if len(asked) == 1:
            raise KeyboardInterrupt
        asked.append(arguments)
        return real(*arguments)

    monkeypatch.setattr(LoadedField, "answer", interrupted)
    stopped = predict(*ask, "--out", out)
    assert stopped.code == 130 and not out.exists() and part.is_dir()
    assert "1 of 3 blocks are kept" in stopped.err and stopped.lines[-1] == "interrupted"
    monkeypatch.setattr(LoadedField, "answer", lambda *arguments: asked.append(arguments) or real(*arguments))
    refused = predict(*ask, "--out", out)
    assert refused.code == 2 and "--resume" in refused.err
    refused = predict(*hearing, "--line", "0,0,1:2,0,1:6", "--ghz", 2, 5, "--what", "power", "--out", out, "--resume")
    assert refused.code == 2 and "another command (queries changed)" in refused.err
    config = hearing[1] / "config.json"
    written = config.stat()
    os.utime(config, (0, 0))  # as of a training that has replaced this one
    refused = predict(*ask, "--out", out, "--resume")
    assert refused.code == 2 and "another command (trained changed)" in refused.err
    os.utime(config, ns=(written.st_atime_ns, written.st_mtime_ns))
    assert predict(*ask, "--out", out, "--resume").code == 0
    assert len(asked) == 3 and not part.exists()
    with np.load(out) as one, np.load(whole) as other:
        assert {*one} == {*other}
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])


def test_a_picture_alone_asks_for_no_more_than_it_shows(hearing, tmp_path, monkeypatch):
    sizes = []
    real = LoadedField.answer
    monkeypatch.setattr(LoadedField, "answer", lambda *a: sizes.append(sum(len(p.rows) for p in a[-1])) or real(*a))
    result = predict(*hearing, "--line", "0,0,1:2,0,1:900", "--ghz", 2, "--picture", tmp_path / "a.png")
    assert (result.code, sizes) == (0, [12])


@pytest.mark.parametrize(("what", "name"), [("spectra", "pas"), ("power", "power_db")])
def test_a_field_that_was_left_ready_says_the_same(tmp_path, monkeypatch, what, name):
    """Without reading the run again, unless it has changed. Arrays are in the same order: pictures draw the first."""
    run = make_run(tmp_path / "box")
    write_confidence(run, *intervals())
    ask = ["--run", run, "--tx", *INSIDE, "--ghz", 28, 2, "--what", what, "--out"]
    monkeypatch.setenv("WBGS_CACHE", "")
    assert predict(*ask, tmp_path / "plain.npz").code == 0
    monkeypatch.setenv("WBGS_CACHE", str(tmp_path / "cache"))
    assert predict(*ask, tmp_path / "first.npz").code == 0
    loaded = []
    real = predict_command.load_field
    monkeypatch.setattr(predict_command, "load_field", lambda run, *more: loaded.append(run) or real(run, *more))
    again = predict(*ask, tmp_path / "second.npz")
    assert (again.code, loaded) == (0, [])
    assert predict(*ask[:-1], "--picture", tmp_path / "second.png").code == 0 and (tmp_path / "second.png").stat().st_size
    assert not loaded
    with np.load(tmp_path / "plain.npz") as plain:
        for one in ("first", "second"):
            with np.load(tmp_path / f"{one}.npz") as answer:
                assert [*answer] == [*plain]
                np.testing.assert_allclose(answer[name], plain[name], atol=2e-5)
                assert str(answer["meta"]) == str(plain["meta"])
    assert predict(*ask[:-1], "--rx", 1, "--out", tmp_path / "none.npz").code == 2
    for entry in (tmp_path / "cache").rglob("ready/*.npz"):
        entry.write_bytes(b"damaged")

    def read_before_a_change(folder, *more):
        found = real(folder, *more)
        loaded.append(folder)
        os.utime(run / "config.json", (len(loaded), 0))
        return found

    monkeypatch.setattr(predict_command, "load_field", read_before_a_change)
    for _ in range(2):  # what was read before a file changed is not used afterwards
        loaded.clear()
        assert predict(*ask, tmp_path / "third.npz").code == 0 and loaded
    write_config(run, RunConfig("gone.npz", "wideband", "smoke", 0, None, SETTINGS))
    assert predict(*ask, tmp_path / "fourth.npz").code == 2


@pytest.fixture(scope="module")
def coherent(tmp_path_factory):
    """A run of the coherent field, untrained."""
    return make_coherent_run(tmp_path_factory.mktemp("runs") / "coherent")


@pytest.mark.heavy
def test_below_the_band_only_paths_answer(coherent, tmp_path):
    out = tmp_path / "low.npz"
    result = predict("--run", coherent, "--tx", INSIDE[0], "--ghz", 0.4, "--what", "power", "--out", out)
    assert result.code == 0
    assert [line for line in result.lines if line.startswith("warning: 0.4 GHz lies below 1 GHz: ray methods")]
    with np.load(out) as answer:
        assert -80 < answer["power_db"][0, 0] < 0
    result = predict("--run", coherent, "--tx", INSIDE[0], "--ghz", 0.2, "--out", out)
    assert result.code == 2 and "0.3 to 100 GHz" in result.err


@pytest.mark.heavy
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
        (["--what", "paths"], ["does not predict paths", "wave or hybrid"]),
        (["--what", "mimo"], ["does not predict paths"]),
        (["--what", "frequency-response"], ["does not predict paths"]),
        (["--what", "mimo", "--tx-array", "4"], ["--tx-array 4 is not an array"]),
        (["--what", "mimo", "--tx-array", "0x3"], ["--tx-array 0x3"]),
        (["--what", "paths", "--tx-velocity", "1,2"], ["--tx-velocity 1,2 is not a velocity"]),
        (["--tx-array", "2x2"], ["--tx-array has no effect on --what spectra; it belongs to mimo"]),
        (
            ["--what", "paths", "--band-mhz", "20"],
            ["--band-mhz has no effect on --what paths; it belongs to freq"],
        ),
        (["--what", "mimo", "--points", "8"], ["--points has no effect on --what mimo"]),
        (["--what", "mimo", "--rx-velocity", "1,0,0"], ["--rx-velocity has no effect on --what mimo; it belongs to paths"]),
        (["--what", "frequency-response", "--points", "1"], ["is not a band"]),
        (["--what", "frequency-response", "--band-mhz", "-5"], ["is not a band"]),
        (["--what", "frequency-response", "--band-mhz", "100000"], ["reaches -22 GHz"]),
        (["--what", "paths", "--export", "OUT/a.csv"], ["does not end in .zip"]),
    ],
)
def test_what_of_the_channel_cannot_be_asked(run, tmp_path, arguments, words):
    test_what_cannot_be_asked(run, tmp_path, [*ASK, "--out", "OUT/a.npz", *arguments], words)
