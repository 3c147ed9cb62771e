"""`wbgs-jax map`: the same answers as `wbgs-jax predict` gives place by place, pictures, and what cannot be asked."""

import json
import math

import jax.numpy as jnp
import numpy as np
import pytest
from builders.commands import assert_error_for_people, call
from builders.synthetic import tiny_dataset
from builders.untrained import make_coherent_run, make_run
from PIL import Image

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.antenna_placement import power_at_users
from wbgs_jax.commands import map as map_command
from wbgs_jax.commands import predict as predict_command
from wbgs_jax.inference import radio_map
from wbgs_jax.inference.evaluate_quantities import LoadedField, domain_of
from wbgs_jax.inference.intervals import PowerConfidence, write_confidence
from wbgs_jax.inference.quantities import QUANTITIES, Network
from wbgs_jax.inference.radio_map import cut_at, pieces, plane_over
from wbgs_jax.radio.array import codebook
from wbgs_jax.radio.channel import noise_dbm, sinr_db, throughput_bps
from wbgs_jax.training.run_folder import load_trained

AREA = ["--area", "-1,0:1,1", "--height", "1.3"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return {"wave": make_coherent_run(folder / "wave"), "wideband": make_run(folder / "wideband")}


def ask(runs, field, *arguments):
    return call(map_command.main, "--run", runs[field], *arguments)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("what", "ghz"),
    [
        *[("power", (2.4, 28, 60)), ("k-factor", (28,)), ("delay-spread", (28,)), ("angular-spread", (2.4, 28, 60))],
        *[pytest.param(what, (28,), marks=pytest.mark.slow) for what in ("power", "angular-spread")],
        *[pytest.param(what, (2.4, 28, 60), marks=pytest.mark.slow) for what in ("k-factor", "delay-spread")],
    ],
)
def test_a_map_holds_what_predict_says(runs, tmp_path, what, ghz):
    out, points = tmp_path / "map.npz", tmp_path / "points.npz"
    result = ask(runs, "wave", "--ghz", *ghz, "--what", what, *AREA, "--step", 0.5, "--out", out)
    assert result.code == 0, result.err
    with np.load(out) as found:
        xs, ys, height = found["xs"], found["ys"], float(found["height"])
        name = QUANTITIES[what].outputs[0]
        values = found[name]
        assert values.shape[:3] == (len(ghz), 2, 4) and height == 1.3
        np.testing.assert_allclose(xs, [-0.75, -0.25, 0.25, 0.75])
        assert json.loads(str(found["meta"]))["what"] == what
    places = [f"{x},{y},{height}" for y in ys for x in xs]
    result = call(predict_command.main, "--run", runs["wave"], "--tx", *places, "--ghz", *ghz, "--what", what, "--out", points)
    assert result.code == 0, result.err
    with np.load(points) as found:
        expected = np.moveaxis(found[name], 1, 0).reshape(values.shape)
    np.testing.assert_allclose(values, expected, rtol=2e-4, atol=1e-3 if what != "delay-spread" else 1e-12)
    assert np.ptp(values) > 0


def test_best_beams_are_those_of_the_spectra(runs, tmp_path):
    out, points = tmp_path / "map.npz", tmp_path / "points.npz"
    assert ask(runs, "wideband", "--ghz", 28, "--what", "best-beam", *AREA, "--step", 0.5, "--out", out).code == 0
    with np.load(out) as found:
        beams, xs, ys = found["best_beam"], found["xs"], found["ys"]
        azimuth, zenith = found["beam_azimuth_deg"], found["beam_zenith_deg"]
    places = [f"{x},{y},1.3" for y in ys for x in xs]
    assert call(predict_command.main, "--run", runs["wideband"], "--tx", *places, "--ghz", 28, "--out", points).code == 0
    with np.load(points) as found:
        heard = found["pas"].reshape(len(places), -1)[:, codebook()]
    np.testing.assert_allclose(heard[np.arange(len(places)), beams.ravel()], heard.max(1), rtol=0.051)
    assert azimuth.shape == zenith.shape == (len(codebook()),) and np.abs(azimuth).max() <= 180 and zenith.max() < 90


