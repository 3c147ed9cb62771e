"""`wbgs-jax update` as people call it."""

import dataclasses

import numpy as np
import pytest
from builders.commands import assert_error_for_people, call
from builders.synthetic import tiny_dataset

from wbgs_jax._util.errors import UserError
from wbgs_jax.commands.update import main
from wbgs_jax.data.load import RELEASED, scene_dataset
from wbgs_jax.data.scene_file import SceneFile, load_scene, save_scene
from wbgs_jax.inference.intervals import read_confidence, read_power_confidence
from wbgs_jax.inference.trained_field import RunConfig
from wbgs_jax.training.calibration.changes import Notice
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.training.update import Update, check_new, with_links, write_run


def new_links(path, count, ghz=(2.4, 10.0), **changes) -> SceneFile:
    """Links of the scene of the example: those of some transmitters, as if measured again."""
    scene = load_scene(RELEASED / "scene1.npz")
    some = np.random.default_rng(1).permutation(np.flatnonzero(scene.split == 0))[:count]
    hertz = np.isin(np.round(scene.frequencies_hz / 1e9, 3), ghz)
    values = {
        "tx_positions": scene.tx_positions[some],
        "split": scene.split[some],
        "frequencies_hz": scene.frequencies_hz[hertz],
        "snapshots": scene.snapshots[some][:, :, hertz],
    }
    made = dataclasses.replace(scene, **(values | {name: change(values, scene) for name, change in changes.items()}))
    save_scene(path, made)
    return made


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "no trained field; give --example"),
        (["--example"], "give the new links: --data NEW.npz"),
        (["--example", "--data", "NEW"], "give a folder for the updated run: --out RUN2"),
        (["--example", "--data", "NEW", "--out", "OUT", "--false-alarms", 0], "--false-alarms 0 is not a probability"),
        (["--example", "--data", "NEW", "--out", "."], "holds other files; choose another --out"),
        (["--example", "--data", "nowhere", "--out", "OUT"], "there is no scene 'nowhere'"),
        (["--run", "nowhere", "--data", "NEW", "--out", "OUT"], "nowhere is not a run folder"),
    ],
)
def test_errors_are_for_people(tmp_path, options, message):
    words = {"NEW": tmp_path / "new.npz", "OUT": tmp_path / "out"}
    assert_error_for_people(call(main, *(words.get(word, word) for word in options)), message)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("count", "changes", "message"),
    [
        (3, {}, "has 3 transmitters; an update needs at least 5 new ones"),
        (6, {"rx_position": lambda values, scene: scene.rx_position + 0.5}, "is not a receiver of scene1"),
        (6, {"element_positions": lambda values, scene: 2 * scene.element_positions}, "is not a receiver of scene1"),
        (6, {"vertices": lambda values, scene: 2 * scene.vertices}, "is of another room than scene1"),
        (6, {"tx_positions": lambda values, scene: values["tx_positions"] + 50}, "lie outside of the room"),
    ],
)
def test_data_that_do_not_belong_to_the_run_are_refused(tmp_path, count, changes, message):
    new_links(tmp_path / "new.npz", count, **changes)
    done = call(main, "--example", "--data", tmp_path / "new.npz", "--out", tmp_path / "out")
    assert_error_for_people(done, message)
    assert not (tmp_path / "out").exists()


def test_new_links_are_read_with_the_options_of_the_run(tmp_path, monkeypatch):
    def other_data(config, source):
        raise UserError(f"{source} is read at {config.frequency_ghz} GHz; stop here")

    new_links(tmp_path / "new.npz", 6)
    monkeypatch.setattr(RunConfig, "other_data", other_data)
    done = call(main, "--example", "--data", tmp_path / "new.npz", "--out", tmp_path / "out")
    assert_error_for_people(done, "new.npz is read at None GHz")


def test_a_field_without_a_mesh_has_nothing_that_could_have_changed():
    old = tiny_dataset()
    bare = dataclasses.replace(old, vertices=old.vertices[:0], faces=old.faces[:0], face_part=None, materials=None)
    with pytest.raises(UserError, match="has no mesh"):
        check_new(old, bare)


@pytest.mark.heavy
def test_nothing_is_written_where_nothing_has_changed(tmp_path):
    new_links(tmp_path / "new.npz", 12)
    done = call(main, "--example", "--data", tmp_path / "new.npz", "--out", tmp_path / "out", "--false-alarms", 1e-3)
    assert done.code == 0, done.err
    (line,) = done.out.splitlines()
    assert line.startswith("nothing has changed (p = ")
    assert not (tmp_path / "out").exists()


def test_intervals_of_an_updated_run_are_far_from_stale_and_new_places(tmp_path):
    """The field has learned nothing of the spectra at new places: an answer next to them is as uncertain as before."""
    trained = load_trained()
    old = trained.dataset()
    assert trained.intervals is not None
    stale = old.tx_positions[:, 0] < np.median(old.tx_positions[:, 0])
    new = scene_dataset(new_links(tmp_path / "new.npz", 6))
    new = dataclasses.replace(new, tx_positions=new.tx_positions + 0.05)
    room = with_links(old, np.flatnonzero(~stale), new)
    write_run(tmp_path / "run", Update(Notice(0.01, {}), [], 1.0, trained, room, stale, []), old)
    before = np.asarray(trained.intervals.tx_position)
    kept = before[before[:, 0] >= np.float32(np.median(old.tx_positions[:, 0])) - 1e-4]
    for found in (read_confidence(tmp_path / "run"), read_power_confidence(tmp_path / "run")):
        assert found is not None
        np.testing.assert_allclose(found.tx_position, kept, atol=1e-3)
