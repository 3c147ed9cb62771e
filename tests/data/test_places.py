"""Places where no antenna can stand: bodies and rooms, from any side, against a formula."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from builders.synthetic import tiny_dataset

from wbgs_jax.data.scene import closed_bodies
from wbgs_jax.inference.domain import Domain
from wbgs_jax.inference.evaluate_quantities import domain_of
from wbgs_jax.mesh.bodies import ClosedBody, inside

BESIDE = np.array([3.0, 3, 0])


def scene_with(*meshes):
    """A data set whose surfaces are some meshes, a part each."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return dataclasses.replace(
        tiny_dataset(),
        vertices=np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32),
        faces=np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]).astype(np.int32),
        face_part=np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]).astype(np.int32),
        materials=None,
    )


def at(mesh, *place):
    return mesh.copy().apply_translation(place)


def test_inside_is_that_of_the_formula(rng):
    """A sphere, and a ring that a point can be in the middle of without being in it."""
    points = rng.uniform(-2, 2, (500, 3))
    ball = trimesh.creation.icosphere(3)
    found = inside(ClosedBody("ball", ball.triangles), points)
    radius = np.linalg.norm(points, axis=1)
    sure = np.abs(radius - 1) > 0.03
    np.testing.assert_array_equal(found[sure], radius[sure] < 1)
    ring = trimesh.creation.torus(1.2, 0.5, major_sections=128, minor_sections=64)
    away = np.hypot(np.hypot(points[:, 0], points[:, 1]) - 1.2, points[:, 2])
    sure = np.abs(away - 0.5) > 0.03
    turned_inwards = ring.triangles[:, ::-1]
    for triangles in (ring.triangles, turned_inwards):
        np.testing.assert_array_equal(inside(ClosedBody("ring", triangles), points)[sure], away[sure] < 0.5)


def test_cabinets_are_bodies_and_rooms_and_sheets_are_none():
    dataset = tiny_dataset()
    receiver, transmitters = np.asarray(dataset.receivers.position[0], float), dataset.tx_positions
    room = at(trimesh.creation.box((50, 50, 50)), *transmitters.mean(0))
    cabinet = at(trimesh.creation.box((0.5, 0.5, 0.5)), *(receiver + BESIDE))
    box = trimesh.creation.box((0.5, 0.5, 0.5))
    open_box = at(trimesh.Trimesh(box.vertices, box.faces[:-1], process=False), *(receiver - BESIDE))
    scene = scene_with(room, cabinet, open_box)
    (found,) = closed_bodies(scene)
    assert found.name == "part 1" and inside(found, (receiver + BESIDE)[None])[0]
    soup = cabinet.copy()
    soup = trimesh.Trimesh(
        soup.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False
    )  # a vertex for every corner
    assert len(closed_bodies(scene_with(soup))) == 1
    assert closed_bodies(dataclasses.replace(scene, faces=scene.faces[:0], face_part=scene.face_part[:0])) == ()


def test_an_answer_from_within_a_body_or_from_far_away_has_no_confidence():
    dataset = tiny_dataset()
    receiver = np.asarray(dataset.receivers.position[0], float)
    centre = receiver + BESIDE
    domain = domain_of(scene_with(at(trimesh.creation.box((0.5, 0.5, 0.5)), *centre)))
    domain = Domain.from_json(domain.as_json())
    places = np.array([centre, centre + np.array([0, 0, 0.4]), dataset.tx_positions[0], [500.0, 0, 1]])
    low, high = domain.box
    within = ((places >= low) & (places <= high)).all(1)
    np.testing.assert_array_equal(domain.outside(places), [True, not within[1], False, True])
    (line,) = domain.warnings(receiver, centre[None], np.array([domain.band[0]]))
    assert "is inside a closed body (part 0 of" in line and "where no antenna can stand" in line
    away = np.array([[500.0, 0, 1], [600, 0, 1]])
    lines = domain.warnings(away, receiver[None], np.array([domain.band[0]]))
    assert [line.split(" lies outside")[0] for line in lines] == ["RX (500, 0, 1) m", "RX (600, 0, 1) m"]


def test_without_surfaces_places_nearby_keep_their_confidence():
    """Transmitters alone do not close a room."""
    dataset = dataclasses.replace(tiny_dataset(), faces=np.zeros((0, 3), np.int32), face_part=None, materials=None)
    domain = domain_of(dataset)
    size = np.linalg.norm(domain.box[1] - domain.box[0])
    places = domain.box[1] + np.array([[0.1, 0, 0], [size, 0, 0]])
    np.testing.assert_array_equal(domain.outside(places), [False, True])


def test_places_of_the_test_belong_to_no_domain_without_surfaces():
    dataset = dataclasses.replace(tiny_dataset(), faces=np.zeros((0, 3), np.int32), face_part=None, materials=None)
    far = dataset.tx_positions.copy()
    far[dataset.test] += 100
    np.testing.assert_array_equal(domain_of(dataclasses.replace(dataset, tx_positions=far)).outside(far[dataset.test]), True)


@pytest.mark.parametrize("n", [0, 1])
def test_no_place_is_none(n):
    body = ClosedBody("box", trimesh.creation.box((1, 1, 1)).triangles)
    assert inside(body, np.zeros((n, 3))).shape == (n,)


def test_arrays_of_an_answer_lose_their_confidence_there_alone():
    domain = Domain("room", np.array([[0.0, 0, 0], [4, 3, 2]]), (1e9, 1e11))
    answer = {"pas": np.ones((2, 90, 360), np.float32), "expected": np.full((2, 3), 0.9, np.float32)}
    found = domain.without_intervals(answer, np.array([[1.0, 1, 1], [500, 0, 1]]), np.full(2, 2e9))
    np.testing.assert_array_equal(found["pas"], answer["pas"])
    np.testing.assert_array_equal(found["expected"], np.array([[0.9] * 3, [np.nan] * 3], np.float32))
    assert found["expected"].dtype == np.float32
    assert domain.without_intervals({"pas": answer["pas"]}, np.zeros((2, 3)), np.ones(2)).keys() == {"pas"}


def test_frequencies_beyond_the_trained_band_have_no_interval():
    domain = Domain("room", np.array([[0.0, 0, 0], [4, 3, 2]]), (1e9, 1e11))
    hertz = np.array([0.9e9, 1e9, 1e9 * (1 - 1e-9), 1e11, 1.01e11])
    np.testing.assert_array_equal(domain.out_of_band(hertz), [True, False, False, False, True])
    places = np.array([[1.0, 1, 1], [500, 0, 1]])
    found = domain.without_intervals({"within_db": np.ones((2, 5))}, places, hertz, paired=False)["within_db"]
    np.testing.assert_array_equal(np.isnan(found), [domain.out_of_band(hertz), [True] * 5])


def test_compiled_code_finds_the_same_places(rng):
    centre = np.array([1.0, 1, 1])
    ball = ClosedBody("ball", at(trimesh.creation.icosphere(2, 0.5), *centre).triangles)
    domain = Domain("room", np.array([[0.0, 0, 0], [4, 3, 2]]), (1e9, 1e11), 0.0, (ball,))
    places = rng.uniform(-0.5, 2.5, (400, 3)).astype(np.float32)
    clear = np.abs(np.linalg.norm(places - centre, axis=1) - 0.5) > 0.03
    found = jax.jit(lambda points: domain.outside(points, jnp))(places)
    np.testing.assert_array_equal(found[clear], domain.outside(places)[clear])
    assert 0.1 < found.mean() < 0.9