@pytest.mark.heavy
def test_the_picture_shows_maps_and_walls(runs, tmp_path):
    picture = tmp_path / "new" / "map.png"
    result = ask(runs, "wave", "--ghz", 2.4, 28, "--step", 0.4, "--picture", picture)
    assert result.code == 0 and result.err.splitlines()[-1] == f"picture: {picture}"
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert np.ptp(pixels, -1).max() > 80 and pixels.std() > 20


@pytest.mark.heavy
def test_a_map_marks_places_without_confidence(runs, tmp_path):
    """Those far outside of the mesh, and no others."""
    out = tmp_path / "wide.npz"
    assert ask(runs, "wave", "--ghz", 28, "--what", "power", "--area", "-60,-60:60,60", "--step", 20, "--out", out).code == 0
    with np.load(out) as found:
        low, high = domain_of(load_trained(runs["wave"]).dataset()).box[:, :2]
        x, y = np.meshgrid(found["xs"], found["ys"])
        within = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
        assert found["no_confidence"].dtype == bool and found["no_confidence"].shape == found["power_db"].shape[1:]
        np.testing.assert_array_equal(found["no_confidence"][~within], True)


def test_a_map_holds_intervals_only_within_the_room_and_the_band(runs, tmp_path):
    out = tmp_path / "wide.npz"
    arrays = (np.ones((1, 3)), np.zeros(4), np.ones(4), np.zeros(5), 0.5, 1.0, 0.9)
    write_confidence(runs["wave"], None, PowerConfidence(*(jnp.asarray(a, jnp.float32) for a in arrays)))
    low, high = domain_of(load_trained(runs["wave"]).dataset()).box[:, :2]
    area = f"{low[0] - 1},{low[1]}:{high[0]},{high[1]}"
    result = ask(runs, "wave", "--ghz", 0.5, 28, "--area", area, "--step", 0.5, "--out", out)
    write_confidence(runs["wave"], None)
    (line,) = (line for line in result.err.splitlines() if "prediction interval" in line)
    with np.load(out) as found:
        missing, marked = np.isnan(found["within_db"]), found["no_confidence"]
        assert np.isfinite(found["power_db"]).all()
        np.testing.assert_array_equal(missing, np.isnan(found["expected_error_db"]))
    assert missing[0].all() and not missing[1].all()  # no data below 1 GHz
    np.testing.assert_array_equal(missing[1], marked)
    assert marked[:, 0].all()
    assert (
        line
        == f"warning: {missing.sum()} of {missing.size} predictions have no prediction interval; the interval is NaN in files"
    )


@pytest.mark.heavy
def test_another_receiver_has_another_map(runs, tmp_path):
    maps = []
    for name, rx in (("own", []), ("other", ["--rx", "0.5,0.5,1.5"])):
        out = tmp_path / f"{name}.npz"
        assert ask(runs, "wave", "--ghz", 28, *AREA, *rx, "--step", 0.5, "--out", out).code == 0
        with np.load(out) as found:
            maps.append(found["power_db"])
    assert np.abs(maps[1] - maps[0]).max() > 1


NETWORK = ["--tx", "0.4,0.3,1.5", "-0.5,0.8,1.4", "--power-dbm", 20, 17, "--load", 0.5, "--bandwidth-mhz", 400]


def test_a_warning_names_the_ends_of_a_map_of_several_transmitters(runs, tmp_path, monkeypatch):
    """The places of the plane are the receivers."""

    def stop(*_):
        raise UserError("stopped")

    monkeypatch.setattr(map_command, "at_transmitters", stop)
    rest = ["--area", "-1,0:0,90", "--height", "1.3", "--step", 30, "--out", tmp_path / "map.npz"]
    result = ask(runs, "wave", "--ghz", 28, "--what", "sinr", "--tx", "70,0,1", "0,0,1", *rest)
    named = [line.split(" lies outside")[0] for line in result.err.splitlines() if "lies outside" in line]
    assert sorted(set(named)) == ["warning: RX (-0.5, 15, 1.3) m", "warning: RX (-0.5, 75, 1.3) m", "warning: TX (70, 0, 1) m"]


