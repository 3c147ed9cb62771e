"""The page of the viewer: its server, a line of progress until there is a field, and what the browser does by itself.

It is shown before JAX is loaded.
"""

import contextlib
import html
import io
from importlib import resources
from typing import Any

import viser

STOPPED = (
    "The server has stopped or cannot be reached. This is the last picture that it sent. Start it again (wbgs-jax view); the "
    "page then continues by itself."
)


class Page:
    """A server whose page shows a line of progress until there is a viewer."""

    def __init__(self, host: str = "localhost", port: int = 8080):
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a table; the command prints one line instead
            self.server = viser.ViserServer(host=host, port=port, label="wbgs-jax", verbose=False)
        gui = self.server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        if hasattr(gui, "main_panel"):  # viser 1.1; before it the panel floats over the picture
            gui.main_panel.dock_right()
        gui.add_html(page_script())
        self._line = gui.add_html("")
        self._bar: Any = gui.add_progress_bar(5.0, animated=True)  # viser does not export its type
        self.progress("starting", 5)

    @property
    def port(self) -> int:
        """The port of the server."""
        return self.server.get_port()

    def progress(self, words: str, percent: int) -> None:
        """Shows what is being done."""
        self._line.content, self._bar.value = as_words(f"{words} ..."), percent

    def ready(self) -> None:
        """Removes the line of progress."""
        self._line.visible = self._bar.visible = False

    def stop(self) -> None:
        """Stops the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()


def page_script() -> str:
    """Returns an element that starts `page.js` in the browser, and that it watches to notice that the server has stopped."""
    script = html.escape(resources.files("wbgs_jax.viewer").joinpath("page.js").read_text(), quote=True)
    return (
        f'<div id="wbgs-probe" data-stopped="{html.escape(STOPPED, quote=True)}">'
        f'<img alt="" src="data:," style="display: none" onerror="{script}"></div>'
    )


def as_words(sentence: str, kind: str = "wbgs-words") -> str:
    """Returns a sentence as an element of the panel."""
    return f'<div class="wbgs-panel"><div class="{kind}">{html.escape(sentence)}</div></div>'
