"""The command line: an interrupted run goes on to the same bytes, and mistakes are told in one line."""

import dataclasses
import functools
import importlib.util
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from data_gen import generate as module
from data_gen import jobs, llvm
from data_gen.generate import generate
from data_gen.options import Options, make_job
from data_gen.scenes import get_scene
from data_gen.settings import ArraySettings, SolverSettings
from wbgs_jax._util.errors import UserError
from wbgs_jax.data.load import RELEASED
from wbgs_jax.data.scene_file import load_scene
from wbgs_jax.radio.array import planar_array


def options(folder, **changes):
    """Three batches at two frequencies, as small as it gets."""
    quick = Options(
        out=folder / "scene.npz",
        work=folder / "work",
        frequencies=(2.4, 60.0),
        samples=500,
        depth=1,
        max_paths=20_000,
        max_tx=20,
        workers=1,
    )
    return dataclasses.replace(quick, **changes)


@pytest.fixture(autouse=True)
def few_aimed_rays(monkeypatch):
    """The search is not the subject here, and ceilings of a few transmitters are enough."""
    few = functools.partial(SolverSettings, rays_per_face=1, rays_per_mirrored_face=0)
    monkeypatch.setattr("data_gen.options.SolverSettings", few)
    monkeypatch.setattr("data_gen.options.CEILING_TX", 5)


