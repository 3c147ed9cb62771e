"""The released files are what the code in this repository makes: scenes, transmitters, settings, counts."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from data_gen.scenes import FREQUENCIES_21_HZ, FREQUENCIES_HZ, SCENES, get_scene
from data_gen.settings import SolverSettings
from experiments.jobs import GHZ_FIXED
from wbgs_jax.data.load import RELEASED
from wbgs_jax.data.scene_file import TEST, load_scene
from wbgs_jax.radio.array import lag_basis, planar_array, snapshot_to_pas

FIXED_HZ = tuple(1e9 * ghz for ghz in GHZ_FIXED)
FILES = {
    **{f"scene{n}": (n, FREQUENCIES_HZ) for n in SCENES},
    "scene1_21f": (1, FREQUENCIES_21_HZ),
    "scene2_fixed": (2, FIXED_HZ),
}


@pytest.fixture(scope="module", params=FILES)
def released(request):
    number, frequencies = FILES[request.param]
    return load_scene(RELEASED / f"{request.param}.npz"), get_scene(number), frequencies


@pytest.fixture(scope="module")
def basis():
    """Of the squared spectra of the array that all files have."""
    return lag_basis(planar_array())


def test_all_scenes_are_there_and_small():
    assert {path.stem for path in RELEASED.glob("*.npz")} == set(FILES)
    assert sum(path.stat().st_size for path in RELEASED.glob("*.npz")) < 25e6
    scenes = [load_scene(RELEASED / f"scene{n}.npz") for n in SCENES]
    assert sum(scene.snapshots[..., 0].size for scene in scenes) >= 50_000


def test_a_file_is_of_the_scene_in_the_code(released):
    scene, spec, frequencies = released
    assert scene.meta["mesh_sha256"] == spec.mesh_sha256()
    np.testing.assert_array_equal(scene.tx_positions, spec.accessible_tx())
    np.testing.assert_array_equal(scene.rx_position, [spec.rx_position])
    np.testing.assert_array_equal(scene.frequencies_hz, frequencies)
    elements = planar_array(spacing=0.015) if frequencies == FIXED_HZ else planar_array()
    np.testing.assert_allclose(scene.element_positions, elements[None], atol=1e-12)
    for name, array in spec.mesh_arrays().items():
        np.testing.assert_array_equal(getattr(scene, name), array)


def test_a_file_is_of_the_settings_in_the_code(released):
    scene, _, frequencies = released
    assert scene.meta["solver"].items() >= dataclasses.asdict(SolverSettings()).items()
    assert scene.meta["tx_without_path"] == 0 and scene.meta["tx_candidates"] == 900
    np.testing.assert_allclose(scene.meta["frequencies_read_back_hz"], frequencies, rtol=1e-6)


def test_the_split_is_by_transmitter_and_a_fifth(released):
    scene, *_ = released
    assert abs((scene.split == TEST).mean() - 0.2) < 0.002


def test_ceilings_are_in_order(released):
    scene, *_ = released
    for row in scene.meta["ceilings"]:
        orders = [row[f"order<={k}"] for k in range(4)]
        assert orders == sorted(orders) and 0.75 < row["phase_blind"] < 1
        if row["frequency_ghz"] < 10 and scene.name.endswith("fixed"):
            continue  # one wide beam, which the line of sight knows as well as anybody
        assert all(0.3 < row[name] < row["phase_blind"] for name in ("inverse_distance", "nearest_tx", "line_of_sight"))


def test_squared_spectra_lie_in_the_49_dimensions_of_the_array(released, basis, rng):
    scene, _, frequencies = released
    if frequencies == FIXED_HZ:
        pytest.skip("its array has another basis at every frequency")
    snapshots, elements = scene.snapshots[:, 0], scene.element_positions[0]
    np.testing.assert_array_equal(elements, planar_array())
    chosen = snapshots[rng.integers(len(snapshots), size=4), rng.integers(snapshots.shape[1], size=4)]
    pas = snapshot_to_pas(jnp.asarray(chosen), jnp.asarray(elements))
    squared = np.asarray(pas, np.float64).reshape(4, -1) ** 2
    assert basis.shape[1] == 49
    residual = squared - squared @ basis @ basis.T
    assert (np.linalg.norm(residual, axis=1) < 1e-5 * np.linalg.norm(squared, axis=1)).all()
