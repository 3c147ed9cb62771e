"""The scene file: what goes in comes out, in every format, and nothing that is not a scene is believed."""

import dataclasses
import hashlib
import json
import re
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from builders.synthetic import tiny_scene

from wbgs_jax._util.errors import UserError
from wbgs_jax.data import load_dataset, released_scenes, scene_dataset
from wbgs_jax.data.scene_file import SceneFile, load_scene, save_scene
from wbgs_jax.radio.array import planar_array

CARD = Path(__file__).parents[2] / "docs" / "dataset.md"


@pytest.fixture
def scene(rng):
    n_tx, n_freq = 5, 3
    return SceneFile(
        name="den",
        snapshots=rng.normal(size=(n_tx, 1, n_freq, 32)).view(complex).astype(np.complex64),
        tx_positions=rng.normal(size=(n_tx, 3)),
        frequencies_hz=np.array([1e9, 2.4e9, 94e9]),
        rx_position=np.array([[2.0, 1.0, 0.5]]),
        rx_orientation=np.array([[0.5, -0.5, 0.5, 0.5]]),
        element_positions=planar_array()[None],
        element_pattern="tr38901",
        vertices=rng.normal(size=(6, 3)).astype(np.float32),
        faces=rng.integers(0, 6, (4, 3)).astype(np.int32),
        face_part=np.array([0, 0, 1, 1], np.int32),
        split=np.array([0, 1, 0, 2, 1], np.int8),
        meta={"seed": 7, "parts": [{"name": "floor", "material": "wood"}, {"name": "wall", "material": "brick"}]},
    )


@pytest.fixture(scope="module", params=["snapshot", "pas", "power"])
def three(request):
    """Three receivers with arrays of fixed size and patterns of their own, observed in every kind."""
    scene = tiny_scene(4, n_rx=3, kind=request.param, unit="metres")
    return dataclasses.replace(scene, element_pattern=("tr38901", "iso", ""), split=np.array([0, 0, 2, 1], np.int8))


ARRAYS = [f.name for f in dataclasses.fields(SceneFile) if f.name not in ("name", "meta")]


def assert_same(again, scene):
    for key in ARRAYS:
        found, expected = getattr(again, key), getattr(scene, key)
        if isinstance(expected, np.ndarray):
            np.testing.assert_array_equal(found, expected)
            assert found.dtype == expected.dtype
        else:
            assert found == expected
    assert again.name == scene.name
    assert scene.meta.items() <= again.meta.items()


def test_round_trip(tmp_path, scene):
    save_scene(tmp_path / "s.npz", scene)
    assert_same(load_scene(tmp_path / "s.npz"), scene)


def test_round_trip_of_several_receivers(tmp_path, three):
    save_scene(tmp_path / "s.npz", three)
    assert_same(load_scene(tmp_path / "s.npz"), three)
    dataset = load_dataset(tmp_path / "s.npz")
    assert (dataset.n_receivers, len(dataset), dataset.receivers.unit) == (3, 4 * 3 * 3, "metres")
    assert dataset.receivers.pattern_exponents.tolist() == [[1, 0], [0, 0], [0, 0]]


def test_a_renamed_scene_keeps_its_new_name(tmp_path, scene):
    save_scene(tmp_path / "s.npz", scene)
    save_scene(tmp_path / "t.npz", dataclasses.replace(load_scene(tmp_path / "s.npz"), name="loft"))
    assert load_scene(tmp_path / "t.npz").name == "loft"


def test_equal_scenes_give_equal_bytes(tmp_path, scene):
    for name in ("a.npz", "b.npz"):
        save_scene(tmp_path / name, scene)
    save_scene(tmp_path / "c.npz", load_scene(tmp_path / "a.npz"))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes() == (tmp_path / "c.npz").read_bytes()


def test_metadata_may_hold_numbers_of_numpy(tmp_path, scene):
    meta = {"seed": np.int64(7), "gain": np.float32(0.5), "checks": np.array([1, 2])}
    save_scene(tmp_path / "s.npz", dataclasses.replace(scene, meta=meta))
    assert {"seed": 7, "gain": 0.5, "checks": [1, 2]}.items() <= load_scene(tmp_path / "s.npz").meta.items()
    for other in (1j, np.complex64(1), tmp_path):
        with pytest.raises(UserError, match=r"^.*t\.npz: meta contains what JSON cannot represent \(a \w+\); give texts"):
            save_scene(tmp_path / "t.npz", dataclasses.replace(scene, meta={"a": other}))
    assert not (tmp_path / "t.npz").exists()


