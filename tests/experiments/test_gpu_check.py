"""The check of a GPU: pieces that end in time and continue, a JSON each, and an exit code that means parity."""

import json
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.gpu_check import __main__ as command_line
from experiments.gpu_check.progress import figures_of
from experiments.gpu_check.record import NEEDED_OF_STAND_IN, PART, PIECES, TRAININGS, Record, begin, parity_holds
from wbgs_jax._util.cli import run_command

DEVICE = {"name": "cpu", "platform": "cpu", "environment": {"commit": "abc", "jax": "1"}}
HOLDS = {"pinned": True, "values": 0.0, "gradients": 0.0, "holds": True}
ENDLESS = "record.add('row', 5)\ntry:\n    time.sleep(60)\nexcept KeyboardInterrupt:\n    sys.exit(75)"


@pytest.fixture
def pieces(monkeypatch):
    """Pieces by name that are Python code given (NAME, SECONDS, FILE, STAND_IN, FOLDER), in the place of the real ones."""
    code: dict[str, str] = {}

    def start(*arguments, **options):
        source = "import sys, time\nfrom pathlib import Path\nfrom experiments.gpu_check.record import Record\n"
        source += "record = Record(Path(sys.argv[3]))\n" + code.get(arguments[0], "")
        return subprocess.Popen(
            [sys.executable, "-c", source, *arguments], cwd=command_line.ROOT, text=True, start_new_session=True, **options
        )

    monkeypatch.setattr(command_line, "start", start)
    monkeypatch.setattr(command_line, "find_device", lambda: dict(DEVICE))
    return code


def parity(**cases):
    rooms = dict.fromkeys(NEEDED_OF_STAND_IN, "compared")
    return f"record.add('cases', {cases!r})\nrecord.add('rooms', {rooms!r})"


def run(monkeypatch, tmp_path, *arguments):
    """Returns the exit code, and the results by piece."""
    monkeypatch.setattr(sys, "argv", ["gpu_check", "--out", str(tmp_path / "out"), "--runs", str(tmp_path), *arguments])
    code = 0
    try:
        run_command(command_line.main)
    except SystemExit as stop:
        code = stop.code
    return code, results(tmp_path / "out")


def results(folder):
    return {path.stem.removesuffix("_cpu"): json.loads(path.read_text()) for path in folder.glob("*.json")}


def test_every_piece_leaves_a_file_whatever_happens(pieces, monkeypatch, tmp_path, capsys):
    pieces["parity"] = parity(project=HOLDS)
    pieces["renderer"] = "record.add('n1', {'ms': 1.0})\nraise MemoryError('no room')"
    code, found = run(monkeypatch, tmp_path, "--only", "parity", "renderer", "paper_scene1")
    assert code == 0 and set(found) == {"parity", "renderer", "paper_scene1"}
    for name, result in found.items():
        assert result["piece"] == name and result["provenance"] == DEVICE["environment"] and result["stand_in"]
        assert [call["commit"] for call in result["calls"]] == ["abc"] and result["seconds"] > 0
    assert (found["renderer"]["state"], found["renderer"]["reason"]) == ("failed", "MemoryError: no room")
    assert found["renderer"]["figures"] == {"n1": {"ms": 1.0}} and found["paper_scene1"]["state"] == "done"
    assert "renderer: failed" in capsys.readouterr().err


def test_a_piece_that_was_interrupted_continues(pieces, monkeypatch, tmp_path):
    pieces["renderer"] = ENDLESS
    begin = time.monotonic()
    code, found = run(monkeypatch, tmp_path, "--only", "renderer", "--minutes", "0.1")
    assert code == 0 and time.monotonic() - begin < 30
    assert (found["renderer"]["state"], found["renderer"]["reason"]) == ("part", "the time was up")
    pieces["renderer"] = "record.add('other', len(record.figures))"
    _, found = run(monkeypatch, tmp_path, "--only", "renderer")
    assert found["renderer"]["figures"] == {"row": 5, "other": 1} and len(found["renderer"]["calls"]) == 2
    assert found["renderer"]["state"] == "done"
    _, found = run(monkeypatch, tmp_path, "--only", "renderer")
    assert found["renderer"]["figures"] == {"other": 0} and len(found["renderer"]["calls"]) == 1


