"""Readers on damaged files: they read them, or say in one line what is wrong. No traceback, no hang, bounded memory."""

import contextlib
import os
import resource
import shutil
import signal
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest
from builders.reliability.damage import damage
from builders.reliability.ledger import count
from builders.reliability.readables import READABLES
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from wbgs_jax._util.errors import UserError

QUICK, SLOW = 10, 750
"""Cases a reader."""
FORGIVING = dict.fromkeys(
    (
        "JSON",
        "YAML",
        "curves and neighbours of a run",
        "readings of powers",
        "result of an experiment",
        "batch of the generator",
    ),
    60,
)
"""Cases of readers to which half of the damage or more is a file as good as any: of ten, none may be noticed."""
LONGEST_S, MOST_BYTES = 5, 4 * 2**30
SLOW_TO_READ = {"checkpoint": 250, "room in GLB": 400, "exported field": 400}
COSTLY = ("checkpoint", "exported field", "manifest of a run", "room in GLB")
"""Left to the slow tests."""


class Hang(BaseException):
    """It takes longer than anybody waits."""


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """An alarm after `LONGEST_S`, and no more memory than `MOST_BYTES` beyond what there is."""

    def ring(number, frame):
        raise Hang(f"longer than {LONGEST_S} s")

    signals = {signal.SIGPROF: signal.ITIMER_PROF, signal.SIGALRM: signal.ITIMER_REAL}
    before, old = {number: signal.signal(number, ring) for number in signals}, resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, old[1]))
    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)  # of the processor, which others may use as well
    signal.setitimer(signal.ITIMER_REAL, 12 * LONGEST_S)
    try:
        yield
    finally:
        for number, timer in signals.items():
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])
        resource.setrlimit(resource.RLIMIT_AS, old)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Makes whole files once a reader, and returns their contents and a folder to damage them in."""
    made: dict[str, tuple[dict[str, bytes], Path, list[str]]] = {}

    def get(name):
        if name not in made:
            folder = tmp_path_factory.mktemp("whole")
            READABLES[name].make(folder)
            READABLES[name].read(folder)
            READABLES[name].make(folder) if name.startswith("curves") else None
            chosen = [str(p.relative_to(folder)) for p in sorted(folder.glob(READABLES[name].damaged)) if p.is_file()]
            made[name] = files(folder), tmp_path_factory.mktemp("case") / "case", chosen
        return made[name]

    return get


def lay_out(contents: dict[str, bytes], folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    for name, content in contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def check(name: str, folder: Path) -> bool:
    """Reads; returns whether there was something to say."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with bounded():
                READABLES[name].read(folder)
        except UserError as error:
            line = str(error)
            assert "\n" not in line and 10 < len(line) < 1500, line
            assert "allow_pickle" not in line, line
            return True
    return False


def fuzz(name: str, whole, cases: int) -> None:
    contents, folder, chosen = whole(name)
    said, tried = [], []

    @seed(int(os.environ["WBGS_TEST_SEED"]) ^ zlib.crc32(name.encode()))
    @settings(
        max_examples=cases, deadline=None, database=None, suppress_health_check=[*HealthCheck], report_multiple_bugs=True,
        phases=(Phase.generate, Phase.shrink),
    )  # fmt: skip
    @given(st.randoms(use_true_random=True))
    def one(draw: Random) -> None:
        which = draw.choice(chosen)
        damaged = contents | {which: damage(draw, which, contents[which])}
        lay_out(damaged, folder)
        tried.append(which)
        said.append(check(name, folder))
        assert set(files(folder)) <= set(damaged) | {"box.npz"}, "no file is left beside"

    one()
    assert any(said), "nothing that was done was noticed"
    count("damaged files", name, len(tried))


@pytest.mark.parametrize("name", [name for name in READABLES if name not in COSTLY])
def test_a_few_damaged_files(name, whole):
    fuzz(name, whole, FORGIVING.get(name, QUICK))


@pytest.mark.slow
@pytest.mark.parametrize("name", READABLES)
def test_many_damaged_files(name, whole):
    fuzz(name, whole, SLOW_TO_READ.get(name, SLOW))
