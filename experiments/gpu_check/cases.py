"""Functions that the library computes on a device: every public one that is pure, with small inputs from scene 1.

A test lowers each for CUDA, values and gradients; `parity.py` runs each on a GPU and beside it on the CPU. `ON_THE_HOST` names
the other public functions; a test sees to it that each stands in one of the two.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import wbgs_jax as wb
from experiments.bench.scene import Scene as RandomScene
from experiments.bench.scene import random_scene
from experiments.profiles import TINY
from wbgs_jax.config import Settings, changed
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.rssi_folder import Readings
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import field_names, get_field
from wbgs_jax.inference.intervals import FEATURES, POWER_FEATURES, Confidence, PowerConfidence
from wbgs_jax.inference.trained_field import RunConfig, TrainedField
from wbgs_jax.training.batches import TrainingData, training_data
from wbgs_jax.training.hooks import probe_of
from wbgs_jax.training.loop import make_hook

ON_THE_HOST = frozenset(
    """
    add_body as_deepmimo at_receiver cell_means choose_beams choose_next_places default_field evaluate export_field field_names
    from_deepmimo from_paths from_sionna get_field learn_map load_dataset load_deepmimo load_exported load_paths load_readings
    load_room load_scene load_trained load_walls make_locator make_mesh make_power_predictor make_predictor
    make_movement make_query make_receiver make_surface map_queries measure_limits pas_directions person place_reflector
    plan_movement planar_array power_at_users power_when_rotated
    predict_blocks predict_gains predict_isotropic_paths predict_many predict_map predict_paths
    pytree rank_beams read_antenna read_deepmimo read_gaussians register save_paths save_scene scene_of_paths
    scene_of_sionna scene_of_snapshots score_beams stack_receivers static straight_powers surface_from_points
    train_field walking_order write_deepmimo write_gaussians
    """.split()  # noqa: SIM905
)
"""Public functions that read and write, prepare, or make the functions that a device runs: those of the predictors, the locator
and `power_at_users` are cases."""
N, B, FEW = 200, 2, 8
"""Gaussians and queries, and Gaussians of the stand-in."""
TINY_WAVE: dict[str, Any] = {
    "specular_tried": 64,
    "specular_kept": 32,
    "diffracted_tried": 32,
    "diffracted_kept": 16,
    "mirror_areas": (0.0, 0.0),
}
TINY_VOLUME = {"samples": 3, "directions": 12, "width": 8, "depth": 2, "skip": 1, "radiance_widths": (8,), "point_octaves": 2}
TINY_FIELDS: dict[str, dict[str, Any]] = {"wave": TINY_WAVE, "wideband": TINY, "wrfgs": TINY, "nerf2": TINY_VOLUME}
COHERENT = ("wave", "hybrid")
"""Fields that find mirror images on the host: their plans are made outside."""
AIMS = ("mean_power", "soft_minimum", "tenth_percentile")
"""Objectives of antenna placement."""
SEED = 0


@dataclass(frozen=True)
class Case:
    """A pure function with its inputs."""

    name: str
    """As `wb` has it: render_splats, coherent.snapshots; of a field its part behind a colon: loss:hybrid."""
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    differentiable: tuple[int, ...] = (0,)
    """Which arguments have gradients; none of a function of integers."""
    costly: bool = False
    """It takes long to compile, and others stand for it where time is short."""

    def program(self) -> Callable[..., Any]:
        """Returns a function of the arguments: values, and the gradients of a weighted sum of all of them."""
        if not self.differentiable:
            return self.function

        def total(*arguments: Any) -> tuple[Any, Any]:
            values = self.function(*arguments)
            return sum(map(_weighted, _numbers(values))), values

        gradient = jax.grad(total, self.differentiable, has_aux=True)
        return lambda *arguments: tuple(reversed(gradient(*arguments)))


def _numbers(tree: Any) -> Iterator[Any]:
    """Yields the leaves that are no integers."""
    return (leaf for leaf in map(jnp.asarray, jax.tree.leaves(tree)) if jnp.issubdtype(leaf.dtype, jnp.inexact))


def _weighted(leaf: Any) -> Any:
    """Returns the sum of what a leaf holds by weights that no symmetry cancels; of what stands for nothing (infinite), none."""
    if jnp.iscomplexobj(leaf):
        return _weighted(leaf.real) + _weighted(leaf.imag)
    weights = np.cos(1.0 + 0.37 * np.arange(leaf.size)).astype(leaf.dtype).reshape(leaf.shape)
    finite = jnp.isfinite(leaf)
    return jnp.sum(jnp.where(finite, leaf, 0) * weights)


def splatting(few: int = 0) -> list[Case]:
    """Returns the cases of the renderer and its parts; of few Gaussians they are quick where kernels are interpreted."""
    scene = _small_scene(few) if few else random_scene(N, B, SEED)
    receiver, limits = scene.receiver, scene.limits
    planned = scene.gaussians, scene.attenuation, scene.signal

    def plan(gaussians: Any) -> Any:
        made = wb.splat.geometry_plan(gaussians, receiver, limits)
        jobs = [leaf for name, leaf in vars(made.jobs).items() if name not in ("slots", "tiling")]
        return made.splats, jobs  # the slots are zeros on a CPU

    return [
        Case("project", lambda gaussians: wb.splat.project(gaussians, receiver), (scene.gaussians,)),
        Case("geometry_plan", plan, (scene.gaussians,)),
        Case("render_splats", scene.tiled, planned, (0, 1, 2)),
        Case("render_dense", scene.dense, planned, (0, 1, 2)),
    ]


def _small_scene(n: int) -> RandomScene:
    """Returns Gaussians whose tile lists have no room to spare: every job in them is interpreted, empty or not."""
    scene = random_scene(n, B, SEED)
    jobs = wb.splat.geometry_plan(scene.gaussians, scene.receiver, scene.limits).jobs
    exact = {"entries": int(jobs.required_entries), "jobs": int(jobs.required_jobs)}
    return dataclasses.replace(scene, limits=dataclasses.replace(scene.limits, **exact))


def arrays() -> list[Case]:
    """Returns the cases of the antenna array."""
    rng = np.random.default_rng(SEED)
    elements = jnp.asarray(wb.radio.planar_array(), jnp.float32)
    snapshot = jnp.asarray(rng.normal(size=(B, 16)) + 1j * rng.normal(size=(B, 16)), jnp.complex64)
    directions = jnp.asarray(wb.radio.pas_directions()[::9, ::9].reshape(-1, 3), jnp.float32)

    spectra = jnp.asarray(rng.uniform(size=(2, 90, 360)), jnp.float32)

    def beams(elements: Any, snapshot: Any) -> Any:
        return wb.radio.cbf(snapshot, wb.radio.steering_vector(elements, directions))

    return [
        Case("steering_vector", wb.radio.steering_vector, (elements, directions), (0, 1)),
        Case("cbf", beams, (elements, snapshot)),
        Case("peak_direction_error", lambda one: wb.radio.peak_direction_error(one, spectra[1], elements), (spectra[0],)),
        Case("snapshot_to_pas", lambda elements, snapshot: wb.radio.snapshot_to_pas(snapshot, elements), (elements, snapshot)),
    ]


def channels() -> list[Case]:
    """Returns the cases of what engineers read from paths and snapshots."""
    rng = np.random.default_rng(SEED)
    amplitude = jnp.asarray(rng.normal(size=(B, 5)) + 1j * rng.normal(size=(B, 5)), jnp.complex64)
    drawn = rng.normal(size=(3, B, 5, 3))
    direction = jnp.asarray(drawn / np.linalg.norm(drawn, axis=-1, keepdims=True), jnp.float32)
    metres, offsets = jnp.asarray(rng.uniform(3, 30, (B, 5)), jnp.float32), jnp.linspace(-2e8, 2e8, 9)
    snapshot = jnp.asarray(rng.normal(size=(2, B, 16)) + 1j * rng.normal(size=(2, B, 16)), jnp.complex64)
    velocity = jnp.array([1.0, 2.0, 0.0])

    def paths(amplitude: Any, metres: Any) -> wb.Paths:
        return wb.Paths(amplitude, direction[0], metres, direction[1], direction[2])

    def of_paths(name: str, function: Callable[[wb.Paths], Any]) -> Case:
        return Case(name, lambda *own: function(paths(*own)), (amplitude, metres), (0, 1))

    return [
        of_paths("Paths.cfr", lambda own: own.cfr(offsets)),
        of_paths("Paths.taps", lambda own: own.taps(4e8, 0, 40)),
        of_paths("cir_of_paths", lambda own: wb.interchange.cir_of_paths(own, wb.make_receiver([0.0, 0.0, 1.0]), 28e9)),
        of_paths("angular_spread_deg", wb.radio.angular_spread_deg),
        of_paths("delay_spread_s", wb.radio.delay_spread_s),
        of_paths("k_factor_db", wb.radio.k_factor_db),
        Case(
            "doppler_hz",
            lambda hertz: wb.radio.doppler_hz(paths(amplitude, metres), hertz, velocity, -velocity),
            (jnp.array(28e9),),
        ),
        Case("free_space_db", wb.radio.free_space_db, (metres, jnp.full((B, 5), 28e9)), (0, 1)),
        Case("received_power_db", wb.radio.received_power_db, (snapshot[0],)),
        Case("doppler_spectrogram", lambda h: wb.applications.doppler_spectrogram(h, 1e3, 8), (snapshot[0, 0],)),
        Case("correlation", wb.radio.correlation, tuple(snapshot), (0, 1)),
        Case("noise_dbm", wb.radio.noise_dbm, (jnp.array(1e8), jnp.array(7.0)), (0, 1)),
        Case("sinr_db", lambda dbm: wb.radio.sinr_db(dbm, -90.0, 0.5), (-40.0 - 2 * metres,)),
        Case("throughput_bps", lambda ratio: wb.radio.throughput_bps(ratio, 1e8), (metres - 15.0,)),
    ]


def images() -> list[Case]:
    """Returns the cases of encodings and losses."""
    rng = np.random.default_rng(SEED)
    pictures = [jnp.asarray(rng.random((B, 90, 360)), jnp.float32) for _ in range(2)]
    places, hertz = jnp.asarray(rng.normal(size=(5, 3)), jnp.float32), jnp.asarray([1e9, 28e9, 94e9], jnp.float32)
    return [
        Case("positional_encoding", lambda places: wb.fields.positional_encoding(places, 6), (places,)),
        Case("frequency_encoding", lambda hertz: wb.fields.frequency_encoding(hertz, 6), (hertz,)),
        Case("image_loss", lambda seen, truth: wb.fields.image_loss(seen, truth, 0.2), tuple(pictures)),
        Case("ssim", wb.ssim, tuple(pictures)),
    ]


def statistics() -> list[Case]:
    """Returns the cases of prediction uncertainty, and of objectives over users."""
    rng = np.random.default_rng(SEED)
    places = jnp.asarray(rng.normal(size=(6, 3)), jnp.float32)
    query = wb.make_query(rng.normal(size=(B, 3)), 28e9)
    pas, power = jnp.asarray(rng.random((B, 90, 360)), jnp.float32), jnp.asarray([-80.0, -95.0])

    def learned(count: int) -> tuple[Any, ...]:
        return jnp.zeros(count), jnp.ones(count), jnp.linspace(-0.5, 0.5, count + 1)

    of_spectra = jnp.zeros(3), places, *learned(FEATURES), jnp.array([-1.0, 1.0]), jnp.ones(()), jnp.ones(()), jnp.zeros(0)
    spectra, powers = Confidence(*of_spectra), PowerConfidence(*(places, *learned(POWER_FEATURES), *(jnp.ones(()),) * 3))
    return [
        Case("expected_ssim", lambda pas, power: wb.expected_ssim(spectra, pas, query, power), (pas, power), (0, 1)),
        Case("expected_power", lambda power: wb.expected_power(powers, power, query, jnp.zeros(3)), (power,)),
        *(Case(name, getattr(wb.applications, name), (jnp.linspace(-120.0, -60.0, 40).reshape(2, 20),)) for name in AIMS),
    ]


def powers() -> list[Case]:
    """Returns the case of a map of measured powers."""
    rng = np.random.default_rng(SEED)
    places, receivers = rng.uniform(0, 8, (40, 3)), rng.uniform(0, 8, (3, 3))
    measured = -40 - 20 * np.log10(np.linalg.norm(places[:, None] - receivers, axis=-1)) + rng.normal(size=(40, 3))
    readings = Readings(places, measured, np.ones((40, 3)), (), receivers)
    tx = jnp.asarray(rng.uniform(0, 8, (5, 3)), jnp.float32)
    return [Case("received_power", functools.partial(wb.power_map.received_power, wb.power_map.learn_map(readings)), (tx,))]


@dataclass(frozen=True)
class Known:
    """A field of scene 1 and what is needed to ask it."""

    settings: Settings
    dataset: Dataset
    data: TrainingData
    field: Any
    params: Any
    capacity: Any
    index: Any
    """Some training links."""

    @property
    def query(self) -> Any:
        """Query of the links of `index`."""
        return self.dataset.query(np.asarray(self.index))

    @property
    def probe(self) -> Any:
        """Probe of the field's hooks."""
        hooks = (make_hook(name, self.settings) for name in self.field.hooks)
        return probe_of([hook for hook in hooks if hook is not None], self.params)