def test_a_scene_needs_no_mesh(tmp_path, scene):
    bare = dataclasses.replace(
        scene, vertices=np.zeros((0, 3), np.float32), faces=np.zeros((0, 3), np.int32), face_part=np.zeros(0, np.int32)
    )
    save_scene(tmp_path / "s.npz", bare)
    assert load_scene(tmp_path / "s.npz").faces.shape == (0, 3)


def test_a_thickness_in_millimetres_is_refused(scene):
    parts = [{"name": "floor"}, {"name": "wall", "material": "brick", "thickness": 200}]
    with pytest.raises(UserError, match=r"^part 1 of den must be .* a thickness in metres, 0 to 2; correct it$"):
        scene_dataset(dataclasses.replace(scene, meta={"parts": parts}))


def test_surfaces_without_an_antenna_near_them_are_refused(scene):
    """One antenna suffices, at most the longest side of their box away."""
    surfaces = {"faces": np.array([[0, 1, 2]], np.int32), "face_part": np.zeros(1, np.int32)}
    corner = dataclasses.replace(scene, vertices=np.float32(15 + 2 * np.eye(3)), **surfaces)
    with pytest.warns(UserWarning, match="most transmitters lie outside of the surfaces"):
        assert len(scene_dataset(dataclasses.replace(corner, rx_position=np.full((1, 3), 13.1)))) == 15
    with pytest.raises(
        UserError, match=r"^den: the transmitters are not near the surfaces, .*; give both in metres, in one frame$"
    ):
        scene_dataset(dataclasses.replace(corner, rx_position=np.full((1, 3), 12.9)))


