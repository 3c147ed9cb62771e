"""The coherent field's paths: how long a receiver, a transmitter and a query take, how that grows, and beside other tracers."""

import dataclasses
import functools
import importlib.util
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float

from experiments.bench import tracers
from experiments.bench.timing import Effort, Report, interleaved
from wbgs_jax._util.cli import say
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.load import load_dataset
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import coherent
from wbgs_jax.fields.coherent import WaveConfig
from wbgs_jax.types import Mesh, Query, Transmitter, make_query, make_receiver

SCENES, RIVAL_SCENES = ("2", "3", "4", "5"), ("1", "2")
BLOCK_TX = 16
FACETS = (300, 3_000, 20_000, 100_000)
HALL = np.array([30.0, 30.0, 4.0])
"""Metres: the hall whose furniture makes the facets."""
CROWD = 4
"""Transmitters that are traced in the hall."""
RIVAL_TX = 4
RIVAL_CONFIG = WaveConfig(
    mirror_areas=(0.0, 0.0), specular_tried=1024, specular_kept=512, diffracted_tried=8, diffracted_kept=8
)
"""Two reflections off facets of any size, as in the other tracers; paths through walls cannot be excluded."""


def measure(report: Report, effort: Effort) -> None:
    """All of it."""
    for number in SCENES[:1] if effort.quick else SCENES:
        measure_scene(report, effort, number)
    for number in RIVAL_SCENES[:1] if effort.quick else RIVAL_SCENES:
        _measure_rivals(report, effort, number)


@jax.jit
def answer(params: Any, plan: Any, paths: Any, place: Any, frequency_hz: Float[jax.Array, " b"]) -> Any:
    """Returns spectra, snapshots and powers of transmitters whose paths are known."""
    paths = jax.tree.map(lambda leaf: leaf[place], paths)
    return coherent.observe(params, plan, paths, Query(Transmitter(paths.specular.points[:, 0, 0]), frequency_hz))


def measure_scene(report: Report, effort: Effort, number: str) -> None:
    """A released scene by its own numbers: everything that does not depend on the query is planned."""
    say(f"rays: scene {number}")
    dataset = load_dataset(number)
    field = coherent.make_field(DatasetScene(dataset).mesh())
    params, receiver = tracers.known_params(field, dataset), dataset.receiver()
    plan = field.plan(params, receiver)
    query = dataset.query(first_links(dataset, BLOCK_TX))
    some, tens = query.tx_position, jnp.asarray(frequencies_of(dataset), jnp.float32)

    def block() -> Any:
        paths = coherent.trace(plan, some)
        return [answer(params, plan, paths, jnp.full(len(tens), one), tens) for one in range(len(some))]

    def single() -> Any:
        return answer(params, plan, coherent.trace(plan, some[:1]), jnp.zeros(len(tens), int), tens)

    def outside() -> Any:
        return field.render(params, plan, jax.tree.map(lambda leaf: leaf[:1], query))

    ready, traced = (lambda: field.plan(params, receiver)), (lambda: coherent.trace(plan, some))
    calls = {"receiver": ready, "trace": traced, "block": block, "single": single, "outside": outside}
    seconds = interleaved(calls, effort)
    report.add_time(f"rays_scene{number}_receiver_ready", seconds["receiver"])
    report.add_time(f"rays_scene{number}_transmitter", seconds["trace"] / len(some))
    report.add_time(f"rays_scene{number}_spectrum_in_blocks", seconds["block"] / len(some) / len(tens))
    report.add_time(f"rays_scene{number}_query_of_{len(tens)}_frequencies", seconds["single"])
    report.add_time(f"rays_scene{number}_query_outside_of_jit", seconds["outside"])


def measure_facets(report: Report, effort: Effort) -> None:
    """Measures how processor time and memory grow with the number of facets, whatever else the machine does."""
    for facets in FACETS[:1] if effort.quick else FACETS:
        _measure_hall(report, effort, facets)


