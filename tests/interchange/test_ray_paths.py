"""Paths as Sionna RT's: round trips, a line of sight in closed form, a field's own paths, and the scenes that follow."""

from dataclasses import fields, replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from builders.drawn_paths import bounced_paths, draw_paths
from jaxtyping import TypeCheckError

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.scene_file import TEST, load_scene, save_scene
from wbgs_jax.interchange.ray_paths import (
    SPECULAR,
    RayPaths,
    check_paths,
    from_paths,
    from_sionna,
    load_paths,
    read_paths,
    save_paths,
)
from wbgs_jax.interchange.scenes import scene_of_paths, scene_of_snapshots
from wbgs_jax.propagation.paths import REFLECTED, TRANSMITTED
from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array, steering_vector
from wbgs_jax.radio.channel import Paths


def assert_same(one, other):
    for field in fields(RayPaths):
        np.testing.assert_allclose(getattr(one, field.name), getattr(other, field.name), err_msg=field.name)


def test_a_file_and_back(rng, tmp_path):
    paths = draw_paths(rng)
    save_paths(tmp_path / "paths.npz", paths)
    assert_same(load_paths(tmp_path / "paths.npz"), paths)
    with np.load(tmp_path / "paths.npz") as archive:
        assert archive["a"].shape == (2, 1, 6, 1, 4) and archive["vertices"].shape == (3, 2, 6, 4, 3)


@pytest.mark.parametrize("synthetic", [True, False])
def test_an_object_of_the_simulator(rng, synthetic):
    """`a` as real and imaginary part, axes of antennas, positions as columns."""
    paths = draw_paths(rng)
    one = paths.as_sionna()

    def between_antennas(name, values):
        axis = 1 + (name in ("interactions", "vertices"))
        values = np.expand_dims(values, (axis, axis + 2))
        return np.repeat(values, 3, axis)

    given = {name: values for name, values in one.items() if name not in ("a", "sources", "targets", "frequency_hz")}
    if not synthetic:
        given = {name: between_antennas(name, values) for name, values in given.items()}
    a = np.repeat(one["a"], 3, 1)
    ends = {"sources": paths.sources.T, "targets": paths.targets.T}
    simulated = SimpleNamespace(a=(a.real, a.imag), **given, **ends)
    assert_same(from_sionna(simulated, 2.4e9, antennas=(0, 0)), paths)
    with pytest.raises(UserError, match="between 3 and 1 antennas of a device; choose one of each"):
        from_sionna(simulated, 2.4e9)
    with pytest.raises(UserError, match="frequency"):
        from_sionna(simulated)


def test_what_are_no_paths(rng, tmp_path):
    arrays = draw_paths(rng).as_sionna()
    with pytest.raises(UserError, match="have no tau"):
        from_sionna({name: values for name, values in arrays.items() if name != "tau"})
    with pytest.raises(UserError, match="phi_r of these paths has shape"):
        from_sionna(arrays | {"phi_r": arrays["phi_r"][:1]})
    with pytest.raises(UserError, match=r"a of these paths is not complex but float64; .* or a_real and a_imag"):
        from_sionna(arrays | {"a": np.abs(arrays["a"])})
    with pytest.raises(UserError, match=r"a of these paths has shape \(0, 6, 4\); expected receivers"):
        from_sionna(arrays | {"a": arrays["a"][:0, 0, :, 0]})
    for imaginary in (arrays["a"].imag[..., :2], np.array(["x"])):
        with pytest.raises(UserError, match="a of these paths has the parts float64 of shape"):
            from_sionna(arrays | {"a": (arrays["a"].real, imaginary)})
        np.savez(tmp_path / "a.npz", a_real=arrays["a"].real, a_imag=imaginary)
        with pytest.raises(UserError, match=r"a of .*a\.npz has the parts float64 of shape"):
            read_paths(tmp_path / "a.npz")
    (tmp_path / "a.npz").write_bytes(b"nothing")
    with pytest.raises(UserError, match="damaged"):
        load_paths(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("tau", np.nan, "tau of a valid path is not finite"),
        ("phi_r", np.nan, "phi_r of a valid path is not finite"),
        ("theta_t", -0.5, r"theta_t is -0\.5 to .*; give angles from \+z, 0 to pi"),
        ("theta_r", 4.0, r"theta_r is .* to 4; give angles from \+z, 0 to pi"),
    ],
)
def test_values_that_no_valid_path_has(rng, name, value, words):
    paths = bounced_paths(rng)
    check_paths(paths, "room")
    changed = getattr(paths, name).copy()
    changed[1, 0, 2] = value
    with pytest.raises(UserError, match=f"room: {words}"):
        check_paths(replace(paths, **{name: changed}), "room")
    valid = paths.valid.copy()
    valid[1, 0, 2] = False
    check_paths(replace(paths, **{name: changed}, valid=valid), "room")


