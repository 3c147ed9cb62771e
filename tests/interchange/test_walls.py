"""Walls with two faces, as building models have them, as one sheet each: their thickness, and no gap where they met."""

import numpy as np
import pytest
import trimesh

from wbgs_jax.data.scene import _obstructed
from wbgs_jax.mesh.bodies import triangulate
from wbgs_jax.mesh.walls import divided, hidden_walls, walls_as_sheets


def block(low, high):
    return trimesh.creation.box(bounds=(low, high))


def turned(mesh, degrees):
    return mesh.copy().apply_transform(trimesh.transformations.rotation_matrix(np.radians(degrees), (0, 0, 1)))


DOORWAY = [(0, 0), (2, 0), (2, 2.1), (2.9, 2.1), (2.9, 0), (5, 0), (5, 2.7), (0, 2.7)]
"""Corners (y, z) of a partition with a doorway."""


def prism(outline, low, high):
    """A closed body over a concave outline in the y-z plane, from one x to another."""
    count = len(outline)
    corners = np.array([(x, y, z) for x in (low, high) for y, z in outline], float)
    cap = triangulate(corners[:count], np.arange(count), np.array([count]))
    around = [(i, (i + 1) % count) for i in range(count)]
    sides = [face for a, b in around for face in ((a, b, b + count), (a, b + count, a + count))]
    mesh = trimesh.Trimesh(corners, np.concatenate([cap[:, ::-1], cap + count, np.array(sides)]), process=False)
    assert mesh.is_watertight
    return mesh


def flat(degrees=0.0):
    """Two rooms, 8 x 5 x 2.7 m within, of slabs: walls 0.3 m, a partition 0.12 m with a doorway and a door, and a table."""
    parts = {
        "floor": block((-0.3, -0.3, -0.25), (8.3, 5.3, 0)),
        "ceiling": block((-0.3, -0.3, 2.7), (8.3, 5.3, 2.95)),
        "south": block((-0.3, -0.3, 0), (8.3, 0, 2.7)),
        "north": block((-0.3, 5, 0), (8.3, 5.3, 2.7)),
        "west": block((-0.3, 0, 0), (0, 5, 2.7)),
        "east": block((8, 0, 0), (8.3, 5, 2.7)),
        "partition": prism(DOORWAY, 4.94, 5.06),
        "door": block((4.98, 2, 0), (5.02, 2.9, 2.1)),
        "table": block((1, 1, 0.7), (2.6, 1.8, 0.74)),
        "cabinet": block((6, 4, 0.01), (7.2, 4.6, 2.0)),
    }
    return {name: turned(mesh, degrees) for name, mesh in parts.items()}


@pytest.mark.parametrize("degrees", [0.0, 31.0])
def test_slabs_become_sheets_of_their_thickness(degrees):
    parts = flat(degrees)
    meshes, walls = walls_as_sheets(list(parts.values()))
    found = dict(zip(parts, np.round(walls, 6), strict=True))
    assert found == {
        "floor": 0.25, "ceiling": 0.25, "south": 0.3, "north": 0.3, "west": 0.3, "east": 0.3, "partition": 0.12, "door": 0.04,
        "table": 0, "cabinet": 0,
    }  # fmt: skip
    after = dict(zip(parts, meshes, strict=True))
    assert after["table"] is parts["table"] and after["cabinet"].is_watertight
    assert after["west"].area == pytest.approx(5 * 2.7) and after["door"].area == pytest.approx(0.9 * 2.1)
    assert after["partition"].area == pytest.approx(5 * 2.7 - 0.9 * 2.1)
    assert after["floor"].bounds[:, 2].tolist() == [0, 0], "the face that looks into the room"


@pytest.mark.parametrize("degrees", [0.0, 31.0])
def test_no_way_out_of_a_room(degrees, rng):
    """Straight lines out of it, and from room to room through the closed door, meet a sheet."""
    meshes, _ = walls_as_sheets(list(flat(degrees).values()))
    triangles = np.concatenate([mesh.triangles for mesh in meshes])
    normals = trimesh.unitize(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    inside = rng.uniform((0.2, 0.2, 0.2), (4.7, 4.8, 2.5), (300, 3))
    outside = np.concatenate(
        [4 + 30 * trimesh.unitize(rng.normal(size=(150, 3))), rng.uniform((5.2, 1, 0.1), (7.8, 4.8, 2.6), (150, 3))]
    )
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), (0, 0, 1))
    ends = zip(trimesh.transform_points(inside, turn), trimesh.transform_points(outside, turn), strict=True)
    assert all(_obstructed(np.stack(line), triangles, normals) for line in ends)


