"""Run experiments: `python -m experiments.runner [--profile quick] [--only table1] [--minutes 9]`.

Without `--only` these are the tables and figures of the paper; the series (`--only choices`, `tuning`, `wave_choices`) are run
by name. Jobs come in the order of importance: every experiment's first seed, then further ones, of those that see more spectra
after the others. Finished jobs are skipped, interrupted ones resume where they stopped, however they ended. `--cluster local`
does several jobs at once, `--cluster tcp://...` on the workers of any Dask scheduler (docs/cluster.md). `make tables` shows the
results.
"""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # read with JAX; see wbgs_jax/_util/quiet.py

# isort: split

import dataclasses
import shutil
import signal
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import tyro

from data_gen.cluster import connected, finished
from experiments.catalogue import EXPERIMENTS, unique_jobs
from experiments.execute import execute
from experiments.jobs import Job
from experiments.paper import DENSE_SCENE
from experiments.results import FOLDER, Results
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax.training.loop import Interrupted
from wbgs_jax.training.run_folder import Taken, locked

RUNS = Path("runs/experiments")
GO_ON = "the time is up: run the same command again to go on"


@dataclass(frozen=True)
class Command:
    """Run the experiments that have no result yet."""

    profile: Literal["quick", "paper", "smoke"] = "quick"
    """quick: two CPU cores, hours. paper: full size, a GPU. smoke: minutes, proves that everything works. The series have sizes
    of their own, and are small with smoke too."""
    only: tuple[str, ...] = ()
    """Experiments: table1, figure7, ..., or a series such as choices; all tables and figures by default."""
    scenes: tuple[str, ...] = ()
    """Scenes (1, 2, ..., 1_21f); all by default."""
    data: str | None = None
    """Run the jobs on this scene file or folder of spectra instead."""
    seeds: tuple[int, ...] = ()
    """Seeds; all by default."""
    fields: tuple[str, ...] = ()
    """Fields (wideband, wrfgs, wave, baselines, ...); all by default."""
    variants: tuple[str, ...] = ()
    """Variants (snr_10, tx_20, missing_30, ...; experiments/variants.py); all by default."""
    minutes: float | None = None
    """Stop after this time; what is cut goes on the next time."""
    dry_run: bool = False
    """List the jobs and what is known of them."""
    results: Path = FOLDER
    runs: Path = RUNS
    """Where unfinished runs are kept. With --cluster every worker has to see both folders."""
    cluster: str | None = None
    """Do the jobs on a Dask cluster: "local", processes on this machine, or the address of a scheduler (tcp://host:8786)."""
    workers: int = 2
    """Processes of `--cluster local`."""


class TimeIsUp(UserError):
    """The time limit, outside a training (inside one it is `Interrupted`)."""