@pytest.mark.heavy
def test_maps_of_several_transmitters_are_those_of_each(runs, tmp_path):
    """What a receiver gets from a transmitter is what a field at the receiver predicts, with the ends exchanged."""
    out, pictures = tmp_path / "sinr.npz", [tmp_path / "sinr.png", tmp_path / "cdf.png"]
    files = ["--out", out, "--picture", pictures[0], "--cdf", pictures[1]]
    result = ask(runs, "wave", "--ghz", 2.4, 28, "--what", "sinr", *NETWORK, *AREA, "--step", 0.5, *files)
    assert result.code == 0, result.err
    found = dict(np.load(out))
    assert found["received_dbm"].shape == (2, 2, 2, 4) and found["sinr_db"].shape == (2, 2, 4)
    each, meta = np.moveaxis(found["received_dbm"], 0, -1), json.loads(str(found["meta"]))
    ratios = np.asarray(sinr_db(jnp.asarray(each), noise_dbm(400e6, 7.0), 0.5)).max(-1)  # of the best server: equal loads
    np.testing.assert_allclose(found["sinr_db"], ratios, atol=1e-3)
    np.testing.assert_array_equal(found["best_server"], each.argmax(-1))
    np.testing.assert_array_equal(found["rsrp_dbm"], each.max(-1))
    np.testing.assert_allclose(found["throughput_bps"], throughput_bps(jnp.asarray(ratios), 400e6), rtol=1e-3)
    assert meta["power_dbm"] == [20, 17] and meta["bandwidth_hz"] == 400e6 and "receiver" not in meta
    assert len(np.unique(found["best_server"])) == 2
    trained = load_trained(runs["wave"])
    user = [found["xs"][1], found["ys"][0], float(found["height"])]
    powers = power_at_users(trained.field, trained.params, user, 2.4e9)(found["tx_positions"], 0.0)[:, 0]
    np.testing.assert_allclose(found["received_dbm"][:, 0, 0, 1], np.asarray(powers) + np.array([20, 17]), atol=0.1)
    for picture in pictures:
        with Image.open(picture) as image:
            assert np.asarray(image.convert("L")).std() > 10


def test_sinr_and_throughput_are_those_of_the_best_server(monkeypatch):
    """Not of the second transmitter, whose ratio is larger because it alone interferes."""
    powers = iter((-50.0, -51.0))
    monkeypatch.setattr(
        radio_map, "evaluate_plane", lambda *_: {"power_db": np.full((1, 1, 1), next(powers))} | dict.fromkeys(SHARED, 0)
    )
    plane, hertz = plane_over(np.zeros(2), np.ones(2), 1.0, 1.0), np.array([28e9])
    fields = [object.__new__(LoadedField)] * 2
    found = radio_map.evaluate_network(fields, plane, hertz, Network((0.0,), (0.0, 1.0), 1e6, 0.0))
    ratio = sinr_db([-50.0, -51.0], noise_dbm(1e6), [0.0, 1.0])[0]
    assert found["best_server"] == 0 and found["rsrp_dbm"] == -50 and (found["tx_power_dbm"] == 0).all()
    np.testing.assert_allclose(found["sinr_db"].item(), ratio, atol=1e-4)
    np.testing.assert_allclose(found["throughput_bps"].item(), throughput_bps(ratio, 1e6), rtol=1e-4)


SHARED = ("xs", "ys", "height", "frequencies_hz")