def _measure_hall(report: Report, effort: Effort, facets: int) -> None:
    """A hall full of boxes."""
    say(f"facets: a hall of {facets}")
    rng = np.random.default_rng([effort.seed, facets])
    field = coherent.make_field(hall(facets, rng), WaveConfig(max_facets=max(FACETS)))
    receiver, params = make_receiver(HALL * [0.1, 0.5, 0.9]), field.init(jax.random.key(0))
    begin = time.process_time()
    plan = field.plan(params, receiver)
    ready, tx = time.process_time() - begin, rng.uniform(HALL * [0.1, 0.1, 0.8], HALL * 0.95, (CROWD, 3))
    query = make_query(tx, 28e9)
    compiled = coherent.trace.lower(plan, query.tx_position).compile()
    every = jnp.arange(CROWD)
    times = []
    for _ in range(1 + effort.repeats):  # the first one compiles
        begin = time.process_time()
        jax.block_until_ready(answer(params, plan, compiled(plan, query.tx_position), every, query.frequency_hz))
        times.append((time.process_time() - begin) / CROWD)
    report.add_time(f"facets_{facets}_spectrum_cpu", np.array(times[1:]))
    report.add(f"facets_{facets}_receiver_ready_cpu", ready, "s", "lower")
    analysis = compiled.memory_analysis()
    assert analysis is not None, "every backend with XLA knows"
    report.add(f"facets_{facets}_temporaries", analysis.temp_size_in_bytes / 1e9, "GB", "lower")


def hall(facets: int, rng: np.random.Generator) -> Mesh:
    """Returns a hall with as many boxes, in rows, as make so many facets."""
    boxes = (facets - 6) // 6
    side = int(np.ceil(np.sqrt(boxes)))
    pitch = (HALL[:2] - 2) / side
    parts = [trimesh.creation.box(bounds=[np.zeros(3), HALL])]
    for place in range(boxes):
        low = np.array([*(1 + pitch * divmod(place, side)), rng.uniform(0.05, 0.7 * HALL[2])])
        size = np.array([*(0.4 * pitch), rng.uniform(0.1, 0.8)])
        parts.append(trimesh.creation.box(bounds=[low, low + size]))
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + 8 * i for i, part in enumerate(parts)])
    part = np.repeat(np.arange(len(parts)), 12)
    arrays = (jnp.asarray(faces, jnp.int32), jnp.asarray(part, jnp.int32), jnp.zeros(len(faces), jnp.int32))
    return Mesh(jnp.asarray(vertices, jnp.float32), *arrays, jnp.array([0.02], jnp.float32))


def _measure_rivals(report: Report, effort: Effort, number: str) -> None:
    """Other tracers at equal transmitters, receiver and orders, and how far they agree path by path."""
    dataset = load_dataset(number)
    queries = np.asarray(dataset.query(first_links(dataset, RIVAL_TX)).tx_position, np.float64), frequencies_of(dataset)
    ours = tracers.Ours(dataset, RIVAL_CONFIG)
    for name, (module, make) in tracers.RIVALS.items():
        if importlib.util.find_spec(module) is None:
            report.skip(f"rays_scene{number}_{name}", f"{module} is not installed; pip install {module}")
            continue
        say(f"rays: scene {number} beside {name}")
        _measure_rival(report, effort, f"rays_scene{number}_{name}", ours, make(dataset, number), queries)


def _measure_rival(report: Report, effort: Effort, label: str, ours: Any, rival: Any, queries: tuple[Any, Any]) -> None:
    """One of them: what a transmitter takes at all frequencies, both in turn, and what both find."""
    sides = {"ours": functools.partial(ours.fields, *queries), "theirs": functools.partial(rival.fields, *queries)}
    seconds = interleaved(sides, dataclasses.replace(effort, repeats=min(effort.repeats, 5)))
    report.add_sample(f"{label}_ratio", seconds["theirs"] / seconds["ours"], "x", "higher")
    for side in sides:
        report.add_time(f"{label}_transmitter_{side}", seconds[side] / len(queries[0]))
    report.add(f"{label}_set_up_ours", ours.set_up_s, "s", "lower")
    report.add(f"{label}_set_up_theirs", rival.set_up_s, "s", "lower")
    for what, (value, unit, better) in tracers.compare(ours.paths(*queries), rival.paths(*queries)).items():
        report.add(f"{label}_{what}", value, unit, better)


def first_links(dataset: Dataset, count: int) -> np.ndarray:
    """Returns a link each of some training transmitters, far apart in the list."""
    _, first = np.unique(dataset.tx_index[dataset.train], return_index=True)
    return dataset.train[first[np.linspace(0, len(first) - 1, count).round().astype(int)]]


def frequencies_of(dataset: Dataset) -> Float[np.ndarray, " freq"]:
    """Returns the frequencies of a data set, hertz."""
    return np.unique(dataset.frequencies_hz)
