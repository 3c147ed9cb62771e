"""`wbgs-jax convert`: a run's Gaussians and paths for other programs, and paths of theirs as a scene that trains."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from builders.commands import assert_error_for_people, call
from builders.drawn_paths import angles_of, bounced_paths
from builders.untrained import make_coherent_run, make_run
from scipy.io import savemat

from wbgs_jax.commands import convert as convert_command
from wbgs_jax.data.load import load_dataset
from wbgs_jax.data.scene_file import load_room
from wbgs_jax.interchange.deepmimo import read_deepmimo
from wbgs_jax.interchange.gaussian_ply import read_gaussians
from wbgs_jax.interchange.ray_paths import load_paths, save_paths


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return {"wideband": make_run(folder / "wideband"), "wave": make_coherent_run(folder / "wave")}


def convert(*arguments):
    result = call(convert_command.main, *arguments)
    assert (result.code, result.out) == (0, ""), result.err
    return result.err


def test_gaussians_for_a_splat_viewer(runs, tmp_path):
    said = convert("--run", runs["wideband"], "--tx", "1,0.5,1.5", "--ghz", 28, "--out", tmp_path / "a.ply")
    assert "(60, coloured by their mean signal at 28 GHz)" in said
    gaussians, colours = read_gaussians(tmp_path / "a.ply")
    assert gaussians.means.shape == (60, 3) and colours.std() > 0.05
    refused = call(convert_command.main, *["--run", runs["wave"], "--tx=1,0,1", "--ghz=28", "--out", tmp_path / "b.ply"])
    assert_error_for_people(refused, "wave field", "no Gaussians")


@pytest.mark.heavy
def test_paths_out_and_in_again(runs, tmp_path):
    """As Sionna's and as a DeepMIMO scenario: both become the same scene."""
    grid = ["--grid", "-1,0.5,1.5:1,1,1.5:3x2x1", "--ghz", 5]
    convert("--run", runs["wave"], *grid, "--out", tmp_path / "paths.npz")
    convert("--run", runs["wave"], *grid, "--out", tmp_path / "scenario")
    paths = load_paths(tmp_path / "paths.npz")
    assert paths.a.shape[:2] == (1, 6) and paths.valid.any(-1).all()
    direct = np.linalg.norm(paths.sources - paths.targets[0], axis=1) / 299792458
    np.testing.assert_allclose(np.where(paths.valid, paths.tau, 1).min(-1)[0], direct, rtol=1e-4)
    users = read_deepmimo(tmp_path / "scenario")
    assert users["power"].shape[0] == 6 and users["tx_pos"].shape == (1, 3)
    convert("--paths", tmp_path / "paths.npz", "--array", "2x2", "--out", tmp_path / "one.npz")
    convert("--paths", tmp_path / "scenario", "--ghz", 5, "--array", "2x2", "--out", tmp_path / "other.npz")
    one, other = (load_dataset(tmp_path / f"{name}.npz") for name in ("one", "other"))
    assert one.snapshots.shape == (6, 4) and len(one.test) == 1
    np.testing.assert_allclose(one.snapshots, other.snapshots, rtol=1e-2, atol=1e-3 * np.abs(one.snapshots).max())


@pytest.mark.parametrize("suffix", [".mat", ".MAT", ".NPZ"])
def test_arrays_of_sionna_in_files_of_any_kind(tmp_path, suffix):
    paths = bounced_paths(np.random.default_rng(0), transmitters=6)
    arrays = paths.as_sionna() | {"frequency_hz": np.array([paths.frequency_hz])}
    for file in (tmp_path / "plain.npz", tmp_path / f"paths{suffix}"):
        with file.open("wb") as stream:
            if file.suffix.lower() == ".mat":
                savemat(stream, arrays)
            else:
                np.savez(stream, **arrays)
        convert("--paths", file, "--array", "2x2", "--out", tmp_path / f"{file.stem}_scene.npz")
    one, other = (load_dataset(tmp_path / f"{name}_scene.npz") for name in ("plain", "paths"))
    np.testing.assert_array_equal(one.snapshots, other.snapshots)


