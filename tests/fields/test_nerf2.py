"""The NeRF2-style volume: closed forms of the accumulation, rays in a box, sampled directions, training and checkpoints."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import FIELDS, tiny_dataset, tiny_scene, tiny_settings

from wbgs_jax._util.errors import UserError
from wbgs_jax.commands import train as train_command
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.fields import nerf2
from wbgs_jax.fields.nerf2 import Nerf2Config, Nerf2Field
from wbgs_jax.inference.predictor import predict_spectra
from wbgs_jax.radio.array import PAS_SHAPE, pas_directions
from wbgs_jax.training.batches import training_data
from wbgs_jax.training.loop import Run, train
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.training.step import loss_and_gradients
from wbgs_jax.types import Query, make_query, make_receiver

BOX = np.array([[-3.0, -2, 0], [3, 2.5, 2.8]], np.float32)
RECEIVER = make_receiver([0.3, -0.2, 1.0], [0.9, 0.1, -0.3, 0.2])
CONFIG = dataclasses.replace(FIELDS["nerf2"], samples=3, directions=40, depth=3)
SETTINGS = tiny_settings(
    "nerf2",
    field=vars(CONFIG) | {"network_lr": 1e-2, "network_optimizer": "adam"},
    optim={"steps": 60},
    loop={"epoch_steps": 20, "evaluate_every": 60},
)
QUERY = make_query([[1.0, 2, 1.5], [-1, 0.5, 2]], [2.4e9, 60e9])
LOCAL = jnp.asarray(pas_directions().reshape(-1, 3), jnp.float32)
render = jax.jit(nerf2.render)


@jax.jit
def some_pixels(params, plan, query, pixels):
    """Spectra at some pixels: rays are marched for these alone."""
    rays = nerf2.make_rays(plan.box, plan.receiver, LOCAL[pixels])
    return nerf2.march(params, plan, rays, query).T


def make_field(**changes):
    return Nerf2Field(jnp.asarray(BOX), dataclasses.replace(CONFIG, **changes))


def make_params(rng, field):
    """Every weight drawn anew: nothing is zero by its initialiser."""
    return jax.tree.map(lambda a: jnp.asarray(rng.normal(0, 0.4, a.shape), jnp.float32), field.init(jax.random.key(0)))


def test_a_single_opaque_shell_returns_its_radiance(rng, x64):
    signal = rng.random((5, 7, 3))
    shell = rng.integers(0, 7, 5)
    depth = np.where(np.arange(7) == shell[:, None], 100.0, 0.0)[..., None] * np.ones(3)
    seen = nerf2.accumulate(jnp.asarray(depth), jnp.asarray(signal))
    np.testing.assert_allclose(seen, signal[np.arange(5), shell], rtol=1e-12)


def test_accumulation_is_the_front_to_back_sum(rng, x64):
    depth, signal = rng.gamma(1, 0.7, (4, 9, 2)), rng.random((4, 9, 2))
    alpha, transmittance, total = 1 - np.exp(-depth), np.ones((4, 2)), np.zeros((4, 2))
    for s in range(9):
        total += transmittance * alpha[:, s] * signal[:, s]
        transmittance *= 1 - alpha[:, s]
    np.testing.assert_allclose(nerf2.accumulate(jnp.asarray(depth), jnp.asarray(signal)), total, rtol=1e-12)


def test_rays_end_on_the_box():
    local = jnp.asarray(pas_directions().reshape(-1, 3), jnp.float32)
    rays = nerf2.make_rays(jnp.asarray(BOX), RECEIVER, local)
    ends = np.asarray(RECEIVER.position + rays.world * rays.length[:, None])
    np.testing.assert_allclose(np.linalg.norm(rays.world, axis=-1), 1, rtol=1e-5)
    assert (ends > BOX[0] - 1e-4).all() and (ends < BOX[1] + 1e-4).all()
    assert np.abs(ends[:, None] - BOX).min((1, 2)).max() < 1e-4  # one coordinate lies on a face


def test_rays_along_the_axes_reach_the_faces_opposite():
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    rays = nerf2.make_rays(jnp.asarray(BOX), make_receiver([0.3, -0.2, 1.0]), jnp.asarray(axes, jnp.float32))
    np.testing.assert_allclose(rays.length, [2.7, 2.7, 1.8, 3.3, 1.8, 1.0], rtol=1e-5)


def test_rays_do_not_end_at_a_receiver_above_everything():
    """Without a mesh the box is that of the antennas."""
    dataset = tiny_dataset(6)
    high = jnp.asarray(dataset.tx_positions.max(0) + np.array([0, 0, 0.5]), jnp.float32)[None]
    receivers = dataclasses.replace(dataset.receivers, position=high)
    without_mesh = {"vertices": np.zeros((0, 3)), "faces": np.zeros((0, 3), int), "face_part": None, "materials": None}
    dataset = dataclasses.replace(dataset, receivers=receivers, **without_mesh)
    field = Nerf2Field.build(SETTINGS.field, DatasetScene(dataset), 0)
    assert float(nerf2.make_rays(field.box, dataset.receiver(), LOCAL).length.min()) > 0.9


@pytest.mark.heavy
def test_sampled_pixels_are_those_of_the_whole_image(rng):
    field = make_field()
    params = make_params(rng, field)
    plan = field.plan(params, RECEIVER)
    whole = render(params, plan, QUERY)
    assert whole.shape == (2, *PAS_SHAPE) and float(whole.std()) > 1e-3
    pixels = nerf2.choose_pixels(jax.random.key(int(rng.integers(1000))), CONFIG.directions)
    seen = some_pixels(params, plan, QUERY, pixels)
    np.testing.assert_allclose(seen, whole.reshape(2, -1)[:, pixels], rtol=1e-4, atol=1e-5)


@pytest.mark.heavy
def test_a_query_does_not_depend_on_its_neighbours_in_the_batch(rng):
    field = make_field()
    params = make_params(rng, field)
    plan = field.plan(params, RECEIVER)
    both = render(params, plan, QUERY)
    for i in range(2):
        one = render(params, plan, jax.tree.map(lambda a, i=i: jnp.stack([a[i], a[i]]), QUERY))
        np.testing.assert_allclose(one[0], both[i], rtol=1e-4, atol=1e-5)
        alone = some_pixels(params, plan, jax.tree.map(lambda a, i=i: a[i : i + 1], QUERY), jnp.arange(0, 32_400, 800))
        np.testing.assert_allclose(alone[0], both[i].reshape(-1)[::800], rtol=1e-4, atol=1e-5)
    assert float(jnp.abs(both[0] - both[1]).max()) > 1e-3


@pytest.mark.parametrize("count", [40, 7, 32_400])
def test_pixels_are_one_of_each_stretch_and_a_function_of_the_key(count):
    first, again, other = (np.asarray(nerf2.choose_pixels(jax.random.key(k), count)) for k in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    edges = np.arange(count + 1) * 32_400 / count
    assert (first >= np.floor(edges[:-1])).all() and (first <= edges[1:]).all() and first.max() < 32_400
    assert (first != other).any() or count == 32_400


@pytest.mark.parametrize("relative", [True, False])
def test_frequency_transmitter_and_all_weights_matter_with_finite_gradients(rng, relative):
    field = make_field(relative=relative)
    params = make_params(rng, field)
    plan, pixels = field.plan(params, RECEIVER), nerf2.choose_pixels(jax.random.key(0), CONFIG.directions)

    @jax.jit
    def gradients(params, query):
        return jax.grad(lambda *both: jnp.sum(some_pixels(both[0], plan, both[1], pixels) ** 2), argnums=(0, 1))(params, query)

    # A transmitter at the receiver is where lengths have no derivative.
    query = Query(jnp.stack([QUERY.tx_position[0], RECEIVER.position]), QUERY.frequency_hz)
    weights, asked = gradients(params, query)
    for path, leaf in jax.tree_util.tree_leaves_with_path((weights, asked)):
        assert bool(jnp.isfinite(leaf).all()), jax.tree_util.keystr(path)
    assert all(float(jnp.abs(leaf).max()) > 0 for leaf in jax.tree.leaves(weights))
    assert float(jnp.abs(asked.frequency_hz).max()) > 0 and float(jnp.abs(asked.tx_position[0]).max()) > 0


def test_the_key_of_a_step_decides_the_directions():
    """A run folds its seed and the step into it."""
    data, field = training_data(tiny_dataset()), make_field()
    params = field.init(jax.random.key(0))
    losses = jax.jit(lambda key: loss_and_gradients(field, params, None, data, jnp.arange(3), None, key)[0][0])
    first, again, other = (float(losses(jax.random.key(seed))) for seed in (0, 0, 1))
    assert first == again != other


@pytest.mark.heavy
def test_its_pixels_are_drawn_with_the_runs_seed(tmp_path):
    """The same parameters and batches, another seed: another loss in the first epoch."""
    first, other = (Run(tiny_dataset(), "nerf2", SETTINGS, seed, tmp_path / str(seed)) for seed in (0, 1))
    batches = first.batches(0, SETTINGS.loop.epoch_steps)
    for run in (first, other):
        run.batches = lambda *_: batches
    other.state = jax.tree.map(jnp.copy, first.state)
    assert first.epoch()["loss"] != other.epoch()["loss"]


@pytest.mark.heavy
def test_training_lowers_the_loss_and_resumes_as_if_never_interrupted(tmp_path):
    dataset = tiny_dataset()
    dataset = dataclasses.replace(dataset, validation=dataset.test, test=dataset.test[:0])
    whole = train(dataset, "nerf2", SETTINGS, 0, tmp_path / "whole")
    curve = [json.loads(line) for line in (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()]
    assert curve[-1]["loss"] < 0.8 * curve[0]["loss"]
    assert 0 < curve[-1]["held_out_ssim"] < 1

    part = Run(dataset, "nerf2", SETTINGS, 0, tmp_path / "parts")
    part.epoch()
    part.save()
    resumed = train(dataset, "nerf2", SETTINGS, 0, tmp_path / "parts", resume=True)
    for a, b in zip(jax.tree.leaves(whole.params), jax.tree.leaves(resumed.params), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.heavy
def test_the_command_line_trains_and_the_run_can_be_loaded(tmp_path):
    """With the settings of the other tests, to compile them once."""
    save_scene(tmp_path / "box.npz", tiny_scene())
    values = vars(SETTINGS.field) | {"radiance_widths": 8, "relative": None}
    flags = [f"--nerf2.{name.replace('_', '-')}={value}" for name, value in values.items() if value is not None]
    flags += ["--optim.steps=60", "--optim.batch=2", "--optim.final-fraction=1.0", "--loop.evaluate-spectra=2"]
    command = f"--scene {tmp_path}/box.npz --field nerf2 --preset smoke --out {tmp_path}/run --loop.epoch-steps=20"
    train_command.main([*command.split(), *flags])
    trained = load_trained(tmp_path / "run")
    assert trained.step == 60 and trained.config.settings.field == SETTINGS.field
    dataset = trained.dataset()
    predicted = predict_spectra(trained.field, trained.params, dataset, dataset.test[:2])
    assert predicted.shape == (2, *PAS_SHAPE) and np.isfinite(predicted).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [("samples", 0), ("directions", 0), ("directions", 40_000), ("width", 0), ("radiance_widths", ()), ("tx_octaves", -1)],
)
def test_settings_that_cannot_work_are_refused(name, value):
    with pytest.raises(UserError, match=name.replace("_", "-")):
        Nerf2Config(**{name: value}).check("nerf2")
