"""Shares of lines and branches, all together and by room."""

import json

from builders.commands import call

from tools.qa.coverage_account import main


def test_shares_are_of_all_lines_of_a_room(tmp_path):
    def file(covered, lines, taken, branches):
        values = {"covered_lines": covered, "num_statements": lines, "covered_branches": taken, "num_branches": branches}
        return {"summary": values}

    files = {
        "wbgs_jax/commands/train.py": file(9, 10, 0, 0),
        "wbgs_jax/splat/a.py": file(1, 2, 1, 4),
        "wbgs_jax/splat/b.py": file(8, 8, 3, 4),
    }
    (tmp_path / "report.json").write_text(json.dumps({"files": files}))
    done = call(main, "--report", tmp_path / "report.json", "--out", tmp_path)
    assert done.code == 0, done.err
    found = json.loads((tmp_path / "coverage.json").read_text())
    assert (found["lines"], found["branches"]) == (90.0, 50.0)
    assert found["rooms"] == {
        "commands": {"lines": 90.0, "branches": 100.0, "statements": 10},
        "splat": {"lines": 90.0, "branches": 50.0, "statements": 10},
    }
