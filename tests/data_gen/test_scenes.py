"""Scenes are what a ray tracer needs: closed, free of coinciding surfaces, of known materials, with room for the antennas."""

import dataclasses
import functools
import itertools
import json

import numpy as np
import pytest
import trimesh

from data_gen.scenes import FREQUENCIES_21_HZ, FREQUENCIES_HZ, SCENES, get_scene
from data_gen.scenes.base import RX_CLEARANCE, TX_CLEARANCE
from data_gen.scenes.geometry import crossings, winding_number
from wbgs_jax._util.errors import UserError
from wbgs_jax.data.load import RELEASED
from wbgs_jax.interchange import rooms

MAX_TRIANGLES = 2500
OPEN_ROOMS, FLATS = (1, 6), (2, 3, 4, 5)
FRAMES = ("_frames", "_posts")


@pytest.fixture(scope="module", params=sorted(SCENES))
def spec(request):
    return get_scene(request.param)


@functools.cache
def _accessible(number):
    return get_scene(number).accessible_tx()


@pytest.fixture(scope="module")
def tx(spec):
    return _accessible(_number(spec))


@pytest.fixture(scope="module")
def bodies(spec):
    """(part, body) of all solids; all bodies are boxes or upright prisms."""
    return [(p, body) for p in spec.solids for body in p.mesh.split()]


def _number(spec):
    return int(spec.name.removeprefix("scene"))


def test_solids_are_closed_and_the_mesh_is_small(spec):
    for p in spec.solids:
        assert p.mesh.is_watertight and p.mesh.is_winding_consistent and p.mesh.volume > 0, p.name
    assert len(spec.triangles()) < MAX_TRIANGLES
    assert all(p.mesh.area_faces.min() > 1e-6 for p in spec.parts)
    assert len({p.name for p in spec.parts}) == len(spec.parts)


def test_all_bodies_are_convex(bodies):
    # The ray tracer takes every edge for the ridge of a convex wedge.
    for p, body in bodies:
        assert body.volume == pytest.approx(body.convex_hull.volume, rel=1e-9), p.name


def _oriented_shell(spec):
    """The outer surface as one mesh whose triangles all look outwards."""
    triangles = spec.triangles("shell")
    normals = trimesh.triangles.normals(triangles)[0]
    inwards = spec.in_room(triangles.mean(1) + 1e-4 * normals)
    assert (inwards != spec.in_room(triangles.mean(1) - 1e-4 * normals)).all()  # one side is in the room, the other is not
    triangles[inwards] = triangles[inwards][:, ::-1]
    return trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles))


def test_the_room_is_closed(spec, rng):
    shell = _oriented_shell(spec)
    low, high = spec.bounds()
    points = rng.uniform(low - 1, high + 1, (400, 3))
    inside = spec.in_room(points)
    assert 0.1 < inside.mean() < 0.9
    # A hole of any size or an overlap would change the solid angle that the surface fills.
    np.testing.assert_allclose(winding_number(shell, points), inside, atol=1e-6)


def test_the_l_and_the_slope_are_no_boxes():
    corner = np.array([[5.0, 4.0, 1.0], [5.0, -4.0, 1.0], [-5.0, 4.0, 1.0]])
    assert get_scene(3).in_room(corner).tolist() == [False, True, True]
    assert get_scene(5).in_room(np.array([[0.0, -3.5, 2.5], [0.0, 3.5, 2.5]])).tolist() == [False, True]


def test_no_two_surfaces_coincide(spec):
    triangles = spec.triangles()
    normals = trimesh.triangles.normals(triangles)[0]
    first = np.argmax(np.abs(normals) > 1e-6, axis=1)
    normals *= np.sign(np.take_along_axis(normals, first[:, None], 1))  # both sides of a plane count as one plane
    planes = np.c_[normals, (normals * triangles[:, 0]).sum(1)].round(5) + 0.0
    _, which = np.unique(planes, axis=0, return_inverse=True)
    for plane in range(which.max() + 1):
        for i, j in itertools.combinations(np.flatnonzero(which.ravel() == plane), 2):
            if (triangles[i].min(0) <= triangles[j].max(0)).all() and (triangles[j].min(0) <= triangles[i].max(0)).all():
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


