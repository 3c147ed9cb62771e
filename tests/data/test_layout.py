"""The published folder layout: read whole, refused damaged, written from scene files."""

import dataclasses
import shutil
import subprocess
import sys
import warnings

import numpy as np
import pytest
import trimesh
from builders.synthetic import tiny_scene
from PIL import Image

from wbgs_jax._util.errors import UserError
from wbgs_jax.data import load_dataset, scene_dataset
from wbgs_jax.data.image_folder import NOMINAL_FREQUENCY_HZ, export_layout, load_layout, mesh_to_world, world_to_mesh
from wbgs_jax.data.scene_file import Room, SceneFile, save_room, save_scene
from wbgs_jax.mesh.ply import read_ply, write_ply
from wbgs_jax.radio.array import planar_array

N = 6
POSITIONS = [(0.1, 0.2, 0.3), (0.1, 0.2, 0.3), (-1, 2.5, 0), (-1, 2.5, 0), (4, 5, 6), (4, 5, 6)]
RECEIVER = "gateway1:\n  position: [2, 1, 0.5]\n  orientation: [0.1, 0.2, 0.3, 0.927]  # quaternion\n"
GATEWAY = f"dataset_name: den\nconvention: zenith\n{RECEIVER}"


@pytest.fixture
def folder(tmp_path, rng):
    """Three transmitters at 1 and 2.4 GHz in a folder of its own."""
    folder = tmp_path / "den"
    (folder / "spectrum").mkdir(parents=True)
    for k in range(1, N + 1):
        Image.fromarray(rng.integers(0, 256, (90, 360)).astype(np.uint8)).save(folder / "spectrum" / f"{k:05d}.png")
    (folder / "tx_pos.csv").write_text("x,y,z\n" + "\n".join(f"{x},{y},{z}" for x, y, z in POSITIONS) + "\n")
    (folder / "gateway_info.yml").write_text(GATEWAY)
    (folder / "freq.txt").write_text("1\n2.4\n1\n2.4\n1\n2.4")
    (folder / "train_index.txt").write_text("00001\n00002\n00003\n00004\n")
    (folder / "test_index.txt").write_text("00005\n00006\n")
    vertices = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 10]], np.float32)
    write_ply(folder / "point_cloud.ply", vertices, np.array([[0, 1, 2]], np.int32))
    return folder


@pytest.fixture
def scene(rng):
    n_tx, n_freq = 4, 3
    return SceneFile(
        name="loft",
        snapshots=(rng.normal(size=(n_tx, 1, n_freq, 32)).view(complex)).astype(np.complex64),
        tx_positions=rng.normal(size=(n_tx, 3)) * 10.0 ** rng.integers(-3, 3, (n_tx, 1)),
        frequencies_hz=np.array([0.1 + 0.2, 2.4, 94.0]) * 1e9 + rng.random(3),
        rx_position=rng.normal(size=(1, 3)),
        rx_orientation=(q := rng.normal(size=(1, 4))) / np.linalg.norm(q),
        element_positions=planar_array()[None],
        vertices=99 * rng.normal(size=(6, 3)).astype(np.float32),
        faces=rng.integers(0, 6, (4, 3)).astype(np.int32),
        face_part=np.zeros(4, np.int32),
        split=np.array([0, 1, 0, 0], np.int8),
    )


