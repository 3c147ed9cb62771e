"""The two halves of the path solver against the whole: rays traced once carry what a solve at each frequency finds."""

import numpy as np
import pytest

from data_gen.scenes import get_scene
from data_gen.settings import SolverSettings

pytestmark = pytest.mark.usefixtures("simulator_backend")

FREQUENCIES = (10e9, 77e9)


def load(settings):
    """The scene and the tracer of a simulator of scene 1 that holds three transmitters."""
    import sionna.rt as rt

    from data_gen.solve import Simulator

    simulator = Simulator(get_scene(1), settings)
    for i, position in enumerate(get_scene(1).accessible_tx()[[40, 333, 666]].tolist()):
        simulator._scene.add(rt.Transmitter(f"tx{i}", position=position))
    return simulator._scene, simulator._tracers[0]


def tune(scene, frequency):
    """Sets the frequency; opaque to the compiler, which would otherwise compile everything anew for every number."""
    import drjit as dr
    import mitsuba as mi

    scene.frequency = dr.opaque(mi.Float, frequency)


def solve(scene, settings):
    """What the public solver finds, which traces at the scene's present frequency."""
    import sionna.rt as rt

    solver = rt.PathSolver(deterministic=True)
    return solver(
        scene, max_depth=settings.max_depth, samples_per_src=settings.samples_per_src, seed=settings.seed,
        max_num_paths_per_src=settings.max_paths_per_src, diffraction=settings.diffraction,
    )  # fmt: skip


def rows(found):
    """A row for every valid path, in a fixed order: transmitter, delay, interactions, field at all elements (float32)."""
    real, imaginary = (np.array(part)[0, :, :, 0] for part in found.a)
    delays = np.array(found.tau)
    tx = np.broadcast_to(np.arange(delays.shape[1], dtype=np.float32)[:, None], delays.shape)
    table = np.concatenate([tx, delays, np.array(found.interactions)[:, 0].astype(np.float32), real, imaginary])
    valid = table[:, np.array(found.valid)[0]].T
    return valid[np.lexsort(valid.T[::-1])]


@pytest.mark.parametrize(("depth", "diffraction"), [(3, False), (1, True)])
def test_fields_equal_those_of_the_public_solver(depth, diffraction):
    from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator

    # The public solver's own search: no aimed rays, and its share of diffraction.
    settings = SolverSettings(
        max_depth=depth, diffraction=diffraction, samples_per_src=20_000, max_paths_per_src=20_000, rays_per_face=0,
        rays_per_mirrored_face=0, diffraction_probability=SBCandidateGenerator.DIFFRACTION_SAMPLING_PROBABILITY,
    )  # fmt: skip
    scene, tracer = load(settings)
    tune(scene, FREQUENCIES[0])
    traced = tracer.trace()
    for frequency in FREQUENCIES:
        tune(scene, frequency)
        ours, stock = rows(tracer.fields(traced)), rows(solve(scene, settings))
        assert len(ours) > 30 and ours.any(0).all()
        # All paths, not only those in common: the search does not depend on the frequency.
        np.testing.assert_array_equal(ours, stock)


def test_only_the_search_differs_from_the_itu_material():
    import sionna.rt as rt

    settings = SolverSettings(max_depth=3, samples_per_src=20_000, max_paths_per_src=20_000, diffraction=False)
    scene, tracer = load(settings)
    tune(scene, 1e9)
    traced = tracer.trace()
    balanced = rows(tracer.fields(traced))
    for name, item in scene.objects.items():
        part = get_scene(1).parts[int(name.removeprefix("part-"))]
        item.radio_material = rt.ITURadioMaterial(f"itu-{name}", part.material, thickness=part.thickness)
    np.testing.assert_array_equal(balanced, rows(tracer.fields(traced)))
    # What the balance is for: at 1 GHz walls transmit nearly everything, and a search by power finds few reflections.
    assert len(balanced) > 1.5 * len(rows(solve(scene, settings)))