def test_a_wall_that_ended_at_the_face_that_is_gone_is_lengthened():
    """A T: the second partition stands at the far side of the first, which keeps the face that looks at the middle."""
    hall = block((0, 0, -0.2), (20, 10, 0))
    first, second = block((14, 0, 0), (14.2, 10, 3)), block((14.2, 5, 0), (20, 5.1, 3))
    (_, kept, long), walls = walls_as_sheets([hall, first, second])
    assert walls == pytest.approx([0.2, 0.2, 0.1])
    assert kept.bounds[:, 0].tolist() == [14, 14]
    np.testing.assert_allclose(long.bounds[:, 0], [14, 20])


def test_the_face_towards_the_antennas_is_kept_where_the_middle_is_outside():
    """The notch of an L-shaped building holds the middle of its box; a transmitter outside of that box counts for nothing."""
    floor = block((-0.3, -0.3, -0.2), (10.3, 10.3, 0))
    south, west = block((2, 2, 0), (10, 2.3, 3)), block((2, 2.3, 0), (2.3, 10, 3))
    antennas = np.array([(1, 1, 1), (8, 1, 1), (1, 8, 1), (2.15, 15, 1)])
    for places, kept in ((None, (2.3, 2.3)), (antennas, (2, 2))):
        (_, first, second), walls = walls_as_sheets([floor, south, west], places)
        assert walls == pytest.approx([0.2, 0.3, 0.3])
        assert first.bounds[:, 1].tolist() == [kept[0]] * 2 and second.bounds[:, 0].tolist() == [kept[1]] * 2


def test_bodies_that_are_no_walls_stay(rng):
    """A pillar, a table top, a ball, a hull, a wedge; a wall whose bodies are of two thicknesses."""
    wedge = trimesh.convex.convex_hull(
        [(0, 0, 0), (4, 0, 0), (0, 0.2, 0), (4, 0.4, 0), (0, 0, 2), (4, 0, 2), (0, 0.2, 2), (4, 0.4, 2)]
    )
    two = trimesh.util.concatenate([block((0, 0, 0), (4, 0.1, 2)), block((5, 0, 0), (9, 0.3, 2))])
    bodies = [
        block((0, 0, 0), (0.4, 0.4, 3)), block((0, 0, 0), (1.6, 0.8, 0.03)), trimesh.creation.icosphere(),
        trimesh.convex.convex_hull(rng.normal(size=(30, 3))), wedge, two, trimesh.creation.cylinder(1, 3),
    ]  # fmt: skip
    meshes, walls = walls_as_sheets(bodies)
    assert walls == [0] * len(bodies) and all(one is other for one, other in zip(meshes, bodies, strict=True))


@pytest.mark.parametrize("ends", [(0.2, 0.0), (0.2, 0.2), (-0.2, 0.2)])
def test_walls_with_mitred_ends_are_walls(ends):
    outline = [(0, 0), (5, 0), (5 - ends[1], 0.2), (ends[0], 0.2)]
    wall = trimesh.convex.convex_hull([(x, y, z) for x, y in outline for z in (0, 2.7)])
    (mesh,), thickness = walls_as_sheets([wall])
    assert thickness == pytest.approx([0.2]) and np.ptp(mesh.vertices[:, 1]) < 1e-9


def test_the_walls_of_one_name_are_divided_by_their_thickness():
    """As in models whose objects have the name of their class; a cupboard stays a body."""
    thin, thick = block((0, 0, 0), (4, 0.1, 2.7)), block((5, 0, 0), (9, 0.3, 2.7))
    cupboard = block((0, 3, 0), (1, 3.6, 2))
    pieces = divided(trimesh.util.concatenate([thick, cupboard, thin]))
    meshes, walls = walls_as_sheets(pieces)
    assert sorted(walls) == pytest.approx([0, 0.1, 0.3])
    assert sorted(mesh.area for mesh in meshes) == pytest.approx([7.6, 10.8, 10.8])
    for whole in (trimesh.util.concatenate([thin, thin.copy().apply_translation((0, 9, 0))]), cupboard):
        assert divided(whole) == [whole]


def test_walls_in_one_piece_are_reported():
    corner = prism([(0, 0), (5, 0), (5, 0.2), (0.2, 0.2), (0.2, 4), (0, 4)], 0, 2.7)
    corner.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (0, 1, 0)))
    assert hidden_walls(corner) == pytest.approx(0.2, rel=0.1)
    assert not any(map(hidden_walls, (block((0, 0, 0), (1.2, 0.6, 2)), block((0, 0, 0), (3, 2, 2.7)))))


def test_several_segments_of_one_object_are_sheets():
    segments = [block((0, 0, 0), (4, 0.2, 2.7)), block((5, 0, 0), (9, 0.2, 2.7))]
    (mesh,), walls = walls_as_sheets([trimesh.util.concatenate(segments)])
    assert walls == pytest.approx([0.2]) and mesh.area == pytest.approx(2 * 4 * 2.7)
