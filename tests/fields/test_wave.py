"""The coherent field as a whole: it learns materials, survives files, and is asked by the same commands."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import box, field_of, mesh_of, room
from synthetic import tiny_scene, tiny_settings

from wbgs_jax import predict, train
from wbgs_jax._util.errors import UserError
from wbgs_jax.data.load import scene_dataset
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.data.surface import make_mesh
from wbgs_jax.fields import wave
from wbgs_jax.fields.wave import WaveConfig, WaveField
from wbgs_jax.inference.predictor import predictor
from wbgs_jax.propagation.transport import snapshots_from_paths
from wbgs_jax.radio.array import cbf, pas_directions, snapshot_to_pas, steering_vector
from wbgs_jax.training.loop import Run
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.types import make_query, make_receiver

FREQUENCIES = np.array([1e9, 3e9, 10e9, 30e9])
RX = (1.0, 1.0, 1.2)
ANSWERS = {"snapshot": "snapshots", "k-factor": "k_factor_db"}
SMALL = {"specular_tried": 64, "specular_kept": 32, "diffracted_tried": 32, "diffracted_kept": 16}
PARTS = [*room(), box((3, 1, 0.5), (4, 2, 1.2))]
snapshots = jax.jit(wave.snapshots)


def scene_of_known_materials(n_tx=16):
    """A room with a box, its snapshots computed by the field itself with materials that are not those it starts from."""
    known = {"permittivity": 6.5, "conductivity": 0.1, "thickness": 0.05}
    _, params, plan = field_of(PARTS, RX, mirror_areas=(0.0, 0.0), **known, **SMALL)
    rng = np.random.default_rng(3)
    tx = rng.uniform([0.3, 0.3, 0.3], [5.7, 3.7, 2.7], (n_tx, 3))
    query = make_query(np.repeat(tx, len(FREQUENCIES), 0), np.tile(FREQUENCIES, n_tx))
    y = np.asarray(snapshots(params, plan, query)).reshape(n_tx, 1, len(FREQUENCIES), 16)
    scene = dataclasses.replace(tiny_scene(n_tx), **make_mesh_arrays(PARTS))
    return dataclasses.replace(
        scene,
        snapshots=y.astype(np.complex64),
        tx_positions=tx,
        frequencies_hz=FREQUENCIES,
        rx_position=np.array([RX]),
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
        "wave",
        field={"mirror_areas": (0.0, 0.0), "materials_lr": 0.05} | SMALL,
        optim={"steps": steps, "min_steps": steps, "batch": 8, "final_fraction": 0.1},
        loop={"epoch_steps": 20, "evaluate_every": steps, "checkpoint_every": steps},
    )


def test_training_finds_the_materials_and_moves_nothing_else(scene, tmp_path):
    """Held-out spectra, and the permittivity itself: all it has seen are snapshots. The field's geometry stays what it was."""
    run = Run(scene_dataset(scene), "wave", settings(160), 0, tmp_path)
    before = run.evaluate()["held_out_ssim"]
    geometry, start = jax.tree.map(np.array, run.field), jax.tree.map(np.array, run.state.params)
    while run.step < 160:
        run.epoch()
    assert run.evaluate()["held_out_ssim"] > max(before, 0.97)
    permittivity = 1 + np.exp(np.asarray(run.state.params.materials.log_susceptibility))
    assert abs(permittivity[0] - 6.5) < 0.25 * abs(4.0 - 6.5)
    jax.tree.map(np.testing.assert_array_equal, geometry, run.field)
    np.testing.assert_array_equal(run.state.params.materials.log_thickness, start.materials.log_thickness)  # it is known
    for name in ("log_susceptibility", "log_conductivity", "slope"):
        assert (getattr(start.materials, name) != getattr(run.state.params.materials, name)).all()
    for name in ("facet_correction", "excess_loss", "log_gain"):
        assert (getattr(start, name) != getattr(run.state.params, name)).any()


def test_the_commands_train_and_answer(scene, tmp_path, capsys):
    """train, load, predict: spectra, and quantities of the channel."""
    path, folder = tmp_path / "plaster.npz", tmp_path / "run"
    save_scene(path, scene)
    arguments = ["--scene", str(path), "--field", "wave", "--preset", "smoke", "--out", str(folder), "--optim.steps", "20"]
    few = [f"--wave.{name.replace('_', '-')}={value}" for name, value in SMALL.items()]
    quick = ["--wave.mirror-areas", "0.0", "--search.rounds", "0", "--loop.evaluate-spectra", "0"]
    train.main([*arguments, *few, *quick])
    trained = load_trained(folder)
    assert trained.step == 20 and trained.field.sizes(trained.params)["facets"] == 12
    spectra = np.asarray(predictor(trained)([2.0, 2.0, 1.5], [2e9, 20e9]))
    assert spectra.shape == (2, 90, 360)
    np.testing.assert_allclose(spectra.max((1, 2)), 1, rtol=1e-6)
    for what, name in ANSWERS.items():
        out = tmp_path / f"{what}.npz"
        asked = ["--run", str(folder), "--tx", "2,2,1.5", "--ghz", "2", "20", "--what", what, "--out", str(out)]
        predict.main(asked)
        with np.load(out) as archive:
            assert archive[name].shape[:2] == (1, 2) and np.isfinite(archive[name]).all()
            assert json.loads(str(archive["meta"]))["field"] == "wave"
    with np.load(tmp_path / "snapshot.npz") as archive:
        elements = trained.dataset().receiver().element_positions
        np.testing.assert_allclose(snapshot_to_pas(archive["snapshots"][0], elements), spectra, atol=1e-2)


