"""The architecture's arrows: the pure part stands alone, and neither side of the scene file reaches into the other."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PURE = ["array", "config", "encoding", "fields.wideband", "geometry", "losses", "networks", "pytree", "splat", "types"]
HOST_ONLY = {"matplotlib", "optax", "orbax", "PIL", "plyfile", "rich", "scipy", "skimage", "trimesh", "tyro", "yaml"}
SIMULATOR = {"data_gen", "drjit", "mitsuba", "sionna"}
TRAINING = ("train", "train_step", "trainer", "fields", "splat", "density", "optim", "networks", "checkpoint", "runs", "eval")

TINY_RENDER = """
import numpy as np, jax, jax.numpy as jnp
from wbgs_jax import Capacity, Surface, WidebandConfig, make_query, make_receiver, wideband

def pas_of(points):
    config = WidebandConfig(width=4, depth=2, skip=1, radiance_widths=(4,), gaussian_octaves=1, tx_octaves=1)
    params = wideband.init(jax.random.key(0), Surface(points, jnp.full(5, 0.2)), config)
    plan = wideband.plan(params, make_receiver((0, 0, 0)), Capacity(entries=4096, jobs=1024))
    return wideband.render(params, plan, make_query((1, 1, 1), 5e9))

pas = jax.jit(pas_of)(np.random.default_rng(0).uniform(1, 2, (5, 3)).astype(np.float32))
assert pas.shape == (1, 90, 360) and float(pas.max()) > 0.01
"""

BLOCKER = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {blocked!r}:
            raise ImportError("blocked: " + name)

sys.meta_path.insert(0, Blocker())
"""


def imports_of(path: Path) -> set[str]:
    """Full names of everything a file imports, wherever in it."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join([*package[: len(package) + 1 - node.level], node.module or ""]) if node.level else node.module
            names |= {f"{base}.{alias.name}".replace("..", ".") for alias in node.names}
    return names


def modules_of(package: str) -> dict[str, Path]:
    files = {path: ".".join(path.relative_to(ROOT).with_suffix("").parts) for path in sorted((ROOT / package).rglob("*.py"))}
    return {name.removesuffix(".__init__"): path for path, name in files.items()}


LIBRARY = modules_of("wbgs_jax")


def reachable(name: str, seen: set[str]) -> set[str]:
    """Names of all modules of the library that importing one of them runs."""
    parents = [name.rsplit(".", n)[0] for n in range(name.count(".") + 1)]
    for module in parents:
        if module in LIBRARY and module not in seen:
            seen.add(module)
            for imported in imports_of(LIBRARY[module]):
                reachable(imported, seen)
    return seen


def test_the_finder_of_imports_finds_them():
    """Known arrows; an empty set would make every test here pass."""
    assert "wbgs_jax.splat" in reachable("wbgs_jax.fields.wideband", set())
    assert any(name.startswith("optax") for name in imports_of(LIBRARY["wbgs_jax.training.optim"]))
    assert any(name.startswith("orbax") for name in imports_of(LIBRARY["wbgs_jax.training.checkpoint"]))


@pytest.mark.parametrize("module", PURE)
def test_the_pure_part_imports_nothing_of_the_host(module):
    for name in reachable(f"wbgs_jax.{module}", set()):
        outside = {imported.split(".")[0] for imported in imports_of(LIBRARY[name])}
        assert not outside & HOST_ONLY, name


def test_the_pure_part_renders_where_the_hosts_modules_are_missing():
    """JAX itself needs SciPy, and Flax needs rich and PyYAML; those are not blocked."""
    source = BLOCKER.format(blocked=HOST_ONLY - {"rich", "scipy", "yaml"}) + "".join(
        f"import wbgs_jax.{name}\n" for name in PURE
    )
    done = subprocess.run([sys.executable, "-c", source + TINY_RENDER], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", LIBRARY)
def test_the_library_never_imports_the_simulator(name):
    assert not {imported.split(".")[0] for imported in imports_of(LIBRARY[name])} & SIMULATOR


@pytest.mark.parametrize("name", modules_of("data_gen"))
def test_the_generator_never_imports_models_or_training(name):
    imported = imports_of(modules_of("data_gen")[name])
    assert not [i for i in imported if i.startswith(tuple(f"wbgs_jax.{module}" for module in TRAINING))]


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        ("splat", ("fields", "data", "train", "losses", "networks")),
        ("fields", ("data", "train", "runs", "eval")),
        ("data", ("fields", "train", "runs", "eval", "splat")),
        ("losses", ("metrics", "data", "fields")),
        ("train_step", ("trainer", "runs", "checkpoint", "density")),
        ("density", ("trainer", "runs", "checkpoint")),
        ("trainer", ("train", "eval", "runs")),
    ],
)
def test_arrows_point_down(lower, upper):
    files = [name for name in LIBRARY if f"{name}.".startswith(f"wbgs_jax.{lower}.")]
    assert files
    for name in files:
        for imported in imports_of(LIBRARY[name]):
            parts = imported.split(".")
            assert not (parts[0] == "wbgs_jax" and len(parts) > 1 and parts[1] in upper), (name, imported)
