"""Reports as tables and files, with the provenance of their figures."""

import platform
import shlex
import subprocess
from pathlib import Path
from typing import Any

import jax
from rich.table import Table

import wbgs_jax
from wbgs_jax.config import to_dict
from wbgs_jax.data.dataset import VALIDATION
from wbgs_jax.data.load import source_names
from wbgs_jax.inference.trained_field import RunConfig, TrainedField


def environment() -> dict[str, Any]:
    """Returns the code version and the device of this process."""
    device = jax.devices()[0]
    return {
        "version": wbgs_jax.__version__,
        "commit": _commit(),
        "device": device.device_kind if device.platform != "cpu" else f"cpu {platform.machine()}",
        "jax": jax.__version__,
    }


def _commit() -> str | None:
    """Returns the commit of the code; None without a repository or git."""
    describe = ["git", "describe", "--always", "--dirty"]
    try:
        git = subprocess.run(describe, capture_output=True, text=True, cwd=Path(__file__).parent, check=False)
    except OSError:
        return None
    return git.stdout.strip() or None


def provenance(trained: TrainedField) -> dict[str, Any]:
    """Returns the provenance of the figures of a trained field."""
    return environment() | {
        "command": "wbgs-jax train " + shlex.join(_training_arguments(trained.config)),
        "preset": trained.config.preset,
        "seed": trained.config.seed,
        "steps": trained.step,
        "training_seconds": round(trained.seconds, 1),
        **trained.field.inspect(trained.params).sizes,
        "settings": to_dict(trained.config.settings, trained.config.field),
    }


def _training_arguments(config: RunConfig) -> list[str]:
    sources = [Path(name) for name in source_names(config.source)]
    data = ["--data" if sources[0].is_dir() else "--scene", ",".join(path.name for path in sources)]
    if config.frequency_ghz is not None:
        data += ["--frequency-ghz", f"{config.frequency_ghz:g}"]
    if config.convention is not None:
        data += ["--convention", config.convention]
    if config.train_ghz:
        data += ["--train-ghz", *(f"{f:g}" for f in config.train_ghz)]
    if config.train_tx:
        data += ["--train-tx", str(config.train_tx)]
    if config.test_box:
        data += ["--test-box", *(f"{x:g}" for x in config.test_box)]
    if config.validation != VALIDATION:
        data += ["--validation", f"{config.validation:g}"]
    if config.receiver is not None:
        data += ["--receiver", str(config.receiver)]
    if not config.neighbours:
        data += ["--no-neighbours"]
    return [*data, "--field", config.field, "--preset", config.preset, "--seed", str(config.seed)]


def device_name() -> str:
    """Returns a short name of the device for file names: cpu, or the GPU's kind."""
    device = jax.devices()[0]
    return "cpu" if device.platform == "cpu" else device.device_kind.lower().replace("nvidia", "").strip().replace(" ", "-")


def result_path(folder: Path, report: dict[str, Any], preset: str) -> Path:
    """Returns FOLDER/quality_<dataset>_<field>_<preset>_<device>.json; parts other than the test are appended to the name."""
    name = f"quality_{report['scene']}_{report['field']}_{preset}_{device_name()}"
    return folder / f"{with_part(name, report['part'])}.json"


def with_part(name: str, part: str) -> str:
    """Returns a name with the part of the data appended unless it is the test, so that validation figures never replace it."""
    return name if part == "test" else f"{name}_{part}"


def table(report: dict[str, Any]) -> Table:
    """Returns the report as a table with one row per frequency and the baselines beside the field."""
    names = list(report["baselines"])
    others = [name.replace("_", " ") for name in names]
    if "median_ssim" in report:
        part = "held-out" if report["part"] == "test" else "validation"
        title, cells = f"{part} SSIM (median / mean) of {report['n']} spectra", _cells_of_spectra
        columns = [report["field"], *others, "PSNR dB", "MAE"]
    else:
        title, cells = f"received power of {report['n']} held-out links", _cells_of_powers
        columns = ["median error dB", "mean", *others]
    result = Table(title=f"{report['scene']}, {report['field']}: {title}")
    for column in ("GHz", *columns):
        result.add_column(column, justify="right")
    for i, own in enumerate(report["per_frequency"]):
        baselines = [report["baselines"][name]["per_frequency"][i] for name in names]
        result.add_row(f"{own['frequency_ghz']:g}", *cells(own, baselines))
    result.add_section()
    result.add_row("all", *cells(report, [report["baselines"][name] for name in names]))
    return result


