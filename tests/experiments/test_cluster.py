"""Jobs on a Dask cluster: the results of a serial run to the bit, whoever is killed on the way."""

import contextlib
import dataclasses
import os
import signal
import sys
import threading
import time

import cloudpickle
import pytest

from data_gen import cluster
from experiments import runner
from experiments.jobs import Job
from experiments.results import Results
from wbgs_jax._util.errors import UserError

cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers cannot import tests
TIMES = ("wall_seconds", "training_seconds", "evaluation_seconds", "environment")
"""What may differ: times, and the commit, where somebody works in the tree meanwhile."""


def untimed(command, job):
    found = Results(command.profile, command.results).get(job)
    return {name: value for name, value in found.values.items() if name not in TIMES}


def elsewhere(command, tmp_path, **changes):
    return dataclasses.replace(command, results=tmp_path / "other", runs=tmp_path / "more", **changes)


def killed_once(number, folder):
    """The process is gone at the second task, but not at its second try."""
    begun = folder / str(number)
    if number == 1 and not begun.exists():
        begun.write_text("begun")
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 2:
        raise ValueError("as it should be")
    return number**2


@pytest.mark.heavy
def test_a_killed_worker_loses_nothing_and_an_error_stops_no_other(tmp_path):
    with cluster.connected("local", 2) as client:
        found = {task: (said, str(error)) for task, said, error in cluster.finished(client, killed_once, range(4), tmp_path)}
        assert found == {0: (0, "None"), 1: (1, "None"), 2: (None, "as it should be"), 3: (9, "None")}
        assert (tmp_path / "1").exists()
        begin = time.monotonic()
        with pytest.raises(TimeoutError):
            list(cluster.finished(client, time.sleep, [20, 20, 20], seconds=0.5))
        assert time.monotonic() - begin < 10


@pytest.mark.slow
@pytest.mark.usefixtures("scene")
def test_a_cluster_has_the_results_of_a_serial_run(command, tmp_path, capsys):
    jobs = [Job("1", "baselines", combination, all_tx=True, profile="smoke") for combination in ("C3", "C4")]
    there = elsewhere(command, tmp_path, cluster="local", workers=2)
    assert runner.run(jobs, command) == []
    assert runner.run(jobs, there) == []
    for job in jobs:
        assert untimed(there, job) == untimed(command, job)
    assert not list((there.runs / "smoke").iterdir())
    said = capsys.readouterr().err
    assert "2 jobs: 2 left" in said and all(f"{job.name}: " in said for job in jobs)
    assert runner.run(jobs, there) == []
    assert "2 jobs: 0 left" in capsys.readouterr().err


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense"])
def test_a_scheduler_that_is_not_there_is_one_line(address, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_S", "300ms")
    with pytest.raises(UserError, match="no Dask scheduler answers at"), cluster.connected(address, 1):
        pass


def test_without_dask_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UserError, match=r"pip install 'wbgs-jax\[cluster\]'"), cluster.connected("local", 1):
        pass


class Killer:
    """Kills the worker that has a job, as soon as it has left something, and notes when that was written last."""

    def __init__(self, client, part):
        self.client, self.part, self.killed, self.written = client, part, None, set()
        self.thread = threading.Thread(target=self.watch, daemon=True)
        self.thread.start()

    def watch(self):
        while self.killed is None or self.part.exists():
            if self.killed is None and self.part.exists():
                (self.killed,) = (worker for worker, tasks in self.client.processing().items() if tasks)
                os.kill(self.client.run(os.getpid)[self.killed], signal.SIGKILL)
            with contextlib.suppress(OSError):
                self.written.add(self.part.stat().st_mtime_ns)
            time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.usefixtures("scene")
def test_a_job_whose_worker_is_killed_goes_on_where_it_stopped(command, tmp_path, monkeypatch):
    """A model for each of ten frequencies: those that are done when the worker is killed are not done again."""
    job, killers = Job("1", "wrfgs", profile="smoke"), []
    there = elsewhere(command, tmp_path, cluster="local", workers=2)
    part, connected = there.runs / "smoke" / job.name / "1GHz" / "part.npz", runner.connected

    @contextlib.contextmanager
    def watched(*arguments):
        with connected(*arguments) as client:
            killers.append(Killer(client, part))
            yield client

    monkeypatch.setattr(runner, "connected", watched)
    assert runner.run([job], command) == []
    assert runner.run([job], there) == []
    (killer,) = killers
    assert killer.killed and len(killer.written) == 1
    assert untimed(there, job) == untimed(command, job)
