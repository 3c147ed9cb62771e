"""Meshes become facets, bodies and edges: nothing is lost, nothing is doubled."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from builders.rooms import box, edges_of, facets_of, mesh_of, rectangle, room

from wbgs_jax._util.errors import UserError
from wbgs_jax.mesh.edges import about_edges, edges_of_facets
from wbgs_jax.mesh.facets import areas, facets_from_mesh, half_planes_of


def segments(edges):
    """Both ends of every edge, as a sorted list of rounded numbers."""
    ends = np.stack([edges.start, edges.start + edges.direction * edges.length[:, None]], 1).round(6) + 0.0
    return sorted(sorted(map(tuple, pair)) for pair in ends)


def test_a_box_has_six_facets_and_twelve_edges():
    facets = facets_of(box((0, 0, 0), (1, 2, 3)))
    edges = edges_of_facets(facets)
    assert sorted(areas(facets).round(6)) == [2, 2, 3, 3, 6, 6]
    assert sorted(edges.length.round(6)) == [1] * 4 + [2] * 4 + [3] * 4
    centre = np.array([0.5, 1, 1.5])
    assert (np.sum(facets.normal * centre, -1) < facets.offset).all()  # normals point outwards
    for start, direction, length, normal in zip(edges.start, edges.direction, edges.length, edges.normal_0, strict=True):
        tangent = np.cross(normal, direction)
        assert tangent @ (centre - start - direction * length / 2) > 0  # into the 0-face


def test_a_mesh_without_any_area_is_refused():
    line = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(UserError, match="no triangle with an area"):
        facets_of(line)


def test_a_fine_mesh_is_merged_and_its_area_kept(rng):
    fine = box((0, 0, 0), (1, 2, 3)).subdivide().subdivide()
    facets = facets_of(fine)
    assert len(facets.body) < len(fine.faces) / 4
    np.testing.assert_allclose(areas(facets).sum(), fine.area, rtol=1e-6)


def test_facets_cover_every_point_of_a_plane_once(rng):
    """A wall with a door: the windows of its facets are a partition of unity."""
    wall = trimesh.util.concatenate(
        [
            rectangle((0, 0, 0), (0, 2, 0), (0, 0, 3)),
            rectangle((0, 3, 0), (0, 2, 0), (0, 0, 3)),
            rectangle((0, 2, 2), (0, 1, 0), (0, 0, 1)),
        ]
    )
    facets = facets_of(wall)
    outline = half_planes_of(facets)
    points = np.stack([np.zeros(500), rng.uniform(0, 5, 500), rng.uniform(0, 3, 500)], -1)
    depth = np.einsum("fed,nd->nfe", outline.inward, points) - outline.offset
    inside = (depth > 0).all(-1).sum(-1)
    door = (points[:, 1] > 2) & (points[:, 1] < 3) & (points[:, 2] < 2)
    np.testing.assert_array_equal(inside, np.where(door, 0, 1))


def test_triangles_and_slopes_stay_what_they_are():
    gable = trimesh.Trimesh(
        [[0, 0, 0], [4, 0, 0], [4, 0, 2], [2, 0, 3], [0, 0, 2]], [[0, 1, 2], [0, 2, 4], [4, 2, 3]], process=False
    )
    facets = facets_of(gable)
    assert len(facets.body) == 2  # a rectangle and a triangle
    np.testing.assert_allclose(np.sort(areas(facets)), [2, 8])


def test_sheets_and_inner_corners_have_no_edges():
    assert edges_of(*room()).length.size == 0
    inside_out = box((1, 1, 1), (2, 2, 2))
    inside_out.invert()
    assert edges_of(*room(), inside_out).length.size == 0


@pytest.mark.parametrize("material", [None, [0, 0]])
def test_joined_bodies_diffract_at_free_edges_only(material):
    """A leg under a table top, two millimetres apart: its upper edges are no edges, of one material or of two."""
    leg, top = box((0, 0, 0), (0.1, 0.1, 0.7)), box((-0.5, -0.5, 0.702), (0.5, 0.5, 0.74))
    edges = edges_of(leg, top, material=material)
    leg_edges = np.abs(edges.start[:, 0] - 0.05) < 0.06
    assert leg_edges.sum() == 12 - 4 and (~leg_edges).sum() == 12


BESIDE = [box((0, 0, 0), (1, 1, 1)), box((1, 0, 0), (2, 1, 1))]
"""They touch with a whole side: four pairs of their faces lie in one plane and share corners."""


@pytest.mark.parametrize("other", [BESIDE[1], box((1, 0, 0), (3, 1, 2)), box((1, 1, 0), (2, 2, 1)), box((0, 0, 1), (1, 1, 2))])
def test_touching_objects_of_one_material_stay_two_bodies(other):
    """Each has the facets and edges that it has alone, and shares none with the other."""
    facets = facets_of(BESIDE[0], other, material=[0, 0])
    edges = edges_of_facets(facets)
    assert set(facets.material.tolist()) == {0} and edges.length.size == 24
    found, expected = [], []
    for body in set(facets.body.tolist()):
        own = jax.tree.map(lambda leaf, body=body: leaf[facets.body[edges.facet] == body], edges)
        found.append((sorted(areas(facets)[facets.body == body].round(6)), segments(own)))
    for part in (BESIDE[0], other):
        found_alone = facets_of(part)
        expected.append((sorted(areas(found_alone).round(6)), segments(edges_of_facets(found_alone))))
    assert sorted(found) == sorted(expected)


def test_blocks_of_one_object_that_touch_along_an_edge_are_closed():
    """The side that they share belongs to four triangles; a wall of their material is no part of their body."""
    blocks = trimesh.util.concatenate([box((0, 0, 0), (1, 1, 1)), box((1, 1, 0), (2, 2, 1))])
    wall = rectangle((0, 0, 0), (-3, 0, 0), (0, 0, 1))
    assert np.unique(facets_of(blocks, wall, material=[0, 0]).body, return_counts=True)[1].tolist() == [12, 1]


@pytest.mark.parametrize("height", [3.0, 2.0])
@pytest.mark.parametrize("material", [[0, 0], [0, 1]])
def test_walls_of_one_material_that_meet_are_one_body(material, height):
    """An L of two sheets, seen from outside: its corner is an edge, as high as the lower wall."""
    walls = [rectangle((0, 0, 0), (4, 0, 0), (0, 0, 3)), rectangle((4, 0, 0), (0, 3, 0), (0, 0, height))]
    facets = facets_of(*walls, material=material)
    edges = edges_of_facets(facets)
    if material == [0, 1]:
        assert len(set(facets.body.tolist())) == 2 and edges.length.size == 0
    else:
        assert len(set(facets.body.tolist())) == 1
        assert segments(edges) == [[(4, 0, 0), (4, 0, height)]]


def test_a_room_of_six_sheets_is_a_box():
    """Its walls look outwards; of one material they are one body with a box's edges."""
    facets = facets_of(*room(), material=[0] * 6)
    assert set(facets.body.tolist()) == {0}
    assert segments(edges_of_facets(facets)) == segments(edges_of(box((0, 0, 0), (6, 4, 3))))