@functools.cache
def _scene() -> tuple[Dataset, TrainingData]:
    dataset = wb.load_dataset(1)
    return dataset, training_data(dataset)


@functools.cache
def known(name: str) -> Known:
    """Returns a tiny field with parameters as they are before training, shaken so that nothing is zero."""
    dataset, data = _scene()
    both = {"wave": TINY_WAVE, "wideband": TINY}
    settings = get_field(name).presets["smoke"]
    settings = _both(settings, both) if name == "hybrid" else changed(settings, {"field": TINY_FIELDS.get(name, {})})
    field = get_field(name).build(settings.field, DatasetScene(dataset), SEED)
    rng = np.random.default_rng(SEED)
    params = jax.tree.map(lambda a: a + jnp.asarray(rng.normal(0, 0.02, a.shape), a.dtype), field.init(jax.random.key(SEED)))
    return Known(
        settings, dataset, data, field, params, field.capacity(params, dataset.receivers), jnp.asarray(dataset.train[:B])
    )


def _both(settings: Settings, changes: dict[str, dict[str, Any]]) -> Settings:
    """Returns the hybrid field's settings with those of its parts changed."""
    parts = {name: dataclasses.replace(getattr(settings.field, name), **values) for name, values in changes.items()}
    return dataclasses.replace(settings, field=dataclasses.replace(settings.field, **parts))