@pytest.fixture(scope="module")
def uninterrupted(simulator_backend, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        few_aimed_rays.__wrapped__(patch)
        return generate(options(tmp_path_factory.mktemp("whole")))


def test_the_scene_file_is_complete(uninterrupted):
    scene, spec = load_scene(uninterrupted), get_scene(1)
    assert scene.snapshots.shape == (20, 1, 2, 16) and (np.abs(scene.snapshots).max(-1) > 0).all()
    assert scene.split.sum() == 4  # 20 % of the transmitters, for all frequencies
    np.testing.assert_array_equal(scene.frequencies_hz, [2.4e9, 60e9])
    np.testing.assert_array_equal(scene.element_positions, planar_array()[None])
    np.testing.assert_array_equal(scene.rx_position, [spec.rx_position])
    assert (scene.element_unit, scene.element_pattern) == ("wavelengths", "tr38901")
    meta = scene.meta
    assert meta["mesh_sha256"] == spec.mesh_sha256()
    assert [p["material"] for p in meta["parts"]] == [p.material for p in spec.parts]
    assert meta["tx_candidates"] == 900 and meta["tx_kept"] == 20 and meta["tx_without_path"] == 0
    assert meta["solver"]["samples_per_src"] == 500 and meta["solver"]["max_depth"] == 1
    assert meta["rx_array"]["pattern"] == "tr38901"
    np.testing.assert_allclose(meta["frequencies_read_back_hz"], scene.frequencies_hz, rtol=1e-6)
    assert set(meta["generator"]["versions"]) == set(jobs.PACKAGES)
    assert [entry["frequency_ghz"] for entry in meta["ceilings"]] == [2.4, 60.0]
    for entry in meta["ceilings"]:
        assert entry["order<=1"] == 1.0  # depth 1: nothing is left out
        assert entry["order<=0"] < 1 and entry["phase_blind"] < 1
        assert 0 < entry["inverse_distance"] < 1
    for entry in meta["channel"]:
        assert entry["line_of_sight_share"] > 0.9 and entry["median_paths"] > 2 and entry["median_delay_spread_ns"] > 0
        assert entry["gain_db_p05"] < entry["gain_db_p50"] < entry["gain_db_p95"] < 0
    assert str(uninterrupted.parent) not in json.dumps(meta)


def test_interrupted_and_resumed_equals_uninterrupted(uninterrupted, tmp_path, monkeypatch):
    from data_gen.solve import Simulator

    original, calls = Simulator.paths, []

    def interrupted(self, positions, frequencies):
        calls.append(len(positions))
        if len(calls) == 2:
            raise KeyboardInterrupt
        return original(self, positions, frequencies)

    monkeypatch.setattr(Simulator, "paths", interrupted)
    with pytest.raises(KeyboardInterrupt):
        generate(options(tmp_path))
    assert not options(tmp_path).out.exists()
    resumed = generate(options(tmp_path))
    assert calls == [8, 8, 8, 4]  # one batch was lost, none repeated
    assert resumed.read_bytes() == uninterrupted.read_bytes()
    generate(options(tmp_path))
    assert len(calls) == 4


@pytest.mark.slow
def test_killed_and_resumed_equals_uninterrupted(uninterrupted, tmp_path):
    """The real thing: SIGKILL in the middle of a run of the command, and the command again."""
    program = (
        "import functools, sys, tyro; import data_gen.options as o; from data_gen.generate import generate;"
        "o.SolverSettings = functools.partial(o.SolverSettings, rays_per_face=1, rays_per_mirrored_face=0); o.CEILING_TX = 5;"
        "generate(tyro.cli(o.Options))"
    )
    arguments = ["--frequencies", "2.4", "60", "--samples", "500", "--depth", "1", "--max-paths", "20000", "--max-tx", "20"]
    arguments += ["--workers", "1", "--out", str(tmp_path / "scene.npz"), "--work", str(tmp_path / "work")]
    command = [sys.executable, "-c", program, *arguments]
    first = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    while first.poll() is None and not list(tmp_path.glob("work/*/0000.npz")):
        time.sleep(0.01)
    first.kill()
    first.wait()
    assert not (tmp_path / "scene.npz").exists()
    subprocess.run(command, check=True, capture_output=True)
    assert (tmp_path / "scene.npz").read_bytes() == uninterrupted.read_bytes()


@pytest.mark.slow
def test_two_processes_give_the_same_bytes(uninterrupted, tmp_path):
    assert generate(options(tmp_path, workers=2, threads=1)).read_bytes() == uninterrupted.read_bytes()


def found_without(*lost):
    """Results of 20 transmitters of which some have no path at one frequency."""
    n_paths = np.ones((20, 2), int)
    n_paths[list(lost), 1] = 0
    return {
        "read_back_hz": np.array([2.4e9, 60e9]), "n_paths": n_paths, "snapshots": np.full((20, 2, 16), 1j, np.complex64),
        "line_of_sight": n_paths > 0, "delay_spread_s": np.zeros((20, 2)), "ceilings": np.full((20, 2, 5), np.nan),
    }  # fmt: skip


@pytest.mark.parametrize("lost", [(), (3, 7)])
def test_transmitters_without_a_path_are_left_out_and_counted(simulator_backend, tmp_path, monkeypatch, lost):
    monkeypatch.setattr(jobs, "collect", lambda *_: found_without(*lost))
    monkeypatch.setattr(module, "_compute", lambda *_: None)
    scene = load_scene(generate(options(tmp_path, ceilings=False)))
    assert scene.meta["tx_without_path"] == len(lost) and len(scene.tx_positions) == 20 - len(lost)
    kept = np.delete(make_job(options(tmp_path)).tx_positions, lost, 0)
    np.testing.assert_array_equal(scene.tx_positions, kept)


def test_no_path_at_all_is_told_before_long(simulator_backend, tmp_path, monkeypatch):
    from data_gen.solve import Simulator, TxPaths

    nothing = TxPaths(np.zeros((0, 16), complex), np.zeros(0), np.zeros(0, int))

    def paths(self, positions, frequencies):
        self.read_back_hz = {f: f for f in frequencies}
        return [[nothing] * len(positions) for _ in frequencies]

    monkeypatch.setattr(Simulator, "paths", paths)
    with pytest.raises(UserError, match="no path between the receiver and any of 20 transmitters"):
        generate(options(tmp_path))
    monkeypatch.setattr("data_gen.jobs.SILENT", 10)
    with pytest.raises(UserError, match="no path between the receiver and any of 16 transmitters"):
        generate(options(tmp_path, seed=1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scene": "99"}, "no scene 99"),
        ({"scene": "nowhere.glb"}, "--rx"),
        ({"materials": Path("m.toml")}, "your own scene"),
        ({"frequency_set": "21"}, "exclude each other"),
        ({"name": "../elsewhere"}, "--name"),
        ({"rx_orientation": (0.0, 0.0, 0.0, 0.0)}, "quaternion"),
        ({"array": ArraySettings(rows=0)}, "--array.rows"),
        ({"array": ArraySettings(spacing=0)}, "--array.spacing"),
        ({"scale": -1.0}, "--scale"),
        ({"frequencies": (200.0,)}, "200 GHz is outside"),
        ({"out": None}, "--out"),
        ({"workers": 0}, "--workers"),
        ({"max_tx": 0}, "--max-tx"),
        ({"samples": 0}, "--samples"),
        ({"scattering": (0.3, 1.2)}, "--scattering"),
        ({"seed": -1}, "--seed"),
        ({"depth": 0}, "--depth"),
    ],
)
def test_mistakes_are_told_before_anything_is_computed(tmp_path, changes, message, monkeypatch):
    monkeypatch.setattr(jobs, "run", None)
    with pytest.raises(UserError, match=message) as caught:
        generate(options(tmp_path, **changes))
    assert "\n" not in str(caught.value)


def test_an_output_that_cannot_be_written_is_told_first(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write"):
        generate(options(tmp_path, out=tmp_path / "file" / "scene.npz"))


def test_released_files_are_not_replaced_by_others():
    assert Options().default_out() == RELEASED / "scene1.npz"
    assert Options(scene="3", frequency_set="21").default_out().name == "scene3_21f.npz"
    assert Options(scene="rooms/office.glb", samples=7).default_out() == Path("office.npz")
    for changes in ({"samples": 7}, {"depth": 2}, {"diffraction": False}, {"array": ArraySettings(rows=8)}, {"max_tx": 3},
                    {"solver": "simulator"}, {"scattering": (0.0, 0.1)}, {"seed": 1}):  # fmt: skip
        with pytest.raises(UserError, match="--out"):
            Options(**changes).default_out()


def test_the_checksum_sees_everything_that_decides(monkeypatch):
    monkeypatch.setattr(jobs, "versions", lambda: {"sionna-rt": "any"})  # the simulator need not be installed
    job = make_job(Options(max_tx=5))
    settings = [{"samples_per_src": 7}, {"max_depth": 2}, {"diffraction": False}, {"seed": 1}, {"tx_per_call": 2},
                {"solver": "simulator"}, {"scattering": (0.3, 0)}, {"scattering": (0, 0.3)},
                {"scattering": (0.3, 0), "samples_diffuse": 7}]  # fmt: skip
    others = [dataclasses.replace(job, settings=dataclasses.replace(job.settings, **change)) for change in settings]
    others += [
        dataclasses.replace(job, tx_positions=job.tx_positions[:-1]),
        dataclasses.replace(job, frequencies_hz=job.frequencies_hz[:-1]),
        dataclasses.replace(job, array=ArraySettings(pattern="iso")),
        dataclasses.replace(job, spec=dataclasses.replace(job.spec, rx_position=(0.0, 0.0, 1.0))),
        dataclasses.replace(job, spec=dataclasses.replace(job.spec, rx_orientation=(0.0, 0.0, 0.0, 1.0))),
        dataclasses.replace(job, spec=dataclasses.replace(job.spec, parts=job.spec.parts[:-1])),
    ]
    assert job.digest("llvm") == "d97c520e9aab8af6"  # unfinished work of before is found, and what it was is not changed
    digests = {job.digest("llvm"), job.digest("cuda"), *(other.digest("llvm") for other in others)}
    assert len(digests) == len(others) + 2
    assert job.digest("llvm") == make_job(Options(max_tx=5, workers=3, threads=1)).digest("llvm")


def test_all_cores_are_used_within_the_memory_of_a_laptop(monkeypatch):
    for cores, expected in ((1, (1, None)), (2, (1, None)), (4, (2, 2)), (7, (3, 3)), (64, (4, 16))):
        monkeypatch.setattr("os.sched_getaffinity", lambda _, n=cores: range(n), raising=False)
        assert module._processes(Options(), "llvm") == expected
        assert module._processes(Options(workers=3, threads=1), "llvm") == (3, 1)
        assert module._processes(Options(), "cuda") == (1, None)


def test_another_array_is_in_the_file(simulator_backend, tmp_path):
    array = ArraySettings(rows=2, columns=3, plane="xy", pattern="iso", spacing=0.4)
    turned = (0.0, 0.0, 0.0, 2.0)
    scene = load_scene(generate(options(tmp_path, max_tx=8, array=array, rx_orientation=turned)))
    assert scene.snapshots.shape == (8, 1, 2, 6) and scene.element_pattern == "iso"
    np.testing.assert_array_equal(scene.element_positions, array.element_positions()[None])
    np.testing.assert_array_equal(scene.rx_orientation, [[0, 0, 0, 1]])


@pytest.mark.skipif(importlib.util.find_spec("sionna") is None, reason=llvm.NOT_INSTALLED)
def test_no_usable_libllvm_is_told_in_one_line(monkeypatch):
    monkeypatch.setattr(llvm, "probe", lambda *_: False)
    monkeypatch.setattr(llvm, "_succeeds", lambda *_: False)
    monkeypatch.setenv(llvm.VARIABLE, "/nowhere/libLLVM.so")
    with pytest.raises(UserError, match="libllvm19") as caught:
        llvm.find_backend()
    assert "/nowhere/libLLVM.so" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "version"),
    [("libLLVM.so.19.1", 19), ("libLLVM-17.so.1", 17), ("libLLVM-14.0.6.so.1", 14), ("libLLVM.dylib", None)],
)
def test_library_versions(name, version, tmp_path):
    assert llvm.library_version(tmp_path / name) == version