def test_walls_apart_and_bodies_at_a_wall_stay_what_they_are():
    """Three walls in a row, one apart, and a cabinet of the same material that touches one of them in its corners."""
    row = [rectangle((x, 0, 0), (2, 0, 0), (0, 0, 3)) for x in (0, 2, 4, 8)]
    facets = facets_of(*row, box((2, 0, 0), (4, 1, 3)), material=[0] * 5)
    assert sorted(np.unique(facets.body, return_counts=True)[1]) == [1, 1, 6]  # the row is one facet
    assert edges_of_facets(facets).length.size == 12


def test_a_wall_that_is_divided_where_another_meets_it_has_no_edge():
    """A T of three sheets: two of them alone would be a wedge with three quarters of a turn in front of it, but the third
    closes it."""
    left, right = (rectangle((x, 0, 0), (0, 0, 3), (4, 0, 0)) for x in (-4, 0))
    inner = rectangle((0, -3, 0), (0, 3, 0), (0, 0, 3))
    assert segments(edges_of(left, inner, material=[0, 0])) == [[(0, 0, 0), (0, 0, 3)]]
    assert edges_of(left, right, inner, material=[0, 0, 0]).length.size == 0
    solids = [box((0, 0, 0), (1, 1, 1)), box((1, 0, 0), (3, 1, 1)), box((0, 0, 4), (9, 9, 9))]
    assert edges_of(*solids, material=[0, 0, 0]).length.size == 36  # solids that touch keep theirs


