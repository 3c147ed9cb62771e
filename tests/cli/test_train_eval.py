"""The two command lines, from a scene file and from a folder of spectra, and what they say when something is wrong."""

import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from PIL import Image
from synthetic import tiny_scene

from wbgs_jax import eval as eval_command
from wbgs_jax import train as train_command
from wbgs_jax.training.checkpoint import checkpoint_steps
from wbgs_jax.data.layout import export_layout
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax._util.command import run_command

pytestmark = pytest.mark.slow

TINY_SETTINGS = {
    "wideband": {"gaussians": 60, "width": 8, "depth": 2, "skip": 1, "radiance-widths": 8},
    "optim": {"steps": 4, "batch": 2},
    "loop": {"epoch-steps": 2, "evaluate-every": 4, "evaluate-spectra": 2},
}
TINY = ["--preset", "smoke"]
TINY += [word for group, values in TINY_SETTINGS.items() for name, v in values.items() for word in (f"--{group}.{name}", v)]


def call(module, *arguments):
    """Exit code, stdout and stderr of a command line, in this process."""
    out, err = io.StringIO(), io.StringIO()
    argv = mock.patch.object(sys, "argv", [module.__name__, *map(str, arguments)])
    with argv, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            run_command(module.main)
        except SystemExit as stop:
            return SimpleNamespace(code=stop.code, out=out.getvalue(), err=err.getvalue())
    return SimpleNamespace(code=0, out=out.getvalue(), err=err.getvalue())


def in_a_process(module, *arguments):
    command = [sys.executable, "-m", module.__name__, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | {"JAX_PLATFORMS": "cpu"})
    return SimpleNamespace(code=done.returncode, out=done.stdout, err=done.stderr)


def assert_error_for_people(result, *words):
    assert result.code == 2
    assert result.out == ""
    (line,) = result.err.splitlines()
    assert line.startswith("error: ")
    for word in words:
        assert str(word) in line


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "box.npz"
    save_scene(path, tiny_scene())
    return path


@pytest.fixture(scope="module")
def layout(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "box"
    export_layout(tiny_scene(), folder)
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory, scene, layout):
    """Run folders by the kind of their data."""
    runs = {}
    for option, source in (("--scene", scene), ("--data", layout)):
        runs[option] = tmp_path_factory.mktemp("runs") / "run"
        result = call(train_command, option, source, "--out", runs[option], *TINY)
        assert (result.code, result.out) == (0, ""), result.err
        assert "trained 4 steps" in result.err
    return runs


@pytest.fixture
def run(tmp_path, trained):
    """A copy of a trained run, not evaluated yet."""
    shutil.copytree(trained["--scene"], tmp_path / "run", ignore=shutil.ignore_patterns("eval.json", "pictures"))
    return tmp_path / "run"


@pytest.mark.parametrize("kind", ["--scene", "--data"])
def test_train_then_eval_prints_one_json_object_and_draws(trained, kind):
    folder = trained[kind]
    assert {path.name for path in folder.iterdir()} >= {"config.json", "metrics.jsonl", "checkpoints"}
    assert checkpoint_steps(folder / "checkpoints") == [4]
    result = call(eval_command, "--run", folder, "--json")
    assert result.code == 0, result.err
    report = json.loads(result.out)
    assert report == json.loads((folder / "eval.json").read_text())
    assert report.keys() >= {"scene", "field", "n", "median_ssim", "mean_ssim", "per_frequency", "references"}
    assert (report["scene"], report["field"], report["n"]) == ("box", "wideband", 6)
    assert [row["frequency_ghz"] for row in report["per_frequency"]] == [1, 10, 94]
    assert sum(row["n"] for row in report["per_frequency"]) == 6
    assert report["references"].keys() == {"mean_image", "nearest_tx", "inverse_distance", "line_of_sight"}
    for scores in (report, *report["references"].values()):
        assert 0 < scores["median_ssim"] < 1 and 0 < scores["mean_ssim"] < 1
    for name in ("spectra.png", "spectra_polar.png", "ssim_by_frequency.png", "curves.png"):
        with Image.open(folder / "pictures" / name) as image:
            assert image.format == "PNG" and np.asarray(image.convert("L")).std() > 5


