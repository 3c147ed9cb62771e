"""A room by itself: written and read, beside spectra and beside snapshots."""

import dataclasses
import json

import numpy as np
import pytest

from wbgs_jax._util.errors import UserError
from wbgs_jax.data import load_dataset
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.data.scene_file import Room, load_room, save_room, save_scene
from wbgs_jax.interchange.scenes import scene_of_snapshots
from wbgs_jax.radio.array import planar_array

PARTS = [{"name": n, "material": m, "thickness": t} for n, m, t in (("wall", "brick", 0.2), ("door", "wood", 0.04))]


@pytest.fixture
def room(rng):
    vertices = rng.uniform(-3, 3, (7, 3)).astype(np.float32)
    faces = rng.integers(0, 7, (5, 3)).astype(np.int32)
    return Room(vertices, faces, np.array([0, 0, 1, 1, 0], np.int32), PARTS)


def test_a_room_is_what_was_written(tmp_path, room):
    save_room(tmp_path / "a.npz", room)
    again = load_room(tmp_path / "a.npz")
    for name in ("vertices", "faces", "face_part"):
        np.testing.assert_array_equal(getattr(again, name), getattr(room, name))
        assert getattr(again, name).dtype == getattr(room, name).dtype
    assert again.parts == PARTS


def test_a_room_that_cannot_be_read_is_not_written(tmp_path, room):
    with pytest.raises(UserError, match=r"a\.npz: vertices contains .*; positions are in metres"):
        save_room(tmp_path / "a.npz", dataclasses.replace(room, vertices=1e4 * room.vertices))
    with pytest.raises(UserError, match=r"a\.npz: meta contains what JSON cannot represent"):
        save_room(tmp_path / "a.npz", dataclasses.replace(room, parts=[{"name": tmp_path}]))
    assert not list(tmp_path.iterdir())
    save_room(tmp_path / "a.npz", dataclasses.replace(room, parts=[{"thickness": np.float64(0.5)}]))
    assert load_room(tmp_path / "a.npz").parts == [{"thickness": 0.5}]


def test_beside_snapshots_objects_keep_their_materials(tmp_path, room, rng):
    snapshots = rng.normal(size=(6, 1, 1, 8)).view(complex)
    places = rng.normal(size=(6, 3)), np.array([5e9]), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), planar_array(2, 2)
    save_scene(tmp_path / "mine.npz", scene_of_snapshots(snapshots, *places, "mine", room=room))
    dataset = load_dataset(tmp_path / "mine.npz")
    assert dataset.materials.names == ("brick 0.2", "wood 0.04")
    np.testing.assert_array_equal(dataset.materials.material, room.face_part)
    mesh = DatasetScene(dataset).mesh()
    np.testing.assert_allclose(mesh.thickness, [0.2, 0.04])
    assert load_room(tmp_path / "mine.npz").parts == PARTS, "a scene file holds a room, too"
    with pytest.raises(UserError, match="snapshots of mine are real; give complex voltages"):
        scene_of_snapshots(np.abs(snapshots), *places, "mine", room=room)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"faces": np.full((5, 3), 7)}, "faces refer to vertices that do not exist"),
        ({"face_part": np.full(5, -1)}, "face_part must not be negative"),
        ({"vertices": np.full((7, 3), 1e5)}, "positions are in metres"),
        ({"vertices": np.full((7, 3), np.nan)}, "contains NaN"),
        ({"faces": np.zeros((0, 3), int), "face_part": np.zeros(0, int)}, "has no triangles"),
        ({"faces": None}, "lacks faces"),
        ({"meta": None}, "lacks meta"),
        ({"meta": np.array("no JSON")}, "meta of room file"),
        ({"meta": np.array("[]")}, "meta of room file"),
        ({"vertices": np.zeros(3)}, "must be a 2-D"),
    ],
)
def test_what_is_no_room_is_refused(tmp_path, room, change, words):
    arrays = {"vertices": room.vertices, "faces": room.faces, "face_part": room.face_part, "meta": np.array(json.dumps({}))}
    arrays = {name: value for name, value in (arrays | change).items() if value is not None}
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(UserError, match=f"a.npz.*{words}|{words}.*a.npz") as caught:
        load_room(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)
