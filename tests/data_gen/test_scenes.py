"""Scenes are what a ray tracer needs: closed, free of coinciding surfaces, of known materials, with room for the antennas."""

import dataclasses
import itertools

import numpy as np
import pytest
import trimesh

from data_gen import materials
from data_gen.scenes import SCENES, get_scene
from data_gen.scenes.base import RX_CLEARANCE, TX_CLEARANCE, grid_3d, part, winding_number
from data_gen.scenes.furniture import box, chair, lamp, place, shelf, sofa, table, wall
from wbgs_jax.errors import UserError

MAX_TRIANGLES = 5000


@pytest.fixture(scope="module", params=sorted(SCENES))
def spec(request):
    return get_scene(request.param)


@pytest.fixture(scope="module")
def tx(spec):
    return spec.accessible_tx()


def test_furniture_is_closed_and_the_mesh_is_small(spec):
    for p in spec.furniture:
        assert p.mesh.is_watertight and p.mesh.is_winding_consistent and p.mesh.volume > 0, p.name
    assert sum(len(p.mesh.faces) for p in spec.parts) < MAX_TRIANGLES
    assert all(p.mesh.area_faces.min() > 1e-6 for p in spec.parts)
    assert len({p.name for p in spec.parts}) == len(spec.parts)


def test_the_room_is_closed(spec, rng):
    sheets = [p.mesh for p in spec.parts if not p.closed]
    shell = trimesh.util.concatenate(sheets)
    low, high = spec.bounds()
    size = high - low
    # The area of the box and no point of any sheet outside it: with no overlap (next test) there can be no hole either.
    np.testing.assert_allclose(shell.area, 2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0]), rtol=1e-6)
    on_box = (np.abs(shell.triangles_center - low) < 1e-9) | (np.abs(shell.triangles_center - high) < 1e-9)
    assert on_box.any(1).all()
    points = rng.uniform(low + 0.01, high - 0.01, (50, 3))
    # A closed surface fills all directions once, whichever way its triangles are wound.
    np.testing.assert_allclose(_solid_angle(shell, points), 4 * np.pi, rtol=1e-6)


def _solid_angle(mesh, points):
    single = (trimesh.Trimesh(mesh.vertices, mesh.faces[i : i + 1], process=False) for i in range(len(mesh.faces)))
    return sum(np.abs(winding_number(m, points)) for m in single) * 4 * np.pi


def test_no_two_surfaces_coincide(spec):
    triangles = np.concatenate([p.mesh.triangles for p in spec.parts])
    normals = np.concatenate([p.mesh.face_normals for p in spec.parts])
    offsets = np.einsum("ni,ni->n", normals, triangles[:, 0])
    for i, j in itertools.combinations(range(len(triangles)), 2):
        sign = normals[i] @ normals[j]
        if abs(sign) > 1 - 1e-9 and abs(offsets[i] - np.sign(sign) * offsets[j]) < 1e-6:
            assert _overlap(triangles[i], triangles[j], normals[i]) < 1e-9, (i, j)


def _overlap(first, second, normal):
    """Area common to two triangles of one plane (convex clipping)."""
    u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    axes = np.stack([u / np.linalg.norm(u), np.cross(normal, u / np.linalg.norm(u))], -1)
    polygon, clip = list(first @ axes), second @ axes
    if _cross(clip[1] - clip[0], clip[2] - clip[0]) < 0:
        clip = clip[::-1]
    for start, end in zip(clip, np.roll(clip, -1, 0), strict=True):
        side = [_cross(end - start, p - start) for p in polygon]
        kept = []
        for k, p in enumerate(polygon):
            q, a, b = polygon[k - 1], side[k], side[k - 1]
            if a * b < 0:
                kept.append(q + (p - q) * b / (b - a))
            if a >= 0:
                kept.append(p)
        polygon = kept
    return 0.5 * abs(sum(_cross(p, q) for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True)))


def _cross(a, b):
    return a[0] * b[1] - a[1] * b[0]


def test_bodies_of_furniture_do_not_interpenetrate(spec):
    bodies = [body for p in spec.furniture for body in p.mesh.split()]
    for first, second in itertools.combinations(bodies, 2):
        gap = np.maximum(first.bounds[0] - second.bounds[1], second.bounds[0] - first.bounds[1])
        assert gap.max() > 1e-4  # all bodies are boxes or upright prisms: apart along an axis


def test_furniture_is_inside_the_room_and_touches_nothing(spec):
    low, high = spec.bounds()
    for p in spec.furniture:
        assert (p.mesh.bounds[0] > low + 1e-3).all() and (p.mesh.bounds[1] < high - 1e-3).all(), p.name


def test_materials_are_valid_at_all_frequencies(spec):
    for p in spec.parts:
        materials.check_material(p.material)
        assert 0 < p.thickness < 0.5
    for frequency in spec.frequencies_hz:
        materials.check_frequency(frequency)


def test_grid_counts(spec, tx):
    assert len(spec.tx_grid) == 900
    assert 0.8 * 900 < len(tx) < 900
    grid = {tuple(p) for p in spec.tx_grid}
    assert all(tuple(p) in grid for p in tx) and len(np.unique(tx, axis=0)) == len(tx)