def test_measurements_of_other_code_are_not_continued_and_trainings_are(pieces, monkeypatch, tmp_path):
    stop = "record.add('row', 1)\nsys.exit(75)"
    pieces |= {"renderer": stop, "paper_scene1": stop}
    run(monkeypatch, tmp_path, "--only", "renderer", "paper_scene1")
    monkeypatch.setattr(command_line, "find_device", lambda: DEVICE | {"environment": {"commit": "def"}})
    pieces |= dict.fromkeys(("renderer", "paper_scene1"), "record.add('known', len(record.figures))")
    _, found = run(monkeypatch, tmp_path, "--only", "renderer", "paper_scene1")
    assert found["renderer"]["figures"] == {"known": 0} and found["paper_scene1"]["figures"]["known"] == 2
    assert [call["commit"] for call in found["paper_scene1"]["calls"]] == ["abc", "def"]


def test_a_training_continues_on_another_device(pieces, monkeypatch, tmp_path):
    pieces["paper_scene1"] = "sys.exit(75)"
    run(monkeypatch, tmp_path, "--only", "paper_scene1")
    monkeypatch.setattr(command_line, "find_device", lambda: DEVICE | {"name": "other"})
    pieces["paper_scene1"] = ""
    _, found = run(monkeypatch, tmp_path, "--only", "paper_scene1")
    assert set(found) == {"paper_scene1_other"} and len(found["paper_scene1_other"]["calls"]) == 2


def test_next_takes_the_pieces_in_order_and_leaves_what_failed(pieces, monkeypatch, tmp_path):
    pieces |= {"parity": parity(project=HOLDS), "renderer": "raise ValueError", "paper_scene1": "sys.exit(75)"}
    for expected in (1, 2, 3, 3):
        _, found = run(monkeypatch, tmp_path, "--next")
        assert set(found) == set(PIECES[:expected])
    pieces["paper_scene1"] = ""
    run(monkeypatch, tmp_path, "--next")
    _, found = run(monkeypatch, tmp_path, "--next")
    assert set(found) == set(PIECES[:4]) and len(found["paper_scene1"]["calls"]) == 3


def test_all_that_is_missing_runs_and_the_list_shows_it(pieces, monkeypatch, tmp_path, capsys):
    pieces["parity"] = parity(project=HOLDS)
    run(monkeypatch, tmp_path, "--only", "parity")
    capsys.readouterr()
    run(monkeypatch, tmp_path, "--list")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("parity: done") and lines[1:] == [f"{name}: missing" for name in PIECES[1:]]
    code, found = run(monkeypatch, tmp_path)
    assert code == 0 and set(found) == set(PIECES) and len(found["parity"]["calls"]) == 1


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (parity(project=HOLDS | {"holds": False}), "parity does not hold: project; see"),
        ("record.add('cases', {'project': {'holds': True}})", "parity does not hold: not everything was compared; see"),
    ],
)
def test_without_parity_the_exit_code_is_2(code, words, pieces, monkeypatch, tmp_path, capsys):
    pieces["parity"] = code
    stopped, found = run(monkeypatch, tmp_path, "--only", "parity", "renderer")
    assert stopped == 2 and not parity_holds(found["parity"]) and found["renderer"]["state"] == "done"
    assert words in capsys.readouterr().err.splitlines()[-1]


def test_a_record_is_whole_after_every_figure(tmp_path):
    path = tmp_path / "check.json"
    record = begin(path, "renderer", DEVICE, None)
    for n in range(3):
        record.add("rows", {f"n{n}": n})
        assert len(json.loads(path.read_text())["figures"]["rows"]) == n + 1
    record.leave_out("n9", "the time was up")
    record.finish("part", 1.0)
    assert record.read()["left_out"] == {"n9": "the time was up"} and record.read()["seconds"] == 1.0


