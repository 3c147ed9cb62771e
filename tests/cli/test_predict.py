"""`python -m wbgs_jax.predict`: spectra and pictures, exported fields, and what it says when something is wrong."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from untrained import make_run

from wbgs_jax import predict as predict_command
from wbgs_jax._util.command import run_command
from wbgs_jax.inference.export import load_exported

INSIDE = ["1,0.5,1.5", "-1,1,1.2"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "box")


@pytest.fixture
def predict(monkeypatch, capsys):
    """Calls the command line in this process: exit code, stdout and lines on stderr."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["predict", *map(str, arguments)])
        code = 0
        try:
            run_command(predict_command.main)
        except SystemExit as stop:
            code = stop.code
        captured = capsys.readouterr()
        return SimpleNamespace(code=code, out=captured.out, lines=captured.err.splitlines())

    return call


def test_spectra_and_export_agree(predict, run, tmp_path):
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


def test_what_the_field_was_not_trained_for_is_a_warning(predict, run, tmp_path):
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
        (["--tx", INSIDE[0], "--ghz", "28", "0.9", "--out", "OUT/a.npz"], ["0.9", "1 to 100 GHz"]),
        (["--tx", INSIDE[0], "--ghz", "28e9", "--out", "OUT/a.npz"], ["2.8e+10", "1 to 100 GHz"]),
        (["--tx", INSIDE[0], "--ghz", "nan", "--out", "OUT/a.npz"], ["nan"]),
        ([*ASK, "--out", "OUT/a.csv"], ["--out", ".npz"]),
        ([*ASK, "--picture", "OUT/a.jpg"], ["--picture", ".png"]),
        (["--export", "OUT/a.bin"], ["--export", ".zip"]),
        (["--export", "RUN/config.json/a.zip"], ["cannot write"]),
    ],
)
def test_what_cannot_be_asked(predict, run, tmp_path, arguments, words):
    places = (word.replace("OUT", str(tmp_path)).replace("RUN", str(run)) for word in arguments)
    result = predict("--run", run, *places)
    assert (result.code, result.out) == (2, "")
    (line,) = result.lines
    assert line.startswith("error: ")
    for word in words:
        assert word in line
    assert list(tmp_path.iterdir()) == []


def test_runs_that_are_none(predict, tmp_path):
    result = predict("--run", tmp_path / "gone", *ASK, "--out", tmp_path / "a.npz")
    assert result.code == 2
    assert result.lines == [
        f"error: {tmp_path / 'gone'} is not a run folder: it has no config.json; train first (make train SCENE=1)"
    ]
    assert list(tmp_path.iterdir()) == []
