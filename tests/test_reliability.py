"""What goes wrong outside of the program: one line for people, and nothing that is silently something else."""

import dataclasses
import errno
import fcntl
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from builders.commands import assert_error_for_people, call
from builders.synthetic import tiny_dataset, tiny_scene, tiny_settings
from builders.untrained import make_coherent_run

from wbgs_jax._util import files
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_yaml, safe_name
from wbgs_jax.commands import evaluate as evaluation
from wbgs_jax.commands import predict
from wbgs_jax.data import load_dataset, save_scene
from wbgs_jax.data.dataset import checksum, hold_out_validation
from wbgs_jax.training import checkpoint
from wbgs_jax.training.loop import Run
from wbgs_jax.training.run_folder import FILE, load_trained, locked

SETTINGS = tiny_settings("wave")


@pytest.fixture
def saved(tmp_path):
    """A folder with checkpoints of steps 4 and 8."""
    for step in (4, 8):
        checkpoint.save(tmp_path, step, {"a": np.arange(6.0) + step, "b": np.ones((2, 3))}, {}, {"seconds": 1.5}, keep=3)
    return tmp_path


def test_another_value_in_a_checkpoint_is_told_and_the_one_before_is_named(saved, monkeypatch):
    """Whatever Orbax makes of a flipped bit: it is not what was written."""
    from orbax.checkpoint import v1 as ocp

    original = ocp.load

    def flipped(path):
        found = original(path)
        key = next(key for key in found if key.endswith("['a']"))
        changed = np.asarray(found[key]).copy()
        changed.view(np.uint8)[3] ^= 1
        return found | {key: changed}

    assert checkpoint.read(saved, 8).metadata == {"seconds": 1.5}
    monkeypatch.setattr(ocp, "load", flipped)
    with pytest.raises(UserError, match=r"damaged or incomplete \(its checksum .* delete that folder to use that of step 4"):
        checkpoint.read(saved, 8)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), ValueError("RESOURCE_EXHAUSTED: no space\nmore")])
def test_a_full_disk_leaves_the_checkpoint_before(saved, error, monkeypatch):
    from orbax.checkpoint import v1 as ocp

    def full(path, *_, **__):
        (Path(path).parent / f"{Path(path).name}.orbax-checkpoint-tmp").mkdir()
        raise error

    monkeypatch.setattr(ocp, "save", full)
    with pytest.raises(UserError, match=r"cannot write checkpoint .*; the checkpoint of step 8 is intact") as caught:
        checkpoint.save(saved, 12, {"a": np.zeros(3)}, {}, {}, keep=3)
    assert "\n" not in str(caught.value)
    assert {entry.name for entry in saved.iterdir()} == {"4", "8"}


@pytest.mark.heavy
def test_other_data_under_the_same_name_are_refused(tmp_path):
    """When a training continues, is queried or is scored."""
    run = make_coherent_run(tmp_path / "box")
    stored = checkpoint.read(run / "checkpoints", 5)
    assert "data" not in stored.metadata  # of before checksums: taken as it is
    assert len(load_trained(run).dataset()) == len(tiny_dataset())
    scene, folder = tmp_path / "box.npz", tmp_path / "trained"
    dataset = hold_out_validation(load_dataset(scene))
    Run(dataset, "wave", SETTINGS, 0, folder).save()
    other = hold_out_validation(tiny_dataset(seed=1))
    with pytest.raises(UserError, match="have changed since it was trained"):
        Run(other, "wave", SETTINGS, 0, folder).restore()
    assert Run(dataset, "wave", SETTINGS, 0, folder).restore()
    for entry in (folder / "checkpoints").iterdir():
        entry.rename(run / "checkpoints" / "9")  # newer than the one without
    asked = ["--run", run, "--tx", "1,0,1", "--ghz", "10", "--out", tmp_path / "x.npz"]
    assert call(predict.main, *asked).code == 0
    save_scene(scene, tiny_scene(seed=1))
    assert_error_for_people(call(predict.main, *asked), "have changed since it was trained")


def test_a_checksum_is_of_every_number_and_of_no_name(rng):
    dataset = tiny_dataset()
    assert checksum(dataset) == checksum(tiny_dataset())
    for name in ("tx_positions", "snapshots", "vertices", "frequencies_hz"):
        values = np.asarray(getattr(dataset, name)).copy()
        flat, at = values.reshape(-1), rng.integers(values.size)
        flat[at] = flat[at] * (1 + 1e-6) + 1e-6
        own = {"observations": {name: values}} if name in dataset.observations else {name: values}
        changed = dataclasses.replace(dataset, **own)
        assert checksum(changed) != checksum(dataset), name
    assert checksum(dataclasses.replace(dataset, name="other")) == checksum(dataset)
    moved = dataclasses.replace(dataset, train=dataset.test, test=dataset.train)
    assert checksum(moved) != checksum(dataset)


def _hold(folder, ready):
    with locked(folder):
        ready.set()
        time.sleep(60)