def test_a_room_on_its_side_is_refused_beside_antennas(tmp_path):
    """Rooms of 12 x 14 x 3 m with the antennas up to 2.5 m high; the model is y up but in a format that is usually z up."""
    paths = bounced_paths(np.random.default_rng(0), transmitters=6, direct=True)
    low = {name: getattr(paths, name) * [1, 1, 0.25] for name in ("sources", "targets")}
    length = np.linalg.norm(low["targets"][:, None] - low["sources"][None], axis=-1)
    offset = (low["targets"][:, None] - low["sources"][None]) / length[..., None]
    away, towards = (angles_of(ends[:, :, None]) for ends in (offset, -offset))
    direct = replace(
        paths, **low, a=paths.a[..., :1], tau=length[..., None] / 299792458, theta_t=away[0], phi_t=away[1],
        theta_r=towards[0], phi_r=towards[1], interactions=paths.interactions[:0, ..., :1],
        vertices=paths.vertices[:0, ..., :1, :], valid=paths.valid[..., :1]
    )  # fmt: skip
    save_paths(tmp_path / "paths.npz", direct)
    room = trimesh.creation.box(bounds=[[-1, -2, 0], [11, 12, 3]])
    room.export(tmp_path / "upright.obj")
    room.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]).export(tmp_path / "turned.obj")
    convert(tmp_path / "turned.obj", "--out", tmp_path / "turned.npz")
    given = "--paths", tmp_path / "paths.npz", "--out", tmp_path / "scene.npz", "--mesh"
    refused = call(convert_command.main, *given, tmp_path / "turned.obj")
    assert_error_for_people(refused, "turned.obj lies on its side", "100% once it is upright; give --up y or --up z")
    refused = call(convert_command.main, *given, tmp_path / "turned.npz")
    assert_error_for_people(refused, "convert its model again with --up y or --up z")
    assert_error_for_people(call(convert_command.main, *given, tmp_path / "turned.npz", "--up", "y"), "--up has no effect on")
    assert_error_for_people(call(convert_command.main, *given[:4], "--up", "y"), "--up has no effect on paths alone")
    convert(*given, tmp_path / "upright.obj")
    upright = load_room(tmp_path / "scene.npz").vertices
    convert(*given, tmp_path / "turned.obj", "--up", "y")
    np.testing.assert_allclose(np.sort(load_room(tmp_path / "scene.npz").vertices, 0), np.sort(upright, 0), atol=1e-5)


