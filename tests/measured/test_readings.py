"""Readings in from folders, and averaged."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from builders.flats import HEIGHT, RECEIVERS, folder, places, powers, write_table

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.rssi_folder import Readings, attribution, cell_means, load_readings
from wbgs_jax.data.tables import match_columns, not_received, note_of_powers, tokens
from wbgs_jax.power_map.model import MAX_PLACES
from wbgs_jax.power_map.survey import load_survey


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


def test_weak_readings_of_gateways_are_readings(tmp_path):
    (tmp_path / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{k},1,1\n" for k in range(4)))
    (tmp_path / "gateway_position.yml").write_text("gateway1: [0, 0, 2]\n")
    (tmp_path / "gateway_rssi.csv").write_text("gateway1\n-97\n-100\n-104.5\n-111\n")
    np.testing.assert_array_equal(load_readings(tmp_path, HEIGHT).powers[:, 0], [-97, np.nan, -104.5, -111])


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
    of_band = np.concatenate([state, np.zeros((12, 3, 2))], -1).astype(np.complex64)
    of_band[:, :, 3] = np.nan
    of_band[7, 1, 5] = np.nan
    np.save(tmp_path / "csidata.npy", 1e4 * of_band)  # counts of a converter, without direct current and the band's edges
    usual = np.delete(state, 3, -1)
    mean = np.mean([abs(complex(value)) ** 2 for value in usual[6, 1]])
    assert load_readings(tmp_path, HEIGHT).powers[6, 1] == pytest.approx(10 * np.log10(mean) + 80, abs=1e-4)
    assert np.isfinite(load_readings(tmp_path, HEIGHT).powers).sum() == 35
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
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,-50,-60\n", "line 2 has 4 cells, but the header has 5"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,-50,loud,-60\n", "row 1: 'loud' is not a number"),
        ("readings.csv", "x,y,rssi_1,rssi_2\n1,1,-50,-60\n", "2 columns of powers"),
        ("readings.csv", "x,rssi_1,rssi_2,rssi_3\n1,-50,-60,-70\n", "has no column 'y'"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n", "no rows"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,,-50,-60,-70\n", "places must be coordinates in metres"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1e9,-50,-60,-70\n", "places must be coordinates in metres"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,-5000,-60,-70\n", "powers must be dBm"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,inf,-60,-70\n", "powers must be dBm"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,1e-7,0,3e-9\n", "convert milliwatts"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,55,60,70\n", "give magnitudes their sign"),
        ("readings.csv", "x,y,floor,rssi_1,rssi_2,rssi_3\n1,1,2,-55,-60,-70\n", "floors but no heights"),
        ("readings.csv", "x,y,battery,rssi_1,rssi_2,rssi_3\n1,1,2,-55,-60,-70\n", "4 columns of powers"),
        (
            "readings.csv",
            "x,y,rssi_1,rssi_2,rssi_3\n" + "".join(f"{i},1,-4{i},4{i},-5{i}\n" for i in range(5)),
            r"powers of receiver 2 are all positive; give magnitudes their sign",
        ),
        (
            "readings.csv",
            "x,y,kitchen,hall,office\n1,1,-55,-60,-70\n",
            "kitchen, hall, office.* name them rssi_1",
        ),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3\n1,1,,,\n", "nothing was received anywhere"),
        ("readings.csv", "x;y;rssi_1;rssi_2;rssi_3\n1;1;-50;-60;-70\n", "separate them by commas"),
        (
            "readings.csv",
            "x\ty\trssi_1\trssi_2\trssi_3\n1\t1\t-50\t-60\t-60\n",
            "tabs between its cells; separate them by commas",
        ),
        ("readings.csv", "x,y,rssi,rssi,rssi\n1,1,-50,-60,-70\n", "has two columns of the same name"),
        ("readings.csv", "x,y,rssi_1,rssi_2,rssi_3,\n1,1,-50,-60,-70,\n", "a column without a name, number 6; name it, or"),
        ("readings.csv", "sep=,\nx,y,rssi_1,rssi_2,rssi_3\n1,1,-50,-60,-70\n", "its first line must name .* without '#' or"),
        ("readings.csv", "# x,y,rssi_1,rssi_2,rssi_3\n1,1,-50,-60,-70\n", "its first line must name .* without '#' or"),
        ("readings.csv", 'x,y,rssi_1,rssi_2,rssi_3\n"1,5",1,-50,-60,-70\n', "'1,5' is not a number; write decimal points"),
        (
            "readings.csv",
            "x [cm],y [cm],rssi_1,rssi_2,rssi_3\n1,1,-50,-60,-70\n",
            r"column 'x \[cm\]'; convert it to metres, and",
        ),
        (
            "readings.csv",
            "x,y,z,rssi_1,rssi_2,rssi_3\n1,1,1300,-50,-60,-70\n",
            r"1.3e\+03 m apart in height, but at most .* in plan",
        ),
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


def test_the_metre_may_stand_behind_coordinates(tmp_path, rng):
    """As surveys name their columns, in every usual spelling."""
    folder(tmp_path, rng, n=20)
    plain = load_readings(tmp_path, HEIGHT)
    for name in ("readings.csv", "receivers.csv"):
        head, rows = (tmp_path / name).read_text().split("\n", 1)
        spelled = {"x": "X [m]", "y": "y (metres)", "z": "z_m", **{f"rssi_{k}": f"RSSI {k} (dBm)" for k in (1, 2, 3)}}
        (tmp_path / name).write_text(",".join(spelled.get(word, word) for word in head.split(",")) + "\n" + rows)
    found = load_readings(tmp_path, HEIGHT)
    np.testing.assert_array_equal(found.places, plain.places)
    np.testing.assert_array_equal(found.powers, plain.powers)
    np.testing.assert_array_equal(found.receivers, plain.receivers)


def test_tables_in_utf_16_are_refused(tmp_path, rng):
    folder(tmp_path, rng, n=20)
    (tmp_path / "readings.csv").write_text("x,y,rssi_1,rssi_2,rssi_3\n1,1,-50,-60,-60\n", encoding="utf-16")
    with pytest.raises(UserError, match=r"readings\.csv is not a text file in UTF-8; save it as CSV in UTF-8"):
        load_readings(tmp_path, HEIGHT)


def test_places_in_degrees_around_receivers_in_metres_are_refused(tmp_path, rng):
    """Readings from one corner of a site are not."""
    tx = places(rng, 30)
    heard = powers(tx).round(2)
    write_table(tmp_path / "receivers.csv", ["x", "y", "z"], RECEIVERS)
    degrees = np.column_stack([8.54 + tx[:, 0] / 75e3, 47.37 + tx[:, 1] / 111e3])
    for positions, refused in ((degrees, True), (degrees[:, ::-1], True), (tx[:, :2] / 30 + 5, False)):
        write_table(tmp_path / "readings.csv", ["x", "y", "rssi_1", "rssi_2", "rssi_3"], np.hstack([positions, heard]))
        if refused:
            with pytest.raises(UserError, match="from the nearest receiver: degrees of longitude and latitude; project them"):
                load_readings(tmp_path, HEIGHT)
        else:
            np.testing.assert_allclose(load_readings(tmp_path, HEIGHT).places[:, :2], positions)


def test_a_folder_that_is_none(tmp_path):
    with pytest.raises(UserError, match=r"folder .* does not exist"):
        load_readings(tmp_path / "nowhere", HEIGHT)


def test_columns_stand_in_any_order_and_headers_in_capitals(tmp_path, rng):
    folder(tmp_path, rng, n=20, noise=0.0)
    first = load_readings(tmp_path, HEIGHT)
    _, *rows = [line.split(",") for line in (tmp_path / "readings.csv").read_text().splitlines()]
    swapped = [["X", "Y", "Room", "RSSI_3", "RSSI_1", "RSSI_2"], *([*row[:3], row[5], row[3], row[4]] for row in rows)]
    (tmp_path / "readings.csv").write_text("\n".join(",".join(row) for row in swapped))
    np.testing.assert_array_equal(load_readings(tmp_path, HEIGHT).powers, first.powers)


def test_receivers_keep_their_ids(tmp_path, rng):
    folder(tmp_path, rng, n=20, noise=0.0)
    path = tmp_path / "receivers.csv"
    lines = [line.split(",", 1)[1] for line in path.read_text().splitlines()]
    path.write_text("\n".join(lines))
    assert load_readings(tmp_path, HEIGHT).titles == ["receiver 1", "receiver 2", "receiver 3"]
    path.write_text("\n".join(f"{name},{line}" for name, line in zip(("id", "a", "b", "c"), lines, strict=True)))
    readings = tmp_path / "readings.csv"
    readings.write_text(readings.read_text().replace("rssi_3", "c").replace("rssi_1", "a").replace("rssi_2", "b"))
    assert cell_means(load_readings(tmp_path, HEIGHT), 0.5).titles == ["receiver 1 (a)", "receiver 2 (b)", "receiver 3 (c)"]


@pytest.mark.parametrize("column", ["receiver_id", "ap_id", "anchor_id", "ssid", "label", "number", "rx", "", "Sensor"])
def test_a_column_of_ids_has_any_name(tmp_path, rng, column):
    """Rows in another order than the columns of powers."""
    folder(tmp_path, rng, n=20, noise=0.0)
    _, *rows = (tmp_path / "receivers.csv").read_text().splitlines()
    (tmp_path / "receivers.csv").write_text("\n".join([f"{column},x,y,z", *rows[::-1]]))
    readings = load_readings(tmp_path, HEIGHT)
    np.testing.assert_allclose(readings.receivers, RECEIVERS[::-1])
    heard = np.isfinite(readings.powers)
    np.testing.assert_allclose(readings.powers[heard], powers(readings.places)[:, ::-1][heard], atol=0.01)
    assert readings.ids == ("3", "2", "1")


@pytest.mark.parametrize(
    ("column", "cells", "says"),
    [
        ("unit", ["ft"] * 3, r"columns of unknown meaning \('unit'\); remove them, and"),
        ("offset_db", ["1.5", "2", "-3"], "'offset_db'"),
        ("Floor", ["1", "2", "3"], "at the same height"),
        ("Floor", ["1", "1", "1"], None),
        ("", ["7", "8", "9"], "unknown meaning"),
        ("", ["0", "1", "2"], None),  # as pandas counts rows
        ("comment", ["new", "", "old"], None),
        ("mac", ["a", "b", "c"], None),
    ],
)
@pytest.mark.parametrize("with_ids", [True, False])
def test_other_columns_of_receivers_are_refused_unless_they_say_nothing(tmp_path, rng, column, cells, says, with_ids):
    folder(tmp_path, rng, n=20, noise=0.0)
    first = load_readings(tmp_path, HEIGHT)
    lines = (tmp_path / "receivers.csv").read_text().splitlines()
    lines = [line if with_ids else line.split(",", 1)[1] for line in lines]
    (tmp_path / "receivers.csv").write_text(
        "\n".join(f"{cell},{line}" for cell, line in zip([column, *cells], lines, strict=True))
    )
    if says is None and (with_ids or column != "mac"):
        np.testing.assert_array_equal(load_readings(tmp_path, HEIGHT).powers, first.powers)
    else:
        with pytest.raises(UserError, match=says or "do not each name one of the receivers"):
            load_readings(tmp_path, HEIGHT)


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
    with pytest.raises(UserError, match="do not each name one of the receivers"):
        load_readings(tmp_path, HEIGHT)


CASES = Path(__file__).parents[3] / "shared" / "cases"


@pytest.mark.parametrize(
    ("columns", "ids"),
    [
        ("ap3,ap1,ap2", "1,2,3"),
        ("office_rssi,kitchen_rssi,hall_rssi", "kitchen,hall,office"),
        ("RSSI Office (dBm),RSSI Kitchen (dBm),RSSI Hall (dBm)", "kitchen,hall,office"),
        ("AA-BB-CC-00-00-03,AA-BB-CC-00-00-01,AA-BB-CC-00-00-02", "aa:bb:cc:00:00:01,aa:bb:cc:00:00:02,aa:bb:cc:00:00:03"),
        ("rssi_003,rssi_001,rssi_002", "1,2,3"),
        ("rssi_3,rssi_1,rssi_2", "AP-01,AP-02,AP-03"),
        ("p2,p0,p1", "gw0,gw1,gw2"),
        ("rx10,rx1,rx101", "1,101,10"),
        ("west_hall,west,hall", "west,hall,west_hall"),
    ],
)
def test_columns_name_receivers_in_any_spelling(columns, ids):
    found = match_columns(Path("t.csv"), columns.split(","), ids.split(","))
    first = [columns.split(",").index(name) for name in found]
    assert first == ([1, 2, 0] if "rx101" not in columns and "west" not in columns else first)
    for column, name in zip(found, ids.split(","), strict=True):
        assert {tokens(name)[-1]} <= set(tokens(column))


@pytest.mark.parametrize("columns", ["p_2,p_0,p_1", "rx3,rx1,rx2"])
def test_receivers_without_names_are_numbered(columns):
    assert match_columns(Path("t.csv"), columns.split(","), 3) == sorted(columns.split(","))


@pytest.mark.parametrize(
    ("columns", "ids"), [("a,b,c", "1,2,3"), ("rssi_1,rssi_2,rssi_4", "1,2,3"), ("hall_1,hall_2,hall_3", "hall,office,kitchen")]
)
def test_columns_that_name_no_receiver_are_refused(columns, ids):
    with pytest.raises(UserError, match="do not each name one of the receivers"):
        match_columns(Path("t.csv"), columns.split(","), ids.split(","))


@pytest.mark.parametrize("number", [0.0, 100.0, -100.0, -120.0, -np.inf, -200.0])
def test_numbers_that_stand_for_nothing_are_recognised(rng, number):
    heard = np.round(rng.uniform(-80, -40, (60, 3)), 1)
    nothing = rng.random(heard.shape) < 0.2
    if np.isfinite(number):
        with pytest.warns(UserWarning, match="is taken as not received"):
            found = not_received(Path("t.csv"), np.where(nothing, number, heard))
    else:
        found = not_received(Path("t.csv"), np.where(nothing, number, heard))
    np.testing.assert_array_equal(np.isnan(found), nothing)
    np.testing.assert_array_equal(found[~nothing], heard[~nothing])


@pytest.mark.parametrize("numbers", [(0.0, 100.0), (-110.0, -200.0), (99.0,), (-130.5, -300.0, 1.0)])
def test_several_numbers_stand_for_nothing(rng, numbers):
    heard = np.round(rng.uniform(-80, -40, (60, 3)), 1)
    marked = heard.copy()
    for k, number in enumerate(numbers):
        marked[10 * k : 10 * k + 8] = number
    with pytest.warns(UserWarning, match="is taken as not received"):
        found = not_received(Path("t.csv"), marked)
    np.testing.assert_array_equal(found, np.where(marked == heard, heard, np.nan))


def test_readings_that_end_at_a_level_are_noted(rng):
    heard = np.round(rng.normal(-82, 8, (200, 3)))
    with pytest.warns(UserWarning, match="readings end at -80 dBm: weaker ones are missing"):
        not_received(Path("t.csv"), np.maximum(heard, -80))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        not_received(Path("t.csv"), heard)
        strong_once = np.concatenate([heard, [[-30.0, -30, -30]] * 5])  # beside a receiver
        np.testing.assert_array_equal(not_received(Path("t.csv"), strong_once), strong_once)


def test_weak_readings_are_readings(rng):
    heard = np.round(rng.uniform(-101, -40, (200, 3)))
    np.testing.assert_array_equal(not_received(Path("t.csv"), heard), heard)


def test_degrees_are_no_metres(tmp_path, rng):
    folder(tmp_path, rng, n=20)
    site = (-0.0664, 39.9929)
    for file, skip in (("readings.csv", 0), ("receivers.csv", 1)):
        header, *rows = [line.split(",") for line in (tmp_path / file).read_text().splitlines()]
        for row in rows:
            row[skip : skip + 2] = [str(s + 1e-5 * float(v)) for s, v in zip(site, row[skip : skip + 2], strict=True)]
        (tmp_path / file).write_text("\n".join(",".join(row) for row in [header, *rows]))
    with pytest.raises(UserError, match="degrees of longitude and latitude; project them to metres"):
        load_readings(tmp_path, HEIGHT)


def test_a_room_for_every_reading_is_refused(tmp_path, rng):
    """Instead of averaging over ever larger cells."""
    folder(tmp_path, rng, n=MAX_PLACES + 1)
    path = tmp_path / "readings.csv"
    header, *rows = path.read_text().splitlines()
    room = header.split(",").index("room")
    named = [",".join([*(cells := row.split(","))[:room], str(k), *cells[room + 1 :]]) for k, row in enumerate(rows)]
    path.write_text("\n".join([header, *named]))
    with pytest.raises(UserError, match=r"readings of 1501 rooms give at least 1501 cells, but .* at most 1500; name the room"):
        load_survey(tmp_path)


@pytest.mark.parametrize(("scale", "offset"), [(100.0, 0.0), (1.0, 40.0), (30.0, -20.0)])
def test_floor_plans_in_another_unit_or_frame_are_refused(tmp_path, rng, scale, offset):
    folder(tmp_path, rng, n=30)
    write_table(tmp_path / "walls.csv", ["x1", "y1", "x2", "y2"], [[0.5, 0, 0.5, 1]])
    assert len(load_survey(tmp_path).walls.ends) == 1  # one wall among the readings
    outline = np.array([[0.0, 0], [8, 0], [8, 4], [0, 4]])
    write_table(tmp_path / "walls.csv", ["x", "y"], scale * outline + offset)
    with pytest.raises(UserError, match=r"floor plan of .* % of the readings lie in its .*; give the plan in metres"):
        load_survey(tmp_path)


def test_walls_of_an_unmeasured_wing_do_not_extend_the_domain(tmp_path, rng):
    folder(tmp_path, rng, n=30)
    write_table(tmp_path / "walls.csv", ["x1", "y1", "x2", "y2"], [[-1, 0, -1, 4], [0, 4, 38, 4]])
    box = load_survey(tmp_path).domain.box
    assert box[0, 0] == -1 and 17 < box[1, 0] < 18


def test_places_where_nothing_was_received_are_not_measured(tmp_path, rng):
    folder(tmp_path, rng, n=30, rooms=False)
    path = tmp_path / "readings.csv"
    path.write_text(path.read_text() + "30,1,,,\n")
    survey = load_survey(tmp_path)
    assert survey.domain.box[1, 0] < 8 and survey.measured[:, 0].max() < 8 < survey.cells.places[:, 0].max()


def test_larger_cells_do_not_average_storeys(tmp_path, rng):
    (tmp_path / "receivers.csv").write_text("id,x,y,z\n1,0,0,2\n")
    plane = rng.uniform(0, 200, (4000, 2)).round(2)
    for heights, refused in ((rng.choice([1.3, 4.3, 7.3], 4000), False), (np.linspace(0, 2000, 4000), True)):
        write_table(
            tmp_path / "readings.csv", ["x", "y", "z", "rssi_1"], np.column_stack([plane, heights, -60 - plane[:, 0] / 9])
        )
        if refused:
            with pytest.raises(UserError, match=r"heights z give at least 20\d\d cells of 1 m"):
                load_survey(tmp_path)
        else:
            with pytest.warns(UserWarning, match=r"readings lie on 3 storeys; ceilings at z = 3, 6 m attenuate in the map"):
                survey = load_survey(tmp_path)
            assert survey.cell_m > 4
            np.testing.assert_allclose(np.unique(survey.cells.places[:, 2].round(6)), [1.3, 4.3, 7.3])


def test_floors_part_readings_as_rooms_do(tmp_path):
    (tmp_path / "receivers.csv").write_text("id,x,y,z\n1,0,0,2\n2,5,5,2\n")
    (tmp_path / "readings.csv").write_text(
        "time,x,y,z,floor,room,2,1\nnoon,1,1,1.2,0,a,-50,-60\nnow,1,1,4.2,1,a,-70,-80\n,2,1,1,,,-70,-80\n"
    )
    readings = load_readings(tmp_path, HEIGHT)
    assert readings.rooms == ("a/0", "a/1", "")
    np.testing.assert_array_equal(readings.powers[:2], [[-60, -50], [-80, -70]])


def test_floors_at_the_same_height_are_refused(tmp_path):
    """Heights from each floor, as z = 1.2 on all of them; floors a storey apart are read."""
    (tmp_path / "receivers.csv").write_text("id,x,y,z\n1,0,0,2\n")
    for rise, refused in ((3.0, False), (0.2, True), (0.0, True)):
        rows = [f"{x},1,{1.2 + rise * floor:g},{floor},-{50 + x}" for floor in (2, 0, 1) for x in range(5)]
        (tmp_path / "readings.csv").write_text("\n".join(["x,y,z,storey,1", "3,3,1.2,,-50", *rows]))
        if refused:
            with pytest.raises(
                UserError, match=r"storeys '\d' and '\d' at the same .*; z must count from one origin, not from"
            ):
                load_readings(tmp_path, HEIGHT)
        else:
            assert len(load_readings(tmp_path, HEIGHT).places) == 16


def test_readings_in_centimetres_are_noted(tmp_path, rng):
    """Of a flat of 8 m x 4 m."""
    folder(tmp_path, rng, n=30, rooms=False)
    (tmp_path / "walls.csv").unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_survey(tmp_path)
    for file, skip in (("readings.csv", 0), ("receivers.csv", 1)):
        header, *rows = [line.split(",") for line in (tmp_path / file).read_text().splitlines()]
        scaled = [[*row[:skip], *(str(100 * float(cell)) for cell in row[skip : skip + 2]), *row[skip + 2 :]] for row in rows]
        write_table(tmp_path / file, header, scaled)
    with pytest.warns(UserWarning, match="neighbouring places are .* m apart: are these metres"):
        load_survey(tmp_path)


def test_gateways_are_found_by_their_names(tmp_path):
    (tmp_path / "tx_pos.csv").write_text("x,y,z\n1,1,1\n2,2,1\n")
    (tmp_path / "gateway_position.yml").write_text("gateway1: [0, 0, 2]\ngateway2: [9, 0, 2]\ngateway3: [5, 5, 2]\n")
    (tmp_path / "gateway_rssi.csv").write_text("gateway3,gateway1,gateway2\n-50,-65,-59\n-60,-100,-55\n")
    np.testing.assert_array_equal(load_readings(tmp_path, HEIGHT).powers, [[-65, -59, -50], [np.nan, -55, -60]])
    (tmp_path / "gateway_rssi.csv").write_text("a,b,c\n-50,-65,-59\n-60,-100,-55\n")
    with pytest.raises(UserError, match="do not each name one of the receivers"):
        load_readings(tmp_path, HEIGHT)


@pytest.mark.skipif(not CASES.exists(), reason="the small inputs are not beside the repository")
def test_small_inputs_that_were_read_wrongly():
    right = load_readings(CASES / "readings" / "mac", HEIGHT)
    for name in ("glued", "prefix", "zero"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = load_readings(CASES / "readings" / name, HEIGHT)
        known = ~np.isnan(found.powers)
        np.testing.assert_array_equal(found.powers[known], right.powers[known])
        np.testing.assert_array_equal(found.receivers, right.receivers)
        assert known.all() == (name != "zero")
    for name in ("readings/milliwatt", "degrees"):
        with pytest.raises(UserError):
            load_readings(CASES / name, HEIGHT)


def test_powers_that_contradict_the_places_of_receivers_are_noted(rng):
    receivers = np.array([[1.0, 5, 2], [18, 5, 2], [10, 1, 2]])
    around = rng.uniform([0, 0, 1.3], [20, 6, 1.3], (120, 3))
    dbm = -45 - 20 * np.log10(np.linalg.norm(around[:, None] - receivers, axis=-1)) + rng.normal(0, 2, (120, 3))
    silent, constant = dbm.copy(), dbm.copy()
    silent[:, 1], constant[:, 1] = np.nan, -30
    few = dbm.copy()
    few[10:, 0] = np.nan
    for measured, own, words in (
        (dbm, receivers, None),
        (few, receivers, None),
        (dbm, receivers[:1].repeat(3, 0), None),
        (dbm[:, [1, 0, 2]], receivers, "the powers of receiver 1 fit the place of receiver 2 clearly better"),
        (dbm, receivers[:, [1, 0, 2]], "powers fit clearly better if x and y of the receivers are exchanged"),
        (-100 - dbm, receivers, "powers rise with the distance from their receivers"),
        (silent, receivers, "receiver 2 has received nothing"),
        (constant, receivers, "all 120 powers of receiver 2 are -30 dBm"),
    ):
        with warnings.catch_warnings(record=True) as notes:
            warnings.simplefilter("always")
            note_of_powers("hall", around, measured, own)
        assert [str(note.message)[: len(words or "") + 6] for note in notes] == ([f"hall: {words}"] if words else [])
