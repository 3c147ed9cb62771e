"""What all command lines share: how errors become one line and an exit code, and lines for people."""

import os
import sys
import warnings
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from wbgs_jax._util.errors import UserError

FURTHEST = 1e5
"""Metres, or metres a second: farther is a mistake, and beyond single precision soon."""
_as_python_has_it = warnings.formatwarning


def run_command(main: Callable[[], None]) -> None:
    """Runs a command line's `main`: a `UserError`, or what the operating system says of a file, becomes one line on stderr and
    exit code 2, Ctrl-C exit code 130, a reader that has gone (`| head`) exit code 141, and a `UserWarning` a line that begins
    with "note:"."""
    warnings.formatwarning = _note
    try:
        main()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    except OSError as error:  # of a place that nobody has looked at: a name too long, a disk that went away
        if error.filename is None:
            raise
        where = UserError(f"{error.strerror}: {error.filename}; check the path, its permissions and the space on its disk")
        print(f"error: {where}", file=sys.stderr)
        raise SystemExit(2) from None


def _note(message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None) -> str:
    """Returns what is printed of a warning."""
    if category is UserWarning:
        return f"note: {message}\n"
    return _as_python_has_it(message, category, filename, lineno, line)


def say(line: str) -> None:
    """Prints a line for people, on stderr: stdout is for results."""
    print(line, file=sys.stderr, flush=True)


def option_value(arguments: Sequence[str], name: str, default: str) -> str:
    """Returns what follows an option on the command line, or the default; the last one counts."""
    value = default
    for i, argument in enumerate(arguments):
        if argument == name:
            value = "".join(arguments[i + 1 : i + 2])
        elif argument.startswith(f"{name}="):
            value = argument.split("=", 1)[1]
    return value


def parse_positions(words: tuple[str, ...]) -> Float[np.ndarray, "tx 3"]:
    """Returns positions in metres from "x,y,z" each; anything else is a `UserError`."""
    unit = "metres, such as --tx 1.0,2.5,1.5"
    return np.array([parse_vector(word, "--tx", "position", unit) for word in words]).reshape(-1, 3)


def parse_vector(word: str, option: str, kind: str = "velocity", unit: str = "metres a second") -> Float[np.ndarray, "3"]:
    """Returns three numbers from "x,y,z"; anything else is a `UserError`."""
    try:
        values = np.array([float(part) for part in word.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != 3 or not (np.abs(values) <= FURTHEST).all():
        raise UserError(f"{option} {word[:60]} is no {kind}; give x,y,z in {unit}, each at most {FURTHEST:g}")
    return values


def point_words(position: Float[np.ndarray, "3"]) -> str:
    """Returns "(x, y, z) m"."""
    return "({:.6g}, {:.6g}, {:.6g}) m".format(*position)


def link_words(tx_position: Float[np.ndarray, "3"], frequency_hz: float) -> str:
    """Returns how a line names a link."""
    return f"TX {point_words(tx_position)} at {frequency_hz / 1e9:g} GHz"
