"""Convergence in the number of rays: snapshots and spectra of fewer rays compared with those of the most.

python -m data_gen.convergence --scene 2 --effort 0.25 0.5 1 4
"""

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Complex, Float

from data_gen.ceilings import scaled
from data_gen.llvm import ensure_backend
from data_gen.scenes import get_scene
from data_gen.settings import ArraySettings, SolverSettings
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError
from wbgs_jax.metrics import ssim
from wbgs_jax.radio.array import snapshot_to_pas
from wbgs_jax.radio.channel import correlation

if TYPE_CHECKING:
    from data_gen.scenes import SceneSpec
    from data_gen.solve import Simulator

TX_SEED = 0


@dataclass(frozen=True)
class Options:
    """Compare snapshots and spectra of several numbers of rays with those of the largest number."""

    scene: int = 1
    """Number of the scene."""
    frequencies: tuple[float, ...] = (1.0, 10.0, 94.0)
    """GHz."""
    effort: tuple[float, ...] = (0.25, 0.5, 1.0, 4.0)
    """Factors on all numbers of rays, ascending; 1 is that of the released scenes, the last one is the reference."""
    tx: int = 16
    """Number of transmitters, drawn at random with a fixed seed."""
    diffraction: bool = True
    """First-order diffraction."""
    depth: int = SolverSettings.max_depth
    """Maximum number of interactions of a path."""


def settings(effort: float, diffraction: bool = True, depth: int = SolverSettings.max_depth) -> SolverSettings:
    """Returns the solver's settings with all numbers of rays multiplied by `effort`."""
    usual = SolverSettings(diffraction=diffraction, max_depth=depth)
    rays = ("samples_per_src", "rays_per_face", "rays_per_mirrored_face")
    more = {name: max(1, round(getattr(usual, name) * effort)) for name in rays}
    batch = max(1, int(usual.tx_per_call / max(effort, 1)))  # memory grows with rays times transmitters
    room = round(usual.max_paths_per_src * max(effort, 1))
    return dataclasses.replace(usual, tx_per_call=batch, max_paths_per_src=room, **more)


def convergence(options: Options) -> list[str]:
    """Returns the rows of the table, one for every number of rays at every frequency."""
    from data_gen.solve import Simulator

    spec = get_scene(options.scene)
    tx = some_tx(spec, options.tx, TX_SEED)
    frequencies = [ghz * 1e9 for ghz in options.frequencies]
    snapshots, costs = [], []
    for effort in options.effort:
        simulator = Simulator(spec, settings(effort, options.diffraction, options.depth))
        simulator.paths(tx[: simulator.settings.tx_per_call], frequencies)  # compilation is not timed
        start = time.perf_counter()
        snapshots.append(traced(simulator, tx, frequencies))
        costs.append((time.perf_counter() - start) / len(tx))
    return _lines(options, snapshots, costs)


def some_tx(spec: "SceneSpec", count: int, seed: int) -> Float[np.ndarray, "tx 3"]:
    """Returns transmitters of a scene, drawn at random."""
    tx = spec.accessible_tx()
    return tx[np.random.default_rng(seed).permutation(len(tx))[:count]]


def traced(
    simulator: "Simulator", tx: Float[np.ndarray, "tx 3"], frequencies_hz: Sequence[float]
) -> Complex[np.ndarray, "freq tx elements"]:
    """Returns the snapshots of transmitters, computed in batches of the size in the settings."""
    size = simulator.settings.tx_per_call
    solved = [simulator.paths(tx[i : i + size], frequencies_hz) for i in range(0, len(tx), size)]
    return np.concatenate([np.array([[p.snapshot() for p in row] for row in one]) for one in solved], 1)


def _lines(options: Options, snapshots: Sequence[Complex[np.ndarray, "freq tx elements"]], costs: Sequence[float]) -> list[str]:
    elements = jnp.asarray(ArraySettings().element_positions())
    lines = []
    for i, ghz in enumerate(options.frequencies):
        best = scaled(snapshots[-1][i])
        truth = np.asarray(snapshot_to_pas(best, elements))
        for effort, cost, by_frequency in zip(options.effort, costs, snapshots, strict=True):
            snapshot = scaled(by_frequency[i])
            same = np.asarray(correlation(snapshot, best))
            score = ssim(np.asarray(snapshot_to_pas(snapshot, elements)), truth)
            cells = (f"{options.scene} | {ghz:g} | {effort:g}", *(f"{v:.3f}" for v in (np.median(same), same.min())),
                     *(f"{v:.3f}" for v in (np.median(score), np.percentile(score, 10))), f"{cost:.2f}")  # fmt: skip
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Runs the command line."""
    options = tyro.cli(Options)
    if not options.effort or min(options.effort) <= 0 or options.tx < 1:
        raise UserError("--effort and --tx must be positive")
    ensure_backend()
    print("| scene | GHz | effort | median correlation | lowest | median SSIM | 10th percentile | seconds per TX |")
    print("|---|---|---|---|---|---|---|---|")
    print("\n".join(convergence(options)))


if __name__ == "__main__":
    run_command(main)
