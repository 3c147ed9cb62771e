"""Show a trained field in a browser:

wbgs-jax view --example                     the trained field that comes with the package
wbgs-jax view --run RUN [--port 8080]
wbgs-jax view --run RUN --html scene.html --tx x,y,z --ghz 28      a page that opens without Python
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from wbgs_jax._util.cli import parse_positions, run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import check_writable
from wbgs_jax.commands.options import TrainedFieldOptions, check_suffixes, load_field, parse_frequencies, parse_receiver

if TYPE_CHECKING:
    from wbgs_jax.viewer.app import Viewer
    from wbgs_jax.viewer.page import Page

LOCAL = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True)
class Command(TrainedFieldOptions):
    """Show a trained field in a browser: room, movable transmitter, received spectrum, paths, power maps and materials."""

    host: str = "localhost"
    """Address to listen on; localhost: this machine only. There is no password: everyone who reaches the address has access."""
    port: int = 8080
    """Port to listen on; if it is in use, another one is chosen."""
    rx: str = ""
    """Receiver, by default the first of the data: its index, x,y,z in metres, or
    x,y,z,w,i,j,k with a quaternion (wxyz) that rotates its array into the world frame."""
    tx: str = ""
    """Initial position of the transmitter, x,y,z in metres."""
    ghz: float | None = None
    """Initial frequency."""
    up: Literal["x", "y", "z"] = "z"
    """Axis of the data that points upwards; y in the published layout."""
    html: Path | None = None
    """Write the view to this .html file, which opens without Python, and exit."""


def check(command: Command) -> None:
    """Raises a `UserError` for an invalid command line, or if viser is not installed."""
    _ = command.folder  # one is named
    check_suffixes(command, {"html": (".html",)})
    if not 0 <= command.port <= 65535:
        raise UserError(f"--port {command.port} is not a port; give a number from 1 to 65535")
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise UserError("the viewer needs viser; install it with: pip install 'wbgs-jax[viewer]'") from error


def start(command: Command) -> "Viewer":
    """Returns the running viewer, set up as on the command line. Its page shows a line of progress while the run is read.

    Raises:
        UserError: the run cannot be read, or the field cannot be queried at this receiver or frequency.
    """
    lowest = None if command.ghz is None else float(parse_frequencies((command.ghz,))[0])
    position = parse_positions((command.tx,))[0] if command.tx else None

    if not (command.folder / "config.json").exists():  # before there is a page
        from wbgs_jax.training.run_folder import read_config

        read_config(command.folder)
    from wbgs_jax.viewer.page import Page

    page = Page(command.host, command.port)
    try:
        return _fill(page, command, lowest, position)
    except BaseException:
        page.stop()
        raise


def _fill(page: "Page", command: Command, lowest_hz: float | None, position: Any) -> "Viewer":
    """Returns the viewer on a page."""
    if not command.html:
        where = "localhost" if command.host in LOCAL else command.host
        say(f"viewer: http://{where}:{page.port} (Ctrl-C stops it)")
    page.progress("reading the run", 10)
    field = load_field(command.folder, "", lowest_hz)
    page.progress("preparing the receiver", 35)

    from wbgs_jax.viewer.app import Viewer
    from wbgs_jax.viewer.session import Session

    session = Session(field)
    if command.rx:
        session.use_receiver(parse_receiver(command.rx, field.dataset))
    viewer = Viewer(session, page, command.html or Path(f"{field.dataset.name}.html"), command.up)
    if command.ghz is not None:
        viewer.set_ghz(command.ghz)
    if position is not None:
        viewer.move(position)
    return viewer


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax view")
    check(command)
    check_writable(command.html)
    use_compilation_cache()
    if command.html:
        say(f"drawing the predictions of {command.folder} ...")
    viewer = start(command)
    if command.html:
        try:
            viewer.wait()
            if not viewer.updates:
                raise UserError(f"the prediction failed, and {command.html} was not written; the line above has the reason")
            say(f"page: {viewer.save()}")
        finally:
            viewer.stop()
        return
    if command.host not in LOCAL:
        say(
            f"note: everyone who reaches {command.host} has access to the viewer; --host localhost restricts it to this machine"
        )
    try:
        while True:
            time.sleep(3600)
    finally:
        viewer.stop()


if __name__ == "__main__":
    run_command(main)
