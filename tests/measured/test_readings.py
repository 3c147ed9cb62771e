"""Readings in from folders, and averaged."""

import numpy as np
import pytest
from flats import HEIGHT, RECEIVERS, folder, places, powers, write_table

from wbgs_jax._util.errors import UserError
from wbgs_jax.measured.readings import Readings, attribution, cell_means, load_readings


def test_a_folder_of_tables(tmp_path, rng):
    readings = load_readings(folder(tmp_path, rng, n=50, noise=0.0), HEIGHT)
    assert readings.powers.shape == (50, 3) and set(readings.rooms) <= {"west", "east"}
    np.testing.assert_allclose(readings.receivers, RECEIVERS)
    heard = np.isfinite(readings.powers)
    assert 0.6 < heard.mean() < 1
    np.testing.assert_allclose(readings.powers[heard], powers(readings.places)[heard], atol=0.01)
    np.testing.assert_array_equal(readings.counts, heard)


def test_the_published_layout_of_gateways(tmp_path, rng):
    tx = places(rng, 20)
    heard = powers(tx)
    heard[3, 1] = -100
    write_table(tmp_path / "tx_pos.csv", ["x", "y", "z"], tx)
    write_table(tmp_path / "gateway_rssi.csv", ["gateway1", "gateway2", "gateway3"], heard)
    lines = [f"gateway{i + 1}: [{', '.join(map(str, p))}]" for i, p in enumerate(RECEIVERS)]
    (tmp_path / "gateway_position.yml").write_text("\n".join(lines))
    readings = load_readings(tmp_path, HEIGHT)
    np.testing.assert_allclose(readings.receivers, RECEIVERS)
    assert np.isnan(readings.powers[3, 1]) and np.isfinite(readings.powers).sum() == 59


@pytest.mark.parametrize("style", ["antennas of one station", "receivers by name"])
def test_the_published_layout_of_channel_state(style, tmp_path, rng):
    """Its power is the mean over subcarriers, in decibels; an antenna that heard nothing says nothing."""
    tx, state = places(rng, 12), rng.normal(size=(12, 3, 26)) + 1j * rng.normal(size=(12, 3, 26))
    state[4, 2] = 0
    np.save(tmp_path / "csidata.npy", state.astype(np.complex64))
    rows = [f"[{', '.join(map(str, place))}]" for place in RECEIVERS]
    if style == "receivers by name":
        lines = [*(f"rx{i}: {row}" for i, row in enumerate(rows)), "num_rx: 3", "source: a set"]
        (tmp_path / "rx_positions.yml").write_text("\n".join(lines))
    else:
        (tmp_path / "base-station.yml").write_text(f"base_station: [{', '.join(rows)}]")
    with pytest.raises(UserError, match=r"has no tx_pos.csv .* NeRF2's own channel state"):
        load_readings(tmp_path, HEIGHT)
    write_table(tmp_path / "tx_pos.csv", ["x", "y", "z"], tx)
    readings = load_readings(tmp_path, HEIGHT)
    np.testing.assert_allclose(readings.receivers, RECEIVERS)
    assert np.isnan(readings.powers[4, 2]) and np.isfinite(readings.powers).sum() == 35
    mean = sum(abs(complex(value)) ** 2 for value in state[7, 1]) / 26
    assert readings.powers[7, 1] == pytest.approx(10 * np.log10(mean), abs=1e-4)
    for damaged, said in ((state.real, "complex numbers"), (state[:, :2], "12 transmitters at 2 receivers")):
        np.save(tmp_path / "csidata.npy", damaged)
        with pytest.raises(UserError, match=said):
            load_readings(tmp_path, HEIGHT)


def test_means_of_cells(rng):
    """Against a loop over all readings."""
    n, size = 200, 0.5
    tx = np.round(places(rng, n), 2)
    heard = rng.uniform(-90, -40, (n, 3))
    heard[rng.random((n, 3)) < 0.3] = np.nan
    rooms = tuple(rng.choice(["a", "b"], n))
    cells = cell_means(Readings(tx, heard, np.isfinite(heard).astype(float), rooms, RECEIVERS), size)
    groups = {}
    for i, place in enumerate(tx):
        groups.setdefault((*np.floor(place / size).astype(int), rooms[i]), []).append(i)
    assert len(cells.places) == len(groups)
    for place, power, count, room in zip(cells.places, cells.powers, cells.counts, cells.rooms, strict=True):
        own = next(g for g in groups.values() if np.allclose(tx[g].mean(0), place) and rooms[g[0]] == room)
        for r in range(3):
            known = heard[own, r][np.isfinite(heard[own, r])]
            assert count[r] == len(known)
            np.testing.assert_allclose(power[r], known.mean() if len(known) else np.nan)


