"""The released files are what the code in this repository makes: scenes, transmitters, settings, counts."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from data_gen.options import Options, make_job
from data_gen.scenes import SCENES
from data_gen.settings import ArraySettings
from experiments.jobs import GHZ_FIXED
from wbgs_jax.data.load import RELEASED
from wbgs_jax.data.scene_file import TEST, load_scene
from wbgs_jax.radio.array import lag_basis, planar_array, snapshot_to_pas

OUTSIDE = {"solver": "simulator", "diffraction": False, "samples": 50_000, "max_paths": 50_000, "max_tx": 200}
ELSEWHERE, HALF = {"max_tx": 240, "ceilings": False}, 0.7071067811865476
FILES = {
    **{f"scene{n}": Options(scene=str(n)) for n in SCENES},
    "scene1_21f": Options(scene="1", frequency_set="21"),
    "scene2_fixed": Options(scene="2", frequencies=GHZ_FIXED, array=ArraySettings(spacing=0.015, unit="metres")),
    "scene2_rx2": Options(scene="2", rx="-0.4,2.6,1.6", rx_orientation=(HALF, 0, 0, -HALF), **ELSEWHERE),
    "scene2_rx3": Options(scene="2", rx="3.0,-2.3,1.4", rx_orientation=(HALF, 0, 0, HALF), **ELSEWHERE),
    "scene4_rx2": Options(scene="4", rx="0.4,1.8,1.6", rx_orientation=(HALF, 0, 0, -HALF), **ELSEWHERE),
    "scene4_rx3": Options(scene="4", rx="8.2,-1.9,1.2", rx_orientation=(0, 0, 0, 1), **ELSEWHERE),
    "scene2_simulator": Options(scene="2", **OUTSIDE),
    "scene4_simulator": Options(scene="4", **OUTSIDE),
    "scene2_diffuse": Options(scene="2", scattering=(0.3, 0.4), max_tx=160),
}
"""How each was made: the commands of the dataset card."""


@pytest.fixture(scope="module", params=FILES)
def released(request):
    return load_scene(RELEASED / f"{request.param}.npz"), make_job(FILES[request.param])


@pytest.fixture(scope="module")
def basis():
    """Of the squared spectra of the array that all files have."""
    return lag_basis(planar_array())


def test_all_scenes_are_there_and_small():
    assert {path.stem for path in RELEASED.glob("*.npz")} == {*FILES, "cabin"}  # that of test_full_wave.py
    assert sum(path.stat().st_size for path in RELEASED.glob("*.npz")) < 25e6
    scenes = [load_scene(RELEASED / f"scene{n}.npz") for n in SCENES]
    assert sum(scene.snapshots[..., 0].size for scene in scenes) >= 50_000


def test_a_file_is_of_the_scene_in_the_code(released):
    scene, job = released
    assert scene.meta["mesh_sha256"] == job.spec.mesh_sha256()
    kept = (job.tx_positions[:, None] == scene.tx_positions).all(-1).any(1)
    np.testing.assert_array_equal(scene.tx_positions, job.tx_positions[kept])
    assert (~kept).sum() == scene.meta["tx_without_path"] and scene.meta["tx_candidates"] == 900
    assert kept.all() or not job.settings.diffraction  # around edges there is always a way
    np.testing.assert_array_equal(scene.rx_position, [job.spec.rx_position])
    np.testing.assert_allclose(scene.rx_orientation, [job.spec.rx_orientation], atol=1e-12)
    np.testing.assert_array_equal(scene.frequencies_hz, job.frequencies_hz)
    elements = planar_array(spacing=0.015) if scene.element_unit == "metres" else planar_array()
    np.testing.assert_allclose(scene.element_positions, elements[None], atol=1e-12)
    for name, array in job.spec.mesh_arrays().items():
        np.testing.assert_array_equal(getattr(scene, name), array)


def test_a_file_is_of_the_settings_in_the_code(released):
    scene, job = released
    assert scene.meta["solver"].items() >= json.loads(json.dumps(job.settings.record())).items()
    np.testing.assert_allclose(scene.meta["frequencies_read_back_hz"], job.frequencies_hz, rtol=1e-6)


def test_the_split_is_by_transmitter_and_a_fifth(released):
    scene, *_ = released
    assert abs((scene.split == TEST).sum() - 0.2 * len(scene.split)) < 1


def test_ceilings_are_in_order(released):
    scene, job = released
    if not job.ceiling_tx:
        pytest.skip("made without them")
    for row in scene.meta["ceilings"]:
        orders = [row[f"order<={k}"] for k in range(4)]
        assert orders == sorted(orders) and 0.75 < row["phase_blind"] < 1
        if row["frequency_ghz"] < 10 and scene.name.endswith("fixed"):
            continue  # one wide beam, which the line of sight knows as well as anybody
        assert all(0.3 < row[name] < row["phase_blind"] for name in ("inverse_distance", "nearest_tx", "line_of_sight"))


def test_squared_spectra_lie_in_the_49_dimensions_of_the_array(released, basis, rng):
    scene, _ = released
    if scene.element_unit == "metres":
        pytest.skip("its array has another basis at every frequency")
    snapshots, elements = scene.snapshots[:, 0], scene.element_positions[0]
    np.testing.assert_array_equal(elements, planar_array())
    chosen = snapshots[rng.integers(len(snapshots), size=4), rng.integers(snapshots.shape[1], size=4)]
    pas = snapshot_to_pas(jnp.asarray(chosen), jnp.asarray(elements))
    squared = np.asarray(pas, np.float64).reshape(4, -1) ** 2
    assert basis.shape[1] == 49
    residual = squared - squared @ basis @ basis.T
    assert (np.linalg.norm(residual, axis=1) < 1e-5 * np.linalg.norm(squared, axis=1)).all()
