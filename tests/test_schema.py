"""The scene file: what goes in comes out, and nothing that is not a scene is believed."""

import dataclasses
import json
import zipfile

import numpy as np
import pytest

from wbgs_jax.array import planar_array
from wbgs_jax.data import load_dataset, scene_dataset
from wbgs_jax.data.schema import SceneFile, load_scene, save_scene
from wbgs_jax.errors import UserError


@pytest.fixture
def scene(rng):
    n_tx, n_freq = 5, 3
    return SceneFile(
        name="den",
        snapshots=(rng.normal(size=(n_tx, n_freq, 16)) + 1j * rng.normal(size=(n_tx, n_freq, 16))).astype(np.complex64),
        tx_positions=rng.normal(size=(n_tx, 3)),
        frequencies_hz=np.array([1e9, 2.4e9, 94e9]),
        rx_position=np.array([2.0, 1.0, 0.5]),
        rx_orientation=np.array([0.5, -0.5, 0.5, 0.5]),
        element_positions=planar_array(),
        vertices=rng.normal(size=(6, 3)).astype(np.float32),
        faces=rng.integers(0, 6, (4, 3)).astype(np.int32),
        face_part=np.array([0, 0, 1, 1], np.int32),
        split=np.array([0, 1, 0, 0, 1], np.int8),
        meta={"seed": 7, "parts": [{"name": "floor", "material": "wood"}, {"name": "wall", "material": "brick"}]},
    )


ARRAYS = [f.name for f in dataclasses.fields(SceneFile) if f.name not in ("name", "meta")]


def test_round_trip(tmp_path, scene):
    save_scene(tmp_path / "s.npz", scene)
    again = load_scene(tmp_path / "s.npz")
    for key in ARRAYS:
        np.testing.assert_array_equal(getattr(again, key), getattr(scene, key))
        assert getattr(again, key).dtype == getattr(scene, key).dtype
    assert again.name == "den"
    assert scene.meta.items() <= again.meta.items()


def test_a_renamed_scene_keeps_its_new_name(tmp_path, scene):
    save_scene(tmp_path / "s.npz", scene)
    save_scene(tmp_path / "t.npz", dataclasses.replace(load_scene(tmp_path / "s.npz"), name="loft"))
    assert load_scene(tmp_path / "t.npz").name == "loft"


def test_equal_scenes_give_equal_bytes(tmp_path, scene):
    for name in ("a.npz", "b.npz"):
        save_scene(tmp_path / name, scene)
    save_scene(tmp_path / "c.npz", load_scene(tmp_path / "a.npz"))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes() == (tmp_path / "c.npz").read_bytes()


def test_a_scene_needs_no_mesh(tmp_path, scene):
    bare = dataclasses.replace(
        scene, vertices=np.zeros((0, 3), np.float32), faces=np.zeros((0, 3), np.int32), face_part=np.zeros(0, np.int32)
    )
    save_scene(tmp_path / "s.npz", bare)
    assert load_scene(tmp_path / "s.npz").faces.shape == (0, 3)


def test_spectra_are_transmitter_major(scene):
    dataset = scene_dataset(scene)
    assert len(dataset) == 15
    for i in range(15):
        tx, freq = divmod(i, 3)
        np.testing.assert_array_equal(dataset.snapshots[i], scene.snapshots[tx, freq])
        np.testing.assert_array_equal(dataset.tx_positions[i], scene.tx_positions[tx])
        assert dataset.frequencies_hz[i] == scene.frequencies_hz[freq]
        assert dataset.tx_index[i] == tx
    assert dataset.train.tolist() == [0, 1, 2, 6, 7, 8, 9, 10, 11]
    assert dataset.test.tolist() == [3, 4, 5, 12, 13, 14]
    np.testing.assert_array_equal(dataset.receiver.orientation, scene.rx_orientation)


def test_scenes_are_found_by_number_and_by_path(tmp_path, scene, monkeypatch):
    monkeypatch.setenv("WBGS_DATA", str(tmp_path))
    for number in (1, 2, 10):
        save_scene(tmp_path / f"scene{number}.npz", dataclasses.replace(scene, name=f"number {number}"))
    assert load_dataset("2").name == load_dataset(2).name == load_dataset(tmp_path / "scene2.npz").name == "number 2"
    for unknown in ("3", 3, "den", "no/such/folder"):
        with pytest.raises(UserError, match=r"1, 2, 10") as error:
            load_dataset(unknown)
        assert str(unknown) in str(error.value)


