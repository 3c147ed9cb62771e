"""The check of a GPU: one JSON that holds whatever is known, sections that end in time, an exit code that means parity."""

import json
import subprocess
import sys
import time

import pytest

from experiments.gpu_check import __main__ as command_line
from experiments.gpu_check.record import NEEDED, Record, not_done, parity_holds
from wbgs_jax._util.command import run_command
from wbgs_jax._util.files import write_json

DEVICE = {"name": "cpu", "platform": "cpu", "environment": {"commit": "abc", "jax": "1"}}
HOLDS = {"pinned": True, "values": 0.0, "gradients": 0.0, "holds": True}


@pytest.fixture
def sections(monkeypatch):
    """Sections by name that are Python code given (NAME, SECONDS, FILE, STAND_IN), in the place of the real ones."""
    code: dict[str, str] = {}

    def start(*arguments, **options):
        source = "import sys, time\nfrom pathlib import Path\nfrom experiments.gpu_check.record import Record\n"
        source += "record = Record(Path(sys.argv[3]), sys.argv[1])\n" + code.get(arguments[0], "")
        return subprocess.Popen(
            [sys.executable, "-c", source, *arguments], cwd=command_line.ROOT, text=True, start_new_session=True, **options
        )

    monkeypatch.setattr(command_line, "start", start)
    monkeypatch.setattr(command_line, "find_device", lambda: dict(DEVICE))
    return code


def parity(**cases):
    rooms = dict.fromkeys(NEEDED, "compared")
    return f"for name, case in {cases!r}.items(): record.add(name, case)\nrecord.set_state('running', rooms={rooms!r})"


def run(monkeypatch, tmp_path, *arguments):
    monkeypatch.setattr(sys, "argv", ["gpu_check", "--out", str(tmp_path), *arguments])
    code = 0
    try:
        run_command(command_line.main)
    except SystemExit as stop:
        code = stop.code
    return code, json.loads((tmp_path / "gpu_check_cpu.json").read_text())


def test_what_failed_or_was_cut_is_listed_and_the_rest_is_kept(sections, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(command_line, "LEAST_S", 0.0)
    monkeypatch.setitem(command_line.SHARES, "queries", 0.02)
    sections["parity"] = parity(project=HOLDS)
    sections["renderer"] = "record.add('n1', {'ms': 1.0})\nraise MemoryError('no room')"
    sections["coherent"] = "record.leave_out('paths', 'no mesh')"
    sections["queries"] = "record.add('queries_per_s', 5)\ntime.sleep(60)"
    begin = time.monotonic()
    code, result = run(monkeypatch, tmp_path, "--minutes", "3", "--only", "parity", "renderer", "coherent", "queries")
    assert code == 0 and time.monotonic() - begin < 40 and result["parity_holds"] and result["stand_in"]
    assert result["provenance"] == DEVICE["environment"]
    states = {name: (section["state"], section["figures"]) for name, section in result["sections"].items()}
    assert states["renderer"] == ("failed", {"n1": {"ms": 1.0}}) and states["queries"] == ("cut", {"queries_per_s": 5})
    assert states["coherent"] == ("done", {})
    assert result["not_done"][:2] == ["renderer: failed, MemoryError: no room", "coherent, paths: no mesh"]
    assert result["not_done"][2].startswith("queries: cut")
    said = capsys.readouterr().err
    assert all(f"not done: {line}" in said for line in result["not_done"])


def test_a_run_of_some_sections_keeps_the_others(sections, monkeypatch, tmp_path):
    sections |= {"parity": parity(project=HOLDS), "renderer": "record.add('n1', 1)"}
    run(monkeypatch, tmp_path, "--only", "parity", "renderer")
    sections["renderer"] = "record.add('n2', 2)"
    code, result = run(monkeypatch, tmp_path, "--only", "renderer")
    assert code == 0 and result["parity_holds"] and result["sections"]["renderer"]["figures"] == {"n2": 2}
    assert {section["commit"] for section in result["sections"].values()} == {"abc"}


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (parity(project=HOLDS | {"holds": False}), "parity does not hold: project; see"),
        ("record.add('project', {'holds': True})", "parity does not hold: not everything was compared; see"),
    ],
)
def test_without_parity_the_exit_code_says_so(code, words, sections, monkeypatch, tmp_path, capsys):
    sections["parity"] = code
    stopped, result = run(monkeypatch, tmp_path, "--only", "parity")
    assert stopped == 2 and not result["parity_holds"]
    assert words in capsys.readouterr().err.splitlines()[-1]


def test_sections_without_time_are_left_out(sections, monkeypatch, tmp_path):
    sections["parity"] = parity(project=HOLDS)
    _, result = run(monkeypatch, tmp_path, "--minutes", "0.01")
    assert {section["state"] for section in result["sections"].values()} == {"left out"}
    assert len(result["not_done"]) == len(result["sections"]) == len(command_line.SHARES)


def test_a_record_is_whole_after_every_figure(tmp_path):
    path = tmp_path / "check.json"
    write_json(path, {"sections": {}})
    record = Record(path, "renderer")
    for n in range(3):
        record.add(f"n{n}", {"ms": n})
        assert len(json.loads(path.read_text())["sections"]["renderer"]["figures"]) == n + 1
    record.leave_out("n9", "the time was up")
    record.set_state("done")
    sections = json.loads(path.read_text())["sections"]
    assert not_done(sections) == ["renderer, n9: the time was up"] and not parity_holds(sections)


def test_the_process_that_starts_the_sections_leaves_the_device_alone():
    code = "import sys, experiments.gpu_check.__main__; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
def test_the_stand_in_on_this_machine(tmp_path):
    command = [sys.executable, "-m", "experiments.gpu_check", "--only", "parity", "renderer", "queries", "--out", str(tmp_path)]
    done = subprocess.run([*command, "--minutes", "30"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "gpu_check_cpu.json").read_text())
    assert result["parity_holds"] and result["stand_in"] and result["not_done"] == []
