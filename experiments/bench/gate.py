"""Figures beside those of an earlier run on the same device, and the gate that a regression of a ratio does not pass.

Only ratios (unit "x") are gated: both sides of a ratio are measured in one run, while absolute times follow the machine's mood.
"""

from typing import Any

from rich.table import Table

from wbgs_jax._util.errors import UserError

Metrics = dict[str, dict[str, Any]]


def worsening(metric: dict[str, Any], baseline: dict[str, Any]) -> float:
    """By which share a figure is worse than the baseline's; negative if it is better."""
    change = metric["value"] / baseline["value"] - 1 if baseline["value"] else 0.0
    return -change if baseline["direction"] == "higher" else change


def check(metrics: Metrics, baseline: Metrics) -> None:
    """Pass or raise.

    Raises:
        UserError: a ratio is worse than the baseline's by more than its tolerance, or there is no ratio to compare.
    """
    ratios = [name for name, metric in metrics.items() if metric["unit"] == "x" and name in baseline]
    if not ratios:
        raise UserError("the gate has nothing to compare: this run and the baseline share no ratio; measure the renderer too")
    failed = [name for name in ratios if worsening(metrics[name], baseline[name]) > metrics[name]["tolerance"]]
    if failed:
        details = [
            f"{name} is {metrics[name]['value']:g} x and was {baseline[name]['value']:g} x"
            f" (tolerance {metrics[name]['tolerance']:.0%})"
            for name in failed
        ]
        raise UserError(f"{len(failed)} of {len(ratios)} ratios regressed: {'; '.join(details)}; fix or accept with --update")


def merge(result: dict[str, Any], baseline: dict[str, Any]) -> dict[str, Any]:
    """A run of some parts, completed by the baseline's others. The environment is that of the baseline's whole run; its `parts`
    say where each comes from."""
    environment, old = result["environment"], baseline["environment"]
    parts = old.get("parts", {}) | environment["parts"]
    return {"metrics": baseline["metrics"] | result["metrics"], "environment": old | {"parts": parts}}


def change(metric: dict[str, Any], baseline: dict[str, Any] | None) -> str:
    """Such as +12%, with a verdict if it exceeds the tolerance."""
    if baseline is None:
        return "new"
    if not baseline["value"]:
        return ""
    worse, tolerance = worsening(metric, baseline), metric["tolerance"]
    verdict = " worse" if worse > tolerance else " better" if worse < -tolerance else ""
    return f"{metric['value'] / baseline['value'] - 1:+.0%}{verdict}"


def table(metrics: Metrics, baseline: Metrics) -> Table:
    """Every figure beside the baseline's."""
    result = Table("figure")
    for column in ("value", "spread", "unit", "baseline", "change"):
        result.add_column(column, justify="left" if column == "unit" else "right")
    for name, metric in metrics.items():
        old = baseline.get(name)
        before = f"{old['value']:g}" if old else ""
        result.add_row(name, f"{metric['value']:g}", f"{metric['spread']:g}", metric["unit"], before, change(metric, old))
    return result