@pytest.mark.parametrize("antennas", ["transmitters", "receivers"])
@pytest.mark.parametrize(("scale", "outcome"), [(1.0, None), (3.28, "noted"), (100.0, "refused")])
def test_antennas_in_another_unit_than_the_surfaces(scene, rng, antennas, scale, outcome):
    """Feet and centimetres in a room of 4 m x 3 m x 3 m."""
    room = dataclasses.replace(
        scene,
        vertices=np.array([[0, 0, 0], [4, 0, 0], [4, 3, 3]], np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
        face_part=np.zeros(1, np.int32),
        tx_positions=rng.uniform([2.5, 0.5, 0.5], [3.5, 2.5, 2.5], scene.tx_positions.shape),
        rx_position=np.array([[3.5, 2.0, 2.0]]),
    )
    name = {"transmitters": "tx_positions", "receivers": "rx_position"}[antennas]
    scaled = dataclasses.replace(room, **{name: scale * getattr(room, name)})
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        if outcome == "refused":
            with pytest.raises(UserError, match=f"the {antennas} are not near the surfaces, .*; give both in metres"):
                scene_dataset(scaled)
        else:
            scene_dataset(scaled)
    assert [f"most {antennas} lie outside of" in str(note.message) for note in notes] == [True] * (outcome == "noted")


def test_links_are_transmitter_major(scene):
    dataset = scene_dataset(scene)
    assert len(dataset) == 15 and dataset.n_receivers == 1
    for i in range(15):
        tx, freq = divmod(i, 3)
        np.testing.assert_array_equal(dataset.snapshots[i], scene.snapshots[tx, 0, freq])
        np.testing.assert_array_equal(dataset.tx_positions[i], scene.tx_positions[tx])
        assert dataset.frequencies_hz[i] == scene.frequencies_hz[freq]
        assert dataset.tx_index[i] == tx
    assert dataset.train.tolist() == [0, 1, 2, 6, 7, 8]
    assert dataset.validation.tolist() == [9, 10, 11]
    assert dataset.test.tolist() == [3, 4, 5, 12, 13, 14]
    np.testing.assert_array_equal(dataset.receivers.orientation, scene.rx_orientation)
    np.testing.assert_array_equal(dataset.face_part, scene.face_part)
    assert dataset.materials.names == ("brick 0", "wood 0") and dataset.materials.material.tolist() == [1, 1, 0, 0]


def test_links_of_several_receivers_go_transmitter_receiver_frequency(three):
    dataset = scene_dataset(three)
    (observed,), (array,) = dataset.observations.values(), three.observations.values()
    for i in range(len(dataset)):
        tx, rx, freq = np.unravel_index(i, (4, 3, 3))
        np.testing.assert_array_equal(observed[i], array[tx, rx, freq])
        np.testing.assert_array_equal(dataset.tx_positions[i], three.tx_positions[tx])
        assert (dataset.receiver_index[i], dataset.tx_index[i]) == (rx, tx)
        assert dataset.frequencies_hz[i] == three.frequencies_hz[freq]
    for part, transmitters in (("train", [0, 1]), ("validation", [2]), ("test", [3])):
        np.testing.assert_array_equal(getattr(dataset, part), np.flatnonzero(np.isin(dataset.tx_index, transmitters)))
    for i, orientation in enumerate(three.rx_orientation):
        np.testing.assert_allclose(dataset.receiver(i).orientation, orientation, atol=1e-7)
        np.testing.assert_array_equal(dataset.receiver(i).element_positions, np.float32(three.element_positions[i]))


def test_of_very_many_materials_the_smaller_ones_are_one(scene):
    """By area; a thickness that is known stays."""
    faces = np.arange(300).reshape(-1, 3)
    corners = np.random.default_rng(0).uniform(-1, 1, (100, 3, 3)) * np.linspace(0.1, 3, 100)[:, None, None]
    parts = [{"name": f"part {i}", "thickness": 0.1 * (i % 2)} for i in range(100)]
    changes = {"vertices": np.float32(corners.reshape(-1, 3)), "faces": np.int32(faces), "meta": {"parts": parts}}
    with pytest.warns(UserWarning, match="has 100 materials: all except the 64 of the largest area"):
        materials = scene_dataset(dataclasses.replace(scene, face_part=np.arange(100, dtype=np.int32), **changes)).materials
    assert len(materials.names) == 66 and {"others 0", "others 0.1"} < set(materials.names)
    others = np.array([materials.names[kind].startswith("others") for kind in materials.material])
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    assert others.sum() == 36 and area[others].max() < area[~others].min()
    np.testing.assert_allclose(materials.thickness[materials.material], [0.1 * (i % 2) for i in range(100)])


@pytest.mark.parametrize(("kind", "nothing"), [("snapshot", np.nan), ("power", -300)])  # as some simulators say it
def test_what_a_receiver_does_not_hear_is_no_link(kind, nothing, tmp_path):
    scene = tiny_scene(4, n_rx=3, kind=kind)
    heard = scene.snapshots if kind == "snapshot" else scene.power_db
    heard[1], heard[0, 2, 1] = np.nan, nothing
    save_scene(tmp_path / "s.npz", scene)
    dataset = load_dataset(tmp_path / "s.npz")
    assert len(dataset) == 3 * 3 * 3 - 1
    assert np.isfinite(dataset.snapshots if kind == "snapshot" else dataset.power_db).all()
    assert set(dataset.tx_index) == {0, 1, 2}
    np.testing.assert_array_equal(dataset.tx_positions[dataset.tx_index == 1][0], scene.tx_positions[2])
    assert dataset.receiver_index[dataset.tx_index == 0].tolist() == [0, 0, 0, 1, 1, 1, 2, 2]


def test_an_empty_spectrum_is_no_link_and_a_dark_one_is_scaled(tmp_path):
    scene = tiny_scene(4, n_rx=3, kind="pas")
    scene.pas[..., 0, 0], scene.pas[1], scene.pas[0, 2, 1] = 255, 0, scene.pas[0, 2, 1] // 4 + 1
    save_scene(tmp_path / "s.npz", scene)
    with pytest.warns(UserWarning, match="maximum of 1 of 27 spectra is below 230 of 255"):
        dataset = load_dataset(tmp_path / "s.npz")
    assert len(dataset) == 27 and (dataset.observations["pas"].max((1, 2)) == 255).all()


def test_a_place_on_both_sides_of_the_split_is_noted(tmp_path):
    scene = tiny_scene(4)
    scene.tx_positions[3], scene.split[:] = scene.tx_positions[0], [0, 0, 2, 1]
    save_scene(tmp_path / "s.npz", scene)
    with pytest.warns(UserWarning, match="box: 1 TX positions are both in train and in test; scores will be too high"):
        load_dataset(tmp_path / "s.npz")


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
        ("snapshots", np.full((5, 1, 3, 16), np.nan, np.complex64), "snapshots contains only NaN"),
        ("snapshots", np.full((5, 1, 3, 16), [np.nan] + [1.0 + 0j] * 15), "or NaN in only some elements of a link"),
        ("snapshots", np.ones((5, 1, 3, 16)), "snapshots must be a 4-D complex64"),
        ("snapshots", np.full((5, 1, 3, 16), 1e300 + 1e300j), "snapshots contains infinity"),
        ("snapshots", np.zeros((5, 3, 16), np.complex64), "snapshots must be a 4-D complex64"),
        ("snapshots", np.zeros((5, 1, 3, 16), "U1"), "snapshots must be a 4-D complex64"),
        ("snapshots", None, "it contains none of pas, snapshots, power_db"),
        ("power_db", np.zeros((5, 1, 3), np.float32), "it contains snapshots and power_db"),
        ("tx_positions", np.full((5, 3), 1j), "tx_positions must be a 2-D float64"),
        ("tx_positions", np.full((5, 3), np.inf), "tx_positions contains NaN"),
        ("tx_positions", np.zeros((4, 3)), "tx_positions has shape"),
        ("frequencies_hz", np.array([1e9, 2e9]), "frequencies_hz has shape"),
        ("frequencies_hz", np.array([1e9, 0, 2e9]), "positive"),
        ("rx_orientation", np.array([[1.0, 1, 0, 0]]), "unit quaternion"),
        ("rx_position", np.zeros((2, 3)), "rx_position has shape"),
        ("element_positions", np.zeros((1, 15, 3)), "element_positions has shape"),
        ("element_unit", "cm", "element_unit must be wavelengths or metres"),
        ("element_pattern", ("iso", "iso"), "element_pattern must be a name, or one per receiver"),
        ("element_pattern", 3, "element_pattern must be a name, or one per receiver"),
        ("faces", np.array([[0, 1, 2**32]] * 4), "do not exist"),
        ("face_part", np.array([0, 0, 1, 2**32]), "face_part contains numbers beyond the range of int32"),
        ("faces", np.array([[0, 1, 6]] * 4, np.int32), "do not exist"),
        ("faces", np.array([[0, 1, -1]] * 4, np.int32), "do not exist"),
        ("face_part", np.zeros(3, np.int32), "face_part has shape"),
        ("split", np.array([0, 1, 3, 0, 0], np.int8), "split must contain"),
        ("split", np.array([0, 1, 256, 0, 0]), "split must contain"),
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
    assert ";" in str(error.value), "says what to do after the semicolon"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("kind", "value", "message"),
    [
        ("pas", np.ones((4, 1, 3, 90, 360), np.float32), "pas must be a 5-D uint8 array, not 5-D float32"),
        ("pas", np.ones((4, 1, 3, 360, 90), np.uint8), "pas has shape"),
        ("pas", np.ones((4, 2, 3, 90, 360), np.uint8), "element_positions has shape"),
        ("pas", np.ones((4, 1, 3, 90, 360), np.uint8), r"pas contains spectra of at most 1 \(multiply them by 255\)"),
        ("pas", np.full((4, 1, 3, 90, 360), 30000, np.uint16), "pas contains numbers beyond the range of uint8"),
        ("power_db", np.full((4, 1, 3), -np.inf, np.float32), "power_db contains infinity"),
        ("power_db", np.full((4, 1, 3), np.nan, np.float32), "or only NaN"),
        ("power_db", np.full((4, 1, 3), 110, np.float32), r"power_db contains 110, as path losses .* \(give 20 log10"),
        ("power_db", np.full((4, 1, 3), 1e-8, np.float32), "power_db contains 1e-08, as .* linear powers"),
        ("power_db", np.full((4, 1, 3), [-60, -60, 31], np.float32), "power_db contains 31"),
        ("power_db", np.zeros((4, 0, 3), np.float32), "element_positions has shape"),
    ],
)
def test_spectra_and_powers_that_are_none_are_not_written(tmp_path, kind, value, message):
    scene = tiny_scene(4, kind="power")
    object.__setattr__(scene, "power_db", None)
    object.__setattr__(scene, kind, value)
    with pytest.raises(UserError, match=message):
        save_scene(tmp_path / "s.npz", scene)


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