class Clock:
    """A time limit, and what a signal that ends the runner does: within a training it is saved first."""

    def __init__(self, minutes: float | None):
        self.minutes, self.expired = minutes, False

    def _alarm(self, number: int, frame: object) -> None:
        self.expired = True
        signal.raise_signal(signal.SIGTERM)  # a training defers it to the end of its epoch and saves

    def _terminate(self, number: int, frame: object) -> None:
        raise TimeIsUp("stopped by a signal")

    def may_go_on(self) -> None:
        """Raises when the time is up, which a training does not say that ended at that moment."""
        if self.expired:
            raise TimeIsUp("the time is up")

    def __enter__(self) -> "Clock":
        self.previous = {
            signal.SIGALRM: signal.signal(signal.SIGALRM, self._alarm),
            signal.SIGTERM: signal.signal(signal.SIGTERM, self._terminate),
        }
        if self.minutes is not None:
            signal.setitimer(signal.ITIMER_REAL, max(60 * self.minutes, 1e-3))
        return self

    def __exit__(self, *exception: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in self.previous.items():
            signal.signal(number, handler)


def all_jobs(names: tuple[str, ...] = (), profile: str = "quick") -> list[Job]:
    """Returns the jobs of some experiments, each once: short ones first, then first seeds; repetitions of costly jobs last."""
    if unknown := [name for name in names if name not in EXPERIMENTS]:
        raise UserError(f"there is no experiment {unknown[0]!r}; choose among: {', '.join(EXPERIMENTS)}")
    jobs = list(dict.fromkeys(job.sized(profile) for job in unique_jobs(names)))
    return sorted(jobs, key=lambda job: (job.seed > 0 and (job.budget > 1 or job.field == "wave"), job.budget, job.seed))


def chosen_jobs(command: Command) -> list[Job]:
    """Returns the jobs of a command line."""
    jobs = all_jobs(command.only, command.profile)
    choices = {"scene": command.scenes, "seed": command.seeds, "field": command.fields, "variant": command.variants}
    for name, wanted in choices.items():
        jobs = [job for job in jobs if not wanted or getattr(job, name) in wanted]
    if not jobs:
        raise UserError("no job fits this choice; see `python -m experiments.runner --dry-run`")
    if command.data is None:
        return jobs
    return list(dict.fromkeys(dataclasses.replace(job, scene=command.data) for job in jobs))


class Durations:
    """Durations of jobs, learned from those that are done."""

    def __init__(self, results: Results, jobs: list[Job]):
        self.known: dict[tuple, list[float]] = {}
        for job in jobs:
            if result := results.get(job):
                # Of a job that was cut, the wall clock saw its end alone.
                seconds = max(result.seconds, result.values.get("wall_seconds", 0))
                self.known.setdefault(self.kind(job), []).append(seconds)

    @staticmethod
    def kind(job: Job) -> tuple:
        """Returns what jobs have in common that take about as long."""
        return (job.field, job.profile), job.budget, job.scene == DENSE_SCENE and not job.combination, job.all_tx

    def expect(self, job: Job) -> float | None:
        """Returns seconds; None if no such job is done."""
        model, budget, *_ = kind = self.kind(job)
        known = self.known.get(kind) or [
            s * budget / other[1] for other, seconds in self.known.items() if other[0] == model for s in seconds
        ]
        return statistics.median(known) if known else None

    def left(self, jobs: list[Job]) -> str:
        """Returns the time left, for people."""
        times = [self.expect(job) for job in jobs]
        hours = sum(t for t in times if t is not None) / 3600
        unknown = sum(t is None for t in times)
        return f"{len(jobs)} left, about {hours:.1f} h" + (f" and {unknown} of unknown length" if unknown else "")


def folder_of(job: Job, command: Command) -> Path:
    """Returns where an unfinished run is kept."""
    return command.runs / job.profile / job.name


def run_job(job: Job, command: Command, may_go_on: Callable[[], None] = lambda: None) -> str:
    """Run one job, here or on a worker, unless it is done or another process has it; returns what became of it."""
    use_compilation_cache()
    folder, results = folder_of(job, command), Results(command.profile, command.results)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with locked(folder):
            if results.get(job):
                return "done meanwhile"
            return executed(job, folder, results, may_go_on)
    except Taken:
        return "another process has it"


def executed(job: Job, folder: Path, results: Results, may_go_on: Callable[[], None]) -> str:
    """Do a job, write its result, and remove what it left on the way; returns its score and its time for people."""
    begin = time.perf_counter()
    try:
        values, pictures = execute(job, folder, may_go_on)
    finally:
        jax.clear_caches()  # otherwise every job's compiled programs stay in memory
    seconds = time.perf_counter() - begin
    results.write(job, values | {"wall_seconds": round(seconds, 1)}, pictures)
    shutil.rmtree(folder, ignore_errors=True)
    score = f"SSIM {values['average_of_medians']:.3f}, " if "average_of_medians" in values else ""
    return f"{score}{seconds:.0f} s"


def run(jobs: list[Job], command: Command) -> list[str]:
    """Run jobs in order until they are done or the time is up; returns one line for every job that failed."""
    results = Results(command.profile, command.results)
    open_jobs = [job for job in jobs if results.get(job) is None]
    say(f"{len(jobs)} jobs: {Durations(results, jobs).left(open_jobs)}")
    return (run_on_cluster if command.cluster else run_here)(jobs, open_jobs, command)


def run_here(jobs: list[Job], open_jobs: list[Job], command: Command) -> list[str]:
    """Run jobs one after the other in this process."""
    results, failures = Results(command.profile, command.results), list[str]()
    with Clock(command.minutes) as clock:
        for i, job in enumerate(open_jobs):
            try:
                say(f"{job.name} ...")
                outcome = run_job(job, command, clock.may_go_on)
                say(f"{job.name}: {outcome}; {Durations(results, jobs).left(open_jobs[i + 1 :])}")
                clock.may_go_on()
            except (Interrupted, TimeIsUp):
                if not clock.expired:
                    raise
                say(GO_ON)
                break
            except Exception as error:  # whatever it is, the other jobs are worth running
                failures.append(f"{job.name}: {one_line(error)}")
                say(f"{failures[-1]}")
    return failures


def run_on_cluster(jobs: list[Job], open_jobs: list[Job], command: Command) -> list[str]:
    """Lets the workers of a Dask cluster run jobs. Another worker resumes the job of a killed one where it stopped."""
    results, failures, left = Results(command.profile, command.results), list[str](), list(open_jobs)
    everywhere = dataclasses.replace(command, results=command.results.resolve(), runs=command.runs.resolve())
    seconds = None if command.minutes is None else 60 * command.minutes
    with connected(command.cluster or "", command.workers) as client:
        try:
            for job, outcome, error in finished(client, run_job, open_jobs, everywhere, seconds=seconds):
                left.remove(job)
                failures += [f"{job.name}: {one_line(error)}"] if error else []
                say(f"{job.name}: {one_line(error) if error else outcome}; {Durations(results, jobs).left(left)}")
        except TimeoutError:
            say(GO_ON)
    return failures


def one_line(error: Exception) -> str:
    """Returns an error for people; of a mistake in the code, its kind too."""
    text = (str(error).splitlines() or [""])[0]
    return text if isinstance(error, UserError) else f"{type(error).__name__}: {text}"


def listing(jobs: list[Job], command: Command) -> str:
    """Returns one line a job: done, begun or open, and the time it takes."""
    results = Results(command.profile, command.results)
    durations = Durations(results, jobs)
    lines = []
    for job in jobs:
        begun = folder_of(job, command).exists()
        state = "done" if results.get(job) else "begun" if begun else "open"
        seconds = durations.expect(job)
        lines.append(f"{state:6} {'?' if seconds is None else f'{seconds:.0f}':>6} s  {job.profile}/{job.name}")
    open_jobs = [job for job in jobs if results.get(job) is None]
    return "\n".join([*lines, f"{len(jobs)} jobs: {durations.left(open_jobs)}"])


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.runner")
    jobs = chosen_jobs(command)
    if command.dry_run:
        print(listing(jobs, command))
        return
    if failures := run(jobs, command):
        raise UserError(f"{len(failures)} of {len(jobs)} jobs failed: " + "; ".join(failures))


if __name__ == "__main__":
    run_command(main)