def test_a_file_system_without_locks_is_no_reason_not_to_train(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.warns(UserWarning, match="cannot be locked on its file system"), locked(tmp_path):
        assert (tmp_path / FILE).exists()


@pytest.mark.heavy
def test_two_trainings_never_share_a_folder(tmp_path):
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    first = context.Process(target=_hold, args=(tmp_path, ready))
    first.start()
    try:
        assert ready.wait(60)
        with pytest.raises(UserError, match=f"is being trained by process {first.pid}; wait"), locked(tmp_path):
            pass
    finally:
        os.kill(first.pid, signal.SIGKILL)
        first.join()
    with locked(tmp_path):  # the lock has gone with its process
        assert (tmp_path / FILE).read_text() == f"process {os.getpid()}"
    assert not (tmp_path / FILE).exists()


@pytest.mark.parametrize("name", ["../../x", "/etc/passwd", "..", "", "a b\n", ".hidden", "\x00", "x" * 5000])
def test_names_from_data_are_no_paths(name, tmp_path):
    safe = safe_name(name)
    assert (tmp_path / safe).resolve().parent == tmp_path.resolve() and 0 < len(safe) <= 100
    save_scene(tmp_path / "scene.npz", dataclasses.replace(tiny_scene(), name=name))
    assert load_dataset(tmp_path / "scene.npz").name == safe


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "\n".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 9)}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    "text",
    [
        BOMB,
        "[" * 3000 + "]" * 3000,
        "a: !!python/object:os.system x",
        "a: " + "9" * 5000,
        "x: 2001-99-99",
        "a: [1",
        "k: v\n" * 300_000,
    ],
    ids=["aliases", "nesting", "tag", "digits", "date", "open", "long"],
)
def test_outlandish_yaml_is_refused_at_once(text, tmp_path):
    path = tmp_path / "gateway_info.yml"
    path.write_text(text)
    begin = time.perf_counter()
    with pytest.raises(UserError) as caught:
        read_yaml(path)
    assert time.perf_counter() - begin < 5 and "\n" not in str(caught.value)


def test_a_pipe_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "gateway_info.yml")
    with pytest.raises(UserError, match="is not a file"):
        read_yaml(tmp_path / "gateway_info.yml")


def test_an_archive_that_would_fill_the_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MOST_BYTES", 10_000_000)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.npy", b"\0" * 20_000_000)
    assert (tmp_path / "bomb.npz").stat().st_size < 100_000
    with pytest.raises(UserError, match=r"expands to .* GiB"):
        load_dataset(tmp_path / "bomb.npz")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"tx_positions": 1e39}, "tx_positions contains 1e.39; positions are in metres"),
        ({"vertices": 1e6}, "vertices contains 1e.06"),
        ({"frequencies_hz": 28.0}, "frequencies_hz contains 28; values are in hertz"),
        ({"frequencies_hz": 1e15}, "frequencies_hz contains 1e.15"),
        ({"face_part": -1}, "face_part must not be negative"),
        ({"rx_orientation": 1e300}, "unit quaternions"),
    ],
)
def test_values_that_cannot_be_meant_are_refused_before_they_overflow(changes, said, tmp_path):
    scene = tiny_scene()
    ((name, value),) = changes.items()
    values = np.asarray(getattr(scene, name)).copy()
    values.reshape(-1)[0] = value
    with pytest.raises(UserError, match=said):
        save_scene(tmp_path / "scene.npz", dataclasses.replace(scene, **{name: values}))


@pytest.mark.parametrize("part", [{"thickness": -0.1}, {"thickness": "thick"}, "wall", None, {"thickness": float("inf")}])
def test_what_is_no_part_is_refused(part, tmp_path):
    save_scene(tmp_path / "scene.npz", dataclasses.replace(tiny_scene(), meta={"parts": [part]}))
    with pytest.raises(UserError, match="part 0 of box must be"):
        load_dataset(tmp_path / "scene.npz")


def test_answers_far_away_are_refused(tmp_path):
    run = make_coherent_run(tmp_path / "box")
    asked = ["--run", run, "--ghz", "10", "--out", tmp_path / "x.npz"]
    assert_error_for_people(call(predict.main, *asked, "--tx", "1e9,0,0"), "--tx 1e9,0,0 is not a position")
    assert_error_for_people(call(predict.main, *asked, "--tx", "1,0,1", "--rx", "1e39,0,0"), "--rx 1e39,0,0 is not a receiver")
    assert not (tmp_path / "x.npz").exists()


@pytest.mark.heavy
def test_without_git_results_have_no_commit(tmp_path, monkeypatch):
    run = make_coherent_run(tmp_path / "box")
    monkeypatch.setenv("PATH", str(tmp_path))
    done = call(evaluation.main, "--run", run, "--no-pictures", "--results", tmp_path / "results")
    assert done.code == 0, done.err
    (report,) = (tmp_path / "results").iterdir()
    assert '"commit": null' in report.read_text()


def test_a_reader_that_has_gone_is_no_traceback():
    program = "import sys; from wbgs_jax._util.cli import run_command\nrun_command(lambda: print('x' * 999_999))"
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.read(10)
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 141
    process.stderr.close()


def test_a_flipped_bit_in_a_scene_file_is_no_other_scene(tmp_path, rng):
    """Whatever bit it is: refused, or of no consequence, as one of a file's date."""
    path = tmp_path / "scene.npz"
    save_scene(path, tiny_scene())
    whole, expected, refused = path.read_bytes(), checksum(load_dataset(path)), 0
    for place in rng.integers(len(whole), size=60):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(damaged))
        try:
            assert checksum(load_dataset(path)) == expected, f"byte {place}"
        except UserError:
            refused += 1
    assert refused > 30