@pytest.mark.parametrize(
    ("field", "arguments", "words"),
    [
        ("wave", ["--ghz", "28", "--what", "sinr", "--out", "OUT/a.npz"], ["--what sinr needs --tx"]),
        ("wave", ["--ghz", "28", "--load", "0.5", "--out", "OUT/a.npz"], ["--load has no effect on --what power"]),
        ("wave", ["--ghz", "28", "--tx", "0,0,1", "--out", "OUT/a.npz"], ["--what power takes no --tx", "throughput"]),
        ("wave", ["--ghz", "28", *map(str, NETWORK), "--what", "rsrp", "--rx", "0", "--out", "OUT/a.npz"], ["omit --rx"]),
        ("wave", ["--ghz", "28", "--what", "sinr", "--tx", "0,0,1", "--load", "2", "--out", "OUT/a.npz"], ["--load 2"]),
        (
            "wave",
            ["--ghz", "28", "--what", "sinr", "--tx", "0,0,1", "--power-dbm", "1", "2", "--out", "OUT/a.npz"],
            ["--power-dbm has 2 numbers"],
        ),
        (
            "wave",
            ["--ghz", "28", "--what", "sinr", "--tx", "0,0,1", "--bandwidth-mhz", "0", "--out", "OUT/a.npz"],
            ["--bandwidth-mhz 0"],
        ),
        ("wideband", ["--ghz", "28", "--what", "sinr", "--tx", "0,0,1", "--out", "OUT/a.npz"], ["predicts only the receivers"]),
        ("wave", ["--ghz", "28"], ["nothing to do", "--picture"]),
        ("wave", ["--out", "OUT/a.npz", "--ghz"], ["--ghz has no frequency"]),
        ("wave", ["--ghz", "28", "--out", "OUT/a.csv"], ["--out", ".npz"]),
        ("wave", ["--ghz", "28", "--picture", "OUT/a.jpg"], [".png or .svg or .pdf"]),
        ("wave", ["--ghz", "0.1", "--out", "OUT/a.npz"], ["0.3 to 100 GHz"]),
        ("wave", ["--ghz", "28", "--step", "0", "--out", "OUT/a.npz"], ["--step 0"]),
        ("wave", ["--ghz", "28", "--step", "1e-4", "--out", "OUT/a.npz"], ["1,000,000 positions"]),
        ("wave", ["--ghz", "28", "--height", "nan", "--out", "OUT/a.npz"], ["--height nan"]),
        ("wave", ["--ghz", "28", "--area", "0,0:0,1", "--out", "OUT/a.npz"], ["--area 0,0:0,1 is not a rectangle"]),
        (
            "wave",
            ["--ghz", "28", "--what", "rsrp", "--tx", "0,2001,1", "--out", "OUT/a.npz"],
            ["each at most 2000"],
        ),
        ("wave", ["--ghz", "28", "--area", "0,0:x,1", "--out", "OUT/a.npz"], ["is not a rectangle"]),
        ("wideband", ["--ghz", "28", "--what", "k-factor", "--out", "OUT/a.npz"], ["not provide k-factor", "wave"]),
        ("wideband", ["--ghz", "0.5", "--out", "OUT/a.npz"], ["from 1 GHz upwards"]),
    ],
)
def test_what_cannot_be_mapped(runs, tmp_path, field, arguments, words):
    assert_error_for_people(ask(runs, field, *(word.replace("OUT", str(tmp_path)) for word in arguments)), *words)
    assert list(tmp_path.iterdir()) == []


def test_planes_are_filled_with_squares(rng):
    low, size, step = rng.uniform(-5, 5, 2), rng.uniform(0.3, 4, 2), rng.uniform(0.05, 0.6)
    plane = plane_over(low, low + size, 1.0, step)
    for places, start, length in zip((plane.xs, plane.ys), low, size, strict=True):
        spacing = length / len(places)
        np.testing.assert_allclose(places, start + (np.arange(len(places)) + 0.5) * spacing)
        assert len(places) == 1 or 0.66 * step < spacing < 1.51 * step
    assert pieces(plane, np.ones(3)) == math.ceil(len(plane.positions()) / (512 // 3))


def test_walls_are_cut_where_the_plane_meets_them():
    dataset = tiny_dataset()
    corners = dataset.vertices[dataset.faces]
    height = float(np.median(dataset.vertices[:, 2])) + 0.1
    lines = cut_at(dataset, height)
    cuts = (corners[..., 2].min(1) < height) & (corners[..., 2].max(1) > height)
    assert len(lines) == cuts.sum() > 0
    assert (lines.reshape(-1, 2) >= dataset.vertices[:, :2].min(0) - 1e-6).all()
