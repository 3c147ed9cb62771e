"""Fixtures shared by all tests: a printed random seed, fixed or drawn, and the optional folder of published data."""

import gc
import os
import tempfile
import zlib
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

# Before anything imports jax.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA warns about tuning flags of cached programs; JAX sets "1" otherwise
os.environ.setdefault("WBGS_CACHE", "")  # command lines under test leave nothing in the home folder
# Workers have a core each: on one that is shared, the threads of a small solve mostly wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if not os.environ.get("WBGS_TEST_OPTIMISED"):
    # Nearly all of the time goes into compiling programs that run once, on next to nothing: half of it is for their speed.
    FAST_TO_COMPILE = ["--xla_backend_optimization_level=0", "--xla_llvm_disable_expensive_passes=true"]
    if version("jaxlib").startswith("0.10."):  # later ones end at a flag that they do not know
        # Small programs are not worth splitting into modules: in one, compiling takes a tenth less processor time.
        FAST_TO_COMPILE += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
    os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *FAST_TO_COMPILE]).strip()

import jax
import numpy as np
import pytest

MOST_MAPS, MOST_BYTES = 25_000, 3e9
SEED_VARIABLE, DATA_VARIABLE = "WBGS_TEST_SEED", "WBGS_SHARED"
USUAL_SEED, FRESH = "2505", "fresh"
"""The seed where the environment names none, and what it says to have another one drawn."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--draws", type=int, default=1, help="run every test of random inputs this often, on fresh ones each time")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    draws = metafunc.config.getoption("draws")
    if draws > 1 and "rng" in metafunc.fixturenames:
        metafunc.parametrize("rng", range(draws), indirect=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("long") is None)


def pytest_collection_finish() -> None:
    # Tracing leaves millions of objects, hardly any of them in circles: looking for those less often saves some per cent.
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)


def pytest_configure(config: pytest.Config) -> None:
    if "PYTEST_XDIST_WORKER" not in os.environ:
        # What one worker or command has compiled the others load.
        folder = tempfile.TemporaryDirectory(prefix="wbgs-test-cache-", ignore_cleanup_errors=True)
        config.add_cleanup(folder.cleanup)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", folder.name)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")  # most of the time goes into small programs
    # In the environment, so that the workers of pytest-xdist draw the same.
    seed = os.environ.get(SEED_VARIABLE) or USUAL_SEED
    os.environ[SEED_VARIABLE] = str(np.random.SeedSequence().entropy % 2**32) if seed == FRESH else seed


def pytest_report_header(config: pytest.Config) -> str:
    return f"random seed: repeat this run with {SEED_VARIABLE}={os.environ[SEED_VARIABLE]}"


def pytest_terminal_summary(terminalreporter: "pytest.TerminalReporter", config: pytest.Config) -> None:
    if config.option.verbose < 0:  # pytest -q prints no header
        terminalreporter.write_line(pytest_report_header(config))


@pytest.fixture(autouse=True, scope="module")
def few_programs_in_memory() -> Iterator[None]:
    """Forgets compiled programs when there are many: each takes memory maps, of which Linux gives a process 65,530, and where
    they end XLA ends the process. Two workers that never forgot would take most of the memory of a laptop."""
    yield
    process = Path("/proc/self")
    if not process.exists():
        return
    maps, pages = (process / "maps").read_bytes().count(b"\n"), int((process / "statm").read_text().split()[1])
    if maps > MOST_MAPS or pages * os.sysconf("SC_PAGE_SIZE") > MOST_BYTES:
        jax.clear_caches()
        gc.collect()
        from wbgs_jax._util.compilation import give_back

        give_back()


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Random numbers that differ by test, and depend on nothing but the printed seed and the test's name."""
    return np.random.default_rng([int(os.environ[SEED_VARIABLE]), zlib.crc32(request.node.name.encode())])


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """Finds a folder of published data by name, or skips: that data is not ours to ship."""
    root = Path(os.environ.get(DATA_VARIABLE) or Path(__file__).parents[2] / "shared" / "data")

    def find(name: str) -> Path:
        if not (root / name).is_dir():
            pytest.skip(f"{name} is not in {root}; set {DATA_VARIABLE} to the folder that holds it")
        return root / name

    return find


@pytest.fixture(scope="module")
def ripple() -> Iterator[None]:
    """Makes a toy field known that compiles in no time."""
    from builders.toys import RippleField, registered

    with registered(RippleField):
        yield


@pytest.fixture
def x64():
    """Double precision for one test."""
    import jax

    with jax.enable_x64(True):
        yield
