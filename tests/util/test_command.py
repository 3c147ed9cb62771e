"""What command lines share: errors as one line and an exit code, options that are looked at first."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from builders.commands import assert_error_for_people, call

from wbgs_jax._util.cli import counted, option_value, parse_vector, point_words, run_command, say
from wbgs_jax._util.errors import UserError
from wbgs_jax.training.progress import Interrupted
from wbgs_jax.types import LARGEST_COORDINATE_M


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (UserError("no such scene; give another"), 2, "error: no such scene; give another\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (Interrupted("stopped at step 4 of 9"), 130, "stopped at step 4 of 9\n"),
    ],
)
def test_what_stops_a_command_is_one_line_and_an_exit_code(capsys, error, code, line):
    def main():
        raise error

    with pytest.raises(SystemExit) as stopped:
        run_command(main)
    assert stopped.value.code == code
    assert capsys.readouterr() == ("", line)


def test_mistakes_of_the_program_are_not_hidden():
    with pytest.raises(ZeroDivisionError):
        run_command(lambda: 1 / 0)


def test_warnings_are_notes(monkeypatch):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)  # put back afterwards
    run_command(lambda: None)
    assert warnings.formatwarning("the mesh was simplified", UserWarning, "mesh.py", 3) == "note: the mesh was simplified\n"
    assert "mesh.py:3" in warnings.formatwarning("soon gone", DeprecationWarning, "mesh.py", 3)


def test_positions_are_limited_as_coordinates_of_data_and_velocities_by_themselves():
    np.testing.assert_array_equal(parse_vector("0,-2000,3e1", "--tx", "position", "metres"), [0, -LARGEST_COORDINATE_M, 30])
    assert parse_vector("0,7500,0", "--tx-velocity")[1] == 7500
    for word, kind in (
        ("0,2001,0", "position"),
        ("0,2001,0", "displacement"),
        ("0,2e5,0", "velocity"),
        ("1_0,0,0", "position"),
    ):
        with pytest.raises(UserError, match=f"--tx {word} is not a {kind}"):
            parse_vector(word, "--tx", kind, "metres")


def test_lines_for_people_leave_stdout_alone(capsys):
    say("12 spectra")
    assert capsys.readouterr() == ("", "12 spectra\n")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "wideband"),
        (["--seed", "1"], "wideband"),
        (["--field", "wave"], "wave"),
        (["--field=wave", "--seed", "1"], "wave"),
        (["--field", "wave", "--field=nerf2"], "nerf2"),
        (["--field"], ""),
        (["--fields", "wave"], "wideband"),
    ],
)
def test_the_value_of_an_option_that_is_looked_at_first(arguments, expected):
    assert option_value(arguments, "--field", "wideband") == expected


def test_what_the_operating_system_says_of_a_file_is_one_line():
    ended = call(lambda _: Path("9" * 5000).stat())
    assert_error_for_people(ended, "File name too long", "check the path")
    with pytest.raises(OSError, match="mistake"):
        call(lambda _: (_ for _ in ()).throw(OSError("a mistake of ours")))


def test_a_point_has_no_rounding_errors():
    """The middle of a line from -0.1 to 0.2 is off zero by 1e-17."""
    assert point_words(np.array([np.linspace(-0.1, 0.2, 4)[1], -0.0, 0.1234567])) == "(0, 0, 0.123457) m"


def test_counts_have_a_singular():
    assert [counted(n, "transmitter") for n in (0, 1, 2)] == ["0 transmitters", "1 transmitter", "2 transmitters"]
    assert [counted(n, "frequency", "frequencies") for n in (1, 2)] == ["1 frequency", "2 frequencies"]