def test_without_any_scene_the_message_says_how_to_get_them(tmp_path, monkeypatch):
    monkeypatch.setenv("WBGS_DATA", str(tmp_path))
    with pytest.raises(UserError, match="make data"):
        load_dataset("1")


def test_released_scenes_are_looked_for_in_the_repository(monkeypatch):
    monkeypatch.delenv("WBGS_DATA", raising=False)
    with pytest.raises(UserError, match="scene 'nowhere'"):
        load_dataset("nowhere")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("snapshots", np.full((5, 3, 16), np.nan, np.complex64), "snapshots contains NaN"),
        ("tx_positions", np.full((5, 3), np.inf), "tx_positions contains NaN"),
        ("tx_positions", np.zeros((4, 3)), "tx_positions has shape"),
        ("frequencies_hz", np.array([1e9, 2e9]), "frequencies_hz has shape"),
        ("frequencies_hz", np.array([1e9, 0, 2e9]), "positive"),
        ("rx_orientation", np.array([1.0, 1, 0, 0]), "unit quaternion"),
        ("element_positions", np.zeros((15, 3)), "element_positions has shape"),
        ("faces", np.array([[0, 1, 6]] * 4, np.int32), "do not exist"),
        ("faces", np.array([[0, 1, -1]] * 4, np.int32), "do not exist"),
        ("face_part", np.zeros(3, np.int32), "face_part has shape"),
        ("split", np.array([0, 1, 2, 0, 0], np.int8), "split must hold"),
    ],
)
def test_a_scene_that_is_none_is_not_written(tmp_path, scene, key, value, message):
    # Past the type checker, which the shapes would not pass: users run without it.
    broken = dataclasses.replace(scene)
    object.__setattr__(broken, key, value)
    with pytest.raises(UserError, match=message) as error:
        save_scene(tmp_path / "s.npz", broken)
    assert "s.npz" in str(error.value)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_file(tmp_path):
    with pytest.raises(UserError, match=r"scene9\.npz.*No such file"):
        load_scene(tmp_path / "scene9.npz")


def test_truncated_anywhere(tmp_path, scene, rng):
    save_scene(tmp_path / "s.npz", scene)
    content = (tmp_path / "s.npz").read_bytes()
    for length in [0, *rng.integers(0, len(content), 30)]:
        (tmp_path / "cut.npz").write_bytes(content[:length])
        with pytest.raises(UserError, match=r"cut\.npz"):
            load_scene(tmp_path / "cut.npz")


def test_damaged_anywhere(tmp_path, scene, rng):
    """A flipped byte is either noticed or harmless: never a traceback."""
    save_scene(tmp_path / "s.npz", scene)
    content = (tmp_path / "s.npz").read_bytes()
    for place in rng.integers(0, len(content), 200):
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        (tmp_path / "bad.npz").write_bytes(damaged)
        try:
            again = load_scene(tmp_path / "bad.npz")
        except UserError as error:
            assert "bad.npz" in str(error)
        else:
            assert all(np.array_equal(getattr(again, key), getattr(scene, key)) for key in ARRAYS)


def test_other_files_are_not_scenes(tmp_path, scene):
    (tmp_path / "text.npz").write_text("hello")
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "array.npy").rename(tmp_path / "array.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.savez(tmp_path / "pickle.npz", snapshots=np.array([{}], object))
    for name in ("text.npz", "array.npz", "other.npz", "pickle.npz"):
        with pytest.raises(UserError, match=name):
            load_scene(tmp_path / name)


@pytest.mark.parametrize("meta", ["{", "[]", "{}", json.dumps({"format": 99})])
def test_a_wrong_format(tmp_path, scene, meta):
    save_scene(tmp_path / "s.npz", scene)
    with zipfile.ZipFile(tmp_path / "s.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    np.save(tmp_path / "meta.npy", np.array(meta))
    with zipfile.ZipFile(tmp_path / "s.npz", "w") as archive:
        for name, content in (members | {"meta.npy": (tmp_path / "meta.npy").read_bytes()}).items():
            archive.writestr(name, content)
    with pytest.raises(UserError, match=r"s\.npz"):
        load_scene(tmp_path / "s.npz")