def save_format_1(path, scene):
    """Writes a scene of one receiver as the first version of this package did."""
    (array,) = (getattr(scene, key)[0] for key in ("element_positions",))
    arrays = {
        "snapshots": scene.snapshots[:, 0], "tx_positions": scene.tx_positions, "frequencies_hz": scene.frequencies_hz,
        "rx_position": scene.rx_position[0], "rx_orientation": scene.rx_orientation[0], "element_positions": array,
        "vertices": scene.vertices, "faces": scene.faces, "face_part": scene.face_part, "split": scene.split,
    }  # fmt: skip
    meta = scene.meta | {"format": 1, "name": scene.name, "rx_array": {"rows": 4, "pattern": scene.element_pattern}}
    np.savez_compressed(path, **arrays, meta=np.array(json.dumps(meta)))


def test_format_1_is_read(tmp_path, scene):
    save_format_1(tmp_path / "one.npz", scene)
    again = load_scene(tmp_path / "one.npz")
    assert_same(again, scene)
    assert again.meta["format"] == 1
    save_scene(tmp_path / "two.npz", again)
    assert_same(load_scene(tmp_path / "two.npz"), scene)
    assert load_scene(tmp_path / "two.npz").meta["format"] == 2


@pytest.mark.parametrize("array", [{}, None, 3, {"rows": 4}])
def test_format_1_need_not_know_its_element_pattern(tmp_path, scene, array):
    save_format_1(tmp_path / "s.npz", dataclasses.replace(scene, element_pattern=""))
    with np.load(tmp_path / "s.npz") as archive:
        arrays = dict(archive)
    meta = json.loads(str(arrays["meta"]))
    del meta["rx_array"]
    arrays["meta"] = np.array(json.dumps(meta | ({} if array is None else {"rx_array": array})))
    np.savez(tmp_path / "s.npz", **arrays)
    assert load_scene(tmp_path / "s.npz").element_pattern == ""
    assert load_dataset(tmp_path / "s.npz").receivers.pattern_exponents.tolist() == [[0, 0]]