CORNERS_OF_L = np.array([(0, 0), (8, 0), (8, 3), (4, 3), (4, 6), (0, 6)], float)
"""Corners (x, y) of a room; the fourth is reentrant."""


@pytest.mark.parametrize("facing", ["in", "out", "either"])
@pytest.mark.parametrize("shell", [True, False])
def test_the_reentrant_corner_of_a_room_diffracts_whichever_way_its_walls_face(shell, facing):
    """It is the only edge with an outer angle on the side of the room. All others have theirs outside."""
    ends = np.column_stack([CORNERS_OF_L, np.zeros(6)]), np.column_stack([np.roll(CORNERS_OF_L, -1, 0), np.zeros(6)])
    parts = [rectangle(a, b - a, (0, 0, 3)) for a, b in zip(*ends, strict=True)]
    for level in (0, 3) if shell else ():
        for low, high in (((0, 0), (4, 3)), ((4, 0), (8, 3)), ((0, 3), (4, 6))):
            parts.append(rectangle((*low, level), (high[0] - low[0], 0, 0), (0, high[1] - low[1], 0)))
            if level == 0:
                parts[-1].invert()
    for number, part in enumerate(parts):
        if facing == "in" or (facing == "either" and number % 2):
            part.invert()
    edges = edges_of(*parts, material=[0] * len(parts))
    assert edges.length.sum() == pytest.approx(74 if shell else 18)
    inside = np.array([(1.0, 1.0, 1.0), (7.0, 2.0, 1.4), (2.0, 5.5, 2.0)])
    _, distance = about_edges(inside.T[:, :, None], edges)
    within = np.isfinite(distance).all(0)
    assert segments(jax.tree.map(lambda leaf: leaf[within], edges)) == [[(4, 3, 0), (4, 3, 3)]]


def test_one_object_of_two_materials_is_two_bodies():
    mesh = mesh_of(box((0, 0, 0), (1, 1, 1)))
    top = (np.asarray(mesh.vertices)[np.asarray(mesh.faces)][..., 2] == 1).all(-1)
    facets = facets_from_mesh(dataclasses.replace(mesh, material=jnp.asarray(top, jnp.int32)))
    assert len(set(zip(facets.body.tolist(), facets.material.tolist(), strict=True))) == 2
    assert edges_of_facets(facets).length.size == 8  # the four around the lid are gone


@pytest.mark.parametrize("shift", [0.0, 1e-7])
def test_corners_that_hardly_differ_are_one(shift):
    first, second = rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0)), rectangle((1 + shift, 0, 0), (1, 0, 0), (0, 1, 0))
    joined = trimesh.Trimesh(
        np.concatenate([first.vertices, second.vertices]), np.concatenate([first.faces, second.faces + 4]), process=False
    )
    facets = facets_of(joined)
    assert len(facets.body) == 1 and jnp.isclose(areas(facets)[0], 2)


def flipped(faces, which):
    faces = np.array(faces)
    faces[which] = faces[which][:, ::-1]
    return faces


