"""The coherent field as a whole: it learns materials, survives files, and is asked by the same commands."""

import dataclasses
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import box, field_of, room
from synthetic import tiny_scene, tiny_settings

from wbgs_jax import load_trained, make_query, predict, predictor, train
from wbgs_jax.radio.array import cbf
from wbgs_jax.data import scene_dataset
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.data.surface import make_mesh
from wbgs_jax._util.errors import UserError
from wbgs_jax.fields import wave
from wbgs_jax.training.loop import Run

FREQUENCIES = np.array([1e9, 3e9, 10e9, 30e9])
RX = (1.0, 1.0, 1.2)
ANSWERS = {"snapshot": "snapshots", "k-factor": "k_factor_db"}


def scene_of_known_materials(n_tx=30):
    """A room with a box, its snapshots computed by the field itself with materials that are not those it starts from."""
    parts = [*room(), box((3, 1, 0.5), (4, 2, 1.2))]
    params, plan = field_of(parts, RX, permittivity=6.5, conductivity=0.1, thickness=0.05, mirror_areas=(0.0, 0.0))
    rng = np.random.default_rng(3)
    tx = rng.uniform([0.3, 0.3, 0.3], [5.7, 3.7, 2.7], (n_tx, 3))
    mesh = make_mesh_arrays(parts)
    query = make_query(np.repeat(tx, len(FREQUENCIES), 0), np.tile(FREQUENCIES, n_tx))
    y = np.asarray(jax.jit(wave.snapshots)(params, plan, query)).reshape(n_tx, len(FREQUENCIES), 16)
    scene = tiny_scene(n_tx)
    return dataclasses.replace(
        scene, snapshots=y.astype(np.complex64), tx_positions=tx, frequencies_hz=FREQUENCIES, rx_position=np.array(RX), **mesh
    )


def make_mesh_arrays(parts):
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return {
        "vertices": np.concatenate([part.vertices for part in parts]).astype(np.float32),
        "faces": np.concatenate([p.faces + start for p, start in zip(parts, starts, strict=False)]).astype(np.int32),
        "face_part": np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts]).astype(np.int32),
        "meta": {"parts": [{"name": f"{i}", "material": "plaster", "thickness": 0.05} for i in range(len(parts))]},
    }


@pytest.fixture(scope="module")
def scene():
    return scene_of_known_materials()


def settings(steps):
    return tiny_settings(
        wave={"mirror_areas": (0.0, 0.0), "plain_tried": 128, "plain_kept": 64, "diffracted_tried": 64, "diffracted_kept": 32},
        optim={"steps": steps, "min_steps": steps, "batch": 8, "materials_lr": 0.05, "final_fraction": 0.1},
        loop={"epoch_steps": 20, "evaluate_every": steps, "checkpoint_every": steps},
    )


def test_training_finds_the_materials(scene, tmp_path):
    """Held-out spectra, and the permittivity itself: all it has seen are snapshots."""
    run = Run(scene_dataset(scene), "wave", settings(160), 0, tmp_path)
    before = run.evaluate()
    while run.step < 160:
        run.epoch()
    assert run.evaluate() > max(before, 0.97)
    permittivity = 1 + np.exp(np.asarray(run.state.params.materials.log_susceptibility))
    assert abs(permittivity[0] - 6.5) < 0.25 * abs(4.0 - 6.5)


def test_only_what_is_learned_moves(scene, tmp_path):
    run = Run(scene_dataset(scene), "wave", settings(20), 0, tmp_path)
    before = jax.tree.map(np.array, run.state.params)
    run.epoch()
    for name in ("facets", "edges", "directivity"):
        jax.tree.map(np.testing.assert_array_equal, getattr(before, name), getattr(run.state.params, name))
    assert (before.materials.log_susceptibility != run.state.params.materials.log_susceptibility).all()


