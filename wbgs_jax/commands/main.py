"""The console script `wbgs-jax`, also run by `python -m wbgs_jax`. Each of its commands is a thin module."""

import importlib
import sys
from typing import NamedTuple

from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError


class Entry(NamedTuple):
    """A command: its module and its line in the help."""

    module: str
    help: str


COMMANDS = {
    "train": Entry("wbgs_jax.commands.train", "train a field on the spectra of a scene"),
    "eval": Entry("wbgs_jax.commands.evaluate", "score a trained field on held-out transmitters, and draw figures"),
    "benchmark": Entry(
        "wbgs_jax.commands.benchmark", "score any program's predictions for the test links of the released scenes"
    ),
    "predict": Entry("wbgs_jax.commands.predict", "predict spectra or channel quantities with a trained field, or export it"),
    "map": Entry("wbgs_jax.commands.map", "predict maps over a floor: received power, SINR, beams, K-factor, spreads"),
    "move": Entry("wbgs_jax.commands.move", "predict a channel over time while antennas, people or furniture move"),
    "view": Entry("wbgs_jax.commands.view", "show a trained field in a browser: drag the transmitter, see paths and maps"),
    "next": Entry("wbgs_jax.commands.next", "choose where to measure next: where the field is most uncertain"),
    "update": Entry("wbgs_jax.commands.update", "find what has changed in a room from a few new links, and update its field"),
    "measure": Entry("wbgs_jax.commands.measure", "fit a map of received power to measured powers, and score it"),
    "convert": Entry("wbgs_jax.commands.convert", "write Gaussians or paths for other programs, or read theirs for training"),
    "layout": Entry("wbgs_jax.commands.export_folder", "write a scene file as a folder of the published layout"),
}


def usage() -> str:
    """Returns what `wbgs-jax --help` prints."""
    rows = [f"  {name:9} {entry.help}" for name, entry in COMMANDS.items()]
    head, tail = (
        "usage: wbgs-jax COMMAND [OPTIONS]",
        "wbgs-jax COMMAND --help lists the options of a command; wbgs-jax view --example needs no training.",
    )
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