def test_eval_of_other_data_for_people_with_results(run, layout, tmp_path):
    result = call(eval_command, "--run", run, "--data", layout, "--no-pictures", "--results", tmp_path / "results")
    assert result.code == 0, result.err
    assert "held-out SSIM" in result.out and "inverse distance" in result.out and "ms a PAS" in result.out
    assert not (run / "pictures").exists()
    (path,) = (tmp_path / "results").iterdir()
    assert path.name == "quality_box_wideband_smoke_cpu.json"
    provenance = json.loads(path.read_text())["provenance"]
    assert provenance["steps"] == 4 and provenance["gaussians"] > 0 and provenance["seed"] == 0
    assert "--preset smoke" in provenance["command"]


def test_resuming_and_what_stands_in_its_way(run, scene):
    arguments = ["--scene", scene, "--out", run, *TINY]
    before = (run / "metrics.jsonl").read_text()
    assert_error_for_people(call(train_command, *arguments), run, "--resume")
    assert_error_for_people(call(train_command, *arguments, "--resume", "--seed", 1), "seed: 0, not 1")
    longer = [*arguments, "--optim.steps", 6, "--resume"]
    assert_error_for_people(call(train_command, *longer), "settings.optim.steps: 4, not 6")
    assert (run / "metrics.jsonl").read_text() == before
    assert call(train_command, *arguments, "--resume").code == 0
    assert (run / "metrics.jsonl").read_text() == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--scene", "no-such-scene"], ["no scene", "no-such-scene"]),
        (["--data", "no-such-folder"], ["no-such-folder"]),
        (["--scene", "gone.npz"], ["gone.npz"]),
        ([], ["--scene", "--data"]),
        (["--scene", "SCENE", "--data", "LAYOUT"], ["--scene", "--data"]),
        (["--scene", "SCENE", "--field", "telepathy"], ["telepathy", "wideband"]),
        (["--scene", "SCENE", "--preset", "warp"], ["warp", "smoke"]),
        (["--scene", "SCENE", "--preset"], ["preset"]),
        (["--scene", "SCENE", "--preset", "smoke", "--optim.steps", "7"], ["7", "multiple"]),
        (["--scene", "SCENE", "--preset", "smoke", "--optim.batch", "0"], ["optim.batch"]),
        (["--scene", "SCENE", "--preset", "smoke", "--wideband.radiance-widths"], ["radiance-widths", "at least 1"]),
        (["--data", "LAYOUT", "--frequency-ghz", "5"], ["freq.txt"]),
    ],
)
def test_what_cannot_be_trained(tmp_path, scene, layout, arguments, words):
    """Nothing is written, not even the run folder."""
    places = {"SCENE": str(scene), "LAYOUT": str(layout)}
    result = call(train_command, "--out", tmp_path / "run", *(places.get(word, word) for word in arguments))
    assert_error_for_people(result, *words)
    assert list(tmp_path.iterdir()) == []


def test_run_folders_that_cannot_be_used(tmp_path, scene):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    for folder in ("file", "file/below", "other"):
        assert_error_for_people(call(train_command, "--scene", scene, "--out", tmp_path / folder, *TINY), tmp_path / folder)
    assert (tmp_path / "file").read_text() == "mine"
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda run: shutil.rmtree(run), ["not a run folder"]),
        (lambda run: (run / "config.json").unlink(), ["config.json"]),
        (lambda run: (run / "config.json").write_text("{"), ["config.json"]),
        (lambda run: shutil.rmtree(run / "checkpoints"), ["no checkpoint", "--resume"]),
    ],
)
def test_what_cannot_be_evaluated(run, damage, words):
    damage(run)
    assert_error_for_people(call(eval_command, "--run", run, "--json"), run, *words)
    assert not (run / "eval.json").exists()


def test_data_that_are_gone(run, scene, tmp_path):
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | {"source": str(tmp_path / "gone.npz")}))
    assert_error_for_people(call(eval_command, "--run", run), "gone.npz")


def test_a_damaged_checkpoint_in_a_process_of_its_own(run):
    (manifest,) = (run / "checkpoints" / "4").glob("*/manifest.ocdbt")
    manifest.write_bytes(b"")
    result = in_a_process(eval_command, "--run", run, "--json")
    assert (result.code, result.out) == (2, "")
    # Reads that Orbax gave up may still complain to stderr while the process ends.
    (line,) = [line for line in result.err.splitlines() if line.startswith("error: ")]
    assert str(run / "checkpoints" / "4") in line and "delete" in line


def test_an_unknown_scene_in_a_process_of_its_own(tmp_path):
    assert_error_for_people(in_a_process(train_command, "--scene", "no-such-scene", "--out", tmp_path / "run"), "no scene")
    assert list(tmp_path.iterdir()) == []
