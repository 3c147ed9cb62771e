"""`wbgs-jax move` as people call it."""

import numpy as np
import pytest
from builders.commands import assert_error_for_people, call

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.movement import nearest_body, position_along
from wbgs_jax.commands.move import Command, main, times_of
from wbgs_jax.training.run_folder import load_trained

BASE = ("--example", "--tx", "1,0.5,1.5", "--ghz", 28)


def test_the_way_is_passed_at_constant_speed():
    """A corner after a third of the way is reached after a third of the time."""
    places = np.array([[0.0, 0, 1], [1, 0, 1], [1, 2, 1]])
    found = position_along(places, np.array([0, 1 / 6, 1 / 3, 2 / 3, 1]))
    assert np.allclose(found, [[0, 0, 1], [0.5, 0, 1], [1, 0, 1], [1, 1, 1], [1, 2, 1]])
    assert np.allclose(position_along(places[:1], np.array([0.0, 1.0])), places[0])


def test_the_default_rate_resolves_the_doppler_shifts():
    """A person who approaches at 2 m/s shifts what it reflects by up to 2 v / lambda; the rate is more than twice that."""
    command = Command(tx=("0,0,1",), person=("0,0,0", "4,0,0"), seconds=2.0, ghz=60.0)
    rate = 1 / np.diff(times_of(command, 60e9))[0]
    assert 2 * (2 * 2 * 60e9 / 3e8) < rate < 3 * (2 * 2 * 60e9 / 3e8)
    with pytest.raises(UserError, match="give other --seconds, or --rate"):
        times_of(Command(tx=("0,0,1",), person=("0,0,0", "40,0,0"), ghz=100.0), 100e9)


def test_a_point_names_the_body_of_the_mesh_that_is_nearest():
    field, _ = (trained := load_trained()).field.receiver_independent(trained.params)
    number = int(field.facets.mover[0])
    assert nearest_body(field, np.asarray(field.facets.corners)[0].mean(0) + 1e-3) == number
    with pytest.raises(UserError, match="no body of the mesh is within 1 m"):
        nearest_body(field, np.array([500.0, 0, 0]))


@pytest.mark.heavy
def test_the_speed_is_the_way_over_the_duration(tmp_path):
    """Few instants, the last of which is one step before the end."""
    options = ("--example", "--tx", "1,0.5,1.5", "3,0.5,1.5", "--ghz", 1, "--seconds", 2, "--rate", 20)
    done = call(main, *options, "--out", tmp_path / "way.npz")
    assert done.code == 0, done.err
    with np.load(tmp_path / "way.npz") as found:
        np.testing.assert_allclose(np.diff(found["tx_position"][:, 0]), 1.0 * np.diff(found["time_s"]), rtol=1e-9)


@pytest.mark.heavy
def test_a_person_who_crosses_the_line_of_sight_blocks_it(tmp_path):
    """The power falls while the person stands between transmitter and receiver, and is as before on either side."""
    receiver = np.asarray(load_trained().dataset().receiver().position)
    tx = receiver + np.array([3.0, 0.0, 0.0])
    middle = (tx + receiver) / 2
    start, end = ([middle[0], middle[1] + y, 0.0] for y in (-1.5, 1.5))
    place, first, last = (",".join(f"{x:.4g}" for x in point) for point in (tx, start, end))
    options = ("--example", "--tx", place, "--person", first, last, "--ghz", 28, "--seconds", 3, "--rate", 100)
    done = call(main, *options, "--out", tmp_path / "walk.npz", "--picture", tmp_path / "walk.png")
    assert done.code == 0, done.err
    with np.load(tmp_path / "walk.npz") as found:
        power, paths = found["power_db"], found["path_amplitude"]
        assert np.allclose(paths.sum(-1), found["response"], atol=1e-9) and len(power) == len(found["time_s"]) == 300
        assert (found["path_delay_s"][np.abs(paths) > 0] > 3.0 / 3e8 * 0.99).all()
    assert np.median(power[:50]) - np.median(power[145:155]) > 8
    assert abs(np.median(power[:50]) - np.median(power[-50:])) < 3
    assert (tmp_path / "walk.png").stat().st_size > 1e4


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--tx", "1,1,1", "1,2,1", "--ghz", 28, "--out", "c.npz"], "no trained field; give --example"),
        ([*BASE, "--person", "0,0,0"], "needs all of --tx x,y,z, --ghz 28 and --out c.npz"),
        ([*BASE, "--out", "c.npz"], "nothing moves; give --tx two places"),
        ([*BASE, "--out", "c.txt", "--person", "0,0,0"], "does not end in .npz or .csv"),
        ([*BASE, "--out", "c.npz", "--body", "1,1,1"], "--body x,y,z and --body-shift x,y,z belong together"),
        ([*BASE, "--out", "c.npz", "--rx-shift", "right"], "--rx-shift right is not a displacement"),
        ([*BASE, "--out", "c.npz", "--person", "door"], "--person door is not a position"),
        ([*BASE, "--out", "c.npz", "--person", "0,0,0", "--seconds", 0], "--seconds 0 is not a duration"),
        ([*BASE, "--out", "c.npz", "--person", "0,0,0", "--rate", -5], "--rate -5 is not a rate"),
        ([*BASE, "--out", "c.npz", "--person", "0,0,0", "--rate", 1], "1 instants are not 2 to 20,000"),
        ([*BASE, "--out", "c.npz", "--rx-shift", "0,0,90"], "instants are not 2 to 20,000"),
    ],
)
def test_errors_are_for_people(tmp_path, monkeypatch, options, says):
    monkeypatch.chdir(tmp_path)
    assert_error_for_people(call(main, *options), says)
    assert not list(tmp_path.iterdir())
