"""Answering queries with a field of the device's preset, everything planned that does not depend on the query."""

import functools
import tempfile
from pathlib import Path

import numpy as np

from experiments.bench.timing import Effort, Report, interleaved, timed
from experiments.bench.training import start_run
from wbgs_jax._util.cli import say
from wbgs_jax.inference.predictor import BLOCK, render_pas

QUERIES = 1000


def measure(report: Report, effort: Effort) -> None:
    """Throughput with the images in the host's memory, latency of one query inside of `jit` and outside, compilation."""
    count = 2 * BLOCK if effort.quick else QUERIES
    say(f"queries: {count} in blocks of {BLOCK}")
    with tempfile.TemporaryDirectory() as folder:
        run = start_run(effort, Path(folder))
    index = np.random.default_rng(effort.seed).choice(run.dataset.validation, count)
    blocks = [run.dataset.query(np.resize(index[i : i + BLOCK], BLOCK)) for i in range(0, count, BLOCK)]
    single = run.dataset.query(index[:1])
    plan = run.field.plan(run.state.params, run.dataset.receiver())
    predictor = functools.partial(render_pas, run.field, run.state.params, plan)
    first = timed(lambda: predictor(blocks[0]))
    calls = {
        "all": lambda: [np.asarray(predictor(block)) for block in blocks],
        "single": lambda: predictor(single),
        "outside": lambda: run.field.render(run.state.params, plan, single),
    }
    seconds = interleaved(calls, effort)
    report.add(f"compile_s_queries_b{BLOCK}", first, "s", "lower")
    report.add_sample("queries_per_s", count / seconds["all"], "1/s", "higher")
    report.add_time("single_query", seconds["single"])
    report.add_time("single_query_outside_of_jit", seconds["outside"])
