"""`wbgs-jax next` as people call it."""

import numpy as np
import pytest
from builders.commands import assert_error_for_people, call
from builders.flats import folder

from wbgs_jax.commands.next import main


def test_places_are_chosen_where_readings_lack(tmp_path, rng):
    data, out = folder(tmp_path, rng, n=25), tmp_path / "next.csv"
    (tmp_path / "places.csv").write_text("x,y,z\n1.0000123,1,1\n7.0000123,1,1\n7.1000123,1,1\n500,1,1\n4.0000123,1.5,1\n")
    done = call(main, "--data", data, "--candidates", tmp_path / "places.csv", "--count", 2, "--start", "0,0,1.3", "--out", out)
    assert done.code == 0, done.err
    table = np.genfromtxt(out, delimiter=",", names=True)
    assert len(table) == 2 and table["x"].max() < 10 and (table["expected_error"] > 0).all()
    assert set(table["x"]) <= {1.0000123, 7.0000123, 7.1000123, 4.0000123}
    assert "1 of 5 candidates are left out" in done.err
    assert done.out.splitlines()[0].lstrip().startswith("1. (")


def test_the_map_is_that_of_the_same_options(tmp_path, rng):
    """Readings without heights, at two metres: candidates at one metre lie below them."""
    data, grid = folder(tmp_path, rng, n=25), "1,1,1:7,2,1:3x2x1"
    high, low = (call(main, "--data", data, "--grid", grid, "--count", 2, "--height", height) for height in (2, 1.2))
    assert high.code == low.code == 0 and "candidates are up to 1 m above or below" in high.err
    assert "above or below" not in low.err and high.out != low.out


@pytest.mark.heavy
def test_a_trained_field_expects_errors_where_it_was_not_trained(tmp_path):
    options = ("--grid=-2,-2,1.5:2,2,1.5:5x5x1", "--count", 3, "--ghz", 28)
    done = call(main, "--example", *options, "--out", tmp_path / "next.csv")
    assert done.code == 0, done.err
    table = np.genfromtxt(tmp_path / "next.csv", delimiter=",", names=True)
    assert len(np.unique(np.stack([table["x"], table["y"]]), axis=1).T) == 3
    assert ((table["expected_error"] > 0) & (table["expected_error"] < 0.5)).all()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ([], "no trained field; give --example"),
        (["--data", "DATA", "--example"], "takes the place of a trained field"),
        (["--data", "DATA"], "give the places that can be measured"),
        (["--data", "DATA", "--grid", "0,0,1:1,1,1:2x2x1", "--count", 0], "--count 0 is not a number of places"),
        (["--data", "DATA", "--grid", "0,0,1:1,1,1:2x2x1", "--start", "door"], "--start door is not a position"),
        (["--example", "--grid", "0,0,1:1,1,1:2x2x1", "--ghz", "0.5"], "--ghz 0.5 lies outside of the trained band"),
        (["--data", "DATA", "--grid", "0,0,1:1,1,1:2x2x1", "--count", 9], "are fewer than --count 9"),
        (["--data", "DATA", "--grid", "0,0,1:1,1,1:200x200x1"], "are too many; at most 4,000"),
        (["--data", "DATA", "--grid", "0,0,1:1,1,1:2x2x1", "--length", -1], "--length -1 is not a distance"),
        (["--data", "DATA", "--grid", "0,0,1:1,1,1:2x2x1", "--ghz", 3], "--ghz and --rx are those of a trained field"),
        (["--data", "DATA", "--candidates", "nowhere.csv"], "cannot read nowhere.csv"),
        (["--run", "nowhere", "--grid", "0,0,1:1,1,1:2x2x1"], "nowhere"),
        (["--example", "--grid", "0,0,1:1,1,1:2x2x1", "--height", 1], "are those of readings"),
        (["--data", "DATA", "--grid", "0,0,1:1,1,1:2x2x1", "--cell", 0], "--cell is 0"),
    ],
)
def test_errors_are_for_people(tmp_path, rng, options, says):
    data = folder(tmp_path, rng, n=20)
    assert_error_for_people(call(main, *(str(data) if word == "DATA" else word for word in options)), says)