def test_transmitters_are_free(spec, tx):
    assert not spec.inside_objects(tx).any()
    assert spec.distance(tx).min() >= 0.10
    assert np.linalg.norm(tx - spec.rx_position, axis=1).min() >= 0.5
    low, high = spec.bounds()
    assert (tx > low).all() and (tx < high).all()


def test_dropped_transmitters_are_not_free(spec, tx):
    kept = {tuple(p) for p in tx}
    dropped = np.array([p for p in spec.tx_grid if tuple(p) not in kept])
    near_rx = np.linalg.norm(dropped - spec.rx_position, axis=1) < RX_CLEARANCE
    assert (spec.inside_objects(dropped) | (spec.distance(dropped) < TX_CLEARANCE) | near_rx).all()


def test_most_transmitters_are_above_the_receiver(spec, tx):
    assert (tx[:, 2] > spec.rx_position[2]).mean() > 0.6


def test_the_receiver_is_free(spec):
    spec.check_receiver()
    low, _ = spec.bounds()
    assert 0.6 <= spec.rx_position[0] - low[0] <= 1.0


def test_a_receiver_inside_something_is_refused(spec):
    middle = tuple(spec.furniture[-1].mesh.triangles_center[0])
    for position in (middle, (100.0, 0.0, 1.0)):
        with pytest.raises(UserError, match="receiver"):
            dataclasses.replace(spec, rx_position=position).accessible_tx()


def test_a_grid_without_a_free_place_is_refused(spec):
    with pytest.raises(UserError, match="accessible"):
        dataclasses.replace(spec, tx_grid=np.array([[100.0, 0, 0]])).accessible_tx()


def test_mesh_hash_is_reproducible_and_sees_changes(spec):
    again = get_scene(int(spec.name.removeprefix("scene")))
    assert again.mesh_sha256() == spec.mesh_sha256()
    first = spec.parts[0]
    thicker = dataclasses.replace(first, thickness=first.thickness * 2)
    moved = dataclasses.replace(first, mesh=first.mesh.copy().apply_translation((1e-3, 0, 0)))
    for changed in (thicker, moved):
        assert dataclasses.replace(spec, parts=(changed, *spec.parts[1:])).mesh_sha256() != spec.mesh_sha256()


def test_mesh_arrays_hold_every_part(spec):
    arrays = spec.mesh_arrays()
    triangles = arrays["vertices"][arrays["faces"]]
    for i, p in enumerate(spec.parts):
        np.testing.assert_allclose(triangles[arrays["face_part"] == i], p.mesh.triangles, atol=1e-6)


def test_winding_number_knows_inside(rng):
    mesh = box((-1, -2, -3), (1, 2, 3))
    points = rng.uniform(-4, 4, (500, 3))
    inside = (np.abs(points) < [1, 2, 3]).all(1)
    np.testing.assert_allclose(np.abs(winding_number(mesh, points)), inside, atol=1e-6)


@pytest.mark.parametrize("mesh", [table(1.8, 0.9, 0.75), chair(), sofa(2.0), shelf(1.2, 0.3, 2.0), lamp()])
def test_furniture_turns_about_its_middle(mesh):
    for facing in range(4):
        turned = place(mesh, 1.0, 2.0, facing)
        extents = mesh.extents[[1, 0, 2]] if facing % 2 else mesh.extents
        np.testing.assert_allclose(turned.extents, extents, atol=1e-9)
        assert turned.is_watertight and turned.volume > 0


def test_wall_is_cut_without_hole_or_overlap():
    openings = {"window": ((1.0, 1.0, 2.0, 2.0), "glass"), "door": ((3.0, 0.0, 4.0, 2.1), "wood")}
    parts = wall("wall", (0, 0, 0), (1, 0, 0), (0, 0, 1), (5.0, 3.0), "concrete", openings)
    assert {p.name: round(p.mesh.area, 9) for p in parts} == {"wall": 15 - 1 - 2.1, "window": 1.0, "door": 2.1}
    assert [p.material for p in parts] == ["concrete", "glass", "wood"]


def test_grid_order():
    grid = grid_3d((0, 0, 0), (1, 2, 3), (2, 3, 4))
    assert grid.shape == (24, 3)
    np.testing.assert_array_equal(grid[:2], [[0, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(grid[-1], [1, 2, 3])


@pytest.mark.parametrize("name", ["brick", "marble", ""])
def test_unknown_material_is_refused(name):
    with pytest.raises(UserError, match="unknown material"):
        part("wall", box((0, 0, 0), (1, 1, 1)), name)


@pytest.mark.parametrize("frequency", [0.0, 0.9e9, 100.1e9, float("nan")])
def test_frequency_without_materials_is_refused(frequency):
    with pytest.raises(UserError, match="GHz"):
        materials.check_frequency(frequency)


def test_unknown_scene_is_refused():
    with pytest.raises(UserError, match="no scene 99"):
        get_scene(99)
