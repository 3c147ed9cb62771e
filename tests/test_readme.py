"""What the documents show works: examples run as they stand, links lead somewhere, the page of public names is today's."""

import dataclasses
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from builders.synthetic import tiny_scene

import wbgs_jax as wb
from experiments import result_table
from wbgs_jax.commands import train
from wbgs_jax.fields import base

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "data_gen" / "README.md"]
NOTEBOOKS = ROOT / "docs" / "notebooks"
TRANSMITTERS = 24
"""Of the tiny scene: four of them, with three frequencies each, are for validation, so that a run learns how sure it is."""
SMALL = [
    "--optim.steps",
    "4",
    "--optim.batch",
    "2",
    "--loop.epoch-steps",
    "2",
    "--density.every",
    "0",
    "--density.reset-every",
    "0",
]
SMALL += ["--wideband.gaussians", "60", "--wideband.width", "8", "--wideband.radiance-widths", "8"]


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the names that the pages use stand for tiny things: scene 1, two runs, and two traced rooms."""
    here = tmp_path_factory.mktemp("pages")
    (here / "wbgs_jax").symlink_to(ROOT / "wbgs_jax")
    results = here / "experiments" / "results"
    results.mkdir(parents=True)
    for rows in result_table.FOLDER.glob("*.jsonl"):
        (results / rows.name).symlink_to(rows)
    result_table.write(results)
    (here / "released").mkdir()
    (here / "runs").mkdir()
    scene = tiny_scene(TRANSMITTERS)
    for file in ("released/scene1.npz", "runs/room_trial.npz"):
        wb.save_scene(here / file, dataclasses.replace(scene, element_pattern="iso"))
    wb.save_scene(here / "runs" / "room_more_rays.npz", dataclasses.replace(scene, snapshots=scene.snapshots * np.exp(1j)))
    run = here / "runs" / "scene1-hybrid-cpu-seed0"
    train.main(
        ["--scene", str(here / "released/scene1.npz"), "--field", "wideband", "--preset", "smoke", "--out", str(run), *SMALL]
    )
    (here / "runs" / "try").symlink_to(run)
    return here


def readme(names: dict) -> None:
    assert names["pas"].shape == (2, 90, 360) and names["slope"].shape == (3,)
    assert bool(np.isfinite(names["slope"]).all())


def concepts(names: dict) -> None:
    assert names["image"].shape == (1, 90, 360)
    assert names["d_tx"].shape == (3,) and float(abs(names["d_tx"]).max()) > 0
    assert float(abs(names["d_params"].gaussians.log_scales).max()) > 0  # nothing is frozen
    assert names["pas"].shape == (90, 360)


def inference(names: dict) -> None:
    assert names["grid"].shape == (2, 3, 4, 90, 360) and names["strongest"].shape == (2, 3, 4)
    assert names["off"].error_db.shape == (2,) and float(names["off"].within_db.min()) > 0
    # Measured spectra correct this run: 28 GHz, which is not in its data, has no interval, a measured frequency has.
    assert bool(np.isnan(names["sure"].low).all())
    query = wb.make_query([[1.0, 0.5, 1.5], [0.0, 1.0, 1.2]], 94e9)
    pas = wb.make_predictor(names["trained"])(query.tx_position, query.frequency_hz)
    sure = wb.expected_ssim(names["trained"].intervals, pas, query)
    assert bool((sure.low <= sure.high).all())
    assert names["slope"].shape == (2, 3) and names["metadata"]["frequency_range_hz"] == [1e9, 94e9]


def new_field(names: dict) -> None:
    field = wb.get_field("constant")(names["ConstantConfig"](brightness=0.25))
    seen = field.render(field.init(wb.make_query([0, 0, 0], 1e9)), None, wb.make_query([[0, 0, 0]] * 2, 1e9))
    assert seen.pas.shape == (2, 90, 360) and float(seen.pas.min()) == float(seen.pas.max()) == 0.25
    assert Path("runs/constant/eval.json").exists() and names["predict"]([0, 0, 1], 1e9).shape == (90, 360)


def recipes(names: dict) -> None:
    np.testing.assert_allclose(names["at_once"], names["mapped"], atol=1e-5)
    np.testing.assert_allclose(names["spectra"][0], names["predict"]([1.0, 0.5, 1.5], 28e9), atol=1e-5)
    assert names["degrees"].shape == (6,) and 0 <= names["within_5_degrees"] <= 1
    assert names["response_db"].shape == (2, 256) and -120 < float(names["response_db"].mean()) < -40
    np.testing.assert_allclose(names["snr_db"], names["rssi_dbm"] + 80, atol=1e-4)
    assert bool((names["sinr_db"] < names["snr_db"]).all()) and float(names["errors"].max()) < 0.2
    assert float(names["mismatch"](names["positions"]).min()) < float(names["mismatch"](names["starts"]).min())
    assert float(names["misfit"](names["params"])) < float(names["first"])
    assert float(abs(names["slopes"]["params"]["field"].gaussians.means).max()) > 0
    assert names["response"].shape == (200, 8) and float(abs(names["response"]).std(0).min()) > 0
    assert names["density"].shape == (len(names["shifts"]), len(names["times"]))
    np.testing.assert_allclose(names["answer"], names["predict"]([1.0, 0.5, 1.5], 28e9), atol=1e-4)


def start(names: dict) -> None:
    assert names["pair"].shape == (2, 90, 360) and float(abs(names["slope"]).max()) > 0


def own_scene(names: dict) -> None:
    assert names["correlation"].shape == (TRANSMITTERS, 1, 3) and names["correlation"].min() > 0.999


def measured(names: dict) -> None:
    assert names["mean"].shape == (1, 2) and float(names["mean"].min()) > -80 and float(names["std"].max()) < 6


def formats(names: dict) -> None:
    assert names["pas"].shape == (10, 90, 360) and names["scene"].snapshots.shape == (877, 1, 10, 16)
    assert len(wb.load_dataset("mine.npz")) == 80


def interchange(names: dict) -> None:
    assert names["gaussians"].means.shape == (names["count"], 3) and float(names["colours"].max()) == 1
    assert names["scene"].snapshots.shape == (8, 1, 1, 16)
    np.testing.assert_allclose(names["again"].channel(0.0), names["paths"].channel(0.0), rtol=1e-5)


def experiments(names: dict) -> None:
    assert {row["scene"] for row in names["ours"]} >= set("123456")


def viewer(names: dict) -> None:
    assert names["answer"].pas.shape == (90, 360)


ELSEWHERE = {"applications.md": ROOT / "tests" / "applications" / "test_guide.py"}
"""Pages whose blocks another test runs."""
HOLDS: dict[str, Callable[[dict], None]] = {
    f"{check.__name__}.md": check
    for check in (
        concepts,
        inference,
        new_field,
        recipes,
        start,
        own_scene,
        measured,
        formats,
        interchange,
        experiments,
        viewer,
    )
} | {"README.md": readme}
"""What must hold of the names that a page's blocks leave, by page."""


@pytest.mark.heavy
@pytest.mark.parametrize("page", [p for p in PAGES if python_blocks(p) and p.name not in ELSEWHERE], ids=lambda p: p.name)
def test_the_examples_of_a_page_run(page, folder, monkeypatch):
    monkeypatch.setattr(base, "_FIELDS", dict(base._FIELDS))
    monkeypatch.setenv("WBGS_DATA", str(folder / "released"))
    monkeypatch.chdir(folder)
    names: dict = {"__name__": "example"}
    for number, code in enumerate(python_blocks(page)):
        exec(compile(code, f"{page.name}, block {number + 1}", "exec"), names)
    assert page.name in HOLDS, f"say in HOLDS what must hold after the blocks of {page.name}"
    HOLDS[page.name](names)


@pytest.mark.parametrize("page", ELSEWHERE)
def test_another_test_runs_the_examples_of_a_page(page):
    assert page in ELSEWHERE[page].read_text()


def test_the_page_of_public_names_is_todays():
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        import make_api
    finally:
        sys.path.pop(0)
    assert (ROOT / "docs" / "api.md").read_text() == make_api.page(), "run `make docs`"


@pytest.mark.parametrize("page", [*PAGES, *sorted(NOTEBOOKS.glob("*.md"))], ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), target
