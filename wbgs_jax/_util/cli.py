"""Shared parts of all command lines: conversion of errors to one line and an exit code, and output for users."""

import os
import sys
import warnings
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from wbgs_jax._util.errors import UserError

STOPPED = 130
"""Exit code of a command that was stopped by Ctrl-C."""
_default_format = warnings.formatwarning


def run_command(main: Callable[[], None]) -> None:
    """Runs the `main` function of a command line.

    A `UserError`, or an error of the operating system about a file, is printed as one line on stderr with exit code 2. Ctrl-C
    gives exit code 130, a closed pipe (`| head`) exit code 141. A `UserWarning` is printed as a line that begins with "note:".
    """
    warnings.formatwarning = _note
    try:
        main()
    except UserError as error:
        print(error if error.exit_code == STOPPED else f"error: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(STOPPED) from None
    except BrokenPipeError:  # the reader, such as `| head`, has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    except OSError as error:  # not handled where it occurred: a name too long, a disk that has failed
        if error.filename is None:
            raise
        where = UserError(f"{error.strerror}: {error.filename}; check the path, its permissions and the space on its disk")
        print(f"error: {where}", file=sys.stderr)
        raise SystemExit(2) from None


def _note(message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None) -> str:
    """Returns the printed form of a warning."""
    if category is UserWarning:
        return f"note: {message}\n"
    return _default_format(message, category, filename, lineno, line)


def say(line: str) -> None:
    """Prints a line for the user on stderr; stdout is for results."""
    print(line, file=sys.stderr, flush=True)


def counted(count: int, one: str, more: str = "") -> str:
    """Returns a number with its noun: "1 transmitter", "2 transmitters"; `more` is an irregular plural."""
    return f"{count} {one if count == 1 else more or one + 's'}"


def option_value(arguments: Sequence[str], name: str, default: str) -> str:
    """Returns the value of an option on the command line, or the default; the last occurrence counts."""
    value = default
    for i, argument in enumerate(arguments):
        if argument == name:
            value = "".join(arguments[i + 1 : i + 2])
        elif argument.startswith(f"{name}="):
            value = argument.split("=", 1)[1]
    return value


def parse_positions(words: tuple[str, ...], option: str = "--tx") -> Float[np.ndarray, "n 3"]:
    """Returns positions (metres) parsed from the strings "x,y,z" of an option.

    Raises:
        UserError: a string is not of this form, or a coordinate is too large.
    """
    unit = f"metres, such as {option} 1.0,2.5,1.5"
    return np.array([parse_vector(word, option, "position", unit) for word in words]).reshape(-1, 3)


def parse_vector(word: str, option: str, kind: str = "velocity", unit: str = "metres per second") -> Float[np.ndarray, "3"]:
    """Returns three numbers parsed from "x,y,z".

    Raises:
        UserError: the string is not of this form, or a number is too large.
    """
    values = parse_numbers(word)
    # Metres per second, or metres (`types.LARGEST_COORDINATE_M`, whose module loads JAX): larger values are mistakes.
    furthest = 1e5 if kind == "velocity" else 2e3
    if len(values) != 3 or not (np.abs(values) <= furthest).all():
        raise UserError(f"{option} {word[:60]} is not a {kind}; give x,y,z in {unit}, each at most {furthest:g}")
    return values


def parse_number(word: str) -> float:
    """Returns a number; anything else is a `ValueError`, also 1_0, which Python reads as 10."""
    if "_" in word:
        raise ValueError(f"{word!r} has an underscore")
    return float(word)


def parse_numbers(word: str) -> Float[np.ndarray, " n"]:
    """Returns the numbers of a string "a,b,...", none if it is not of this form."""
    try:
        return np.array([parse_number(part) for part in word.split(",")])
    except ValueError:
        return np.zeros(0)


def point_words(position: Float[np.ndarray, "3"]) -> str:
    """Returns "(x, y, z) m"; less than a nanometre, as between the ends of a line, is 0."""
    return "({:.6g}, {:.6g}, {:.6g}) m".format(*(np.round(np.asarray(position, np.float64), 9) + 0.0))


def link_words(tx_position: Float[np.ndarray, "3"], frequency_hz: float) -> str:
    """Returns how a line names a link."""
    return f"TX {point_words(tx_position)} at {frequency_hz / 1e9:g} GHz"