def of_field(name: str) -> list[Case]:
    """Returns the cases of a field: its initial parameters, the loss of a batch, and spectra."""
    of, query = known(name), known(name).query
    batch = of.data.batch(of.index, jax.random.key(SEED))
    prepared = of.field.prepare(batch.links, of.data.receivers)

    def loss(params: Any, probe: Any) -> Any:
        return of.field.loss(params, prepared, batch, of.capacity, probe)[0]

    def init(seed: Any) -> Any:
        return of.field.init(jax.random.key(seed))

    return [
        Case(f"{name}:init", init, (jnp.asarray(SEED),), ()),
        Case(f"{name}:loss", loss, (of.params, of.probe)),
        *([Case(f"pas:{name}", _pas(of), (of.params, query.tx_position), (0, 1))] if name not in COHERENT else []),
        *(
            [Case(f"{name}:render", _render(of), (of.params, query.tx_position), (0, 1), costly=True)]
            if name in COHERENT
            else []
        ),
        *(_of_waves(of) if name == "wave" else []),
    ]


def _pas(of: Known) -> Callable[..., Any]:
    receiver = of.dataset.receiver()
    return lambda params, place: wb.pas(of.field, params, receiver, wb.make_query(place, of.query.frequency_hz), of.capacity)


def _render(of: Known) -> Callable[..., Any]:
    plan = of.field.plan(of.params, of.dataset.receiver())
    query = lambda place: wb.make_query(place, of.query.frequency_hz)  # noqa: E731
    return lambda params, place: of.field.render(params, plan, query(place))._replace(paths=None)  # a case of its own


