"""The starting rays: how many, where they go, and what they find that evenly spread ones do not."""

import dataclasses

import numpy as np
import pytest
import trimesh

from data_gen.scenes.base import SceneSpec, part
from data_gen.scenes.geometry import box
from data_gen.scenes.walls import wall
from data_gen.settings import SolverSettings

QUICK = SolverSettings(samples_per_src=2_000, rays_per_face=3, rays_per_mirrored_face=2, max_depth=2, max_paths_per_src=5_000)
POST = (2.0, 0.3), (2.03, 0.33)


@pytest.fixture
def launcher(simulator_backend):
    from data_gen.rays import RayLauncher

    return lambda spec, **changes: RayLauncher(spec, dataclasses.replace(QUICK, **changes))


def room(*more, name="room"):
    """A floor, a wall in two pieces at x = 5, and a thin post."""
    (x0, y0), (x1, y1) = POST
    floor = wall("floor", (0, -3, 0), (1, 0, 0), (0, 1, 0), (5, 6), "concrete")
    sides = wall("side", (5, -3, 0), (0, 1, 0), (0, 0, 1), (6, 3), "concrete", {"window": ((1, 1, 2, 2), "glass")})
    post = part("post", box((x0, y0, 0.5), (x1, y1, 2.5)), "metal")
    return SceneSpec(name, (*floor, *sides, post, *more), (0.5, 0.0, 1.0), np.zeros((0, 3)))


def test_planes_are_counted_once_and_mirrors_are_the_largest(launcher):
    from data_gen.rays import _planes

    normals, offsets = _planes(room())
    np.testing.assert_allclose(normals, [[0, 0, 1], [1, 0, 0]], atol=1e-9)  # 30 and 18 square metres
    np.testing.assert_allclose(offsets, [0, 5], atol=1e-9)


def test_the_number_of_rays_is_the_same_everywhere(launcher, rng):
    rays = launcher(room())
    assert rays.count == 2_000 + 12 * (3 + 2 * 2)  # 12 triangles, 2 mirrors
    for origin in rng.uniform((0.2, -2, 0.5), (4.8, 2, 2.5), (5, 3)):
        directions = rays.aimed(origin)
        assert directions.shape == (rays.count - 2_000, 3) and directions.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    assert launcher(room(), diffraction=False).count == 2_000
    assert len(launcher(SceneSpec("void", (), (0.0, 0.0, 0.0), np.zeros((0, 3)))).aimed(np.zeros(3))) == 0


def test_aimed_rays_meet_the_solid_straight_or_after_one_reflection(launcher, rng):
    rays, origin = launcher(room()), rng.uniform((0.2, -2, 0.5), (1.5, 2, 2.5))
    directions = rays.aimed(origin).astype(np.float64)
    straight, floor, side = np.split(directions, [36, 36 + 24])
    post = room().solids[0].mesh
    assert _hits(post, np.tile(origin, (36, 1)), straight)
    for mirrored, axis, height in ((floor, 2, 0.0), (side, 0, 5.0)):
        t = (height - origin[axis]) / mirrored[:, axis]
        assert (t > 0).all()  # they do go to the mirror
        bounced = mirrored.copy()
        bounced[:, axis] *= -1
        assert _hits(post, origin + t[:, None] * mirrored, bounced)


def _hits(mesh, origins, directions):
    """Whether every ray meets the mesh, slightly inflated: points lie on its faces and float32 directions beside its edges."""
    solid = trimesh.creation.box(extents=mesh.extents + 1e-3)
    solid.apply_translation(mesh.bounds.mean(0))
    low, high = solid.bounds
    with np.errstate(divide="ignore"):
        ends = np.stack([(low - origins) / directions, (high - origins) / directions])
    near, far = ends.min(0).max(1), ends.max(0).min(1)
    return ((near <= far) & (far > 0)).all()


def test_of_too_many_aimed_rays_a_part_is_drawn(launcher, monkeypatch):
    monkeypatch.setattr("data_gen.rays.MAX_AIMED", 20)
    first, again = launcher(room()), launcher(room())
    assert first.count == 2_020
    np.testing.assert_array_equal(first.aimed(np.ones(3)), again.aimed(np.ones(3)))


def test_aimed_rays_find_what_a_hundred_times_as_many_even_ones_find(simulator_backend):
    from data_gen.solve import Simulator

    bars = [part(f"bar{i}", box((3, -2 + i / 2, 0.2), (3.03, -1.97 + i / 2, 2.8)), "metal") for i in range(8)]
    spec = room(*bars)
    tx = np.array([[4.5, 1.0, 1.7]])

    def found(evenly, straight, mirrored):
        rays = {"samples_per_src": evenly, "rays_per_face": straight, "rays_per_mirrored_face": mirrored}
        return len(Simulator(spec, dataclasses.replace(QUICK, **rays)).paths(tx, [5e9])[0][0].delays)

    few = found(200, 8, 4)  # 12 faces of 9 bodies, 2 mirrors: 1,928 rays
    assert few > 3 * found(1_928, 0, 0)
    assert few >= 0.9 * found(200_000, 0, 0)