def test_positions_in_larger_units_are_refused_without_vertices(rng):
    paths = bounced_paths(rng)
    unknown = replace(paths, interactions=paths.interactions[:0], vertices=paths.vertices[:0])
    check_paths(unknown, "room")
    hectometres = replace(unknown, sources=paths.sources / 100, targets=paths.targets / 100)
    with pytest.raises(
        UserError, match=r"room: every path is more than 3 times as long as the line .* give positions in metres"
    ):
        check_paths(hectometres, "room")
    check_paths(replace(unknown, targets=paths.sources[np.zeros(len(paths.targets), int)], tau=paths.tau + 1e-8), "radar")


def sight_lines(rng, frequency=5e9):
    """Arrays of lines of sight between isotropic antennas."""
    receiver, places = np.array([[0.0, 0.0, 1.0]]), rng.uniform([1, -2, 0.5], [4, 2, 2.5], (8, 3))
    offset = receiver - places
    distance = np.linalg.norm(offset, axis=1)
    angles = {
        name: value[None, :, None]
        for end, way in (("t", offset), ("r", -offset))
        for name, value in (
            (f"theta_{end}", np.arccos(way[:, 2] / distance)), (f"phi_{end}", np.arctan2(way[:, 1], way[:, 0]))
        )
    }  # fmt: skip
    a = (SPEED_OF_LIGHT / frequency / (4 * np.pi * distance)).astype(complex)[None, None, :, None, None]
    return angles | {"a": a, "tau": (distance / SPEED_OF_LIGHT)[None, :, None], "sources": places, "targets": receiver}


def test_gains_of_lines_of_sight_that_cannot_be_are_noted(rng, recwarn):
    """At another frequency, with a transmitted power, as powers or half the decibels; antennas have patterns and losses."""
    arrays = sight_lines(rng)
    a = arrays["a"]
    for usual in (a, 3 * a * rng.uniform(0.2, 1, a.shape)):
        check_paths(from_sionna(arrays | {"a": usual}, 5e9), "hall")
    assert not recwarn
    cases = (
        (a, 28e9, "15 dB stronger"),
        (10 * a, 5e9, "20 dB stronger"),
        (a**2, 5e9, "dB weaker"),
        (a**0.5, 5e9, "dB stronger"),
    )
    for values, frequency, words in cases:
        with pytest.warns(UserWarning, match=f"hall: lines of sight are .*{words} than .* {frequency / 1e9:g} GHz; check the"):
            check_paths(from_sionna(arrays | {"a": values}, frequency), "hall")


def test_coefficients_saved_as_one_array_of_both_parts(rng, tmp_path):
    """As np.savez(a=paths.a) writes the pair of Sionna RT."""
    arrays = sight_lines(rng)
    a = arrays["a"] * np.exp(0.4j)
    np.savez(tmp_path / "paths.npz", **(arrays | {"a": np.stack([a.real, a.imag])}))
    np.testing.assert_allclose(load_paths(tmp_path / "paths.npz", 5e9).a, a[:, 0, :, 0])


@pytest.mark.parametrize("end", ["r", "t"])
def test_directions_without_lines_of_sight_are_compared_with_vertices(rng, end):
    paths = bounced_paths(rng, direct=False)
    check_paths(paths, "room")
    theta, phi = f"theta_{end}", f"phi_{end}"
    elevation = {theta: np.abs(np.pi / 2 - getattr(paths, theta)), phi: getattr(paths, phi) + 1}
    with pytest.raises(UserError, match=f"theta_{end}, phi_{end} of reflected .* degrees from the nearest vertex"):
        check_paths(replace(paths, **elevation), "room")
    check_paths(replace(paths, vertices=np.full_like(paths.vertices, np.nan), **elevation), "room")


def test_backwards_twice_is_forwards(rng):
    paths = draw_paths(rng)
    back = paths.reversed()
    np.testing.assert_allclose(back.channel(), paths.channel().T)
    np.testing.assert_array_equal(back.theta_t, np.swapaxes(paths.theta_r, 0, 1))
    assert_same(back.reversed(), paths)


