"""Tables and pictures of scene files, and the figures in their meta. No simulator."""

import dataclasses

import numpy as np
import pytest
from builders.synthetic import tiny_scene

from data_gen import ceilings, report, samples, statistics
from data_gen.convergence import settings
from data_gen.settings import ArraySettings, SolverSettings
from wbgs_jax._util.errors import UserError
from wbgs_jax.data import scene_dataset
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.evaluation.baselines import baselines
from wbgs_jax.metrics import ssim
from wbgs_jax.radio.array import planar_array


@pytest.fixture
def found(rng):
    scene = tiny_scene()
    n_tx, _, n_freq, _ = scene.snapshots.shape
    values = rng.random((n_tx, n_freq, len(ceilings.NAMES)))
    values[1::2] = np.nan  # half of them were not measured
    return {
        "ceilings": values, "n_paths": rng.integers(1, 99, (n_tx, n_freq)), "line_of_sight": rng.random((n_tx, n_freq)) < 0.5,
        "delay_spread_s": rng.random((n_tx, n_freq)) * 1e-8,
    }  # fmt: skip


def test_ceiling_table_is_the_median_of_what_was_measured(found):
    scene = tiny_scene()
    rows = statistics.ceiling_table(scene, found)
    assert [row["frequency_ghz"] for row in rows] == (scene.frequencies_hz / 1e9).tolist()
    for i, row in enumerate(rows):
        for k, name in enumerate(ceilings.NAMES):
            assert row[name] == pytest.approx(np.median(found["ceilings"][::2, i, k]), abs=1e-4)
    dataset = scene_dataset(scene)
    chosen = dataset.test[dataset.frequencies_hz[dataset.test] == scene.frequencies_hz[0]]
    score = ssim(baselines(dataset)["inverse_distance"](chosen), np.asarray(dataset.pas(chosen)))
    assert rows[0]["inverse_distance"] == pytest.approx(np.median(score), abs=1e-4)


def test_nothing_measured_and_nothing_held_out_leave_the_columns_out(found):
    scene = dataclasses.replace(tiny_scene(), split=np.zeros_like(tiny_scene().split))
    nothing = found | {"ceilings": np.full_like(found["ceilings"], np.nan)}
    assert [set(row) for row in statistics.ceiling_table(scene, nothing)] == [{"frequency_ghz"}] * len(scene.frequencies_hz)


def test_channel_table(found):
    scene = tiny_scene()
    doubled = dataclasses.replace(scene, snapshots=2 * scene.snapshots)
    rows, louder = statistics.channel_table(scene, found), statistics.channel_table(doubled, found)
    for i, (row, more) in enumerate(zip(rows, louder, strict=True)):
        assert row["median_paths"] == np.median(found["n_paths"][:, i])
        assert row["line_of_sight_share"] == pytest.approx(found["line_of_sight"][:, i].mean(), abs=1e-4)
        assert row["median_delay_spread_ns"] == pytest.approx(1e9 * np.median(found["delay_spread_s"][:, i]), abs=1e-4)
        assert more["gain_db_p50"] - row["gain_db_p50"] == pytest.approx(20 * np.log10(2), abs=1e-3)
        assert row["gain_db_p05"] <= row["gain_db_p50"] <= row["gain_db_p95"]


def test_report_and_samples_of_a_file(found, tmp_path):
    scene = tiny_scene()
    meta = {"ceilings": statistics.ceiling_table(scene, found), "channel": statistics.channel_table(scene, found)}
    save_scene(tmp_path / "tiny.npz", dataclasses.replace(scene, meta=scene.meta | meta))
    text = report.report((tmp_path / "tiny.npz",))
    n_tx, _, n_freq, _ = scene.snapshots.shape
    assert f"| tiny.npz | {n_tx} | {n_freq} | {n_tx * n_freq} |" in text
    tables = [block for block in text.split("\n\n") if block.startswith("|")]
    assert [len(table.splitlines()) for table in tables] == [3, 3, 2 + n_freq, 2 + n_freq]
    for table in tables:
        assert len({line.count("|") for line in table.splitlines()}) == 1
    samples.draw(scene, tmp_path / "samples.png")
    assert pytest.importorskip("PIL.Image").open(tmp_path / "samples.png").width > 500


def test_samples_and_report_of_several_receivers(found, tmp_path):
    scene = tiny_scene(n_rx=3, kind="pas")
    tables = statistics.ceiling_table(tiny_scene(), found), statistics.channel_table(tiny_scene(), found)
    meta = dict(zip(("ceilings", "channel"), tables, strict=True))
    save_scene(tmp_path / "tiny.npz", dataclasses.replace(scene, meta=scene.meta | meta))
    n_tx, n_rx, n_freq = scene.pas.shape[:3]
    assert f"| tiny.npz | {n_tx} | {n_freq} | {n_tx * n_rx * n_freq} |" in report.report((tmp_path / "tiny.npz",))
    samples.draw(scene, tmp_path / "samples.png", receiver=2)
    with pytest.raises(UserError, match="box has no receiver 3"):
        samples.draw(scene, tmp_path / "none.png", receiver=3)
    with pytest.raises(UserError, match="received powers"):
        samples.draw(tiny_scene(kind="power"), tmp_path / "none.png")
    assert [p.name for p in tmp_path.iterdir() if p.suffix == ".png"] == ["samples.png"]


def test_the_cross_is_the_direction_of_the_transmitter():
    scene = tiny_scene()
    offset = scene.tx_positions[0] - scene.rx_position[0]
    azimuth, zenith = samples._direction(scene_dataset(scene).receiver(), scene.tx_positions[0])
    assert zenith == pytest.approx(np.degrees(np.arccos(offset[2] / np.linalg.norm(offset))), abs=1e-3)
    assert azimuth == pytest.approx(np.degrees(np.arctan2(offset[1], offset[0])), abs=1e-3)


def test_effort_scales_rays_and_keeps_memory():
    usual = SolverSettings()
    assert settings(1.0) == usual
    more = settings(4.0)
    assert more.samples_per_src == 4 * usual.samples_per_src and more.rays_per_face == 4 * usual.rays_per_face
    assert more.tx_per_call * 4 == usual.tx_per_call and more.max_paths_per_src == 4 * usual.max_paths_per_src
    assert settings(0.01).rays_per_mirrored_face == 1


@pytest.mark.parametrize("plane", ["yz", "xy", "xz"])
def test_array_planes(plane):
    positions = ArraySettings(rows=2, columns=3, spacing=0.4, plane=plane).element_positions()
    flat = {"yz": 0, "xy": 2, "xz": 1}[plane]
    assert (positions[:, flat] == 0).all() and np.allclose(positions.mean(0), 0)
    np.testing.assert_allclose(sorted(np.ptp(positions, axis=0)), [0, 0.4, 0.8])
    np.testing.assert_array_equal(ArraySettings().element_positions(), planar_array())
