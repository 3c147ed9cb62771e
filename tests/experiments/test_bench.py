"""The benchmark suite: its figures, its gate, and PyTorch's renderer, which must draw the same image to be compared with."""

import json

import jax
import numpy as np
import pytest

from experiments.bench import __main__ as command_line
from experiments.bench import gate, quality, renderer, timing
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError


def figure(value, unit="x", direction="higher"):
    return {"value": value, "unit": unit, "direction": direction, "spread": 0.0, "tolerance": 0.25}


# Figures


def test_a_figure_is_the_median_with_its_interquartile_range():
    report = timing.Report()
    report.add_time("step", np.array([5.0, 1.0, 2.0, 4.0, 3.0]) / 1e3)
    assert report.metrics == {"step": {"value": 3, "unit": "ms", "direction": "lower", "spread": 2, "tolerance": 0.5}}
    report.add("ratio", 12.3456, "x", "higher")
    assert report.metrics["ratio"] == {"value": 12.35, "unit": "x", "direction": "higher", "spread": 0, "tolerance": 0.25}


def test_competitors_take_turns_and_the_timed_call_follows_an_untimed_one():
    calls = []
    competitors = {name: lambda name=name: calls.append(name) for name in "ab"}
    seconds = timing.interleaved(competitors, timing.Effort(repeats=3))
    turn = "a" * (1 + timing.SHORT_REPEATS) + "b" * (1 + timing.SHORT_REPEATS)
    assert calls == list("ab" + "ab" + turn * 3)  # compile, try, rounds
    assert {name: len(times) for name, times in seconds.items()} == {"a": 3, "b": 3}


@pytest.fixture
def clock(monkeypatch):
    """A clock that only `clock.now` moves."""

    class Clock:
        now = 0.0

        def perf_counter(self):
            return self.now

    monkeypatch.setattr(timing, "time", clock := Clock())
    return clock


def test_the_times_are_those_of_the_calls(clock):
    def takes(seconds):
        def call():
            clock.now += seconds

        return call

    seconds = timing.interleaved({"a": takes(1.0), "b": takes(3.0), "slow": takes(31.0)}, timing.Effort(repeats=5))
    np.testing.assert_allclose(seconds["a"], [1] * 5)
    np.testing.assert_allclose(seconds["b"], [3] * 5)
    assert "slow" not in seconds


def test_a_short_call_counts_with_a_median_and_a_long_one_once(clock):
    pauses = iter([0.01, 0.04, 0.01, 0.01, 0.02, 0.3])

    def call():
        clock.now += next(pauses)

    assert timing.timed_often(call) == pytest.approx(0.01)
    assert timing.timed_often(call) == pytest.approx(0.3)


def test_rounds_end_with_the_budget_but_not_before_the_third(clock):
    def call():
        clock.now += 10.0

    assert len(timing.interleaved({"a": call}, timing.Effort(repeats=9, budget_s=70))["a"]) == 4
    assert len(timing.interleaved({"a": call}, timing.Effort(repeats=9, budget_s=1))["a"]) == timing.MIN_ROUNDS


def test_a_ratio_takes_the_fastest_competitor():
    seconds = {
        renderer.Competitor("torch_groups_fwd_bwd", 8, 1): np.array([3.0, 3.0, 3.0]),
        renderer.Competitor("torch_groups_fwd_bwd", 8, 2): np.array([2.0, 2.0, 9.0]),
        renderer.Competitor("torch_slots_fwd_bwd", 1, 1): np.array([1.0, 1.0, 1.0]),
    }
    np.testing.assert_array_equal(renderer.fastest(seconds, ("torch_groups_fwd_bwd", "torch_slots_fwd_bwd"), 8), [2, 2, 9])
    assert renderer.fastest(seconds, ("dense_fwd_bwd",), 8) is None


def test_sizes_name_the_figures():
    assert renderer.Size(2000).tag(8) == "n2k_b8" and renderer.Size(300).tag(1) == "n300_b1"


def test_time_to_quality_is_the_first_crossing():
    curve = quality.Curve([1.0, 2.0, 3.0], [0.5, 0.8, 0.7])
    assert (curve.time_to(0.5), curve.time_to(0.7), curve.time_to(0.81)) == (1.0, 2.0, None)


def test_compilations_are_counted_by_function_and_cached_calls_are_none():
    @jax.jit
    def counted_epoch(x):
        return x + 1

    curve = quality.Curve()
    with quality.compilations(curve.compiled):
        for size in (2, 2, 3):
            counted_epoch(np.ones(size, np.float32))
    counted_epoch(np.ones(4, np.float32))
    assert curve.compilations_of("counted_epoch") == 2 and curve.compilations_of("another") == 0


# The gate


@pytest.mark.parametrize(
    ("value", "before", "direction", "worse"),
    [(8, 10, "higher", 0.2), (12, 10, "higher", -0.2), (12, 10, "lower", 0.2), (8, 10, "lower", -0.2), (1, 0, "lower", 0)],
)
def test_worse_means_against_the_direction(value, before, direction, worse):
    new, old = figure(value, direction=direction), figure(before, direction=direction)
    assert gate.worsening(new, old) == pytest.approx(worse)


