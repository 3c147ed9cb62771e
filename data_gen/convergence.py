"""How many rays are enough: compares snapshots at several sample counts with those at the largest.

python -m data_gen.convergence --scene 1 --frequencies 1 10 94 --samples 50000 100000 400000 1000000
"""

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import tyro
from jaxtyping import Complex, Float

from data_gen.llvm import ensure_backend
from data_gen.scenes import get_scene
from data_gen.settings import SolverSettings
from wbgs_jax.errors import run_command

TX_SEED = 0


@dataclass(frozen=True)
class Options:
    """Compare snapshots at several sample counts with those at the largest."""

    scene: int = 1
    """Number of the scene."""
    frequencies: tuple[float, ...] = (1.0, 10.0, 94.0)
    """GHz."""
    samples: tuple[int, ...] = (50_000, 100_000, 400_000, 1_000_000)
    """Rays for every transmitter, ascending; the last is the yardstick."""
    tx: int = 10
    """Number of transmitters, drawn at random by a fixed seed."""
    diffraction: bool = True
    """First-order diffraction."""


def correlation(first: Complex[np.ndarray, "n elements"], second: Complex[np.ndarray, "n elements"]) -> Float[np.ndarray, "n"]:
    """|a^H b| / (|a| |b|) of every pair of snapshots; 1 means equal images."""
    inner = np.abs((first.conj() * second).sum(-1))
    return inner / (np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1))


def convergence(options: Options, frequency_hz: float) -> list[str]:
    """One line of the table for every sample count at a frequency."""
    from data_gen.solve import Simulator

    spec = get_scene(options.scene)
    tx = spec.accessible_tx()
    tx = tx[np.random.default_rng(TX_SEED).permutation(len(tx))[: options.tx]]
    snapshots, seconds = [], []
    for samples in options.samples:
        settings = SolverSettings(samples_per_src=samples, diffraction=options.diffraction, tx_per_call=options.tx)
        simulator = Simulator(
            spec, dataclasses.replace(settings, max_paths_per_src=max(settings.max_paths_per_src, samples // 10))
        )
        simulator.set_frequency(frequency_hz)
        simulator.paths(tx)  # compiles
        start = time.perf_counter()
        snapshots.append(np.stack([paths.snapshot() for paths in simulator.paths(tx)]))
        seconds.append((time.perf_counter() - start) / len(tx))
    return _lines(frequency_hz, options.samples, snapshots, seconds)


def _lines(frequency_hz: float, samples: Sequence[int], snapshots: list[np.ndarray], seconds: list[float]) -> list[str]:
    lines = []
    for count, snapshot, second in zip(samples, snapshots, seconds, strict=True):
        same = correlation(snapshot, snapshots[-1])
        lines.append(f"| {frequency_hz / 1e9:g} | {count:,} | {np.median(same):.4f} | {same.min():.4f} | {second:.3f} |")
    return lines


def main() -> None:
    """Command line."""
    options = tyro.cli(Options)
    ensure_backend()
    print("| GHz | samples | median correlation | lowest | seconds a TX |\n|---|---|---|---|---|")
    for ghz in options.frequencies:
        print("\n".join(convergence(options, ghz * 1e9)), flush=True)


if __name__ == "__main__":
    run_command(main)