def test_files_without_arrays_are_read_before_a_frequency_is_asked_for(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.mat").write_bytes(b"")
    (tmp_path / "v4.mat").write_bytes(bytes(200))
    for name, words in (("empty", "has no files such as"), ("a.mat", "a.mat"), ("v4.mat", "not a .mat file of version 5")):
        refused = call(convert_command.main, "--paths", tmp_path / name, "--out", tmp_path / "out.npz")
        assert_error_for_people(refused, words)
        assert "frequency" not in refused.err


def test_a_model_becomes_a_room_beside_spectra(tmp_path):
    """A building model: slabs as closed boxes, y up, in millimetres, with materials by name."""
    model = trimesh.Scene()
    for name, low, high in (
        ("floor", (0, 0, -0.2), (8, 5, 0)), ("wall_a", (0, 0, 0), (8, 0.2, 2.7)), ("wall_b", (7.9, 0.2, 0), (8, 5, 2.7)),
        ("desk", (2, 2, 0.7), (3.4, 2.8, 0.73)),
    ):  # fmt: skip
        model.add_geometry(trimesh.creation.box(bounds=1000 * np.array([low, high])), node_name=name, geom_name=name)
    model.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    model.export(tmp_path / "hall.glb")
    (tmp_path / "m.toml").write_text(
        '[objects]\n"wall*" = "brick"\nwall_b = { material = "glass", thickness = 0.01 }\n"*" = "concrete"\ndesk = "wood"\n'
    )
    options = "--materials", tmp_path / "m.toml", "--scale", 0.001, "--out", tmp_path / "room.npz"
    listing = convert(tmp_path / "hall.glb", *options)
    assert "wall_a  brick     0.2 m   sheet from a closed box 0.2 m deep  2 triangles" in listing
    assert "desk    wood      0.03 m  closed" in listing, "a name takes precedence over a pattern"
    assert "4 objects from (0, 0, 0) to (8, 5, 2.7) m" in listing
    room = load_room(tmp_path / "room.npz")
    assert [(part["material"], part["thickness"]) for part in room.parts] == [
        ("wood", 0.03), ("concrete", 0.2), ("brick", 0.2), ("glass", 0.01)
    ]  # fmt: skip
    unknown = convert(tmp_path / "hall.glb", "--scale", 0.001, "--out", tmp_path / "other.npz")
    assert "desk    desk    unknown thickness" in unknown
    np.testing.assert_array_equal(load_room(tmp_path / "other.npz").vertices, room.vertices)


def test_a_model_without_an_answer(tmp_path):
    (tmp_path / "a.blend").write_bytes(b"BLENDER")
    refused = call(convert_command.main, str(tmp_path / "a.blend"), "--out", str(tmp_path / "room.npz"))
    assert_error_for_people(refused, "a.blend", "Blender's own form", "glTF")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--out", "a.ply"], ["--run", "--paths", "room.glb"]),
        (["room.glb", "--run", "RUN", "--out", "a.npz"], ["one of --run"]),
        (["room.glb", "--out", "a.ply"], ["a.ply does not end in .npz"]),
        (["room.glb", "--out", "a.npz"], ["scene file room.glb does not exist"]),
        (["--run", "RUN", "--out", "a.ply"], ["--tx", "--ghz 28"]),
        (["--example", "--out", "a.ply"], ["--tx", "--ghz 28"]),
        (["--run", "RUN", "--example", "--out", "a.ply"], ["give one of --run RUN and --example"]),
        (["--run", "RUN", "--tx", "1,0,1", "--ghz", "28", "--out", "a.obj"], ["a.obj", "gaussians.ply"]),
        (["--run", "RUN", "--tx", "1,0,1", "--ghz", "28", "--out", "a.npz"], ["does not predict paths"]),
        (["--paths", "gone", "--ghz", "28", "--out", "a.npz"], ["cannot read gone"]),
        (["--paths", "gone", "--out", "a.npz"], ["cannot read gone"]),
        (["--paths", "gone", "--out", "a.ply"], ["does not end in .npz"]),
        (["room.glb", "--ghz", "28", "--out", "a.npz"], ["--ghz has no effect on a model; it belongs to --run or paths of"]),
        (
            ["--paths", "gone", "--tx", "1,0,1", "--out", "a.npz"],
            ["--tx has no effect on paths of Sionna RT or"],
        ),
        (["--paths", ".", "--port", "1", "--out", "a.npz"], ["--port has no effect on paths of DeepMIMO; it belongs to paths"]),
        (["--run", "RUN", "--tx=1,0,1", "--ghz=28", "--swap", "--out", "a.npz"], ["--swap has no effect on --run"]),
        (["--run", "RUN", "--tx=1,0,1", "--ghz=28", "--scale=1", "--out", "a.npz"], ["--scale has no effect on --run"]),
        (["--paths", "gone", "--ghz", "28", "--out", "/dev/null/a.npz"], ["cannot write /dev/null/a.npz"]),
    ],
)
def test_what_cannot_be_converted(runs, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    result = call(convert_command.main, *(str(runs["wideband"]) if word == "RUN" else word for word in arguments))
    assert_error_for_people(result, *words)
    assert list(tmp_path.iterdir()) == []
