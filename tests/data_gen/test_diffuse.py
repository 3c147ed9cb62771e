"""Diffuse reflection against the integral over a rough plane, and what it takes from the specular one."""

import dataclasses

import numpy as np
import pytest
import trimesh

from data_gen.scenes.base import Part, SceneSpec, part
from data_gen.scenes.geometry import box
from data_gen.settings import ArraySettings, SolverSettings
from wbgs_jax.radio.array import SPEED_OF_LIGHT

pytestmark = pytest.mark.usefixtures("simulator_backend")

ISOTROPIC = ArraySettings(rows=1, columns=1, pattern="iso")
FREQUENCY = 10e9
RX, TX = np.array([0.0, 0.0, 2.0]), np.array([4.0, 1.0, 1.5])
ROUGH = 0.5


def floor(material="metal"):
    corners = [(-40, -40, 0), (40, -40, 0), (40, 40, 0), (-40, 40, 0)]
    return Part("floor", trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)]), material, 0.2, "partition")


def paths(parts, depth=1, **changes):
    from data_gen.solve import Simulator

    settings = SolverSettings(
        max_depth=depth, samples_per_src=100_000, samples_diffuse=100_000, max_paths_per_src=200_000, diffraction=False
    )
    spec = SceneSpec("rough", tuple(parts), tuple(RX.tolist()), np.zeros((0, 3)))
    return Simulator(spec, dataclasses.replace(settings, **changes), ISOTROPIC).paths(TX[None], (FREQUENCY,))[0][0]


def split(found):
    """The coefficient of the mirror's path, which is the strongest by far, and those of the diffuse ones."""
    reflected = found.coefficients[found.order == 1, 0]
    strongest = np.abs(reflected).argmax()
    return reflected[strongest], np.delete(reflected, strongest)


def lambertian(scattering):
    """Mean power that a rough plane of metal scatters: every direction's share of what is sent, times the radar equation."""
    down, azimuth = ((np.arange(n) + 0.5) / n for n in (1500, 3000))
    down, azimuth = np.meshgrid(down, 2 * np.pi * azimuth, indexing="ij")
    across = np.sqrt(1 - down**2)
    direction = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), -down], -1)
    point = TX + direction * (TX[2] / down)[..., None]
    length = np.linalg.norm(RX - point, axis=-1)
    share = 0.5 / down.size  # of all that is sent; the other half goes up
    density = share * scattering**2 * (RX[2] / length) / np.pi / length**2
    on_the_floor = np.abs(point[..., :2]).max(-1) < 40
    return (density * on_the_floor).sum() * (SPEED_OF_LIGHT / FREQUENCY) ** 2 / (4 * np.pi)


@pytest.mark.parametrize("solver", ["project", "simulator"])
def test_a_rough_plane_scatters_the_power_it_takes(solver):
    smooth = paths([floor()], solver=solver)
    assert smooth.order.tolist() == [0, 1]
    mirror, diffuse = split(paths([floor()], solver=solver, scattering=(ROUGH, 0.0)))
    assert abs(mirror) == pytest.approx(np.sqrt(1 - ROUGH**2) * abs(smooth.coefficients[1, 0]), rel=1e-4)
    assert len(diffuse) > 10_000
    assert (np.abs(diffuse) ** 2).sum() == pytest.approx(lambertian(ROUGH), rel=0.03)


def test_nearly_nothing_goes_on_after_a_diffuse_reflection():
    """A limit of Sionna RT that the dataset card tells: of all such paths over one mirror it keeps one."""
    import sionna.rt as rt

    from data_gen.solve import Simulator

    mirror = floor()
    mirror.mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    mirror.mesh.apply_translation((0, -2, 0))
    spec = SceneSpec("mirror", (floor(), dataclasses.replace(mirror, kind="solid")), tuple(RX.tolist()), np.zeros((0, 3)))
    settings = SolverSettings(
        max_depth=2,
        samples_per_src=20_000,
        max_paths_per_src=50_000,
        diffraction=False,
        solver="simulator",
        scattering=(ROUGH, 0),
    )
    simulator = Simulator(spec, settings, ISOTROPIC)
    simulator.paths(TX[None], (FREQUENCY,))
    kinds = np.array(simulator._tracers[0].fields(None).interactions)[:, 0, 0].T.tolist()
    diffuse, specular = int(rt.InteractionType.DIFFUSE), int(rt.InteractionType.SPECULAR)
    assert kinds.count([specular, diffuse]) > 100 and kinds.count([diffuse, specular]) == 1


def test_walls_and_solids_are_rough_apart():
    table = part("table", box((1.5, -1, 0.2), (3, 2, 0.25)), "wood")
    counts = [len(paths([floor("concrete"), table], scattering=pair).delays) for pair in ((0, 0), (ROUGH, 0), (0, ROUGH))]
    assert counts[0] < 10 < counts[2] < counts[1]


def test_diffuse_paths_are_the_same_at_every_frequency():
    from data_gen.solve import Simulator

    spec = SceneSpec("rough", (floor("concrete"),), tuple(RX.tolist()), np.zeros((0, 3)))
    settings = SolverSettings(max_depth=1, samples_per_src=5000, max_paths_per_src=20_000, scattering=(ROUGH, ROUGH))
    by_frequency = Simulator(spec, settings, ISOTROPIC).paths(TX[None], (1e9, 94e9))
    low, high = (found[0] for found in by_frequency)
    np.testing.assert_array_equal(low.delays, high.delays)


def test_what_has_no_effect_is_not_recorded():
    usual, late = SolverSettings(), ("solver", "scattering", "samples_diffuse")
    before = {key: value for key, value in dataclasses.asdict(usual).items() if key not in late}
    assert usual.record() == before  # as it was when released files were made
    assert dataclasses.replace(usual, samples_diffuse=7).record() == before
    rough = dataclasses.replace(usual, scattering=(0.3, 0.4))
    assert rough.record() == before | {"scattering": (0.3, 0.4), "samples_diffuse": usual.samples_diffuse}
    theirs = dataclasses.replace(usual, solver="simulator").record()
    assert theirs["solver"] == "simulator" and "rays_per_face" not in theirs and "scattering" not in theirs
