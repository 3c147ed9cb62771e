"""The console script `wbgs-jax`: one word a command, each a thin module that `python -m wbgs_jax.COMMAND` runs too."""

import importlib
import sys
from typing import NamedTuple

from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError


class Entry(NamedTuple):
    """A command."""

    module: str
    help: str


COMMANDS = {
    "train": Entry("wbgs_jax.commands.train", "train a field on the spectra of a scene"),
    "eval": Entry("wbgs_jax.commands.evaluate", "score a trained field on held-out transmitters, and draw it"),
    "predict": Entry("wbgs_jax.commands.predict", "ask a trained field for spectra or channels, or export it"),
    "map": Entry("wbgs_jax.commands.map", "ask a trained field for maps over a floor: power, best beams, spreads"),
    "view": Entry("wbgs_jax.commands.view", "look at a trained field in a browser: drag its transmitter, see paths and maps"),
    "measure": Entry("wbgs_jax.commands.measure", "learn a map of received power from readings, and score it"),
    "convert": Entry(
        "wbgs_jax.commands.convert", "Gaussians, paths and channels for other programs, and theirs for a training"
    ),
    "layout": Entry("wbgs_jax.commands.export_folder", "write a scene file as a folder of the published layout"),
}


def usage() -> str:
    """Returns what `wbgs-jax --help` prints."""
    rows = [f"  {name:8} {entry.help}" for name, entry in COMMANDS.items()]
    head, tail = "usage: wbgs-jax COMMAND [OPTIONS]", "wbgs-jax COMMAND --help says more of each."
    return "\n".join([head, "", "Wideband RF radiance fields in JAX.", "", *rows, "", tail])


def dispatch() -> None:
    """Runs the command that the first argument names."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return
    if arguments[0] == "--version":
        import wbgs_jax

        print(wbgs_jax.__version__)
        return
    if arguments[0] not in COMMANDS:
        raise UserError(f"there is no command {arguments[0]!r}; choose one of: {', '.join(COMMANDS)}")
    importlib.import_module(COMMANDS[arguments[0]].module).main(arguments[1:])


def main() -> None:
    """Entry point."""
    run_command(dispatch)


if __name__ == "__main__":
    main()