def test_figures_of_a_training_that_is_not_finished(tmp_path):
    assert figures_of(tmp_path) == {}
    (tmp_path / "checkpoints" / "20").mkdir(parents=True)
    seconds = [5.0, 5.1, 5.2, 9.0, 9.1]  # a program is compiled at the beginning, and another later
    lines = [{"step": 10 * (i + 1), "loss": 0.5, "gaussians": 7, "seconds": s} for i, s in enumerate(seconds)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    found = figures_of(tmp_path)
    assert (found["steps"], found["saved_step"], found["gaussians"]) == (50, 20, 7)
    assert found["ms_per_step"] == pytest.approx(10.0) and found["ms_per_step_overall"] == pytest.approx(182.0)


def test_the_arguments_of_the_trainings_are_what_they_claim():
    from experiments.gpu_check.training import LEFT_OUT_GHZ, WRFGS_GHZ
    from experiments.gpu_check.training import TRAININGS as DEFINED
    from wbgs_jax.commands import train
    from wbgs_jax.fields.wideband import PAPER
    from wbgs_jax.fields.wrfgs import without_frequency

    assert tuple(DEFINED) == TRAININGS
    parsed = {name: train.parse(piece.arguments(stand_in=False)) for name, piece in DEFINED.items()}
    for name in ("paper_scene1", "paper_scene4"):
        assert parsed[name][1] == PAPER and PAPER.optim.steps == 200_000
    for name in ("wrfgs_scene1", "wrfgs_scene4"):
        command, settings = parsed[name]
        assert settings.field == without_frequency(PAPER.field) and settings.optim == PAPER.optim
        assert command.train_ghz == (WRFGS_GHZ,) and WRFGS_GHZ in parsed["paper_scene4"][0].train_ghz
    assert not set(LEFT_OUT_GHZ) & set(parsed["paper_scene4"][0].train_ghz) and len(parsed["paper_scene4"][0].train_ghz) == 8


def test_the_process_that_starts_the_pieces_leaves_the_device_alone():
    code = "import sys, experiments.gpu_check.__main__; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def start_here(name, seconds, path, stand_in, folder, **_):
    """Runs a piece in this process; what is returned has ended already."""
    from experiments.gpu_check import pieces

    done = pieces.run(name, Record(Path(path)), time.monotonic() + float(seconds), stand_in == "yes", Path(folder))
    return SimpleNamespace(wait=lambda *_: 0 if done else PART)


SOME_CALLS = [(("--next",), ["parity"]), *((("--only", name), [name]) for name in ("paper_scene1", "wrfgs_scene4"))]
"""Options of calls after the first, and the pieces that each ends."""
ALL_CALLS = [(("--next",), [name]) for name in PIECES[:3]] + [((), [*PIECES[3:]])]


@pytest.mark.heavy
@pytest.mark.long
@pytest.mark.parametrize("calls", [SOME_CALLS, pytest.param(ALL_CALLS, marks=pytest.mark.slow)])
def test_the_stand_in_runs_pieces_and_continues_a_training(calls, monkeypatch, tmp_path):
    """The first training is interrupted after its first steps and continued by a later call. Calls that do not take the next
    piece run in this process, where nothing has to be imported again."""
    folder, device = tmp_path / "stand_in" / "paper_scene1", command_line.find_device()
    monkeypatch.setattr(command_line, "find_device", lambda: device)

    def until_the_first_steps(process, seconds, grace):
        deadline = time.monotonic() + seconds
        while process.poll() is None and not (folder / "metrics.jsonl").exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        return command_line.interrupt(process, grace)

    with monkeypatch.context() as patch:
        patch.setattr(command_line, "wait", until_the_first_steps)
        _, found = run(patch, tmp_path, "--only", "paper_scene1")
    training = found["paper_scene1"]["figures"]["training"]
    assert found["paper_scene1"]["state"] == "part" and 0 < training["saved_step"] == training["steps"] < training["of"]
    ended = set[str]()
    for options, names in calls:
        if options != ("--next",):
            monkeypatch.setattr(command_line, "start", start_here)
            monkeypatch.setattr(command_line, "end", lambda process: None)
        code, found = run(monkeypatch, tmp_path, *options)
        ended |= set(names)
        assert code == 0 and {name for name in found if found[name]["state"] == "done"} == ended
    assert set(found) == ended and found["parity"]["figures"]["repeat_difference"] == 0.0
    for name, result in found.items():
        assert result["stand_in"] and {"version", "commit", "device", "jax", "jaxlib"} <= set(result["provenance"])
        assert [call["state"] for call in result["calls"]] == ["part", "done"][name != "paper_scene1" :]
        assert result["seconds"] == pytest.approx(sum(call["seconds"] for call in result["calls"]), abs=0.2)
    trainings = [name for name in TRAININGS if name in ended]
    for name in trainings:
        figures = found[name]["figures"]
        assert figures["training"]["steps"] == figures["training"]["of"] == figures["seen"]["step"] == 40
        assert ("unseen" in figures) == name.startswith("paper") and figures["seen"]["transmitters"] == 2
    frequencies = dict(zip(TRAININGS, (10, 8, 1, 1, 10, 10), strict=True))
    assert all(len(found[name]["figures"]["seen"]["by_ghz"]) == frequencies[name] for name in trainings)
    assert len(found["paper_scene1"]["figures"]["unseen"]["by_ghz"]) == 17
    if "paper_scene4" in ended:
        assert list(found["paper_scene4"]["figures"]["unseen"]["by_ghz"]) == ["24.25", "77"]
