"""Computes the full-wave cabin with openEMS, or continues an interrupted run.

    python -m data_gen.full_wave
    python -m data_gen.full_wave --cell 0.03 --out runs/rough.npz
    python -m data_gen.full_wave --check-cell 0.01

A killed run loses only the element in progress: the same command continues where it stopped.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from data_gen.full_wave.assemble import assemble
from data_gen.full_wave.convergence import convergence
from data_gen.full_wave.elements import cabin_model, digest, element_file, get_element, get_scale, sources
from data_gen.full_wave.openems import run_openems, version
from data_gen.generate import say_written, writable
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.progress_lines import CountProgress
from wbgs_jax.data.load import RELEASED
from wbgs_jax.data.scene_file import save_scene

CELL = 0.015
DURATION = 28e-9


@dataclass(frozen=True)
class Options:
    """Computes a small furnished cabin at 1 to 1.5 GHz with openEMS (FDTD) and writes it as a scene file."""

    cell: float = CELL
    """Edge length of the grid's cells in metres; 0.01, 0.015 and 0.03 fit the cabin."""
    duration: float = DURATION
    """Simulated time in seconds."""
    check_cell: float | None = None
    """Compute one element again with cells of this edge length (metres) and record the agreement in the scene file."""
    out: Path | None = None
    """Scene file to write; by default cabin.npz of the package, or of the current folder if the cell or the duration
    differs."""
    work: Path = Path(__file__).parent.parent / "work"
    """Folder for unfinished work."""

    def target(self) -> Path:
        """Returns the path of the scene file. Results with other settings must not replace the released file."""
        own = (self.cell, self.duration) != (CELL, DURATION)
        return self.out or (Path("cabin.npz") if own else RELEASED / "cabin.npz")


def generate(options: Options) -> Path:
    """Computes or continues the cabin and writes its scene file.

    Returns:
        the scene file's path.
    """
    out, solver = writable(options.target()), version()
    model = cabin_model(options.cell, options.duration)
    folder = options.work / f"cabin-{digest(model, solver)}"
    places = sources()
    files = [element_file(folder, i) for i in range(len(places))]
    print(f"{model.cells:,} cells of {1e3 * model.cell:g} mm, {model.steps} steps, {len(model.points)} transmitters")
    scale = get_scale(run_openems, model, folder)
    results = []
    with CountProgress("cabin, elements", len(files), sum(file.exists() for file in files)) as progress:
        for place, file in zip(places, files, strict=True):
            fresh = not file.exists()
            results.append(get_element(run_openems, model, scale, place, file))
            if fresh:
                progress.advance()
    checks = {}
    if options.check_cell is not None:
        fine = cabin_model(options.check_cell, options.duration)
        checks["convergence"] = convergence(run_openems, fine, results[0], options.work / f"cabin-{digest(fine, solver)}")
    save_scene(out, assemble(model, results, scale, solver, checks))
    return out


def main() -> None:
    """Runs the command line."""
    options = tyro.cli(Options)
    say_written(lambda: generate(options))


if __name__ == "__main__":
    run_command(main)
