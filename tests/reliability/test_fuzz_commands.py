"""Command lines as careless people give them: words left out, doubled, swapped or replaced by nonsense. They end with exit code
0 or 2 and one line, and write nothing where nobody asked them to."""

import os
import sys
import zlib
from pathlib import Path
from random import Random

import pytest
from builders.commands import call
from builders.reliability.damage import WORDS as DAMAGED
from builders.reliability.ledger import count
from builders.untrained import make_coherent_run
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from test_fuzz_readers import bounded

from wbgs_jax._util.errors import UserError
from wbgs_jax.commands import convert, map, measure, predict, train, view
from wbgs_jax.commands import evaluate as evaluation
from wbgs_jax.commands import export_folder as layout
from wbgs_jax.commands import main as cli
from wbgs_jax.training import run_folder
from wbgs_jax.training.run_folder import load_trained

QUICK, SLOW = 10, 400
WORDS = tuple(word for word in DAMAGED if "\x00" not in word)  # no operating system passes it on
MAINS = {
    "train": train.main, "eval": evaluation.main, "predict": predict.main, "map": map.main, "measure": measure.main,
    "convert": convert.main, "view": view.main, "layout": layout.main,
}  # fmt: skip
SEEDS = {
    "train": "--scene box.npz --out made/run --field nerf2 --preset smoke --seed 3 --train-ghz 1 10 --optim.steps 200",
    "eval": "--run box --data box.npz --part test --json --no-pictures --results made/results",
    "predict": "--run box --tx 1,0,1 -1,0.5,1 --ghz 10 28 --what paths --tx-velocity 1,0,0 --out made/x.csv",
    "predict lines": "--run box --line 0,0,1:1,1,1:4 --sweep 1:60:3 --rx 0.5,0,1 --out made/x.npz",
    "predict grids": "--run box --grid 0,0,1:1,1,2:2x2x1 --ghz 28 --what frequency-response --points 8 --out made/x.npz",
    "predict queries": "--run box --queries queries.csv --out made/x.npz --resume --tx-array 2x2 --what mimo",
    "map": "--run box --ghz 10 28 --what power --height 1.2 --step 0.5 --area -1,-1:1,1 --out made/map.npz",
    "measure": "--floor-plan walls.csv --ceiling 2.6 --mesh made/walls.ply --height 1 --cell 0.5",
    "convert": "--run box --grid 0,0,1:1,1,1:2x1x1 --ghz 28 --out made/paths.npz --rx 0",
    "convert paths": "--paths box.npz --ghz 28 --array 2x2 --mesh walls.csv --swap --out made/scene.npz",
    "view": "--run box --port 8080 --tx 1,0,1 --ghz 10 --html made/page.html --up z",
    "layout": "box.npz made/layout",
}  # fmt: skip
FILES = ("box", "box.npz", "walls.csv", "queries.csv", "nowhere", "made", ".", "", "box/config.json", "pipe")


class Reached(UserError):
    """The command line was found to be good, and the work would begin."""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a run and files, and a folder that commands may write to; the work itself is left out."""
    folder = tmp_path_factory.mktemp("commands")
    make_coherent_run(folder / "box")
    (folder / "walls.csv").write_text("x1,y1,x2,y2\n0,0,5,0\n5,0,5,4\n")
    (folder / "queries.csv").write_text("x,y,z,ghz\n1,0,1,28\n")
    os.mkfifo(folder / "pipe")
    return folder


def reached(*_, **__):
    raise Reached("the work begins")


@pytest.fixture
def no_work(monkeypatch, place):
    """Lets commands check everything, and not compute."""
    known = load_trained(place / "box")

    def load(folder):
        return known if Path(folder).resolve() == (place / "box").resolve() else load_trained(folder)

    monkeypatch.setattr(run_folder, "load_trained", load)
    monkeypatch.setattr(train, "train", reached)
    monkeypatch.setattr(evaluation, "evaluate", reached)
    monkeypatch.setattr("wbgs_jax.inference.evaluate_quantities.LoadedField.answer", reached)
    monkeypatch.setattr("wbgs_jax.inference.cached_field.make_cached", lambda *_: None)
    monkeypatch.setattr("wbgs_jax.inference.radio_map.evaluate_plane", reached)
    monkeypatch.setattr("wbgs_jax.inference.evaluate_quantities.predict_paths", reached)
    monkeypatch.setattr("wbgs_jax.viewer.app.Viewer", reached)
    monkeypatch.setattr(measure, "learn_map", reached)
    monkeypatch.setattr(measure, "use_compilation_cache", lambda: None)
    monkeypatch.chdir(place)


def damage_words(draw: Random, words: list[str]) -> list[str]:
    """One to three words are other ones."""
    words = list(words)
    for _ in range(draw.randint(1, 3)):
        at = draw.randrange(len(words)) if words else 0
        match draw.randrange(6):
            case 0 if words:
                words.pop(at)
            case 1 if words:
                words.insert(at, draw.choice(words))
            case 2 if words:
                other = draw.randrange(len(words))
                words[at], words[other] = words[other], words[at]
            case 3 if words:
                parts = words[at].replace(":", ",").split(",")
                words[at] = words[at].replace(draw.choice(parts), draw.choice(WORDS), 1)
            case 4:
                words.insert(at, draw.choice((*WORDS, *FILES, "--", "-h", "--help", "--out", "--resume", "--seed")))
            case _ if words and not words[at].startswith("--"):
                words[at] = draw.choice((*WORDS, *FILES))
    return words


def tree(folder: Path) -> set[str]:
    found = (path.relative_to(folder) for path in folder.rglob("*"))
    return {str(path) for path in found if path.parts[0] not in ("made", "runs")}


def fuzz(name: str, place: Path, cases: int) -> None:
    main, tried = MAINS[name.split()[0]], []

    @seed(int(os.environ["WBGS_TEST_SEED"]) ^ zlib.crc32(name.encode()))
    @settings(
        max_examples=cases, deadline=None, database=None, suppress_health_check=[*HealthCheck],
        phases=(Phase.generate, Phase.shrink),
    )  # fmt: skip
    @given(st.randoms(use_true_random=True))
    def one(draw: Random) -> None:
        words = damage_words(draw, SEEDS[name].split())
        outside = [word for word in words if ".." in word or word.startswith("/")]
        if outside:  # whoever names another place means it
            words = [word for word in words if word not in outside]
        tried.append(words)
        before = tree(place)
        with bounded():
            ended = call(main, *words)
        said = ended.err.strip().splitlines()
        assert ended.code in (0, 2), (words, ended)
        assert "Traceback" not in ended.err, (words, ended.err)
        assert ended.code == 0 or said, words
        asked = {part for word in words for part in Path(word).parts[:1]}
        made = {path for path in tree(place) - before if Path(path).parts[0] not in asked}
        assert not made or "." in words, (words, made)

    one()
    count("command lines", name, len(tried))


@pytest.mark.heavy
@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize("name", SEEDS)
def test_a_few_careless_command_lines(name, place):
    fuzz(name, place, QUICK)


@pytest.mark.slow
@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize("name", SEEDS)
def test_many_careless_command_lines(name, place):
    fuzz(name, place, SLOW)


def test_a_word_that_is_no_command(monkeypatch, rng):
    for _ in range(50):
        word = WORDS[rng.integers(len(WORDS))]
        monkeypatch.setattr(sys, "argv", ["wbgs-jax", word])
        ended = call(lambda _: cli.dispatch())
        assert ended.code == 2 and "no command" in ended.err
