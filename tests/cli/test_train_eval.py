"""The two command lines, from a scene file and from a folder of spectra, and what they say when something is wrong."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.commands import assert_error_for_people, call, in_a_process
from builders.synthetic import tiny_dataset, tiny_scene
from PIL import Image

import wbgs_jax
from wbgs_jax._util.errors import UserError
from wbgs_jax.commands import evaluate as eval_command
from wbgs_jax.commands import train as train_command
from wbgs_jax.data.image_folder import export_layout
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.evaluation.score import watch
from wbgs_jax.fields import get_field
from wbgs_jax.inference.kriging import Mixture
from wbgs_jax.training import curves
from wbgs_jax.training.checkpoint import checkpoint_steps
from wbgs_jax.training.loop import Run
from wbgs_jax.training.progress import Interrupted
from wbgs_jax.training.run_folder import load_trained, read_config, write_config

pytestmark = pytest.mark.usefixtures("ripple")

NETWORKS = {"gaussians": 60, "width": 8, "depth": 2, "skip": 1, "radiance-widths": 8}
SHORT = {
    "optim": {"steps": 4, "batch": 2},
    "loop": {"epoch-steps": 2, "evaluate-every": 4, "evaluate-spectra": 2},
}


def words(sections):
    return [word for name, values in sections.items() for key, v in values.items() for word in (f"--{name}.{key}", str(v))]


SMOKE = ["--preset", "smoke", *words(SHORT)]
TINY = [*SMOKE, "--field", "wideband", *words({"wideband": NETWORKS})]
TOY = [*SMOKE, "--field", "ripple"]


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


def train_and_check(folder, *arguments):
    result = call(train_command.main, *arguments, "--out", folder)
    assert (result.code, result.out) == (0, ""), result.err
    assert "trained 4 steps" in result.err
    lines = result.err.splitlines()
    assert lines[1].startswith("4 steps, ") and lines[2].startswith(f"results: {folder} ")
    assert lines[-1].startswith(f"next: wbgs-jax eval --run {folder} ")
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["training"]["steps"] == 4 and len(manifest["data"]["sha256"]) == 64 and manifest["scores"] == {}
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory, scene, layout):
    """Run folders by the kind of their data; of the folder of spectra, that of a field that compiles quickly."""
    return {
        "--scene": train_and_check(tmp_path_factory.mktemp("runs") / "run", "--scene", scene, *TINY),
        "--data": train_and_check(tmp_path_factory.mktemp("runs") / "run", "--data", layout, *TOY),
    }


@pytest.fixture
def run(tmp_path, trained):
    """A copy of a trained run, not evaluated yet."""
    shutil.copytree(trained["--scene"], tmp_path / "run", ignore=shutil.ignore_patterns("eval.json", "pictures"))
    return tmp_path / "run"


def assert_eval_prints_one_json_object_and_draws(folder, field):
    assert {path.name for path in folder.iterdir()} >= {"config.json", "metrics.jsonl", "checkpoints"}
    assert checkpoint_steps(folder / "checkpoints") == [4]
    result = call(eval_command.main, "--run", folder, "--json")
    assert result.code == 0, result.err
    report = json.loads(result.out)
    assert report == json.loads((folder / "eval.json").read_text())
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["scores"]["test"]["median_ssim"] == report["median_ssim"]
    assert manifest["versions"]["wbgs_jax"] == wbgs_jax.__version__ and "--seed" in manifest["training"]["command"]
    assert report.keys() >= {"scene", "field", "n", "median_ssim", "mean_ssim", "per_frequency", "baselines"}
    assert (report["scene"], report["field"], report["part"], report["n"]) == ("box", field, "test", 6)
    assert [row["frequency_ghz"] for row in report["per_frequency"]] == [1, 10, 94]
    assert sum(row["n"] for row in report["per_frequency"]) == 6
    assert report["baselines"].keys() == {"mean_image", "nearest_tx", "inverse_distance", "line_of_sight"}
    for scores in (report, *report["baselines"].values()):
        assert 0 < scores["median_ssim"] < 1 and 0 < scores["mean_ssim"] < 1
    for name in ("spectra.png", "spectra_polar.png", "ssim_by_frequency.png", "curves.png"):
        with Image.open(folder / "pictures" / name) as image:
            assert image.format == "PNG" and np.asarray(image.convert("L")).std() > 5


@pytest.mark.parametrize(("kind", "field"), [("--scene", "wideband"), ("--data", "ripple")])
def test_train_then_eval_prints_one_json_object_and_draws(trained, kind, field):
    assert_eval_prints_one_json_object_and_draws(trained[kind], field)


@pytest.mark.slow
def test_the_paper_s_field_trains_on_a_folder_of_spectra(tmp_path, layout):
    folder = train_and_check(tmp_path / "run", "--data", layout, *TINY)
    assert_eval_prints_one_json_object_and_draws(folder, "wideband")


def test_eval_of_other_data_for_people_with_results(run, layout, tmp_path):
    result = call(eval_command.main, "--run", run, "--data", layout, "--no-pictures", "--results", tmp_path / "results")
    assert result.code == 0, result.err
    assert "held-out SSIM" in result.out and "inverse distance" in result.out and "ms per PAS" in result.out
    assert not (run / "pictures").exists()
    assert len([*run.glob("eval-*.json")]) == 1, "scores on other data do not replace the run's own"
    (path,) = (tmp_path / "results").iterdir()
    assert path.name == "quality_box_wideband_smoke_cpu.json"
    provenance = json.loads(path.read_text())["provenance"]
    assert provenance["steps"] == 4 and provenance["gaussians"] == 60 and provenance["seed"] == 0
    assert provenance["command"] == "wbgs-jax train --scene box.npz --field wideband --preset smoke --seed 0"
    assert provenance["settings"]["wideband"]["width"] == 8


@pytest.mark.heavy
def test_a_validation_part_is_of_whole_transmitters_and_the_test_is_untouched(tmp_path, scene, monkeypatch):
    """Curves watch it, `eval --part validation` scores it, and what belongs to the test is not replaced by it."""
    run = train_and_check(tmp_path / "run", "--scene", scene, "--validation", 0.3, *TOY)
    plain, split = tiny_dataset(), load_trained(run).dataset()
    np.testing.assert_array_equal(split.test, plain.test)
    assert len(split.validation) == 3 and set(split.validation) | set(split.train) == set(plain.train)
    (held_out,) = set(split.tx_index[split.validation])
    assert held_out not in split.tx_index[split.train]
    reports, drawn = {}, []
    monkeypatch.setattr(eval_command.plotting, "draw_all", lambda folder, *_: drawn.append(folder) or [])
    for part in ("test", "validation"):
        result = call(eval_command.main, "--run", run, "--part", part, "--json", "--results", tmp_path / "results")
        assert result.code == 0, result.err
        reports[part] = json.loads(result.out)
        assert reports[part]["part"] == part and reports[part]["n"] == len(getattr(split, part))
    (watched,) = [entry for entry in curves.read(run / "metrics.jsonl") if "held_out_ssim" in entry]
    trained = load_trained(run)
    training = Run(split, "ripple", trained.config.settings, 0, run)
    chosen = training.numbers[training.watched]
    assert watched["step"] == 4 and len(chosen) == 2 and set(chosen) <= set(split.validation)
    assert watched["held_out_ssim"] == pytest.approx(
        watch(trained.field, trained.params, split, chosen)["held_out_ssim"], abs=1e-6
    )
    assert json.loads((run / "eval.json").read_text()) == reports["test"]
    assert json.loads((run / "eval_validation.json").read_text()) == reports["validation"]
    names = {path.name for path in (tmp_path / "results").iterdir()}
    assert names == {"quality_box_ripple_smoke_cpu.json", "quality_box_ripple_smoke_cpu_validation.json"}
    written = json.loads((tmp_path / "results" / "quality_box_ripple_smoke_cpu_validation.json").read_text())
    assert written["provenance"]["command"].count("--validation 0.3") == 1
    assert drawn == [run / "pictures", run / "pictures_validation"]
    people = call(eval_command.main, "--run", run, "--part", "validation", "--no-pictures")
    assert "validation SSIM" in people.out


def test_a_part_that_there_is_not(tmp_path, scene):
    run = train_and_check(tmp_path / "run", "--scene", scene, "--validation", 0, *TOY)
    assert not any("held_out_ssim" in entry for entry in curves.read(run / "metrics.jsonl"))  # nothing that it could watch
    result = call(eval_command.main, "--run", run, "--part", "validation")
    assert_error_for_people(result, "box has no validation spectra")
    assert not (run / "eval_validation.json").exists()


@pytest.mark.heavy
def test_one_receiver_of_several_frequencies_and_fewer_transmitters(tmp_path):
    """What is looked at is part of the run: evaluated as it was trained, and said by its name and provenance."""
    save_scene(tmp_path / "three.npz", tiny_scene(n_rx=3))
    choice = ["--receiver", 1, "--train-ghz", 1, 94, "--train-tx", 3]
    run = train_and_check(tmp_path / "run", "--scene", tmp_path / "three.npz", *choice, *TOY)
    result = call(eval_command.main, "--run", run, "--json", "--no-pictures", "--results", tmp_path / "results")
    assert result.code == 0, result.err
    report = json.loads(result.out)
    assert report["scene"] == "box_rx1_f1-94_tx3" and report["n"] == 2
    assert [row["frequency_ghz"] for row in report["per_frequency"]] == [10]
    (path,) = (tmp_path / "results").iterdir()
    command = json.loads(path.read_text())["provenance"]["command"]
    for option in ("--receiver 1", "--train-ghz 1 94", "--train-tx 3"):
        assert option in command


def test_resuming_and_what_stands_in_its_way(run, scene):
    """Of the same settings only; a run that has ended stays as it is."""
    arguments = ["--scene", scene, "--out", run, *TINY]
    before = (run / "metrics.jsonl").read_text()
    assert_error_for_people(call(train_command.main, *arguments), run, "--resume")
    assert_error_for_people(call(train_command.main, *arguments, "--resume", "--seed", 1), "seed: 0, not 1")
    longer = [*arguments, "--optim.steps", 6, "--resume"]
    assert_error_for_people(call(train_command.main, *longer), "settings.optim.steps: 4, not 6")
    assert (run / "metrics.jsonl").read_text() == before
    assert call(train_command.main, *arguments, "--resume").code == 0
    assert (run / "metrics.jsonl").read_text() == before
    assert checkpoint_steps(run / "checkpoints") == [4]


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
        (["--scene", "SCENE", "--frequency-ghz", "5"], ["--frequency-ghz is for folders"]),
        (["--scene", "SCENE", "--seed", "-1"], ["--seed is -1", "from 0 to"]),
        (["--scene", "SCENE", "--seed", str(2**32)], ["--seed is 4294967296", "from 0 to"]),
        (["--scene", "SCENE", "--validation", "1"], ["--validation", "fraction"]),
        (["--scene", "SCENE", "--validation", "-0.1"], ["--validation", "fraction"]),
        (["--scene", "SCENE", "--receiver", "1"], ["receivers 0 to 0"]),
        (["--scene", "SCENE", "--train-tx", "5"], ["4 training transmitters"]),
        (["--scene", "SCENE", "--test-box", "0", "0", "0"], ["--test-box has 3 numbers"]),
        (["--scene", "SCENE", "--test-box", "90", "90", "90", "91", "91", "91"], ["no transmitter", "choose another"]),
        (["--scene", "SCENE", "--train-ghz", "28"], ["no spectra at 28 GHz"]),
    ],
)
def test_what_cannot_be_trained(tmp_path, scene, layout, arguments, words):
    """Nothing is written, not even the run folder."""
    places = {"SCENE": str(scene), "LAYOUT": str(layout)}
    result = call(train_command.main, "--out", tmp_path / "run", *(places.get(word, word) for word in arguments))
    assert_error_for_people(result, *words)
    assert list(tmp_path.iterdir()) == []


def test_training_from_python_is_the_command(tmp_path, layout, trained):
    changes = {name: {key.replace("-", "_"): value for key, value in values.items()} for name, values in SHORT.items()}
    found = wbgs_jax.train_field(layout, tmp_path / "run", "ripple", "smoke", changes, seed=0)
    by_command = load_trained(trained["--data"])
    assert found.config == dataclasses.replace(by_command.config, source=found.config.source)
    for a, b in zip(jax.tree.leaves(found.params), jax.tree.leaves(by_command.params), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"field": "telepathy"}, "telepathy"),
        ({"preset": "warp"}, "no preset 'warp'"),
        ({"settings": {"optim": {"stepz": 3}}}, "a setting is unknown .*stepz"),
        ({"settings": {"optics": {"steps": 3}}}, "a setting is unknown .*optics"),
        ({"seeds": 3}, "an option is unknown .*seeds"),
        ({"seed": 3.0}, "--seed is 3.0; give a whole number"),
        ({"train_tx": 40.0}, "--train-tx is 40.0; give a whole number"),
        ({"settings": {"optim": {"steps": 40.0}}}, "--optim.steps is 40.0; give a whole number"),
        ({"settings": {"optim": {"batch": "4"}}}, "--optim.batch is '4'; give a whole number"),
        ({"settings": {"loop": {"epoch_steps": True}}}, "--loop.epoch-steps is True; give a whole number"),
        ({"field": "wideband", "settings": {"wideband": {"frequency_scale": "GHz"}}}, "--wideband.frequency-scale is 'GHz'"),
        ({"field": "hybrid", "settings": {"wideband": {"precision": "float16"}}}, "--wideband.precision .*'bfloat16'"),
        ({"field": "wideband", "settings": {"wideband": {"relative": 1}}}, "--wideband.relative is 1; give True or False"),
        ({"field": "nerf2", "settings": {"nerf2": {"network_optimizer": "sgd"}}}, "'sgd'; give 'adam' or 'muon'"),
        ({"field": "nerf2", "settings": {"nerf2": {"network_lr": np.nan}}}, "--nerf2.network-lr is nan; give a finite number"),
        ({"distributed": True}, "--distributed in every process"),
    ],
)
def test_what_cannot_be_trained_from_python(tmp_path, scene, given, words):
    with pytest.raises(UserError, match=words):
        wbgs_jax.train_field(scene, tmp_path / "run", **({"field": "ripple", "preset": "smoke"} | given))
    assert list(tmp_path.iterdir()) == []


def test_lists_and_numpy_numbers_are_taken_as_plain_values(tmp_path, scene, monkeypatch):
    taken = []

    def stopped(*both):
        taken.append(train_command.run_config(*both))
        raise Interrupted

    monkeypatch.setattr(train_command, "_train", stopped)
    settings = {"nerf2": {"radiance_widths": [32]}, "optim": {"steps": np.int64(50), "warmup": np.float32(0.25)}}
    with pytest.raises(Interrupted):
        wbgs_jax.train_field(scene, tmp_path, "nerf2", "cpu", settings, seed=np.int64(3), train_ghz=np.array([2.4, 5.0]))
    (config,) = taken
    write_config(tmp_path, config)
    assert read_config(tmp_path) == config
    assert config.settings.field.radiance_widths == (32,) and config.train_ghz == (2.4, 5.0)


def test_earlier_names_of_options_mean_the_present_ones():
    common = ["--scene", "1", "--field", "wave", "--preset", "smoke"]
    earlier = ["--search.sure", "3", "--search.geometry", "--search.geometry-doubt=0.01", "--search.clutter-spectra", "9"]
    present = [
        *("--calibration.n-sigma", "3", "--calibration.geometry"),
        *("--calibration.geometry-position-std", "0.01", "--calibration.absorption-spectra", "9"),
    ]
    found = train_command.parse([*common, *earlier])
    assert found == train_command.parse([*common, *present])
    assert (found[1].calibration.n_sigma, found[1].calibration.geometry) == (3, True)


def test_a_released_scene_is_not_hidden_by_a_folder_of_its_name(tmp_path, monkeypatch):
    (tmp_path / "cabin").mkdir()
    monkeypatch.chdir(tmp_path)
    assert train_command.run_config(*train_command.parse(["--scene", "cabin"])).source == "cabin"
    assert train_command.run_config(*train_command.parse(["--data", "cabin"])).source == str(tmp_path / "cabin")


@pytest.mark.heavy
def test_a_stop_behind_the_last_step_says_how_to_go_on(run, scene, monkeypatch):
    """Nobody takes what is not finished for finished."""
    arguments = ["--scene", scene, "--out", run, *TINY, "--resume"]
    (run / "manifest.json").unlink()

    def stopped(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(train_command, "learn_few", stopped)
        result = call(train_command.main, *arguments)
    assert "0 steps, " in result.err
    assert result.code == 130 and result.err.endswith("\nstopped; run the same command with --resume to continue\n")
    with pytest.warns(UserWarning, match=r"the training of .*run is not finished \(step 4 is saved\)"):
        assert call(eval_command.main, "--run", run, "--no-pictures").code == 0
    assert not (run / "manifest.json").exists()
    assert call(train_command.main, *arguments).code == 0
    assert (run / "manifest.json").exists()


def test_run_folders_that_cannot_be_used(tmp_path, scene):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    for folder in ("file", "file/below", "other"):
        assert_error_for_people(
            call(train_command.main, "--scene", scene, "--out", tmp_path / folder, *TINY), tmp_path / folder
        )
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
    assert_error_for_people(call(eval_command.main, "--run", run, "--json"), run, *words)
    assert not (run / "eval.json").exists()


def test_data_that_are_gone(run, scene, tmp_path):
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | {"source": str(tmp_path / "gone.npz")}))
    assert_error_for_people(call(eval_command.main, "--run", run), "gone.npz")


@pytest.mark.heavy
@pytest.mark.parametrize("what", ["manifest.ocdbt", "d/*"])
def test_a_damaged_checkpoint_in_a_process_of_its_own(run, what):
    damaged = list((run / "checkpoints" / "4" / "state").glob(what))
    assert damaged
    for file in damaged:
        file.write_bytes(file.read_bytes()[:10])
    result = in_a_process("wbgs_jax", "eval", "--run", run, "--json")
    assert_error_for_people(result, run / "checkpoints" / "4", "delete")


@pytest.mark.heavy
def test_an_unknown_scene_in_a_process_of_its_own(tmp_path):
    assert_error_for_people(
        in_a_process("wbgs_jax.commands.train", "--scene", "no-such-scene", "--out", tmp_path / "run"), "no scene"
    )
    assert list(tmp_path.iterdir()) == []


def test_what_was_found_wrong_with_the_mesh_is_printed():
    settings = get_field("wave").presets["cpu"]
    off = dataclasses.replace(settings, calibration=dataclasses.replace(settings.calibration, geometry=False))

    def lines(settings=settings, **report):
        return train_command.mesh_lines([{"step": 10, "loss": 1.0}, {"step": 0, **report}], settings)

    moved = {"kept": True, "largest_mm": 12.34, "receiver_mm": 1.0}
    assert lines() == [] and lines(doubt={"spread_mm": 0.3}) == [] and lines(off, doubt={"spread_mm": 0.3}) == []
    (line,) = lines(off, doubt={"spread_mm": 10.0})
    assert "off by about 10 mm; none was moved: --calibration.geometry" in line
    (line,) = lines(doubt={"spread_mm": 10.0}, geometry=moved)
    assert "bodies moved by up to 12 mm, the receiver by 1 mm" in line
    (line,) = lines(doubt={"spread_mm": 10.0}, geometry=moved | {"kept": False})
    assert "no motion fits significantly better" in line
    (line,) = lines(doubt={"spread_mm": 0.1}, absent={"centres": [[0.0, 1.0, 2.0]]})
    assert line.startswith("mesh: 1 body left out")


def test_scores_name_the_share_of_measured_spectra():
    one = jnp.zeros(3)
    few = Mixture(
        one, jnp.zeros(4), jnp.zeros((0, 3)), jnp.float32(0), jnp.zeros((5, 3)), jnp.full(5, 1e9),
        jnp.zeros((5, 90, 360), jnp.uint8), jnp.zeros((90, 360)), jnp.float32(1), jnp.float32(0),
        jnp.array([0.0, 1.0, -1.0, 1.0]), jnp.zeros((5, 2)), jnp.array([-30.0, 0.0]),
    )  # fmt: skip
    assert eval_command.correction_lines(None) == []
    (line,) = eval_command.correction_lines(few)
    assert "the field (weight 0.00) with simple methods on 5 measured spectra" in line
    (line,) = eval_command.correction_lines(dataclasses.replace(few, field=jnp.array([0.0, 1.0])))
    assert "(weight 0.27 to 0.73)" in line
