"""Meshes become facets and edges: nothing is lost, nothing is doubled."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from rooms import box, mesh_of, rectangle, room

from wbgs_jax.wave.edges import edges_of_facets
from wbgs_jax.wave.facets import areas, facets_from_mesh, outline_of


def facets_of(*parts, most=None):
    mesh = mesh_of(*parts)
    return facets_from_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), np.asarray(mesh.cluster), most)


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


def test_a_fine_mesh_is_merged_and_its_area_kept(rng):
    fine = box((0, 0, 0), (1, 2, 3)).subdivide().subdivide()
    facets = facets_of(fine)
    assert len(facets.part) < len(fine.faces) / 4
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
    inward, offset = outline_of(facets)
    points = np.stack([np.zeros(500), rng.uniform(0, 5, 500), rng.uniform(0, 3, 500)], -1)
    depth = np.einsum("fed,nd->nfe", inward, points) - offset
    inside = (depth > 0).all(-1).sum(-1)
    door = (points[:, 1] > 2) & (points[:, 1] < 3) & (points[:, 2] < 2)
    np.testing.assert_array_equal(inside, np.where(door, 0, 1))


def test_triangles_and_slopes_stay_what_they_are():
    gable = trimesh.Trimesh(
        [[0, 0, 0], [4, 0, 0], [4, 0, 2], [2, 0, 3], [0, 0, 2]], [[0, 1, 2], [0, 2, 4], [4, 2, 3]], process=False
    )
    facets = facets_of(gable)
    assert len(facets.part) == 2  # a rectangle and a triangle
    np.testing.assert_allclose(np.sort(areas(facets)), [2, 8])


def test_sheets_and_inner_corners_have_no_edges():
    assert edges_of_facets(facets_of(*room())).length.size == 0
    inside_out = box((0, 0, 0), (1, 1, 1))
    inside_out.invert()
    assert edges_of_facets(facets_of(inside_out)).length.size == 0


def test_joined_bodies_diffract_at_free_edges_only():
    """A leg under a table top, two millimetres apart: its upper edges are no edges."""
    leg, top = box((0, 0, 0), (0.1, 0.1, 0.7)), box((-0.5, -0.5, 0.702), (0.5, 0.5, 0.74))
    edges = edges_of_facets(facets_of(leg, top))
    leg_edges = np.abs(edges.start[:, 0] - 0.05) < 0.06
    assert leg_edges.sum() == 12 - 4 and (~leg_edges).sum() == 12


def test_the_largest_facets_are_kept():
    facets = facets_of(box((0, 0, 0), (1, 2, 3)), most=2)
    np.testing.assert_allclose(areas(facets), [6, 6])


@pytest.mark.parametrize("shift", [0.0, 1e-7])
def test_corners_that_hardly_differ_are_one(shift):
    first, second = rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0)), rectangle((1 + shift, 0, 0), (1, 0, 0), (0, 1, 0))
    joined = trimesh.Trimesh(
        np.concatenate([first.vertices, second.vertices]), np.concatenate([first.faces, second.faces + 4]), process=False
    )
    facets = facets_of(joined)
    assert len(facets.part) == 1 and jnp.isclose(areas(facets)[0], 2)
