"""What the layers of pyproject.toml (import-linter) cannot say: the pure part runs alone, and fields are named in one place."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from wbgs_jax.fields import field_names

ROOT = Path(__file__).parents[1]
HOST_ONLY = {"matplotlib", "optax", "orbax", "PIL", "plyfile", "skimage", "trimesh", "tyro"}
"""Besides, JAX itself needs SciPy, and Flax needs rich and PyYAML."""
LIBRARY = sorted(p for p in (ROOT / "wbgs_jax").rglob("*.py") if "fields" not in p.parts and p.name != "__init__.py")

BLOCKER = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {blocked!r}:
            raise ImportError("blocked: " + name)

sys.meta_path.insert(0, Blocker())
"""

RENDER_EVERYTHING = """
import numpy as np, jax, jax.numpy as jnp
import wbgs_jax as wb
from wbgs_jax.fields.nerf2 import Nerf2Config, Nerf2Field

query, receiver = wb.make_query((1.5, 1.2, 1.4), 5e9), wb.make_receiver((0.5, 0.5, 1.0))
small = dict(width=4, depth=2, skip=1, radiance_widths=(4,))

points = np.random.default_rng(0).uniform(1, 2, (5, 3)).astype(np.float32)
config = wb.wideband.WidebandConfig(gaussian_octaves=1, tx_octaves=1, **small)
splatted = wb.wideband.make_field(wb.Surface(jnp.asarray(points), jnp.full(5, 0.2)), config)

volume = Nerf2Field(jnp.array([[0.0, 0, 0], [2, 2, 2]]), Nerf2Config(samples=2, directions=4, **small))

# A floor and a wall: facets, one edge, mirror images, paths, slabs and the spectrum of what arrives.
corners = np.array([[0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0], [0, 0, 2], [3, 0, 2]], np.float32)
faces = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 5], [0, 5, 4]], np.int32)
part = np.array([0, 0, 1, 1], np.int32)
few = dict(specular_tried=8, specular_kept=4, diffracted_tried=4, diffracted_kept=2, mirror_areas=(0.0,))
mesh = wb.Mesh(*map(jnp.asarray, (corners, faces, part, part)), jnp.zeros(2))
coherent = wb.coherent.make_field(mesh, wb.coherent.WaveConfig(**few))

for field in (splatted, volume, coherent):
    params = field.init(jax.random.key(0))
    plan = type(field).plan if field is coherent else jax.jit(type(field).plan, static_argnames="capacity")
    plan = plan(field, params, receiver, capacity=wb.splat.TileLimits(4096, 1024) if field is splatted else None)
    pas = jax.jit(type(field).render)(field, params, plan, query).pas
    assert pas.shape == (1, 90, 360) and float(pas.max()) > 0.01 and bool(jnp.isfinite(pas).all()), field.name
"""


@pytest.mark.heavy
def test_the_pure_part_renders_where_the_hosts_modules_are_missing():
    """All fields, from their geometry to their spectra."""
    source = BLOCKER.format(blocked=HOST_ONLY) + RENDER_EVERYTHING
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_the_layers_are_kept():
    """The contracts of pyproject.toml, which docs/architecture.md draws."""
    lint = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([lint, "--no-logo", "--no-cache"], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0 and "0 broken" in done.stdout, done.stdout


def named_fields(source: str) -> set[str]:
    """Fields that code names: by an identifier, a string of that name, or an option of a command line."""
    tree, found = ast.parse(source), set()
    names = set(field_names()) | {"wideband", "wave", "wrfgs", "nerf2"}
    for node in ast.walk(tree):
        if isinstance(node, ast.alias):
            found |= names & set(node.name.split("."))
        elif isinstance(node, ast.Name | ast.Attribute):
            found |= names & {node.id if isinstance(node, ast.Name) else node.attr}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            options = {word for match in re.findall(r"--field[ =](\w+)|--(\w+)\.", node.value) for word in match}
            found |= names & ({node.value} | options)
    return found


@pytest.mark.parametrize(
    "source",
    ["from wbgs_jax.fields import wave", "x = fields.wideband", "'nerf2' == name", "print('train with --field wave, please')"],
)
def test_the_finder_finds_names(source):
    """An empty set would make the test below pass."""
    assert len(named_fields(source)) == 1


@pytest.mark.parametrize("path", LIBRARY, ids=lambda p: str(p.relative_to(ROOT)))
def test_no_file_outside_fields_names_a_field(path):
    """A new model is one file: command lines, training, inference and evaluation ask the seam alone. The list of public names
    (`__init__`) is the exception."""
    assert not named_fields(path.read_text())


@pytest.mark.parametrize("path", sorted((ROOT / "wbgs_jax").rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_modules_are_short(path):
    assert len(path.read_text().splitlines()) <= 600


@pytest.mark.parametrize("path", LIBRARY, ids=lambda p: str(p.relative_to(ROOT)))
def test_nobody_guesses_what_a_field_is(path):
    """No `hasattr` on parameters or fields, no `isinstance` of a field: what is needed is asked of the seam."""
    if "_util" in path.parts:
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("hasattr", "isinstance"):
            text = ast.unparse(node)
            assert not re.search(r"hasattr\((.*\.)?(field|params|trained)\b|Field\b", text), text