def _cells_of_spectra(own: dict[str, Any], others: list[dict[str, Any]]) -> list[str]:
    pairs = [f"{figures['median_ssim']:.3f} / {figures['mean_ssim']:.3f}" for figures in (own, *others)]
    return [*pairs, f"{own['psnr_db']:.1f}", f"{own['mae']:.3f}"]


def _cells_of_powers(own: dict[str, Any], others: list[dict[str, Any]]) -> list[str]:
    return [f"{own['power_error_db']:.2f}", *(f"{figures['power_mae_db']:.2f}" for figures in (own, *others))]


def closing_lines(report: dict[str, Any], block: int) -> list[str]:
    """Returns the lines printed below the table."""
    lines = []
    if "median_ssim" in report:
        lines.append(f"SSIM of the worst spectra: {report['p5_ssim']:.3f} (5th percentile), {report['p10_ssim']:.3f} (10th)")
        parts = {"line of sight": report.get("in_sight"), "no line of sight": report.get("out_of_sight")}
        by_sight = [f"{name} {part['median_ssim']:.3f} (n = {part['n']})" for name, part in parts.items() if part]
        lines += [f"SSIM by visibility (median): {', '.join(by_sight)}"] if by_sight else []
        if each := report.get("per_receiver"):
            by_receiver = [f"{own['receiver']}: {own['median_ssim']:.3f} / {own['mean_ssim']:.3f}" for own in each]
            lines.append(f"SSIM by receiver (median / mean): {', '.join(by_receiver)}")
        lines.append(
            f"strongest direction: median error {report['angle_error_deg']:.1f} degrees; power lost by the best predicted beam "
            f"{report['beam_loss_db']:.2f} dB, by the best of three {report['beam_loss_top3_db']:.2f} dB (means)"
        )
    if noisy := report.get("as_observed"):
        lines.append(
            f"with the noise of the training spectra: {noisy['median_ssim']:.3f} / {noisy['mean_ssim']:.3f} (median / mean; "
            "predictions are noise-free, and score lower against noisy spectra)"
        )
    if (same := report.get("truth_repeats")) is not None:
        lines.append(f"truth against itself, traced with more rays: {same:.3f} (median), the highest meaningful score")
    if "snapshot_correlation" in report:
        correlation, error = report["snapshot_correlation"], report["power_error_db"]
        lines.append(f"snapshots: correlation {correlation:.3f}, power error {error:.2f} dB (medians)")
    if power := report.get("power"):
        others = ", ".join(f"{name.replace('_', ' ')} {own['power_mae_db']:.2f} dB" for name, own in power["baselines"].items())
        lines.append(f"received power: mean absolute error {power['power_mae_db']:.2f} dB ({others})")
    if intervals := (report.get("power") or report).get("confidence_db"):
        lines.append(
            f"expected error of powers {intervals['expected']:.2f} dB (mean; actual {intervals['scored']:.2f}); "
            f"{100 * intervals['level']:.0f} % intervals contain {100 * intervals['coverage']:.0f} % of the powers; "
            f"mean error of the more certain half {intervals['risk_coverage']['0.5']:.2f} dB"
        )
    if intervals := report.get("confidence"):
        lines.append(
            f"expected SSIM {intervals['expected']:.3f} (mean; actual {intervals['scored']:.3f}); "
            f"{100 * intervals['level']:.0f} % intervals contain {100 * intervals['coverage']:.0f} % of the scores; "
            f"mean SSIM of the more certain half {intervals['risk_coverage']['0.5']:.3f}"
        )
    if single := report.get("ms_per_pas_single"):
        lines.append(f"{report['ms_per_pas']:.2f} ms per PAS in blocks of {block}, {single:.2f} ms for a single query")
    return lines