@pytest.mark.parametrize(
    "wrong, said",
    [
        (lambda faces, rng: np.concatenate([faces, faces]), "every triangle twice"),
        (lambda faces, rng: np.concatenate([faces, faces[:, ::-1]])[rng.permutation(2 * len(faces))], "every triangle twice"),
        (
            lambda faces, rng: flipped(faces, rng.permutation(len(faces))[: rng.integers(1, len(faces))]),
            "inconsistent triangle orientations",
        ),
        (lambda faces, rng: flipped(faces, np.arange(0, len(faces), 2)), "inconsistent triangle orientations"),
    ],
)
def test_careless_exports_are_mended(wrong, said, rng):
    """A table's leg is a box with six facets and twelve edges, however often and whichever way round its triangles are."""
    right = mesh_of(box((0, 0, 0), (1, 2, 3)), box((5, 0, 0), (6, 2, 3)))
    expected, count = facets_from_mesh(right), len(right.faces) // 2
    first = wrong(np.asarray(right.faces[:count]), rng)
    faces = np.concatenate([first, np.asarray(right.faces[count:])])
    part = np.repeat([0, 1], [len(first), count])
    mesh = dataclasses.replace(right, faces=jnp.asarray(faces), part=jnp.asarray(part), material=jnp.asarray(part))
    with pytest.warns(UserWarning, match=said):
        facets = facets_from_mesh(mesh)
    assert len(facets.offset) == len(expected.offset) == 12
    assert len(edges_of_facets(facets).length) == 24
    planes = [np.round(np.column_stack([f.normal, f.offset]), 6) for f in (facets, expected)]
    np.testing.assert_array_equal(*(np.unique(p + 0.0, axis=0) for p in planes))


@pytest.mark.parametrize("other_way", [False, True])
def test_a_triangle_that_is_there_twice_counts_once(other_way):
    """Of a box and of a wall, whichever way the second one faces."""
    parts = [box((0, 0, 0), (1, 2, 3)), rectangle((5, 0, 0), (0, 2, 0), (0, 0, 3))]
    twice = []
    for part in parts:
        again = part.faces[:1, ::-1] if other_way else part.faces[:1]
        twice.append(trimesh.Trimesh(part.vertices, np.concatenate([part.faces, again]), process=False))
    with pytest.warns(UserWarning, match="triangles of other parts: 2"):
        facets = facets_of(*twice)
    assert areas(facets).sum() == pytest.approx(22 + 6) and len(facets.offset) == 7


@pytest.mark.parametrize("height", [0.0, 0.0005, 0.01])
def test_a_carpet_on_the_floor_is_pointed_out(height):
    """A cabinet on the floor and two boxes side by side are not."""
    carpet = rectangle((1, 1, height), (2, 0, 0), (0, 1.5, 0))
    solids = box((4, 1, 0), (4.5, 2, 2)), box((4.5, 1, 0), (5, 2, 2))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        facets_of(*room(), carpet, *solids)
    messages = [str(one.message) for one in caught]
    assert len(messages) == (height < 0.001)
    assert all("pairs: 1, 3 square metres, the largest at 2, 1.75" in message for message in messages)


def test_bodies_of_one_part_that_touch_keep_both_faces():
    """Two blocks, one on the other: where they touch there are two slabs to pass."""
    lower, upper = box((0, 0, 0), (1, 1, 1)), box((0, 0, 1), (1, 1, 2))
    together = trimesh.util.concatenate([lower, upper])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert areas(facets_from_mesh(mesh_of(together))).sum() == pytest.approx(12)


def test_what_hits_a_seam_hits_one_of_its_facets():
    """Two panels meet at y = 0, and so do what stands on either side."""
    sheets = [rectangle((0, -2, 0), (0, 2, 0), (0, 0, 3)), rectangle((0, 0, 0), (0, 2, 0), (0, 0, 3))]
    outline = half_planes_of(facets_from_mesh(mesh_of(*sheets)))
    inside = (outline.inward @ np.array([0.0, 0.0, 1.3]) >= outline.offset).all(-1)
    assert inside.sum() == 1
