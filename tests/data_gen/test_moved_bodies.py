"""A body of the mesh that moves: path by path against Sionna RT's own solver in the scenes of single instants."""

import jax
import numpy as np
import pytest

from data_gen.scenes.base import SceneSpec, part
from data_gen.scenes.geometry import box
from data_gen.settings import ArraySettings, SolverSettings
from wbgs_jax.applications.movement import make_movement, paths_over_time, plan_movement
from wbgs_jax.fields import coherent
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.types import make_query, make_receiver

pytestmark = [pytest.mark.usefixtures("simulator_backend"), pytest.mark.heavy]

THEIRS = SolverSettings(max_depth=2, samples_per_src=50_000, max_paths_per_src=50_000, diffraction=False, solver="simulator")
HZ = 28e9
RX, TX = np.array([1.25, 2.5, 1.125]), np.array([4.5, 3.25, 1.75])
CONDUCTIVITY = 0.0462 * 28**0.7822
"""Of concrete (ITU-R P.2040), S/m."""


def scene_at(place):
    """A room with a cabinet of concrete, shifted from its first place."""
    walls = part("walls", box((0, 0, 0), (6, 5, 3)), "concrete", kind="shell")
    mesh = box((2.5, 3.75, 0.25), (3.25, 4.5, 2.0))
    mesh.apply_translation(place)
    return SceneSpec("room", (walls, part("cabinet", mesh, "concrete")), tuple(RX), np.zeros((0, 3)))


def found_by_sionna(place):
    """Delays and amplitudes of the paths of at most two reflections, through no wall."""
    from data_gen.solve import Simulator

    ((paths,),) = Simulator(scene_at(place), THEIRS, ArraySettings(rows=1, columns=1, pattern="iso")).paths(TX[None], (HZ,))
    return paths.delays, np.asarray(paths.coefficients).reshape(len(paths.delays), -1)[:, 0]


def test_paths_of_a_moved_cabinet_are_those_of_the_simulator():

    spec = scene_at((0, 0, 0))
    walls, cabinet = (one.mesh for one in spec.parts)
    faces = np.concatenate([walls.faces, cabinet.faces + len(walls.vertices)])
    numbers = np.repeat([0, 1], [len(walls.faces), len(cabinet.faces)]).astype(np.int32)
    vertices = np.concatenate([walls.vertices, cabinet.vertices])
    thickness = np.array([one.thickness for one in spec.parts], np.float32)
    arrays = (np.float32(vertices), np.int32(faces), numbers, numbers, thickness)
    mesh = coherent.Mesh(*map(jax.numpy.asarray, arrays))
    settings = coherent.WaveConfig(
        permittivity=5.24, conductivity=CONDUCTIVITY, slope=0.0, mirror_areas=(0.0, 0.0), diffracted_tried=0, diffracted_kept=0
    )
    field = coherent.make_field(mesh, settings)
    params = field.init(jax.random.key(0))
    centre = np.asarray(field.facets.corners).mean(1)
    (body,) = {
        int(m) for m, c in zip(field.facets.mover, centre, strict=True) if (c > 0.1).all() and (c < [5.9, 4.9, 2.9]).all()
    }
    shift = np.linspace(0, 1, 5)[:, None] * [0.5, -1.0, 0.0]
    motion = make_movement(field, 5, {body: shift})
    plan = plan_movement(field, params, make_receiver(RX), TX, motion)
    over_time = paths_over_time(params, plan, make_query(np.broadcast_to(TX, (5, 3)), HZ), motion)
    for instant in (0, 4):
        delays, expected = found_by_sionna(shift[instant])
        own = np.asarray(over_time.length[instant]) / SPEED_OF_LIGHT
        amplitude = np.asarray(over_time.amplitude[instant])
        strong = np.abs(expected) > 0.02 * np.abs(expected).max()
        assert strong.sum() > 10
        for delay, coefficient in zip(delays[strong], expected[strong], strict=True):
            same = np.abs(own - delay) < 2e-13
            assert np.abs(coefficient - amplitude[same]).min() < 0.03 * abs(coefficient), (instant, delay)
