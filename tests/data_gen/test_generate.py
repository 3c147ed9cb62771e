"""The command line: an interrupted run goes on to the same bytes, and mistakes are told in one line."""

import dataclasses
import importlib.util
import json

import numpy as np
import pytest

from data_gen import generate as module
from data_gen import jobs, llvm
from data_gen.generate import Options, generate
from data_gen.scenes import get_scene
from wbgs_jax.array import planar_array
from wbgs_jax.data.schema import load_scene
from wbgs_jax.errors import UserError


def options(folder, **changes):
    """Two batches at two frequencies and the ceilings, as small as it gets."""
    quick = Options(
        out=folder / "scene.npz", work=folder / "work", frequencies=(2.4, 60.0), samples=500, depth=1, max_paths=500, max_tx=20
    )
    return dataclasses.replace(quick, **changes)


@pytest.fixture(scope="module")
def uninterrupted(simulator_backend, tmp_path_factory):
    return generate(options(tmp_path_factory.mktemp("whole")))


def test_the_scene_file_is_complete(uninterrupted):
    scene, spec = load_scene(uninterrupted), get_scene(1)
    assert scene.snapshots.shape == (20, 2, 16) and (np.abs(scene.snapshots).max(-1) > 0).all()
    assert scene.split.sum() == 4  # 20 % of the transmitters, for all frequencies
    np.testing.assert_array_equal(scene.frequencies_hz, [2.4e9, 60e9])
    np.testing.assert_array_equal(scene.element_positions, planar_array())
    np.testing.assert_array_equal(scene.rx_position, spec.rx_position)
    meta = scene.meta
    assert meta["mesh_sha256"] == spec.mesh_sha256()
    assert [p["material"] for p in meta["parts"]] == [p.material for p in spec.parts]
    assert meta["tx_candidates"] == 900 and meta["tx_kept"] == 20
    assert meta["solver"]["samples_per_src"] == 500 and meta["solver"]["max_depth"] == 1
    np.testing.assert_allclose(meta["frequencies_read_back_hz"], scene.frequencies_hz, rtol=1e-6)
    assert set(meta["generator"]["versions"]) == set(jobs.PACKAGES)
    assert [entry["frequency_ghz"] for entry in meta["ceilings"]] == [2.4, 60.0]
    for entry in meta["ceilings"]:
        assert entry["order<=1"] == 1.0  # depth 1: nothing is left out
        assert entry["order<=0"] < 1 and entry["phase_blind"] < 1
    assert str(uninterrupted.parent) not in json.dumps(meta)


def test_interrupted_and_resumed_equals_uninterrupted(uninterrupted, tmp_path, monkeypatch):
    from data_gen.solve import Simulator

    original, calls = Simulator.paths, []

    def interrupted(self, positions):
        calls.append(len(positions))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return original(self, positions)

    monkeypatch.setattr(Simulator, "paths", interrupted)
    with pytest.raises(KeyboardInterrupt):
        generate(options(tmp_path))
    assert not options(tmp_path).out.exists()
    resumed = generate(options(tmp_path))
    # Per frequency two batches and one call for the ceilings: one call was lost, none repeated.
    assert len(calls) == 6 + 1
    assert resumed.read_bytes() == uninterrupted.read_bytes()
    generate(options(tmp_path))
    assert len(calls) == 7


@pytest.mark.slow
def test_two_processes_give_the_same_bytes(uninterrupted, tmp_path):
    assert generate(options(tmp_path, workers=2, threads=1)).read_bytes() == uninterrupted.read_bytes()


def test_transmitters_without_a_path_are_counted(simulator_backend, tmp_path, monkeypatch):
    def nothing(job, frequencies, folder):
        return {"n_paths": np.array([[3, 0], [1, 1], [0, 0]])}

    monkeypatch.setattr(jobs, "collect", nothing)
    monkeypatch.setattr(module, "_compute", lambda *_: None)
    with pytest.raises(UserError, match="2 of 20 transmitters have no path"):
        generate(options(tmp_path))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scene": 99}, "no scene 99"),
        ({"frequencies": (200.0,)}, "200 GHz is outside"),
        ({"out": None}, "--out"),
        ({"workers": 0}, "--workers"),
        ({"max_tx": 0}, "--max-tx"),
        ({"samples": 0}, "--samples"),
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


def test_the_checksum_sees_settings_but_not_frequencies(monkeypatch):
    monkeypatch.setattr(jobs, "versions", lambda: {"sionna-rt": "any"})  # the simulator need not be installed
    spec = get_scene(1)
    job = module._job(Options(max_tx=5, frequencies=(5.0,)), spec)
    assert job.digest("llvm") == module._job(Options(max_tx=5), spec).digest("llvm")
    settings = [{"samples_per_src": 7}, {"max_depth": 2}, {"diffraction": False}, {"seed": 1}, {"tx_per_call": 2}]
    others = [dataclasses.replace(job, settings=dataclasses.replace(job.settings, **change)) for change in settings]
    others += [
        dataclasses.replace(job, tx_positions=job.tx_positions[:-1]),
        dataclasses.replace(job, spec=dataclasses.replace(spec, rx_position=(0.0, 0.0, 1.0))),
        dataclasses.replace(job, spec=dataclasses.replace(spec, parts=spec.parts[:-1])),
    ]
    digests = {job.digest("llvm"), job.digest("cuda"), *(other.digest("llvm") for other in others)}
    assert len(digests) == len(others) + 2


@pytest.mark.skipif(importlib.util.find_spec("sionna") is None, reason="sionna-rt is not installed")
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