def _of_waves(of: Known) -> list[Case]:
    """Returns the cases that only the coherent field has: snapshots and paths."""
    plan = of.field.plan(of.params, of.dataset.receiver())
    functions = {"coherent.snapshots": wb.coherent.snapshots, "coherent.channels": wb.coherent.channels}
    moving = wb.applications.make_movement(of.field, B, {0: np.linspace(0, 0.1, B)[:, None] * np.ones(3)})
    following = wb.applications.plan_movement(of.field, of.params, of.dataset.receiver(), of.query.tx_position, moving)

    def over_time(params: Any) -> Any:
        return wb.applications.paths_over_time(params, following, of.query, moving)

    return [
        *(Case(name, lambda params, do=do: do(params, plan, of.query), (of.params,)) for name, do in functions.items()),
        Case("paths_over_time", over_time, (of.params,), costly=True),
    ]


def asking() -> list[Case]:
    """Returns the functions that others make: predictors, a locator's loss, the powers of users."""
    of, receiver, query = known("wideband"), known("wideband").dataset.receiver(), known("wideband").query
    trained = TrainedField(RunConfig("1", "wideband", "smoke", SEED, None, of.settings), of.field, of.params, 0, 0.0)
    box = np.array([query.tx_position[0] - 0.6, query.tx_position[0] + 0.6])
    locate = wb.applications.make_locator(trained, [1e9], receivers=[receiver], box=box, step=0.6, starts=2)
    observed = jnp.asarray(np.asarray(of.dataset.pas(of.dataset.train[:1])))
    spectra, power = wb.make_predictor(trained, receiver), wb.make_power_predictor(trained, receiver)
    waves = known("wave")
    served = wb.applications.power_at_users(waves.field, waves.params, np.asarray(receiver.position)[None], [1e9])

    return [
        Case("make_predictor:made", spectra, (query.tx_position, query.frequency_hz)),
        Case("make_power_predictor:made", power, (query.tx_position, query.frequency_hz)),
        Case("make_locator:loss", lambda places: locate.loss(places, observed, 0.1), (query.tx_position,)),
        Case("power_at_users:made", lambda places: served(places, 0.1), (query.tx_position,), costly=True),
    ]


