"""`wbgs-jax measure` as people call it."""

import json

import numpy as np
import pytest
import trimesh
from builders.commands import assert_error_for_people, call
from builders.flats import LAW, folder, powers

from wbgs_jax.commands.measure import main


@pytest.mark.heavy
def test_scores_pictures_and_answers(tmp_path, rng):
    data = folder(tmp_path, rng)
    files = {
        name: tmp_path / f"answer{suffix}" for name, suffix in (("out", ".json"), ("picture", ".png"), ("answers", ".csv"))
    }
    options = [word for name, path in files.items() for word in (f"--{name}", path)]
    done = call(main, "--data", data, "--tx", "1,1,1.3", "7,1,1.3", "500,1,1.3", *options)
    assert done.code == 0, done.err
    report = json.loads(files["out"].read_text())
    assert set(report["scores"]) == {"room_west", "room_east", "squares_of_1_m"}
    assert abs(report["law"]["first_wall_db"] - LAW[2]) < 2.5
    assert all(0.7 < score["within"] <= 1 for score in report["scores"].values())
    table = np.genfromtxt(files["answers"], delimiter=",", names=True)
    assert np.isnan(table["within_db_1"][2]) and "outside of the readings: no interval" in done.out.splitlines()[2]
    table = table[:2]
    expected = powers(np.array([[1, 1, 1.3], [7, 1, 1.3]]))
    assert np.abs(table["dbm_1"] - expected[:, 0]).max() < 6 and (table["within_db_1"] > 0).all()
    assert files["picture"].read_bytes()[:4] == b"\x89PNG"
    assert "mean dBm, 90 % within: receiver 1:" in done.out and "squares of 1 m" in done.out


def test_walls_become_a_mesh(tmp_path, rng):
    folder(tmp_path, rng, n=20)
    done = call(main, "--floor-plan", tmp_path / "walls.csv", "--ceiling", 2.5, "--mesh", tmp_path / "walls.ply")
    assert done.code == 0, done.err
    mesh = trimesh.load(tmp_path / "walls.ply", process=False)
    np.testing.assert_allclose(mesh.bounds[1][2], 2.5)


@pytest.mark.heavy
def test_cells_grow_until_a_map_can_hold_them(tmp_path, rng):
    data = folder(tmp_path, rng, n=1700, rooms=False)
    done = call(main, "--data", data, "--cell", 0.01, "--tx", "1,1,1.3")
    assert done.code == 0 and "cells of 0.01 m" not in done.err, done.err


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ([], "give --data FOLDER"),
        (["--data", "nowhere"], "folder nowhere does not exist"),
        (["--data", "DATA", "--out", "scores.txt"], "does not end in .json"),
        (["--data", "DATA", "--answers", "a.csv"], "--answers needs --tx"),
        (["--data", "DATA", "--cell", "0"], "--cell is 0"),
        (["--data", "DATA", "--tx", "1,2"], "--tx 1,2 is not a position"),
        (["--data", "DATA", "--floor-plan", "nowhere.csv"], "floor plan nowhere.csv does not exist"),
        (["--floor-plan", "walls.csv", "--mesh", "w.ply", "--tx", "1,1,1"], "predicted powers need readings"),
        (["--data", "DATA", "--tx", "1e30,0,0"], "--tx 1e30,0,0 is not a position"),
        (["--data", "DATA", "--out", "/dev/null/s.json"], "cannot write /dev/null/s.json"),
    ],
)
def test_errors_are_for_people(tmp_path, rng, options, says):
    data = folder(tmp_path, rng, n=20)
    assert_error_for_people(call(main, *(str(data) if word == "DATA" else word for word in options)), says)


@pytest.mark.heavy
def test_a_real_flat_with_a_room_held_out(tmp_path, shared_data):
    done = call(main, "--data", shared_data("ble_flat"), "--out", tmp_path / "scores.json")
    assert done.code == 0, done.err
    found = json.loads((tmp_path / "scores.json").read_text())["scores"]
    for room, law in (("room_east", 5.5), ("room_south", 4.9)):
        assert found[room]["error_db"] < 4.0 < law
        np.testing.assert_allclose(found[room]["rivals_db"]["log_distance"], law, atol=0.1)
        assert 0.86 <= found[room]["within"] <= 0.94
    assert "CC BY 4.0" in done.err


@pytest.mark.heavy
def test_odd_rooms_and_receivers(tmp_path, rng):
    """A receiver heard in one room alone, one never heard, a square where nothing is, and names of rooms that are markup."""
    data = folder(tmp_path, rng, n=200)
    header, *lines = (data / "readings.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines]
    for row in rows:
        row[2] = "[/hall]" if row[2] == "west" else "[kitchen]"
        row[4], row[5] = (row[4] if row[2] == "[/hall]" else ""), ""
        row[3:] = ["", "", ""] if max(float(row[0]), float(row[1])) < 1 else row[3:]
    (data / "readings.csv").write_text("\n".join([header, *(",".join(row) for row in rows)]))
    done = call(main, "--data", data, "--out", tmp_path / "scores.json")
    assert done.code == 0, done.err
    assert "room [/hall]" in done.out and "room [kitchen]" in done.out
    assert len(json.loads((tmp_path / "scores.json").read_text())["scores"]) == 3


def test_a_mesh_needs_walls_and_scores_need_room(tmp_path, rng):
    data = folder(tmp_path, rng, n=40)
    (data / "walls.csv").unlink()
    assert_error_for_people(call(main, "--data", data, "--mesh", tmp_path / "w.ply"), "--mesh needs walls")
    lines = [f"{x:.2f},{y:.2f},room,-50,-60,-70" for x, y in rng.uniform(0.1, 0.9, (30, 2))]
    (data / "readings.csv").write_text("\n".join(["x,y,room,rssi_1,rssi_2,rssi_3", *lines]))
    result = call(main, "--data", data)
    assert result.code == 2 and "nothing can be held out" in result.err
