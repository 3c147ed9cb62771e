"""Runs the openEMS binary and reads its records. All files of a run are in a temporary folder."""

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_gen.full_wave.calibration import sampled_frequencies
from data_gen.full_wave.model import Model, Solution
from data_gen.full_wave.solver_input import PROBE, solver_input
from data_gen.scenes.geometry import Vec3
from wbgs_jax._util.errors import UserError

BINARY = "openEMS"
ENGINE = "sse-compressed"
"""Single-threaded; the fastest engine on one core."""
TENTHS = 10


def find_openems() -> str:
    """Returns the path of the binary.

    Raises:
        UserError: it is not installed.
    """
    found = shutil.which(BINARY)
    if found is None:
        raise UserError(f"{BINARY} is not installed; on Debian and Ubuntu: apt-get install openems")
    return found


def version() -> str:
    """Returns the version printed by the binary."""
    banner = subprocess.run([find_openems()], capture_output=True, text=True, check=False).stdout
    found = re.search(r"version (\S+)", banner)
    return found[1] if found else "unknown"


def run_openems(model: Model, source: Vec3) -> Solution:
    """Computes the field of a vertical source at all points of a model.

    Args:
        model: the room.
        source: position of the source's centre, metres.

    Raises:
        UserError: the binary is missing or fails.
    """
    command = [find_openems(), "run.xml", f"--engine={ENGINE}"]
    with tempfile.TemporaryDirectory(prefix="full_wave_") as name:
        folder = Path(name)
        (folder / "run.xml").write_text(solver_input(model, source))
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        log = done.stdout + done.stderr
        if done.returncode or not (folder / f"{PROBE}0").exists():
            code = done.returncode
            raise UserError(f"{BINARY} failed with exit code {code}: {_last_line(log)}; it may need more memory or disk space")
        times, voltages = _records(model, folder)
    reported = _reported(log)
    if not np.isclose(reported["time_step"], model.time_step, rtol=1e-3):
        steps = f"{reported['time_step']:.4g} s instead of {model.time_step:.4g} s"
        raise UserError(f"{BINARY} used a time step of {steps}; is its version not 0.0.35?")
    transform = np.exp(-2j * np.pi * np.outer(times, sampled_frequencies(model))) * (times[1] - times[0])
    return Solution(voltages @ transform / (2 * model.cell), decay(voltages), reported["time_step"], reported["seconds"])


def decay(voltages: Float[np.ndarray, "n times"]) -> float:
    """Returns the level (dB, negative) of recorded pulses in the last tenth of the time relative to that in the strongest
    tenth.

    Differences of neighbouring samples are used, because the absorbing layer leaves a slow drift far below the band.
    """
    energy = [float((part**2).mean()) for part in np.array_split(np.diff(voltages), TENTHS, axis=1)]
    return 10 * float(np.log10(max(energy[-1], np.finfo(float).tiny) / max(energy)))


def _records(model: Model, folder: Path) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "n times"]]:
    """Returns the times (seconds) and the voltages over two cells at all points."""
    records = [np.loadtxt(folder / f"{PROBE}{i}", comments="%", ndmin=2) for i in range(len(model.points))]
    return records[0][:, 0], np.stack([record[:, 1] for record in records])


def _reported(log: str) -> dict[str, float]:
    """Returns the time step and the computing time (seconds) reported in the solver's log."""
    step = re.search(r"timestep is: (\S+) s", log)
    spent = re.search(r"iterations with .* cells : (\S+) sec", log)
    if step is None or spent is None:
        raise UserError(f"{BINARY} ended before its last step: {_last_line(log)}")
    return {"time_step": float(step[1]), "seconds": float(spent[1])}


def _last_line(log: str) -> str:
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    return lines[-1] if lines else "no output"