def line_of_sight(tx, rx, frequency_hz):
    """Free space between isotropic antennas."""
    offset = np.asarray(rx, float) - tx
    length = np.linalg.norm(offset, axis=-1)
    amplitude = (
        SPEED_OF_LIGHT / frequency_hz / (4 * np.pi * length) * np.exp(-2j * np.pi * frequency_hz * length / SPEED_OF_LIGHT)
    )
    direction = offset / length[:, None]
    one = {"amplitude": amplitude, "direction": -direction, "length": length, "departure": direction, "arrival": direction}
    met = np.zeros((len(tx), 1, 5), int)
    points = np.repeat(np.asarray(tx, float)[:, None, None], 5, -2)
    return Paths(**{name: values[:, None] for name, values in one.items()}, interaction=met, points=points)


def test_snapshots_of_a_line_of_sight(rng, tmp_path):
    """What an array sees of plane waves from where the transmitters stand."""
    tx, rx, elements = rng.uniform(1, 4, (9, 3)), np.array([0.0, 0, 1]), planar_array(2, 2)
    paths = [from_paths(line_of_sight(tx, rx, f), tx, rx, f) for f in (5e9, 2e9)]
    np.testing.assert_allclose(
        np.abs(paths[0].a[0, :, 0]), SPEED_OF_LIGHT / 5e9 / (4 * np.pi * np.linalg.norm(tx - rx, axis=1))
    )
    np.testing.assert_allclose(np.angle(paths[0].a), 0, atol=1e-6)
    save_scene(tmp_path / "scene.npz", scene_of_paths(paths, elements, "sight"))
    scene = load_scene(tmp_path / "scene.npz")
    assert scene.snapshots.shape == (9, 1, 2, 4) and (scene.split == TEST).sum() == 2
    np.testing.assert_array_equal(scene.frequencies_hz, [2e9, 5e9])
    arrived = line_of_sight(tx, rx, 5e9)
    expected = arrived.amplitude * np.asarray(steering_vector(*map(jnp.asarray, (elements, arrived.direction[:, 0]))))
    np.testing.assert_allclose(scene.snapshots[:, 0, 1], expected, rtol=1e-4)


def test_what_is_measured_twice_at_a_place_is_on_one_side_of_the_split(rng):
    places, elements = np.repeat(rng.uniform(1, 4, (6, 3)), 3, 0)[rng.permutation(18)], planar_array(2, 2)
    measured = rng.normal(size=(18, 1, 1, 4)) + 1j * rng.normal(size=(18, 1, 1, 4))
    where = np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]])
    scene = scene_of_snapshots(measured, places, np.array([2e9]), *where, elements, "twice")
    tested = {tuple(place) for place in places[scene.split == TEST]}
    assert len(tested) == 1 and (scene.split == TEST).sum() == 3
    few = places[:1] + np.array([[0], [0], [1], [2], [3]])
    with pytest.raises(UserError, match="4 transmitters, but training needs 5"):
        scene_of_snapshots(measured[:5], few, np.array([2e9]), *where, elements, "few")


def test_places_of_interactions():
    """Reflections have one; transmissions are known by their wall alone."""
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 2, 0], [3, 3, 3], [3, 3, 3]], float)[None, None]
    met = np.array([[[REFLECTED, TRANSMITTED, REFLECTED, 0, 0]]])
    arrived = line_of_sight(np.zeros((1, 3)), np.array([3.0, 3, 3]), 1e9)._replace(interaction=met, points=points)
    paths = from_paths(arrived, np.zeros((1, 3)), np.array([3.0, 3, 3]), 1e9)
    assert paths.interactions[0, 0, 0, 0] == SPECULAR
    np.testing.assert_array_equal(paths.vertices[0, 0, 0, 0], [1, 0, 0])
    assert np.isnan(paths.vertices[[1, 3, 4]]).all()
    np.testing.assert_array_equal(paths.vertices[2, 0, 0, 0], [2, 2, 0])


def test_scenes_that_cannot_be(rng):
    paths = draw_paths(rng, transmitters=3)
    with pytest.raises(UserError, match="3 transmitters"):
        scene_of_paths([paths], planar_array(2, 2), "few")
    with pytest.raises(UserError, match="different ends"):
        scene_of_paths([draw_paths(rng), draw_paths(rng)], planar_array(2, 2), "two")
    ends = rng.normal(size=(6, 3)), np.array([1e9]), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]])
    with pytest.raises((UserError, TypeCheckError), match=r"shape \(6, 1, 4\); by transmitter|snapshots"):
        scene_of_snapshots(np.ones((6, 1, 4), complex), *ends, planar_array(2, 2), "flat")