def _gap(first, second):
    """Distance along the axis where two boxes are farthest apart; negative when they overlap."""
    return np.maximum(first[0] - second[1], second[0] - first[1]).max()


def test_solids_do_not_interpenetrate(bodies):
    for (p, first), (q, second) in itertools.combinations(bodies, 2):
        assert _gap(first.bounds, second.bounds) > 1e-4, (p.name, q.name)


def test_sheets_enter_nothing_but_frames_and_posts(spec, bodies):
    sheets = [(p, np.stack([t.min(0), t.max(0)])) for p in spec.parts if not p.closed for t in np.asarray(p.mesh.triangles)]
    for p, body in bodies:
        if not p.name.endswith(FRAMES):
            touched = {q.name for q, bounds in sheets if q.name != "roof" and not q.name.startswith("skylight")
                       and _gap(body.bounds, bounds) < 1e-3}  # fmt: skip
            assert not touched, p.name


def test_solids_are_inside_the_room_and_touch_no_wall(spec, bodies):
    for p, body in bodies:
        grown = trimesh.bounds.corners(body.bounds + np.array([[-1e-3], [1e-3]]))
        assert spec.in_room(grown).all(), p.name


def test_inner_walls_end_at_a_surface_or_in_a_solid(spec):
    """No free edge: just beyond every open edge of a sheet is the outside, another sheet or the inside of a solid."""
    for p in spec.parts:
        if p.kind == "partition":
            others = dataclasses.replace(spec, parts=tuple(q for q in spec.parts if q is not p))
            middles, outwards = _open_edges(p.mesh)
            beyond = middles + 2e-3 * outwards
            hidden = ~spec.in_room(beyond) | spec.inside_objects(beyond) | (others.distance(middles) < 1e-6)
            foot = (middles[:, 2] < 1e-6) | (np.abs(outwards[:, 2]) < 0.5)
            assert hidden.all() and foot.any(), (p.name, middles[~hidden])


def _open_edges(mesh):
    """Middles of the edges that belong to one triangle only, and the directions away from that triangle."""
    rows = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    ends, normals = mesh.vertices[mesh.edges[rows]], mesh.face_normals[mesh.edges_face[rows]]
    outwards = np.cross(ends[:, 1] - ends[:, 0], normals)
    return ends.mean(1), outwards / np.linalg.norm(outwards, axis=1, keepdims=True)


def test_doors_are_open(spec):
    doors = [p for p in spec.parts if p.name.endswith("_frames")]
    assert bool(doors) == (_number(spec) in FLATS)
    for p in doors:
        heads = [body.bounds for body in p.mesh.split() if body.bounds[0, 2] > 1]
        across = np.eye(3)[np.argmin(np.ptp(p.mesh.bounds, axis=0)[:2])]
        for low, high in heads:
            middle = (low + high) / 2
            for height in (0.2, 1.0, 2.0):
                middle[2] = height
                start, end = middle - 0.4 * across, middle + 0.4 * across
                assert crossings(spec.mesh(), start[None], end) == 0, (p.name, middle)
                assert not spec.inside_objects(np.stack([start, end])).any()


def test_share_of_transmitters_without_line_of_sight(spec, tx):
    hidden = 1 - spec.line_of_sight(tx).mean()
    if _number(spec) in OPEN_ROOMS:
        assert hidden < 0.05
    else:
        assert 0.35 < hidden < 0.85


def test_line_of_sight_against_linear_algebra(spec, tx, rng):
    """A segment goes through a triangle where corner + u side + v side = start + t way: u, v, 1 - u - v and t are in 0..1."""
    chosen = tx[rng.choice(len(tx), 60, replace=False)]
    corner, second, third = np.swapaxes(spec.triangles(), 0, 1)
    seen = spec.line_of_sight(chosen)
    for start, free in zip(chosen, seen, strict=True):
        way = np.broadcast_to(np.asarray(spec.rx_position) - start, corner.shape)
        columns = np.stack([second - corner, third - corner, -way], -1)
        across = np.abs(np.linalg.det(columns)) > 1e-12  # and no triangle is seen edge-on
        u, v, t = np.linalg.solve(columns[across], (start - corner)[across][..., None])[..., 0].T
        through = (np.minimum.reduce([u, v, 1 - u - v]) >= 0) & (t > 0) & (t < 1)
        assert free == (not through.any())


