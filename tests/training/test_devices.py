"""Several devices and several processes train the field that one trains, and answer what it answers."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import PYTHONPATH, device_runs
from builders.toys import RippleField, registered, toy_settings

from wbgs_jax._util.devices import (
    COORDINATOR,
    COUNT,
    NUMBER,
    any_process,
    by_first,
    check_alike,
    connect,
    devices_for,
    is_first,
    over_all_links,
    own_devices,
)
from wbgs_jax._util.errors import UserError
from wbgs_jax.training import curves
from wbgs_jax.training.checkpoint import checkpoint_steps
from wbgs_jax.training.loop import Run, train

SCRIPT = Path(device_runs.__file__)
QUICK = ("nerf2", "wideband")
REST = ("wrfgs", "wave", "hybrid")
ASKED_AGREE = 1e-3
"""Of spectra, 0 to 1: phases at 94 GHz are the last digits of path lengths, and other programs round them otherwise."""
AGREE = 1e-3
"""Relative: what eight steps of Adam make of the last bit of a sum, at these large learning rates."""


def started(folder: Path, names: tuple[str, ...], devices: int = 1, **environment: str) -> subprocess.Popen:
    # Devices that are more than the cores wait for each other: longer than XLA has patience, on a machine that is busy.
    flags = f"--xla_force_host_platform_device_count={devices} --xla_cpu_collective_call_terminate_timeout_seconds=600"
    flags += " --xla_cpu_collective_timeout_seconds=600"
    flags = f"{os.environ.get('XLA_FLAGS', '')} {flags}"
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": PYTHONPATH} | environment
    command = [sys.executable, str(SCRIPT), str(folder), *names]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def last_line(process: subprocess.Popen) -> list[str]:
    out, err = process.communicate(timeout=1500)
    assert process.returncode == 0, err
    return out.splitlines()[-1].split()


def in_two_processes(folder: Path, names: tuple[str, ...]) -> None:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    both = [started(folder, names, **{COORDINATOR: address, COUNT: "2", NUMBER: str(number)}) for number in range(2)]
    try:
        assert [last_line(process)[0] for process in both] == ["2", "2"]
    finally:
        for process in both:
            process.kill()


def assert_same_curves(folder: Path, other: Path) -> None:
    a, b = (curves.read(f / "metrics.jsonl") for f in (folder, other))
    assert len(a) == len(b) >= 2
    for x, y in zip(a, b, strict=True):
        assert x.keys() == y.keys()
        for name in x.keys() - {"seconds"}:
            if isinstance(x[name], float):
                np.testing.assert_allclose(x[name], y[name], rtol=AGREE, err_msg=name)
            else:
                assert x[name] == y[name], name  # numbers of Gaussians, what density control did


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Folders of what one device trains, by field."""
    folder, dataset = tmp_path_factory.mktemp("alone"), device_runs.data()

    def run(name):
        if not (folder / name).exists():
            train(dataset, name, device_runs.settings_of(name), 0, folder / name)
        return folder / name

    return run


@pytest.mark.heavy
@pytest.mark.parametrize("names", [QUICK, pytest.param(REST, marks=pytest.mark.slow)], ids=" ".join)
def test_four_devices_train_and_answer_as_one_does(names, alone, tmp_path):
    count, divided, difference = last_line(started(tmp_path, names, devices=4))
    assert count == divided == "4" and float(difference) < ASKED_AGREE
    for name in names:
        assert_same_curves(tmp_path / name, alone(name))


@pytest.mark.heavy
@pytest.mark.parametrize("names", [QUICK[1:], pytest.param(("nerf2", *REST), marks=pytest.mark.slow)], ids=" ".join)
def test_two_processes_train_as_one_does(names, alone, tmp_path):
    in_two_processes(tmp_path, names)
    for name in names:
        assert_same_curves(tmp_path / name, alone(name))
        assert checkpoint_steps(tmp_path / name / "checkpoints") == [4, 8]


def test_one_device_is_left_alone():
    devices, idle = devices_for(8)
    tree = {"a": np.arange(3)}
    assert devices.mesh is None and devices.count == own_devices().count == 1 and not idle
    assert devices.replicated(tree) is tree and devices.own(tree) is tree and devices.kept(tree)[0] is tree
    assert over_all_links(jnp.asarray(2.0)) == 2


def test_too_many_devices_are_an_error_for_people(tmp_path):
    with registered(RippleField), pytest.raises(UserError, match="--devices is 3, but this process has 1"):
        Run(device_runs.data(), "ripple", toy_settings(), 0, tmp_path, devices=3)


def test_devices_that_do_not_divide_a_batch_stay_idle(monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: 6)
    devices, idle = devices_for(8)
    assert devices.mesh is None  # this process has one of them only
    assert idle == "a batch of 8 links uses 4 of 6 devices; --optim.batch 12 would use all"
    assert devices_for(8, 4)[1] == devices_for(12)[1] == ""


def test_processes_that_do_not_divide_a_batch_are_an_error(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    with pytest.raises(UserError, match="3 processes cannot share a batch of 8 links evenly"):
        devices_for(8)


def test_a_single_process_asks_nobody():
    assert is_first() and any_process(True) and not any_process(False)
    check_alike({"a": np.zeros(2)}, "nothing")
    done = []
    by_first(lambda: done.append(1))
    assert done == [1]


def test_an_error_of_the_first_process_stops_all(monkeypatch):
    def fails():
        raise UserError("no space")

    with pytest.raises(UserError, match="no space"):
        by_first(fails)
    monkeypatch.setattr("wbgs_jax._util.devices.is_first", lambda: False)
    monkeypatch.setattr("wbgs_jax._util.devices.any_process", lambda flag: True)
    with pytest.raises(UserError, match="stops because the first one failed"):
        by_first(fails)


def test_processes_that_differ_are_told_so(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr("wbgs_jax._util.devices._gathered", lambda own: np.stack([own, own + 1]))
    with pytest.raises(UserError, match="the state of process 1 and of the first one differ"):
        check_alike({"a": np.zeros(2)}, "the state")


def test_nobody_to_connect_to_is_an_error_for_people(monkeypatch):
    monkeypatch.setenv(COORDINATOR, "")
    with pytest.raises(UserError, match="--distributed: the processes cannot connect"):
        connect()