def test_the_gate_stops_a_regressed_ratio_and_names_it():
    old = {"ratio_a": figure(10.0), "ratio_b": figure(10.0)}
    gate.check({"ratio_a": figure(7.6), "ratio_b": figure(40.0)}, old)
    with pytest.raises(UserError, match=r"1 of 2 ratios regressed: ratio_a is 7.4 x and was 10 x \(tolerance 25%\)") as error:
        gate.check({"ratio_a": figure(7.4), "ratio_b": figure(40.0)}, old)
    assert "\n" not in str(error.value)


def test_the_gate_looks_at_ratios_only():
    old = {"ratio": figure(10.0), "step": figure(1.0, "ms", "lower"), "gone": figure(3.0)}
    gate.check({"ratio": figure(10.0), "step": figure(99.0, "ms", "lower"), "new": figure(0.1)}, old)
    with pytest.raises(UserError, match="nothing to compare"):
        gate.check({"step": figure(1.0, "ms", "lower"), "new": figure(0.1)}, old)


def test_figures_older_than_tolerances_can_be_compared():
    old = {key: value for key, value in figure(10.0).items() if key != "tolerance"}
    with pytest.raises(UserError, match="regressed"):
        gate.check({"ratio": figure(1.0)}, {"ratio": old})
    assert gate.change(figure(1.0), old) == "-90% worse"


def test_changes_are_called_what_they_are():
    times = [gate.change(figure(value, "ms", "lower"), figure(10.0, "ms", "lower")) for value in (11.0, 20.0, 5.0)]
    assert times == ["+10%", "+100% worse", "-50% better"]
    assert gate.change(figure(1.0), None) == "new"


# The command


@pytest.fixture
def ratio(monkeypatch, compilation_cache):
    """Replaces all parts by two that measure nothing; call it to set the ratio that the first one finds."""
    values = {}
    monkeypatch.setattr(
        command_line,
        "PARTS",
        {
            "renderer": lambda report, effort: report.add("ratio", values["ratio"], "x", "higher"),
            "training": lambda report, effort: report.add("step", 1.0, "ms", "lower"),
        },
    )
    return lambda value: values.update(ratio=value)


def run_bench(folder, capsys, **options):
    """Exit code and what stands on stderr."""
    try:
        run_command(lambda: command_line.bench(command_line.Command(out=folder, **options)))
        code = 0
    except SystemExit as stop:
        code = stop.code
    return code, capsys.readouterr().err.splitlines()


def result(folder):
    return json.loads((folder / "bench_cpu.json").read_text())


def test_a_whole_run_becomes_the_baseline(tmp_path, capsys, ratio):
    ratio(10.0)
    assert run_bench(tmp_path, capsys)[0] == 0
    written = result(tmp_path)
    assert written["metrics"].keys() == {"ratio", "step"}
    assert {"version", "commit", "device", "jax", "torch", "cores", "load", "repeats", "seed"} <= written["environment"].keys()
    assert written["environment"]["parts"].keys() == {"renderer", "training"}


def test_a_regression_exits_with_2_and_one_line_and_leaves_the_baseline(tmp_path, capsys, ratio):
    ratio(10.0)
    run_bench(tmp_path, capsys)
    before = (tmp_path / "bench_cpu.json").read_bytes()
    ratio(5.0)
    code, lines = run_bench(tmp_path, capsys, gate=True)
    assert code == 2 and len(lines) == 1
    assert lines[0].startswith("error: 1 of 1 ratios regressed: ratio is 5 x and was 10 x")
    ratio(11.0)
    assert run_bench(tmp_path, capsys, gate=True)[0] == 0
    assert (tmp_path / "bench_cpu.json").read_bytes() == before


def test_an_accepted_regression_is_the_new_baseline(tmp_path, capsys, ratio):
    ratio(10.0)
    run_bench(tmp_path, capsys)
    ratio(5.0)
    run_bench(tmp_path, capsys, gate=True, update=True)
    assert result(tmp_path)["metrics"]["ratio"]["value"] == 5
    assert run_bench(tmp_path, capsys, gate=True)[0] == 0


def test_a_gate_without_a_baseline_measures_nothing(tmp_path, capsys, ratio):
    code, lines = run_bench(tmp_path, capsys, gate=True)
    assert code == 2 and len(lines) == 1 and "there is no baseline" in lines[0]


def test_parts_are_written_on_request_and_leave_the_others(tmp_path, capsys, ratio):
    ratio(10.0)
    run_bench(tmp_path, capsys)
    ratio(20.0)
    run_bench(tmp_path, capsys, only=("renderer",))
    assert result(tmp_path)["metrics"]["ratio"]["value"] == 10
    run_bench(tmp_path, capsys, only=("renderer",), update=True)
    written = result(tmp_path)
    assert written["metrics"]["ratio"]["value"] == 20 and "step" in written["metrics"]
    assert written["environment"]["parts"].keys() == {"renderer", "training"}
