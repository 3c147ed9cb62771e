"""The simulator's own solver beside this project's: what both know, they agree on, and the rest is the simulator's."""

import dataclasses

import numpy as np
import pytest

from data_gen.scenes.base import SceneSpec, part
from data_gen.scenes.geometry import box
from data_gen.settings import SolverSettings
from wbgs_jax._util.errors import UserError

pytestmark = pytest.mark.usefixtures("simulator_backend")

OURS = SolverSettings(max_depth=2, samples_per_src=20_000, max_paths_per_src=20_000, diffraction=False)
THEIRS = dataclasses.replace(OURS, solver="simulator")
FREQUENCIES = (2.4e9, 60e9)
RX = (1.25, 2.5, 1.125)
TX = np.array([[4.5, 3.25, 1.75], [3.0, 0.75, 2.25]])


def room(*parts):
    return SceneSpec("room", (part("walls", box((0, 0, 0), (6, 5, 3)), "concrete", kind="shell"), *parts), RX, np.zeros((0, 3)))


@pytest.fixture(scope="module")
def simulators(simulator_backend):
    from data_gen.solve import Simulator

    return [Simulator(room(), settings) for settings in (OURS, THEIRS)]


@pytest.fixture(scope="module")
def found(simulators):
    return [simulator.paths(TX, FREQUENCIES) for simulator in simulators]


@pytest.mark.parametrize("order", [0, 1])
def test_line_of_sight_and_first_reflections_agree_path_by_path(found, order):
    for ours_by_tx, theirs_by_tx in zip(*found, strict=True):
        for ours, theirs in zip(ours_by_tx, theirs_by_tx, strict=True):
            one, other = (paths.order == order for paths in (ours, theirs))
            assert one.sum() == other.sum() == (6 if order else 1)  # floor, ceiling and four walls
            np.testing.assert_allclose(ours.delays[one], theirs.delays[other], rtol=1e-6)
            # What a float32 delay leaves of the phase at 60 GHz over 15 m.
            limit = 0.01 * np.abs(ours.coefficients[one]).max()
            np.testing.assert_allclose(ours.coefficients[one], theirs.coefficients[other], atol=limit)


def test_snapshots_agree(found):
    for ours_by_tx, theirs_by_tx in zip(*found, strict=True):
        for ours, theirs in zip(ours_by_tx, theirs_by_tx, strict=True):
            y, other = ours.snapshot(), theirs.snapshot()
            assert np.linalg.norm(y - other) < 0.02 * np.linalg.norm(y)


def test_a_snapshot_is_the_frequency_response_that_the_simulator_gives(simulators):
    """The simulator adds the carrier phase in its own way, in single precision, when it is asked for a frequency response."""
    import mitsuba as mi

    _, theirs = simulators
    ((paths, *_),) = theirs.paths(TX, FREQUENCIES[:1])
    response = theirs._tracers[0].fields(None).cfr(mi.Float(0.0), normalize_delays=False, out_type="numpy")
    expected = np.squeeze(response)[:, 0]  # elements, transmitters
    assert np.linalg.norm(paths.snapshot() - expected) < 1e-3 * np.linalg.norm(expected)


def test_materials_are_the_simulators_own_and_those_of_a_user():
    from data_gen.public_solver import public_material
    from wbgs_jax.interchange.rooms import Law, own_material

    itu = public_material("itu", room().parts[0], THEIRS)
    assert type(itu).__module__.startswith("sionna") and itu.itu_type == "concrete"
    clay = dataclasses.replace(room().parts[0], material=own_material("clay", Law(3.9, 0, 0.024, 0.16)), thickness=0.125)
    own = public_material("own", clay, THEIRS)
    assert type(own).__module__.startswith("sionna") and float(np.array(own.thickness).item()) == 0.125


def test_diffraction_is_the_simulators_own():
    """It finds the same edges, and other fields: docs/dataset.md tells what is wrong with them."""
    from data_gen.solve import Simulator

    spec = room(part("cabinet", box((2.5, 1.5, 0.01), (3.3, 3.2, 1.9)), "metal"))
    tx = np.array([[3.125, 3.375, 1.0]])  # just behind an edge of the cabinet
    settings = dataclasses.replace(OURS, max_depth=1, diffraction=True)
    ours, theirs, without = (
        Simulator(spec, dataclasses.replace(settings, **changes)).paths(tx, (1e9,))[0][0]
        for changes in ({}, {"solver": "simulator"}, {"solver": "simulator", "diffraction": False})
    )
    edges = np.setdiff1d(theirs.delays, without.delays)
    assert len(edges) and all(np.isclose(ours.delays, delay, rtol=1e-5).any() for delay in edges)
    assert np.abs(ours.snapshot() - theirs.snapshot()).max() > 0.01 * np.abs(ours.snapshot()).max()


def test_a_full_path_buffer_is_an_error():
    from data_gen.solve import Simulator

    with pytest.raises(UserError, match="--max-paths"):
        Simulator(room(), dataclasses.replace(THEIRS, max_paths_per_src=5)).paths(TX, FREQUENCIES[:1])