def test_format_1_has_snapshots_only(tmp_path, scene):
    save_format_1(tmp_path / "s.npz", scene)
    with np.load(tmp_path / "s.npz") as archive:
        arrays = dict(archive)
    for key, value in (("snapshots", np.float64(1)), ("rx_position", np.zeros((1, 3))), ("split", np.zeros(3, np.int8))):
        np.savez(tmp_path / "bad.npz", **arrays | {key: value})
        with pytest.raises(UserError, match=rf"bad\.npz: {key}"):
            load_scene(tmp_path / "bad.npz")


def test_released_files_are_those_of_the_dataset_card(monkeypatch):
    monkeypatch.delenv("WBGS_DATA", raising=False)
    card = dict(re.findall(r"\| (?:scene)?(\w+)\.npz \|.*`([0-9a-f]{16})` \|", CARD.read_text()))
    files = released_scenes()
    assert set(files) == set(card)
    for number, file in files.items():
        assert hashlib.sha256(file.read_bytes()).hexdigest()[:16] == card[number]
        scene = load_scene(file)
        unit = "metres" if number in ("2_fixed", "cabin") else "wavelengths"
        edition = 1 if number.removesuffix("_21f").isdecimal() else 2  # the first ones
        assert scene.snapshots.shape[1:] == (1, len(scene.frequencies_hz), 16) and scene.meta["format"] == edition
        assert (scene.element_unit, scene.element_pattern) == (unit, "" if number == "cabin" else "tr38901")


@pytest.mark.parametrize("save", [save_scene, save_format_1])
def test_damaged_anywhere(tmp_path, scene, rng, save):
    """A flipped byte is either noticed or harmless: never a traceback."""
    save(tmp_path / "s.npz", scene)
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
            assert_same(again, scene)


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