def test_distances_are_those_to_all_triangles(spec, tx, rng):
    chosen = tx[rng.choice(len(tx), 20, replace=False)]
    expected = np.min([trimesh.proximity.closest_point_naive(p.mesh, chosen)[1] for p in spec.parts], axis=0)
    np.testing.assert_allclose(spec.distance(chosen), expected, atol=1e-7)


def test_materials_are_valid_at_all_frequencies(spec):
    for p in spec.parts:
        rooms.check_material(p.material)
        assert 0 < p.thickness < 0.5
    for frequency in spec.frequencies_hz:
        rooms.check_frequency(frequency)


def test_grid_counts(spec, tx):
    assert len(spec.tx_grid) == 900
    assert 840 <= len(tx) < 900
    grid = {tuple(p) for p in spec.tx_grid}
    assert all(tuple(p) in grid for p in tx) and len(np.unique(tx, axis=0)) == len(tx)


def test_transmitters_are_free(spec, tx):
    assert not spec.inside_objects(tx).any()
    assert spec.distance(tx).min() >= 0.10
    assert np.linalg.norm(tx - spec.rx_position, axis=1).min() >= 0.5
    assert spec.in_room(tx).all()


def test_dropped_transmitters_are_not_free(spec, tx):
    kept = {tuple(p) for p in tx}
    dropped = np.array([p for p in spec.tx_grid if tuple(p) not in kept])
    near_rx = np.linalg.norm(dropped - spec.rx_position, axis=1) < RX_CLEARANCE
    outside = ~spec.in_room(dropped)
    assert (spec.inside_objects(dropped) | (spec.distance(dropped) < TX_CLEARANCE) | near_rx | outside).all()


def test_most_transmitters_are_above_the_receiver(spec, tx):
    assert (tx[:, 2] > spec.rx_position[2]).mean() > 0.6


def test_the_receiver_is_free(spec):
    spec.check_receiver()
    assert 0.6 <= spec.rx_position[0] - spec.bounds()[0, 0] <= 1.0  # near the wall behind it


def test_a_receiver_inside_something_is_refused(spec):
    middle = tuple(spec.solids[-1].mesh.split()[0].bounds.mean(0))
    for position in (middle, (100.0, 0.0, 1.0)):
        with pytest.raises(UserError, match="receiver"):
            dataclasses.replace(spec, rx_position=position).accessible_tx()


def test_a_grid_without_a_free_place_is_refused(spec):
    with pytest.raises(UserError, match="accessible"):
        dataclasses.replace(spec, tx_grid=np.array([[100.0, 0, 0]])).accessible_tx()


def test_mesh_hash_is_reproducible_and_sees_changes(spec):
    again = get_scene(_number(spec))
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


def test_frequency_sets():
    assert len(FREQUENCIES_HZ) == 10 and len(FREQUENCIES_21_HZ) == 21
    assert FREQUENCIES_21_HZ[:3] == (1e9, 5e9, 10e9) and FREQUENCIES_21_HZ[-1] == 100e9
    assert all(rooms.check_frequency(f) for f in (*FREQUENCIES_HZ, *FREQUENCIES_21_HZ))


def test_scene_1_is_the_released_one():
    with np.load(RELEASED / "scene1.npz", allow_pickle=False) as archive:
        meta = json.loads(str(archive["meta"]))
        np.testing.assert_array_equal(archive["tx_positions"], get_scene(1).accessible_tx())
        np.testing.assert_array_equal(archive["rx_position"], get_scene(1).rx_position)
    assert get_scene(1).mesh_sha256() == meta["mesh_sha256"]


def test_all_scenes_together():
    assert sum(len(_accessible(number)) for number in SCENES) > 5000


@pytest.mark.parametrize("frequency", [0.0, 0.9e9, 100.1e9, float("nan")])
def test_frequency_without_materials_is_refused(frequency):
    with pytest.raises(UserError, match="GHz"):
        rooms.check_frequency(frequency)


def test_unknown_scene_is_refused():
    with pytest.raises(UserError, match="no scene 99"):
        get_scene(99)
