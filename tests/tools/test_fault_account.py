"""The account of faults: counts add up, and those of other parts stay."""

import json

from tools.qa.reliability import account, collect


def test_counts_are_added_and_replace_older_ones_of_the_same_name(tmp_path):
    entries = [("kills", "a", 2), ("kills", "a", 3), ("damaged files", "scene file", 100)]
    lines = (json.dumps({"part": part, "name": name, "number": number}) for part, name, number in entries)
    (tmp_path / "ledger.jsonl").write_text("\n".join(lines))
    found = collect(tmp_path / "ledger.jsonl")
    assert found == {"kills": {"a": 5}, "damaged files": {"scene file": 100}}
    before = {"tried": {"kills": {"a": 9, "b": 1}, "clocks": {"c": 1}}, "runs": [{"seed": 1}]}
    after = account(before, found, {"seed": 2})
    assert after["totals"] == {"clocks": 1, "damaged_files": 100, "kills": 6}
    assert after["runs"] == [{"seed": 1}, {"seed": 2}]
    assert account(None, {}, {})["totals"] == {} and collect(tmp_path / "nothing") == {}