def placing() -> list[Case]:
    """Returns the cases of antennas and reflectors that look for their place: of powers that are known in closed form."""
    box, user = np.array([[0.0, 0.0, 1.0], [1.2, 1.2, 1.6]]), jnp.array([3.0, 1.0, 1.0])
    plate = wb.applications.make_reflector([0.0, 0.0, 2.0], np.array([[4.0, 1.0, 1.2], [3.0, -2.0, 1.0]]), (1.0, 0.5), [28e9])

    def antenna(user: Any) -> Any:
        return wb.applications.place_antenna(
            lambda places, blur: -jnp.sum((places - user) ** 2, -1)[:, None] - blur, box, step=0.6, starts=1
        )

    def turned(user: Any) -> Any:
        return wb.applications.rotate_array(lambda angles: -jnp.sum((angles - user[:2]) ** 2, -1)[:, None], starts=1)

    return [
        Case("boresight_quaternion", wb.applications.boresight_quaternion, (jnp.array([0.4, -0.2]),)),
        Case("make_reflector:power_db", plate.power_db, (jnp.array([[2.0, 0.5, 1.5, 2.5, 0.1]]),)),
        Case("place_antenna", antenna, (user,), ()),
        Case("rotate_array", turned, (user,), ()),
    ]


ROOMS: dict[str, Callable[[], list[Case]]] = {
    "splatting": splatting,
    "arrays": arrays,
    "channels": channels,
    "images": images,
    "statistics": statistics,
    "powers": powers,
    **{name: functools.partial(of_field, name) for name in field_names()},
    "asking": asking,
    "placing": placing,
}
"""Makers of cases."""
SMALL_ROOMS: dict[str, Callable[[], list[Case]]] = {"splatting": functools.partial(splatting, FEW), "arrays": arrays}
"""Makers of the stand-in's cases."""