def test_the_commands_train_and_answer(scene, tmp_path, monkeypatch, capsys):
    """train, load, predict: spectra, and quantities of the channel."""
    path, folder = tmp_path / "plaster.npz", tmp_path / "run"
    save_scene(path, scene)
    arguments = ["--scene", str(path), "--field", "wave", "--preset", "smoke", "--out", str(folder), "--optim.steps", "20"]
    small = ["--wave.plain-tried", "64", "--wave.diffracted-tried", "32", "--wave.mirror-areas", "0.0", "0.0"]
    monkeypatch.setattr(sys, "argv", ["train", *arguments, *small])
    train.main()
    trained = load_trained(folder)
    assert trained.step == 20 and trained.field.sizes(trained.params)["facets"] == 12
    spectra = np.asarray(predictor(trained)([2.0, 2.0, 1.5], [2e9, 20e9]))
    assert spectra.shape == (2, 90, 360)
    np.testing.assert_allclose(spectra.max((1, 2)), 1, rtol=1e-6)
    for what, name in ANSWERS.items():
        out = tmp_path / f"{what}.npz"
        command = ["predict", "--run", str(folder), "--tx", "2,2,1.5", "--ghz", "2", "20", "--what", what, "--out", str(out)]
        monkeypatch.setattr(sys, "argv", command)
        predict.main()
        with np.load(out) as archive:
            assert archive[name].shape[:2] == (1, 2) and np.isfinite(archive[name]).all()
            assert json.loads(str(archive["meta"]))["field"] == "wave"
    with np.load(tmp_path / "snapshot.npz") as archive:
        plan = trained.field.plan(trained.params, trained.config.dataset().receiver)
        expected = wave.snapshots(trained.params, plan, make_query([[2, 2, 1.5]] * 2, jnp.array([2e9, 20e9])))
        np.testing.assert_allclose(archive["snapshots"][0], expected, rtol=1e-2, atol=1e-9)


def test_without_surfaces_the_message_says_so(scene):
    points = dataclasses.replace(scene_dataset(scene), faces=np.zeros((0, 3), np.int32))
    with pytest.raises(UserError, match="no mesh"):
        make_mesh(points)


def test_the_skeleton_has_the_shapes_of_parameters():
    params, _ = field_of([*room(), box((3, 1, 0.5), (4, 2, 1.2))], RX)
    skeleton = wave.skeleton(params.config, wave.sizes(params))
    assert jax.tree.structure(skeleton) == jax.tree.structure(params)
    for a, b in zip(jax.tree.leaves(skeleton), jax.tree.leaves(params), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)


def test_without_phases_the_spectrum_is_that_of_added_powers(scene, rng):
    """Against the mean over many draws of random path phases, squared."""
    params, plan = field_of([*room(), box((3, 1, 0.5), (4, 2, 1.2))], RX, mirror_areas=(0.0,))
    query = make_query([[2.0, 2.5, 1.5]], 5e9)
    traced = wave.trace(params, plan, query.tx_position)
    found = wave.phase_blind_pas(params, plan, traced, query.frequency_hz)[0]
    arrived = jax.tree.map(lambda leaf: leaf[0], wave.channels(params, plan, query))
    phases = jnp.asarray(np.exp(2j * np.pi * rng.uniform(size=(2000, arrived.amplitude.size))), jnp.complex64)
    drawn = jax.vmap(lambda p: wave.snapshot(arrived._replace(amplitude=arrived.amplitude * p), plan.receiver))(phases)
    drawn = drawn / jnp.abs(drawn).max()
    grid = wave.steering_vector(plan.receiver.element_positions, jnp.asarray(wave.pas_directions(), jnp.float32))
    power = jnp.mean(cbf(drawn, grid) ** 2, 0)
    np.testing.assert_allclose(found, jnp.sqrt(power / power.max()), atol=0.05)


def test_more_facets_than_can_be_numbered_are_refused():
    with pytest.raises(UserError, match="max-facets is 4094; the most is 4093"):
        field_of(room(), RX, max_facets=4094)


def test_phase_blind_spectra_of_next_to_nothing_have_gradients():
    """Behind metal everywhere: powers far below single precision."""
    shell = [box((0.6, 0.6, 0.8), (1.4, 1.4, 1.6))]
    params, plan = field_of(shell, RX, permittivity=4.0, conductivity=1e3, mirror_areas=(0.0,))
    query = make_query([[3.0, 2.0, 1.0]], 94e9)
    traced = jax.jit(wave.trace)(params, plan, query.tx_position)

    def brightness(params):
        return jnp.sum(wave.phase_blind_pas(params, plan, traced, query.frequency_hz))

    gradients = jax.jit(jax.grad(brightness))(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients.materials))