def test_a_folder_loads(folder):
    dataset = load_layout(folder)
    assert dataset.name == "den"
    np.testing.assert_array_equal(dataset.tx_positions, POSITIONS)
    np.testing.assert_array_equal(dataset.frequencies_hz, [1e9, 2.4e9] * 3)
    assert dataset.tx_index.tolist() == [0, 0, 1, 1, 2, 2]
    assert (dataset.train.tolist(), dataset.validation.tolist(), dataset.test.tolist()) == ([0, 1, 2, 3], [], [4, 5])
    assert (dataset.observed.name, dataset.n_receivers, dataset.receiver_index.tolist()) == ("pas", 1, [0] * N)
    images = dataset.observations["pas"]
    for k in range(N):
        np.testing.assert_array_equal(images[k], np.asarray(Image.open(folder / f"spectrum/{k + 1:05d}.png")))
    np.testing.assert_allclose(np.asarray(dataset.pas(np.array([2]))), images[2:3] / 255, atol=1e-7)
    receiver = dataset.receiver()
    np.testing.assert_array_equal(receiver.position, np.float32([2, 1, 0.5]))
    assert (receiver.pattern_exponents == 0).all()  # not known
    # The file's quaternion is x, y, z, w; ours is w, x, y, z.
    expected = np.array([0.927, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(receiver.orientation, expected / np.linalg.norm(expected), atol=1e-6)


def test_the_mesh_turns_from_z_up_to_y_up(folder):
    dataset = load_layout(folder)
    assert dataset.vertices.tolist() == [[1, 3, -2], [4, 6, -5], [7, 10, -8]]
    assert dataset.faces.tolist() == [[0, 1, 2]]


def test_a_room_lies_in_the_frame_of_the_transmitters(folder, rng):
    room = Room(
        rng.normal(size=(4, 3)).astype(np.float32), np.array([[0, 1, 2], [1, 2, 3]], np.int32), np.array([0, 1], np.int32)
    )
    save_room(folder / "room.npz", dataclasses.replace(room, parts=[{"name": n, "material": n, "thickness": 0} for n in "ab"]))
    with pytest.raises(UserError, match=r"both point_cloud.ply and room.npz; keep only one"):
        load_layout(folder)
    (folder / "point_cloud.ply").unlink()
    dataset = load_layout(folder)
    np.testing.assert_array_equal(dataset.vertices, room.vertices)
    np.testing.assert_array_equal(dataset.face_part, [0, 1])
    assert dataset.materials.names == ("a 0", "b 0") and dataset.materials.material.tolist() == [0, 1]


def test_mesh_frames_are_each_other_s_inverse(rng):
    points = rng.normal(size=(20, 3)).astype(np.float32)
    np.testing.assert_array_equal(mesh_to_world(world_to_mesh(points)), points)
    np.testing.assert_array_equal(world_to_mesh(mesh_to_world(points)), points)
    axes = mesh_to_world(np.eye(3, dtype=np.float32))
    np.testing.assert_array_equal(axes[2], [0, 1, 0])  # up stays up
    assert np.linalg.det(axes) == 1  # and nothing is mirrored


def test_row_k_belongs_to_image_k_whatever_the_padding(folder):
    spectra = folder / "spectrum"
    before = load_layout(folder)
    (spectra / "00002.png").rename(spectra / "2.png")
    (spectra / "00005.png").rename(spectra / "005.png")
    (folder / "train_index.txt").write_text("1 2.png\n3\r\n00004")
    after = load_layout(folder)
    np.testing.assert_array_equal(after.observations["pas"], before.observations["pas"])
    np.testing.assert_array_equal(after.train, before.train)


def test_optional_files_may_be_absent(folder):
    for name in ("freq.txt", "train_index.txt", "test_index.txt", "point_cloud.ply"):
        (folder / name).unlink()
    with pytest.warns(UserWarning, match="does not record a frequency, and 1 GHz is assumed"):
        dataset = load_layout(folder)
    assert dataset.vertices.shape == dataset.faces.shape == (0, 3)
    assert set(dataset.frequencies_hz) == {NOMINAL_FREQUENCY_HZ}
    assert len(dataset.train) == 4
    assert not set(dataset.tx_index[dataset.train]) & set(dataset.tx_index[dataset.test])


def test_the_seed_draws_the_split_that_the_folder_lacks(folder):
    for name in ("train_index.txt", "test_index.txt"):
        (folder / name).unlink()
    tests = [tuple(load_layout(folder, seed=seed).test) for seed in (*range(20), 0)]
    assert tests[0] == tests[-1]
    assert set(tests) == {(0, 1), (2, 3), (4, 5)}
    assert len(load_layout(folder, test_fraction=0.7).test) == 4


@pytest.mark.parametrize("where", ["frequency: 0.915\n", "  frequency: 0.915\n"])
def test_one_frequency_from_the_gateway_or_the_caller(folder, where):
    (folder / "freq.txt").unlink()
    (folder / "gateway_info.yml").write_text(GATEWAY + where)
    assert set(load_layout(folder).frequencies_hz) == {915e6}
    assert set(load_layout(folder, frequency_hz=868e6).frequencies_hz) == {868e6}
    with pytest.raises(UserError, match=r"the valid range is 0\.3 to 100 GHz"):
        load_layout(folder, frequency_hz=0.0)


def test_a_folder_with_walls_but_no_frequency_is_doubted(folder):
    (folder / "freq.txt").unlink()
    trimesh.creation.box((20, 20, 20)).export(folder / "point_cloud.ply")
    with pytest.warns(UserWarning, match="does not record a frequency, and 1 GHz is assumed"):
        load_layout(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_layout(folder, frequency_hz=2e9)


def test_a_frequency_at_odds_with_the_file_is_refused(folder):
    with pytest.raises(UserError, match=r"freq\.txt"):
        load_layout(folder, frequency_hz=1e9)


def test_the_first_gateway_is_the_receiver(folder):
    second = "gateway2:\n  position: [9, 9, 9]\n  orientation: [0, 0, 0, 1]\n"
    (folder / "gateway_info.yml").write_text(GATEWAY + second)
    with pytest.warns(UserWarning, match=r"gateway_info\.yml has 2 gateways; the first one, 'gateway1'"):
        np.testing.assert_array_equal(load_layout(folder).receivers.position, np.float32([[2, 1, 0.5]]))


def test_a_validation_part(folder):
    (folder / "train_index.txt").write_text("1\n2\n")
    (folder / "validation_index.txt").write_text("00003.png\n4\n")
    dataset = load_layout(folder)
    parts = [getattr(dataset, part).tolist() for part in ("train", "validation", "test")]
    assert parts == [[0, 1], [2, 3], [4, 5]]
    (folder / "validation_index.txt").write_text("3\n")
    (folder / "train_index.txt").write_text("1\n2\n4\n")
    with pytest.warns(UserWarning, match="1 TX positions are both in train and in validation"):
        load_layout(folder)


def test_a_published_split_through_transmitters_loads_with_a_warning(folder):
    (folder / "train_index.txt").write_text("1\n3\n5")
    (folder / "test_index.txt").write_text("2\n4")
    with pytest.warns(UserWarning, match="2 TX positions"):
        assert len(load_layout(folder).train) == 3


def test_a_point_cloud_without_faces(folder):
    write_ply(folder / "point_cloud.ply", np.ones((4, 3), np.float32), np.zeros((0, 3), np.int32))
    dataset = load_layout(folder)
    assert (len(dataset.vertices), len(dataset.faces)) == (4, 0)


@pytest.mark.parametrize("turned", [True, False])
def test_a_point_cloud_in_the_frame_of_the_transmitters_is_refused(folder, turned):
    points = np.array([*POSITIONS, (2, 1, 0.5)])
    box = trimesh.creation.box(bounds=(points.min(0) - 0.5, points.max(0) + 0.5))
    vertices = world_to_mesh(box.vertices) if turned else box.vertices
    write_ply(folder / "point_cloud.ply", vertices.astype(np.float32), box.faces.astype(np.int32))
    if turned:
        assert len(load_layout(folder).faces) == 12
    else:
        with pytest.raises(UserError, match="they share one frame; write it as room"):
            load_layout(folder)


# Bad input: one file of a good folder is spoilt; the message is one line that names the file and the trouble.


def write(name, content):
    return lambda folder: (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def replace(name, old, new):
    return lambda folder: (folder / name).write_text((folder / name).read_text().replace(old, new))


def remove(name):
    return lambda folder: shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()


def truncate(name, fraction=0.5):
    return lambda folder: (folder / name).write_bytes(
        (folder / name).read_bytes()[: int((folder / name).stat().st_size * fraction)]
    )


def image(name, size, mode="L"):
    return lambda folder: Image.new(mode, size).save(folder / name)


def scale_mesh(factor):
    def spoil(folder):
        vertices, faces = read_ply(folder / "point_cloud.ply")
        write_ply(folder / "point_cloud.ply", factor * vertices, faces)

    return spoil


def images_of_ones(folder):
    for path in (folder / "spectrum").iterdir():
        Image.new("L", (360, 90), 1).save(path)


def empty(folder):
    shutil.rmtree(folder)
    folder.mkdir()


def no_images(folder):
    empty(folder)
    (folder / "spectrum").mkdir()


@pytest.mark.parametrize(
    ("spoil", "file", "trouble"),
    [
        (shutil.rmtree, "den", "is not a folder"),
        (empty, "spectrum", "has no .png"),
        (no_images, "spectrum", "has no .png"),
        (remove("spectrum"), "spectrum", "has no .png"),
        (remove("spectrum/00003.png"), "spectrum", "is in the place of image 00003"),
        (truncate("spectrum/00003.png"), "00003.png", "truncated"),
        (truncate("spectrum/00003.png", 0.02), "00003.png", "truncated"),
        (write("spectrum/00003.png", b""), "00003.png", "truncated or not a PNG"),
        (write("spectrum/00003.png", "hello"), "00003.png", "truncated or not a PNG"),
        (image("spectrum/00003.png", (90, 360)), "00003.png", "360 x 90"),
        (image("spectrum/00003.png", (360, 90), "RGB"), "00003.png", "mode RGB"),
        (image("spectrum/00003.png", (360, 90), "I;16"), "00003.png", "mode I;16"),
        (images_of_ones, "spectrum", "spectra of at most 1 (multiply them by 255)"),
        (image("spectrum/mean.png", (360, 90)), "spectrum", "'mean' is not an image number"),
        (image("spectrum/3.png", (360, 90)), "spectrum", "is in the place of image 00004"),
        (image("spectrum/00000.png", (360, 90)), "00000.png", "number images from 1"),
        (image("spectrum/00007.png", (360, 90)), "tx_pos.csv", "6 rows for 7 images"),
        (remove("tx_pos.csv"), "tx_pos.csv", "No such file"),
        (write("tx_pos.csv", ""), "tx_pos.csv", "first line must be x,y,z"),
        (write("tx_pos.csv", b"\xff\xfe\x00"), "tx_pos.csv", "in UTF-16"),
        (write("tx_pos.csv", b"\xe9\xff\x00"), "tx_pos.csv", "not a text file"),
        (replace("tx_pos.csv", "x,y,z\n", ""), "tx_pos.csv", "first line must be x,y,z"),
        (replace("tx_pos.csv", "-1,2.5,0\n4", "-1,nan,0\n4"), "tx_pos.csv", "row 4"),
        (replace("tx_pos.csv", "-1,2.5,0\n4", "-1,inf,0\n4"), "tx_pos.csv", "row 4"),
        (replace("tx_pos.csv", "-1,2.5,0\n4", "-1,,0\n4"), "tx_pos.csv", "row 4"),
        (replace("tx_pos.csv", "-1,2.5,0\n4", "-1,2.5\n4"), "tx_pos.csv", "row 4"),
        (replace("tx_pos.csv", "-1,2.5,0\n4", "-1,2.5,0,1\n4"), "tx_pos.csv", "row 4"),
        (replace("tx_pos.csv", "-1,2.5,0\n4", "-1,2.5,0\n7,7,7\n4"), "tx_pos.csv", "7 rows for 6 images"),
        (truncate("tx_pos.csv"), "tx_pos.csv", "rows for 6 images"),
        (write("freq.txt", ""), "freq.txt", "0 frequencies for 6 images"),
        (write("freq.txt", "1 2.4 1 2.4 1"), "freq.txt", "5 frequencies for 6 images"),
        (write("freq.txt", "1 2.4 1 2.4 1 2.4 1"), "freq.txt", "7 frequencies for 6 images"),
        (write("freq.txt", "1 2.4 1 2.4 1 nan"), "freq.txt", "'nan'"),
        (write("freq.txt", "1 2.4 1 2.4 1 1e999"), "freq.txt", "'1e999'"),
        (write("freq.txt", "1 2.4 1 2.4 1 GHz"), "freq.txt", "'GHz'"),
        (write("freq.txt", "1 2.4 1 2.4 1 0"), "freq.txt", "'0'"),
        (write("freq.txt", "1 2.4 1 2.4 1 -2"), "freq.txt", "'-2'"),
        (remove("gateway_info.yml"), "gateway_info.yml", "with the position of the receiver, is missing"),
        (write("gateway_info.yml", ""), "gateway_info.yml", "names no gateway"),
        (write("gateway_info.yml", "[1, 2"), "gateway_info.yml", "not valid YAML"),
        (write("gateway_info.yml", "a: 2000-99-99"), "gateway_info.yml", "not valid YAML"),
        (write("gateway_info.yml", "gateway1: 3"), "gateway_info.yml", "names no gateway"),
        (replace("gateway_info.yml", "[2, 1, 0.5]", "[2, 1]"), "gateway_info.yml", "position"),
        (replace("gateway_info.yml", "[2, 1, 0.5]", "[2, 1, .nan]"), "gateway_info.yml", "position"),
        (replace("gateway_info.yml", "[2, 1, 0.5]", "5"), "gateway_info.yml", "position"),
        (replace("gateway_info.yml", "  orientation", "  rotation"), "gateway_info.yml", "orientation"),
        (replace("gateway_info.yml", "[0.1, 0.2, 0.3, 0.927]", "[0, 0, 0, 0]"), "gateway_info.yml", "all zeros"),
        (remove("train_index.txt"), "train_index.txt", "No such file"),
        (remove("test_index.txt"), "test_index.txt", "No such file"),
        (write("train_index.txt", ""), "train_index.txt", "no image"),
        (write("test_index.txt", ""), "test_index.txt", "no image"),
        (write("test_index.txt", "00005\n00007\n"), "test_index.txt", "names image 00007"),
        (write("test_index.txt", "00000\n"), "test_index.txt", "names image 00000"),
        (write("test_index.txt", "00005\nfive\n"), "test_index.txt", "'five'"),
        (write("test_index.txt", "00005\n5\n"), "test_index.txt", "twice"),
        (write("test_index.txt", "00004\n00005\n"), "test_index.txt", "image 00004 is in both"),
        (write("validation_index.txt", "00005\n"), "test_index.txt", "image 00005 is in both"),
        (write("validation_index.txt", "1\n"), "validation_index.txt", "image 00001 is in both"),
        (write("validation_index.txt", ""), "validation_index.txt", "no image"),
        (lambda f: (write("validation_index.txt", "3")(f), remove("test_index.txt")(f)), "test_index.txt", "No such file"),
        (truncate("point_cloud.ply"), "point_cloud.ply", "truncated"),
        (write("point_cloud.ply", ""), "point_cloud.ply", "not a PLY"),
        (scale_mesh(1000), "point_cloud.ply", "vertices contains 10000; positions are in metres"),
        (scale_mesh(1e-3), "den", "the transmitters are not near the surfaces"),
    ],
)
def test_bad_input(folder, spoil, file, trouble):
    spoil(folder)
    with pytest.raises(UserError) as error:
        load_layout(folder)
    message = str(error.value)
    assert file in message and trouble in message, message
    assert "\n" not in message
    assert ";" in message, f"says what to do after the semicolon: {message}"


# Export


def assert_same(exported, dataset):
    for key in ("tx_positions", "frequencies_hz", "tx_index", "train", "validation", "test", "vertices", "faces"):
        np.testing.assert_array_equal(getattr(exported, key), getattr(dataset, key), err_msg=key)
    index = np.arange(len(dataset))
    assert np.abs(np.asarray(exported.pas(index)) - np.asarray(dataset.pas(index))).max() < 0.5 / 255 + 1e-6
    np.testing.assert_array_equal(exported.receivers.position, dataset.receivers.position)
    np.testing.assert_allclose(exported.receivers.orientation, dataset.receivers.orientation, atol=1e-7)
    assert exported.name == dataset.name


@pytest.mark.parametrize("exists", [False, True])
def test_an_export_loads_as_the_scene(tmp_path, scene, exists):
    if exists:
        (tmp_path / "out").mkdir()
    export_layout(scene, tmp_path / "out")
    assert_same(load_dataset(tmp_path / "out"), scene_dataset(scene))
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out").stat().st_mode & 0o700 == 0o700


@pytest.mark.parametrize("kind", ["snapshot", "pas"])
def test_the_validation_of_an_export(tmp_path, kind):
    scene = tiny_scene(kind=kind)
    export_layout(scene, tmp_path / "without")
    assert not (tmp_path / "without" / "validation_index.txt").exists()
    scene = dataclasses.replace(scene, split=np.array([0, 2, 0, 1, 2, 1], np.int8))
    export_layout(scene, tmp_path / "with")
    assert_same(load_layout(tmp_path / "with"), scene_dataset(scene))
    assert (tmp_path / "with" / "validation_index.txt").read_text().split()[:4] == ["00004", "00005", "00006", "00013"]


@pytest.mark.parametrize(("changes", "what"), [({"n_rx": 3}, "3 receivers"), ({"kind": "power"}, "only received powers")])
def test_what_the_layout_has_no_form_for(tmp_path, changes, what):
    with pytest.raises(UserError, match=f"scene box has {what}, which the layout cannot represent; keep the scene file"):
        export_layout(tiny_scene(**changes), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_an_exported_mesh_is_z_up(tmp_path, scene):
    export_layout(scene, tmp_path / "out")
    x, y, z = scene.vertices.T
    np.testing.assert_array_equal(read_ply(tmp_path / "out" / "point_cloud.ply")[0], np.stack([x, -z, y], -1))


def test_published_files_have_the_published_form(tmp_path, scene):
    out = tmp_path / "out"
    export_layout(scene, out)
    assert sorted(p.name for p in (out / "spectrum").iterdir()) == [f"{k:05d}.png" for k in range(1, 13)]
    assert (out / "tx_pos.csv").read_text().splitlines()[0] == "x,y,z"
    assert (out / "test_index.txt").read_text().split() == ["00004", "00005", "00006"]
    with Image.open(out / "spectrum" / "00001.png") as png:
        assert (png.mode, png.size) == ("L", (360, 90))


def test_a_folder_with_content_is_left_alone(tmp_path, scene):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    (tmp_path / "file").touch()
    for name in ("out", "file"):
        with pytest.raises(UserError, match=rf"{name} exists and is not an empty folder"):
            export_layout(scene, tmp_path / name)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["file", "mine", "out"]


def test_a_failed_export_leaves_nothing(tmp_path, scene, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(UserError, match="No space left"):
        export_layout(scene, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_split_without_test_has_no_form_in_the_layout(tmp_path, scene):
    scene.split[:] = 0
    with pytest.raises(UserError, match="lacks test spectra"):
        export_layout(scene, tmp_path / "out")


@pytest.mark.heavy
def test_command_line(tmp_path, scene):
    save_scene(tmp_path / "s.npz", scene)
    command = [sys.executable, "-m", "wbgs_jax.commands.export_folder", str(tmp_path / "s.npz"), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert_same(load_layout(tmp_path / "out"), scene_dataset(scene))
    refused = subprocess.run(command, capture_output=True, text=True)  # the folder is full now
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1 and refused.stderr.startswith("error: "), refused.stderr


# Published data


def test_the_published_wideband_sample_loads(shared_data):
    dataset = load_dataset(shared_data("wideband3dgs_example1"))
    assert (len(dataset), len(dataset.train), len(dataset.test)) == (500, 400, 100)
    assert len(np.unique(dataset.frequencies_hz)) == 10
    assert len(set(dataset.tx_index[dataset.train])) == 40
    assert len(set(dataset.tx_index[dataset.test])) == 10
    assert not set(dataset.tx_index[dataset.train]) & set(dataset.tx_index[dataset.test])
    # Every transmitter stands inside the room's bounding box: the mesh lies in the transmitters' frame.
    assert (dataset.tx_positions > dataset.vertices.min(0)).all()
    assert (dataset.tx_positions < dataset.vertices.max(0)).all()


def test_the_published_rfid_sample_loads(shared_data):
    dataset = load_dataset(shared_data("wrfgs_rfid_40"), frequency_hz=915e6)
    assert (len(dataset), len(dataset.train), len(dataset.test)) == (40, 32, 8)
    assert set(dataset.frequencies_hz) == {915e6}
    assert len(dataset.vertices) == 0


def test_files_in_other_spellings(folder, recwarn):
    """Endings in capitals, quotation marks, and models that are not read."""
    before = load_layout(folder)
    image = folder / "spectrum" / "00003.png"
    image.rename(image.with_suffix(".PNG"))
    rows = (folder / "tx_pos.csv").read_text().splitlines()
    (folder / "tx_pos.csv").write_text('"x","y","z"\n' + "\n".join(rows[1:]))
    (folder / "room.glb").write_bytes(b"glTF")
    np.testing.assert_array_equal(load_layout(folder).observations["pas"], before.observations["pas"])
    assert not any("is not read" in str(note.message) for note in recwarn)
    (folder / "point_cloud.ply").unlink()
    with pytest.warns(
        UserWarning, match=r"room\.glb is not read; if .*, convert it: wbgs-jax convert room\.glb --out room\.npz"
    ):
        load_layout(folder)


def test_spectra_that_are_not_scaled_to_their_maximum(folder):
    bright = load_layout(folder, convention="zenith").observations["pas"]
    for path in (folder / "spectrum").iterdir():
        Image.fromarray(np.asarray(Image.open(path)) // 4).save(path)
    with pytest.warns(UserWarning, match="maximum of 6 of 6 spectra is below 230 of 255; each spectrum is scaled"):
        scaled = load_layout(folder, convention="zenith").observations["pas"]
    np.testing.assert_allclose(scaled.astype(float), bright, atol=6)
    assert (scaled.max((1, 2)) == 255).all()


def test_a_black_image_is_no_spectrum(folder):
    Image.fromarray(np.zeros((90, 360), np.uint8)).save(folder / "spectrum" / "00003.png")
    with pytest.raises(UserError, match=r"image 00003 of .*spectrum is black; remove images without spectra \(1 of 6\)"):
        load_layout(folder, convention="zenith")


def test_a_transmitter_at_the_receiver_is_refused(folder):
    rows = (folder / "tx_pos.csv").read_text().splitlines()
    (folder / "tx_pos.csv").write_text("\n".join([*rows[:2], "2,1,0.5", *rows[3:]]))
    with pytest.raises(UserError, match=r"den: the transmitter at .* is at its receiver"):
        load_layout(folder, convention="zenith")