def test_the_terms_of_data_are_found(tmp_path):
    (tmp_path / "README.md").write_text("# A set\n\nBy A. Author, doi 10.1/2,\nlicence CC BY 4.0.\n\nOther words.\n")
    assert attribution(tmp_path) == ["By A. Author, doi 10.1/2, licence CC BY 4.0."]
    assert attribution(tmp_path / "nowhere") == []


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("readings.csv", None, "has no readings.csv or calibration.csv"),
        ("receivers.csv", None, "has no receivers.csv or anchors.csv"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,-50,-60\n", "line 2 has 4 cells, the header 5"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,-50,loud,-60\n", "row 1: 'loud' is no number"),
        ("readings.csv", "x,y,rssi_1,rssi_2\n1,1,-50,-60\n", "2 columns of powers"),
        ("readings.csv", "x,rssi_1,rssi_2,rssi_3\n1,-50,-60,-70\n", "has no column 'y'"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n", "no rows"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,,-50,-60,-70\n", "places must be numbers of metres"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1e9,-50,-60,-70\n", "places must be numbers of metres"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,-5000,-60,-70\n", "powers must be dBm"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,-inf,-60,-70\n", "powers must be dBm"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,,,\n", "nothing was received anywhere"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,100,-60,-70\n", "leave cells empty"),
        ("readings.csv", "x;y;rssi_1;rssi_2;rssi_3\n1;1;-50;-60;-70\n", "separate them by commas"),
        ("readings.csv", "x,y,rssi,rssi,rssi\n1,1,-50,-60,-70\n", "names two columns alike"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, rng, file, content, says):
    folder(tmp_path, rng, n=20)
    if content is None:
        (tmp_path / file).unlink()
    else:
        (tmp_path / file).write_text(content)
    with pytest.raises(UserError, match=says):
        load_readings(tmp_path, HEIGHT)


def test_a_folder_that_is_none(tmp_path):
    with pytest.raises(UserError, match="there is no folder"):
        load_readings(tmp_path / "nowhere", HEIGHT)


def test_columns_stand_in_any_order_and_headers_in_capitals(tmp_path, rng):
    folder(tmp_path, rng, n=20, noise=0.0)
    first = load_readings(tmp_path, HEIGHT)
    _, *rows = [line.split(",") for line in (tmp_path / "readings.csv").read_text().splitlines()]
    swapped = [["X", "Y", "Room", "RSSI_3", "RSSI_1", "RSSI_2"], *([*row[:3], row[5], row[3], row[4]] for row in rows)]
    (tmp_path / "readings.csv").write_text("\n".join(",".join(row) for row in swapped))
    np.testing.assert_array_equal(load_readings(tmp_path, HEIGHT).powers, first.powers)


def test_columns_end_in_ids_that_hold_underscores(tmp_path, rng):
    folder(tmp_path, rng, n=20, noise=0.0)
    first = load_readings(tmp_path, HEIGHT)
    _, *stations = (tmp_path / "receivers.csv").read_text().splitlines()
    places = [line.split(",")[1:] for line in stations]
    ids = ["1", "ap_1", "AP_3"]
    lines = ["id,x,y,z", *(",".join([name, *place]) for name, place in zip(ids, places, strict=True))]
    (tmp_path / "receivers.csv").write_text("\n".join(lines))
    _, *rows = [line.split(",") for line in (tmp_path / "readings.csv").read_text().splitlines()]
    for names in (["rssi_ap_3", "rssi_1", "rssi_ap_1"], ["ap_3", "1", "ap_1"]):
        swapped = [["x", "y", "room", *names], *([*row[:3], row[5], row[3], row[4]] for row in rows)]
        (tmp_path / "readings.csv").write_text("\n".join(",".join(row) for row in swapped))
        np.testing.assert_array_equal(load_readings(tmp_path, HEIGHT).powers, first.powers)
    swapped[0][3] = "rssi_ap_4"
    (tmp_path / "readings.csv").write_text("\n".join(",".join(row) for row in swapped))
    with pytest.raises(UserError, match="ends in the receiver's id 'ap_3'"):
        load_readings(tmp_path, HEIGHT)