def test_without_surfaces_the_message_says_so(scene):
    points = dataclasses.replace(scene_dataset(scene), faces=np.zeros((0, 3), np.int32), face_part=None, materials=None)
    with pytest.raises(UserError, match="no mesh"):
        make_mesh(points)


def test_several_receivers_are_refused_by_name():
    """Its mirror images are those of one receiver."""
    dataset = scene_dataset(tiny_scene(n_rx=3))
    field = wave.make_field(make_mesh(dataset), WaveConfig(mirror_areas=(0.0,), **SMALL))
    with pytest.raises(UserError, match="the wave field knows one receiver, and the data have 3"):
        field.prepare(dataset.links(np.arange(4)), dataset.receivers)


def test_prepared_links_are_rendered_as_others_are(rng):
    """Paths that are traced beforehand, and looked up by the number of their transmitter, give the same observation."""
    field, params, plan = field_of(PARTS, RX, mirror_areas=(0.0,), **SMALL)
    tx = rng.uniform([0.3, 0.3, 0.3], [5.7, 3.7, 2.7], (3, 3))
    query = make_query(tx[[2, 0, 2]], [2e9, 5e9, 20e9])
    links = wave.Links(query, jnp.zeros(3, int), jnp.array([7, 3, 7]))
    receivers = jax.tree.map(lambda leaf: leaf[None], plan.receiver)
    cache = field.prepare(links, receivers)
    np.testing.assert_array_equal(cache.tx_index, [3, 7])
    prepared = jax.jit(WaveField.render_links)(field, params, field.plan(params, plan.receiver, cache=cache), cache, links)
    for a, b in zip(prepared, jax.jit(WaveField.render)(field, params, plan, query), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5 * float(jnp.abs(b).max()))


def test_all_parameters_have_finite_gradients(rng):
    """Of image, correlation and power losses together, from metal's frequencies to those of dust, near the floor and above."""
    field, params, plan = field_of(PARTS, RX, mirror_areas=(0.0, 0.0), **SMALL)

    @jax.jit
    def gradients(params, query):
        def total(params):
            seen = field.render(params, plan, query)
            return jnp.sum(seen.pas) + jnp.sum(jnp.abs(seen.snapshots) ** 2) + jnp.sum(seen.power_db)

        return jax.grad(total)(params)

    for height in (0.002, 0.5, 1.5):
        tx = np.append(rng.uniform([0.3, 0.3], [5.7, 3.7]), height)
        found = gradients(params, make_query([tx] * 3, [1e9, 24e9, 100e9]))
        for path, leaf in jax.tree_util.tree_leaves_with_path(found):
            assert np.isfinite(leaf).all(), (jax.tree_util.keystr(path), height)
        assert float(jnp.abs(found.excess_loss).max()) > 0 and float(jnp.abs(found.facet_correction).max()) > 0


def test_without_phases_the_spectrum_is_that_of_added_powers(rng):
    """Against the mean over many draws of random path phases, squared."""
    _, params, plan = field_of(PARTS, RX, mirror_areas=(0.0,), **SMALL)
    query = make_query([[2.0, 2.5, 1.5]], 5e9)
    blind = dataclasses.replace(plan, config=dataclasses.replace(plan.config, coherent=False))
    found = jax.jit(wave.render)(params, blind, query)[0]
    arrived = jax.tree.map(lambda leaf: leaf[0], jax.jit(wave.channels)(params, plan, query))

    @jax.jit
    def mean_power(phases):
        def drawn(p):
            return snapshots_from_paths(arrived._replace(amplitude=arrived.amplitude * p), plan.receiver, query.frequency_hz[0])

        y = jax.vmap(drawn)(phases)
        grid = steering_vector(plan.receiver.element_positions, jnp.asarray(pas_directions(), jnp.float32))
        return jnp.mean(cbf(y / jnp.abs(y).max(), grid) ** 2, 0)

    power = mean_power(jnp.asarray(np.exp(2j * np.pi * rng.uniform(size=(1000, arrived.amplitude.size))), jnp.complex64))
    np.testing.assert_allclose(found, jnp.sqrt(power / power.max()), atol=0.07)


def test_more_facets_than_can_be_numbered_are_refused():
    with pytest.raises(UserError, match="max-facets is 4094; the most is 4093"):
        WaveField.check(WaveConfig(max_facets=4094))


def test_phase_blind_spectra_of_next_to_nothing_have_gradients():
    """Behind metal everywhere: powers far below single precision."""
    shell = [box((0.6, 0.6, 0.8), (1.4, 1.4, 1.6))]
    _, params, plan = field_of(shell, RX, permittivity=4.0, conductivity=1e3, mirror_areas=(0.0,), coherent=False, **SMALL)
    query = make_query([[3.0, 2.0, 1.0]], 94e9)
    gradients = jax.jit(jax.grad(lambda params: jnp.sum(wave.render(params, plan, query))))(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients.materials))


def test_the_pattern_is_the_receivers():
    """What TR 38.901's element gains in the direction of sight, 8 dB, is in the received power."""
    field = wave.make_field(mesh_of(room()[0]), WaveConfig(mirror_areas=(), **SMALL))
    params, query = field.init(jax.random.key(0)), make_query([[4.0, 1.0, 1.2]], 10e9)
    power = []
    for pattern in ("iso", "tr38901"):
        plan = field.plan(params, make_receiver(RX, pattern=pattern))
        power.append(float(jax.jit(WaveField.render)(field, params, plan, query).power_db[0]))
    assert power[1] - power[0] == pytest.approx(8.0, abs=1e-3)
