"""The runner: what is done is skipped, what was cut goes on, no job is done twice, no failure stops the others."""

import dataclasses
import signal
import subprocess
import sys
import threading
import time

import pytest

from experiments import runner
from experiments.jobs import Job
from experiments.results import Results
from experiments.variants import VARIANTS
from wbgs_jax._util.cli import run_command

JOB = Job("1", "wideband", profile="smoke")
VALUES = {
    "average_of_medians": 0.5,
    "training_seconds": 1.0,
    "evaluation_seconds": 0.1,
    "wall_seconds": 1.2,
    "ssim": {"1": [0.5]},
    "tx": [0],
}


@pytest.fixture
def calls(monkeypatch):
    """Jobs that were executed, by a stand-in that takes no time."""
    executed = []

    def stand_in(job, folder, may_go_on):
        executed.append(job.name)
        return VALUES, None

    monkeypatch.setattr(runner, "execute", stand_in)
    return executed


def result_of(command, job=JOB):
    return Results(command.profile, command.results).get(job)


@pytest.mark.heavy
def test_every_job_is_done_once(command, calls):
    wanted = [dataclasses.replace(JOB, seed=seed) for seed in range(3)]
    assert runner.run(wanted[:2], command) == []
    assert runner.run(wanted, command) == []
    assert calls == [job.name for job in wanted]


def test_a_failing_job_does_not_stop_the_others(command, calls, monkeypatch, capsys):
    succeed = runner.execute
    broken = Job("1", "wave", profile="smoke")

    def execute_most(job, *others):
        if job == broken:
            raise ZeroDivisionError("no paths\nand more")
        return succeed(job, *others)

    monkeypatch.setattr(runner, "execute", execute_most)
    monkeypatch.setattr(sys, "argv", ["runner", "--profile", "smoke", "--scenes", "1", "--seeds", "0", "--only", "table1"])
    monkeypatch.setattr(runner.tyro, "cli", lambda *_, **__: dataclasses.replace(command, scenes=("1",), only=("table1",)))
    with pytest.raises(SystemExit) as stop:
        run_command(runner.main)
    assert stop.value.code == 2
    assert len(calls) == len([job for job in runner.all_jobs(("table1",), "smoke") if job.scene == "1"]) - 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == f"error: 1 of {len(calls) + 1} jobs failed: scene1_wave_seed0: ZeroDivisionError: no paths"


def test_two_at_once_do_not_do_the_same_job(command, monkeypatch):
    executed, together = [], threading.Barrier(2)

    def slow(job, *others):
        executed.append(job.name)
        time.sleep(0.3)
        return VALUES, None

    def run_one():
        together.wait()
        said.append(runner.run_job(JOB, command))

    monkeypatch.setattr(runner, "execute", slow)
    said: list[str] = []
    threads = [threading.Thread(target=run_one) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert executed == [JOB.name]
    assert "another process has it" in said or "done meanwhile" in said


def test_the_lock_of_a_killed_process_is_free(command, calls):
    lock = command.runs / command.profile / JOB.name / "training.lock"
    lock.parent.mkdir(parents=True)
    hold = "import fcntl, sys, time; f = open(sys.argv[1], 'w'); fcntl.flock(f, fcntl.LOCK_EX); print('held'); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-u", "-c", hold, str(lock)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        runner.run([JOB], command)
        assert calls == []
        holder.kill()
    runner.run([JOB], command)
    assert calls == [JOB.name]


def test_the_time_limit_holds_outside_a_training(command, monkeypatch, capsys):
    monkeypatch.setattr(runner, "execute", lambda *_: time.sleep(60))
    begin = time.monotonic()
    assert runner.run([JOB, dataclasses.replace(JOB, scene="2")], dataclasses.replace(command, minutes=0.005)) == []
    assert time.monotonic() - begin < 10
    assert "the time is up" in capsys.readouterr().err
    assert result_of(command) is None


def test_a_signal_from_outside_stops_everything(command, monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(runner, "execute", lambda *_: signal.raise_signal(signal.SIGTERM))
    with pytest.raises(runner.TimeIsUp):
        runner.run([JOB], command)
    assert signal.getsignal(signal.SIGTERM) == before


def test_jobs_come_in_the_order_of_importance():
    listed = runner.all_jobs()
    assert listed[0] == Job("1", "wideband")
    costly = [job for job in listed if job.seed and (job.budget > 1 or job.field == "wave")]
    cheap = [job for job in listed if job not in costly]
    assert listed == cheap + costly
    for some in (cheap, costly):
        order = [(job.budget, job.seed) for job in some]
        assert order == sorted(order)


@pytest.mark.usefixtures("calls")
def test_times_of_another_budget_are_scaled(command):
    runner.run([JOB], command)
    durations = runner.Durations(Results(command.profile, command.results), [JOB])
    usual = durations.expect(dataclasses.replace(JOB, scene="2"))
    assert durations.expect(dataclasses.replace(JOB, variant="long")) == usual * VARIANTS["long"].budget > 0


def test_a_listing_says_what_is_done(command, calls):
    wanted = [JOB, dataclasses.replace(JOB, scene="2"), dataclasses.replace(JOB, field="wave")]
    runner.run(wanted[:1], command)
    (command.runs / "smoke" / "scene1_wave_seed0").mkdir()
    done, same_kind, begun, total = runner.listing(wanted, command).splitlines()
    assert done.split() == ["done", "1", "s", "smoke/scene1_wideband_seed0"]
    assert same_kind.split() == ["open", "1", "s", "smoke/scene2_wideband_seed0"]
    assert begun.split() == ["begun", "?", "s", "smoke/scene1_wave_seed0"]
    assert total == "3 jobs: 2 left, about 0.0 h and 1 of unknown length"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--only", "table9"], "there is no experiment 'table9'; choose among: table1"),
        (["--scenes", "7"], "no job fits this choice"),
    ],
)
def test_a_wrong_choice_is_one_line(arguments, words, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["runner", "--dry-run", *arguments])
    with pytest.raises(SystemExit) as stop:
        run_command(runner.main)
    (line,) = capsys.readouterr().err.splitlines()
    assert stop.value.code == 2 and words in line


def test_series_are_run_when_they_are_asked_for_in_their_own_size():
    assert {job.profile for job in runner.all_jobs()} == {"quick"}
    series = runner.all_jobs(("choices", "tuning", "wave_choices"), "paper")
    assert {job.profile for job in series} == {"choices", "choices_octaves4", "tuning"}
    assert {job.profile for job in runner.all_jobs(("wave_choices", "table1"), "smoke")} == {"smoke"}


def test_faults_are_chosen_by_name(command):
    chosen = runner.chosen_jobs(
        dataclasses.replace(command, only=("robustness",), scenes=("4",), fields=("hybrid",), variants=("snr_10", "tx_20"))
    )
    assert {job.variant for job in chosen} == {"snr_10", "tx_20"} and {job.scene for job in chosen} == {"4"}


def test_jobs_run_on_other_data(command):
    chosen = runner.chosen_jobs(dataclasses.replace(command, only=("choices",), scenes=("1", "2"), data="a/kitchen.npz"))
    assert {job.scene for job in chosen} == {"a/kitchen.npz"} and len({job.name for job in chosen}) == len(chosen)
    assert Job("a/kitchen.npz", "wideband", variant="fusion_2", seed=1, profile="smoke") in chosen
