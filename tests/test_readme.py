"""The README's library example runs as it stands."""

import re
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"


def test_the_library_example_runs():
    code = re.search(r"## As a library.*?```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert code
    names: dict = {}
    exec(compile(code[1], "README.md", "exec"), names)
    assert names["pas"].shape == (90, 360)
    assert float(names["pas"].max()) == 1
    assert names["image"].shape == (1, 90, 360)
    assert names["d_tx"].shape == (3,) and float(abs(names["d_tx"]).max()) > 0
