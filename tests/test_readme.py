"""What the documents show works: examples run as they stand, links lead somewhere, the page of public names is today's."""

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "data_gen" / "README.md"]


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


def run(code: str) -> dict:
    names: dict = {"__name__": "example"}
    exec(compile(code, "example", "exec"), names)
    return names


def test_the_readmes_example_runs():
    names = run(python_blocks(ROOT / "README.md")[0])
    assert names["pas"].shape == (90, 360)
    assert float(names["pas"].max()) == 1
    assert names["image"].shape == (1, 90, 360)
    assert names["d_tx"].shape == (3,) and float(abs(names["d_tx"]).max()) > 0
    assert float(abs(names["d_params"].gaussians.log_scales).max()) > 0  # nothing is frozen


def test_the_guides_field_is_a_field(monkeypatch):
    from wbgs_jax.fields import base

    monkeypatch.setattr(base, "_FIELDS", dict(base._FIELDS))
    names = run(python_blocks(ROOT / "docs" / "new_field.md")[0])
    import wbgs_jax as wb

    field = wb.get_field("constant")(names["ConstantConfig"](brightness=0.25))
    seen = field.render(field.init(wb.make_query([0, 0, 0], 1e9)), None, wb.make_query([[0, 0, 0]] * 2, 1e9))
    assert seen.pas.shape == (2, 90, 360) and float(seen.pas.min()) == float(seen.pas.max()) == 0.25


def test_the_page_of_public_names_is_todays():
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        import make_api
    finally:
        sys.path.pop(0)
    assert (ROOT / "docs" / "api.md").read_text() == make_api.page(), "run `make docs`"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), target
