"""Counts of what was tried, for `python -m tools.qa.reliability`: a line of JSON each, where it asks for them."""

import json
import os
from pathlib import Path

VARIABLE = "WBGS_FAULT_LEDGER"


def count(part: str, name: str, number: int) -> None:
    """Adds that `number` cases of something were tried and held."""
    if ledger := os.environ.get(VARIABLE):
        with Path(ledger).open("a") as stream:
            stream.write(json.dumps({"part": part, "name": name, "number": number}) + "\n")
