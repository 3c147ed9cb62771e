"""The coherent field as a whole: it learns materials, survives files, and is asked by the same commands."""

import dataclasses
import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import box, field_of, mesh_of, rectangle, room
from builders.synthetic import FIELDS, tiny_dataset, tiny_scene

from wbgs_jax import fields
from wbgs_jax._util.errors import UserError
from wbgs_jax.commands import predict, train
from wbgs_jax.data.load import scene_dataset
from wbgs_jax.data.scene import DatasetScene, make_mesh
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.fields import coherent as wave
from wbgs_jax.fields import get_field
from wbgs_jax.fields.coherent import WaveConfig, WaveField
from wbgs_jax.inference.predictor import make_predictor, observe_links
from wbgs_jax.inference.trained_field import at_receiver
from wbgs_jax.metrics import ssim
from wbgs_jax.radio.array import SPEED_OF_LIGHT, pas_directions, snapshot_to_pas
from wbgs_jax.radio.channel import NO_PATH_DB, received_power_db
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.types import Batch, make_query, make_receiver

FREQUENCIES = np.array([1e9, 3e9, 10e9, 30e9])
RX = (1.0, 1.0, 1.2)
ANSWERS = {"snapshot": "snapshots", "k-factor": "k_factor_db"}
SMALL = {"specular_tried": 64, "specular_kept": 32, "diffracted_tried": 32, "diffracted_kept": 16}
PARTS = [*room(), box((3, 1, 0.5), (4, 2, 1.2))]
SHEETS = [*room(), rectangle((3, 0, 0), (0, 2.5, 0), (0, 0, 3))]
"""Without edges that diffract: what does not ask for them compiles in a third of the time."""
STEPS = 100
SETTINGS = {"wave.materials-lr": 0.08, "optim.steps": STEPS, "optim.min-steps": STEPS, "optim.final-fraction": 0.1}
SETTINGS |= {"loop.evaluate-spectra": 0, "calibration.rounds": 0} | {f"wave.{n.replace('_', '-')}": v for n, v in SMALL.items()}


def scene_of_known_materials(n_tx=16):
    """A room with a box, its snapshots computed by the field itself with materials that are not those it starts from."""
    rng = np.random.default_rng(3)
    tx = rng.uniform([0.3, 0.3, 0.3], [5.7, 3.7, 2.7], (n_tx, 3))
    changes = {"tx_positions": tx, "frequencies_hz": FREQUENCIES, "rx_position": np.array([RX])}
    heard = np.ones((n_tx, 1, len(FREQUENCIES), 16), np.complex64)
    scene = dataclasses.replace(tiny_scene(n_tx), snapshots=heard, **changes, **make_mesh_arrays(PARTS))
    dataset = scene_dataset(scene)
    known = WaveConfig(permittivity=6.5, conductivity=0.1, slope=0.0, excess_amplitude=1.0, mirror_areas=(0.0,), **SMALL)
    params = WaveField.build(known, DatasetScene(dataset), 0).init(jax.random.key(0))
    field = WaveField.build(trained_settings().field, DatasetScene(dataset), 0)
    return dataclasses.replace(scene, snapshots=observe(field, params, dataset).snapshots.reshape(heard.shape))


def observe(field, params, dataset):
    """What a field says of all links: always as many, so that it is compiled once."""
    return observe_links(field, params, dataset, np.arange(len(dataset)))


def make_mesh_arrays(parts):
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return {
        "vertices": np.concatenate([part.vertices for part in parts]).astype(np.float32),
        "faces": np.concatenate([p.faces + start for p, start in zip(parts, starts, strict=False)]).astype(np.int32),
        "face_part": np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts]).astype(np.int32),
        "meta": {"parts": [{"name": f"{i}", "material": "plaster", "thickness": 0.05} for i in range(len(parts))]},
    }


def flags():
    """Of a short training in front of which nothing is searched: one compilation for all tests."""
    return ["--field", "wave", "--preset", "smoke", "--wave.mirror-areas", "0.0", *(f"--{n}={v}" for n, v in SETTINGS.items())]


def trained_settings():
    return train.parse(["--scene", "1", *flags()])[1]


@pytest.fixture(scope="module")
def scene():
    return scene_of_known_materials()


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    """What the command leaves: a run, and the scene beside it."""
    folder = tmp_path_factory.mktemp("trained")
    save_scene(folder / "plaster.npz", scene)
    train.main(["--scene", str(folder / "plaster.npz"), "--out", str(folder / "run"), "--validation", "0", *flags()])
    return folder


@pytest.fixture(scope="module")
def trained(folder):
    return load_trained(folder / "run")


@pytest.mark.heavy
def test_training_finds_the_materials_and_moves_nothing_else(trained):
    """Held-out spectra, and the permittivity itself: all it has seen are snapshots. The field's geometry stays what it was."""
    dataset, params = trained.dataset(), trained.params
    assert trained.step == STEPS
    untouched = WaveField.build(trained.config.settings.field, DatasetScene(dataset), 0)
    start = untouched.init(jax.random.key(0))
    truth = np.asarray(dataset.pas(dataset.test))
    before, after = (np.median(ssim(observe(trained.field, p, dataset).pas[dataset.test], truth)) for p in (start, params))
    assert after > max(before, 0.97)
    permittivity = 1 + np.exp(np.asarray(params.materials.log_susceptibility))
    assert abs(permittivity[0] - 6.5) < 0.25 * abs(4.0 - 6.5)
    jax.tree.map(np.testing.assert_array_equal, untouched, trained.field)
    np.testing.assert_array_equal(params.materials.log_thickness, start.materials.log_thickness)  # it is known
    for name in ("log_susceptibility", "log_conductivity", "slope"):
        assert (np.asarray(getattr(start.materials, name)) != getattr(params.materials, name)).all()
    for name in ("facet_correction", "excess_loss", "log_gain"):
        assert (np.asarray(getattr(start, name)) != getattr(params, name)).any()


@pytest.mark.heavy
def test_the_commands_answer(folder, trained, tmp_path):
    """Spectra, and quantities of the channel: traced anew, those of links whose paths are prepared."""
    assert trained.field.inspect(trained.params).sizes["facets"] == 12
    dataset = trained.dataset()
    seen, index = observe(trained.field, trained.params, dataset), 7 * len(FREQUENCIES) + np.array([1, 3])
    tx = dataset.tx_positions[index[0]]
    spectra = np.asarray(make_predictor(trained)(tx, FREQUENCIES[[1, 3]]))
    assert spectra.shape == (2, 90, 360)
    np.testing.assert_allclose(spectra.max((1, 2)), 1, rtol=1e-6)
    np.testing.assert_allclose(seen.pas[index], spectra, atol=1e-3)
    for what, name in ANSWERS.items():
        out = tmp_path / f"{what}.npz"
        place = ",".join(map(str, tx))
        asked = ["--run", str(folder / "run"), "--tx", place, "--ghz", "3", "30", "--what", what, "--out", str(out)]
        predict.main(asked)
        with np.load(out) as archive:
            assert archive[name].shape[:2] == (1, 2) and np.isfinite(archive[name]).all()
            assert json.loads(str(archive["meta"]))["field"] == "wave"
    with np.load(tmp_path / "snapshot.npz") as archive:
        found, expected = archive["snapshots"][0], seen.snapshots[index]
        np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())
        np.testing.assert_allclose(seen.power_db[index], 10 * np.log10(np.mean(np.abs(found) ** 2, -1)), atol=0.01)


@pytest.mark.heavy
def test_another_receiver_is_asked_as_if_it_were_the_only_one(folder, trained, tmp_path):
    """By the command: another place and another turn of the array, traced anew; what training found out about where the trained
    receiver stands goes with that one. At its own place the field is what it was."""
    receiver = trained.dataset().receiver()
    assert at_receiver(trained, receiver) is trained
    shift, turned = jnp.full((1, 3), 0.05), jnp.full((1, 3), 0.1)
    shifted = dataclasses.replace(trained.field.motion, receiver=shift, receiver_turn=turned)
    moved = dataclasses.replace(trained, field=dataclasses.replace(trained.field, motion=shifted))
    rx, turn, tx = [1.5, 2.0, 1.0], [0.6, 0.0, 0.0, 0.8], [4.0, 1.2, 1.4]
    elsewhere = dataclasses.replace(receiver, position=jnp.array(rx), orientation=jnp.array(turn))
    there = at_receiver(moved, elsewhere)
    at_home, away = (there.field.plan(there.params, one).receiver for one in (receiver, elsewhere))
    np.testing.assert_allclose(at_home.position, receiver.position + 0.05, rtol=1e-6)
    assert np.linalg.norm(at_home.orientation - receiver.orientation) > 0.05
    for own, said in zip(jax.tree.leaves(away), jax.tree.leaves(elsewhere), strict=True):
        np.testing.assert_allclose(own, said, atol=1e-7)
    assert there.intervals is None and there.power_intervals is None and there.correction is None
    plan = trained.field.plan(trained.params, elsewhere)
    expected = np.asarray(jax.jit(wave.snapshots)(trained.params, plan, make_query([tx], [3e9])))
    out, words = tmp_path / "snapshot.npz", [",".join(map(str, place)) for place in ([*rx, *turn], tx)]
    asked = ["--run", str(folder / "run"), "--rx", words[0], "--tx", words[1], "--ghz", "3", "--what", "snapshot"]
    predict.main([*asked, "--out", str(out)])
    with np.load(out) as archive:
        found = archive["snapshots"][0]
        assert json.loads(str(archive["meta"]))["receiver"]["position"] == rx
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


@pytest.mark.heavy
def test_prepared_links_are_rendered_as_others_are(rng):
    """Paths that are traced beforehand, and looked up by the number of their transmitter, give the same observation."""
    field, params, plan = field_of(SHEETS, RX, mirror_areas=(0.0,), **SMALL)
    tx = rng.uniform([0.3, 0.3, 0.3], [5.7, 3.7, 2.7], (3, 3))
    query = make_query(tx[[2, 0, 2]], [2e9, 5e9, 20e9])
    links = query.with_indices(jnp.zeros(3, int), jnp.array([7, 3, 7]))
    receivers = jax.tree.map(lambda leaf: leaf[None], plan.receiver)
    prepared = field.prepare(links, receivers)
    np.testing.assert_array_equal(prepared.tx_index, [3, 7])
    prepared = jax.jit(WaveField.render)(field, params, field.plan(params, plan.receiver, prepared), links)
    others = jax.jit(WaveField.render)(field, params, plan, query)
    powers = [seen._replace(pas=seen.pas**2, paths=None) for seen in (prepared, others)]  # near zero roots are of rounding
    for a, b in zip(*map(jax.tree.leaves, powers), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * np.abs(b).max())


def test_without_surfaces_the_message_says_so(scene):
    points = dataclasses.replace(scene_dataset(scene), faces=np.zeros((0, 3), np.int32), face_part=None, materials=None)
    with pytest.raises(UserError, match="no mesh"):
        make_mesh(points)


@pytest.mark.heavy
def test_links_of_several_receivers_are_rendered_as_those_of_each_alone():
    """From one table of paths, in which every receiver has those of its own transmitters."""
    dataset = scene_dataset(tiny_scene(n_rx=3))
    field = wave.make_field(make_mesh(dataset), WaveConfig(mirror_areas=(0.0,), **SMALL), dataset.receivers.position)
    params, index = field.init(jax.random.key(0)), np.flatnonzero((dataset.receiver_index != 1) | (dataset.tx_index < 4))
    together = observe_links(field, params, dataset, index)
    for number in range(3):
        own, place = dataset.receiver(number), np.flatnonzero(dataset.receiver_index[index] == number)
        plan = field.plan(params, own)
        alone = jax.jit(WaveField.render)(field, params, plan, dataset.query(index[place]))
        for one, other in (
            (together.pas, alone.pas),
            (together.snapshots, alone.snapshots),
            (together.power_db, alone.power_db),
        ):
            np.testing.assert_allclose(one[place], other, atol=2e-3 * np.abs(other).max())
    with pytest.raises(TypeError, match="traces no others"):
        wave.trace(field.plan(params, own, prepared=field.prepare(dataset.links(index), dataset.receivers)), jnp.ones((1, 3)))


@pytest.mark.heavy
@pytest.mark.parametrize("parts", [SHEETS, pytest.param(PARTS, marks=pytest.mark.slow)], ids=["sheets", "edges"])
def test_all_parameters_have_finite_gradients(rng, parts):
    """Of image, correlation and power losses together, from metal's frequencies to those of dust, near the floor and above.
    With edges in tests/propagation, and in every step of the training above."""
    field, params, plan = field_of(parts, RX, mirror_areas=(0.0,), **SMALL)

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


@pytest.mark.heavy
def test_without_phases_the_spectrum_is_that_of_added_powers(rng):
    """Against the mean over many draws of random path phases, squared."""
    _, params, plan = field_of(SHEETS, RX, mirror_areas=(0.0, 0.0), **SMALL)
    query = make_query([[2.0, 2.5, 1.5]], 5e9)
    blind = dataclasses.replace(plan, config=dataclasses.replace(plan.config, coherent=False))
    found = jax.jit(wave.render)(params, blind, query)[0]
    arrived = jax.tree.map(lambda leaf: np.asarray(leaf[0]), jax.jit(wave.channels)(params, plan, query))
    assert (np.abs(arrived.amplitude) > 0).sum() > 20
    phases = np.exp(2j * np.pi * rng.uniform(size=(1000, arrived.amplitude.size)))
    elements = np.asarray(plan.receiver.element_positions, float)
    y = (arrived.amplitude * phases) @ np.exp(2j * np.pi * arrived.direction @ elements.T)
    beams = np.exp(2j * np.pi * pas_directions().reshape(-1, 3) @ elements.T).conj() @ y.T
    power = np.mean(np.abs(beams) ** 2, -1).reshape(90, 360)
    np.testing.assert_allclose(found, np.sqrt(power / power.max()), atol=0.07)


@pytest.mark.heavy
def test_spectra_are_those_of_snapshots_where_places_are_known_and_of_added_powers_where_they_are_not(rng):
    _, params, plan = field_of(SHEETS, RX, mirror_areas=(0.0, 0.0), **SMALL)
    query = make_query(rng.uniform([3.5, 0.5, 0.5], [5.5, 3.5, 2.5], (3, 3)), [5e9, 28e9, 94e9])
    see = jax.jit(lambda params: wave.observe(params, plan, wave.trace(plan, query.tx_position), query))
    known, unknown = (
        see(dataclasses.replace(params, placement=jnp.full_like(params.placement, np.log(m)))) for m in (1e-7, 1.0)
    )
    np.testing.assert_allclose(known.pas, snapshot_to_pas(known.snapshots, plan.receiver.element_positions), atol=2e-3)
    np.testing.assert_allclose(known.power_db, received_power_db(known.snapshots), atol=1e-3)
    blind = dataclasses.replace(plan, config=dataclasses.replace(plan.config, coherent=False))
    # Paths whose lengths depend on all places alike, such as a line of sight and what passes through it, stay together.
    assert np.mean(np.abs(unknown.pas - jax.jit(wave.render)(params, blind, query))) < 0.02
    assert np.mean(np.abs(unknown.pas - known.pas)) > 0.03
    np.testing.assert_array_equal(unknown.snapshots, known.snapshots)


@pytest.mark.heavy
def test_an_array_in_metres_is_that_of_its_wavelengths_at_one_frequency(rng):
    field, params, plan = field_of(SHEETS, RX, mirror_areas=(0.0,), **SMALL)
    params = dataclasses.replace(params, placement=jnp.full_like(params.placement, np.log(2e-3)))
    query = make_query(rng.uniform([3.5, 0.5, 0.5], [5.5, 3.5, 2.5], (3, 3)), 10e9)
    metres = dataclasses.replace(
        plan.receiver, element_positions=plan.receiver.element_positions * (SPEED_OF_LIGHT / 10e9), unit="metres"
    )
    fixed = field.plan(params, metres)
    assert fixed.lag_basis is None and plan.lag_basis is not None
    np.testing.assert_allclose(jax.jit(wave.render)(params, fixed, query), jax.jit(wave.render)(params, plan, query), atol=2e-3)


def test_more_facets_than_can_be_numbered_are_refused():
    with pytest.raises(UserError, match="max-facets is 100001; the most is 100000"):
        WaveConfig(max_facets=100_001).check("wave")


@pytest.mark.heavy
def test_phase_blind_spectra_of_next_to_nothing_have_gradients():
    """Behind metal everywhere: powers far below single precision."""
    settings = {"conductivity": 1e3, "mirror_areas": (0.0,), "coherent": False}
    _, params, plan = field_of(room((0.8, 0.8, 0.8)), (0.4, 0.4, 0.4), **settings, **SMALL)
    query = make_query([[2.0, 1.0, 0.3]], 94e9)

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def gradients(params):
        return jnp.sum(wave.render(params, plan, query)), jnp.abs(wave.channels(params, plan, query).amplitude).max()

    (_, strongest), found = gradients(params)
    assert float(strongest) < 1e-19
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found.materials))


@pytest.mark.heavy
@pytest.mark.parametrize("coherent", [True, False])
def test_a_link_without_any_path_has_gradients(coherent):
    """Data may hold a spectrum where the mesh lets nothing through; a training goes on."""
    field, params, plan = field_of(SHEETS, RX, mirror_areas=(0.0,), coherent=coherent, **SMALL)
    query, receivers = make_query([[3.0, 2.0, 1.0]], 28e9), jax.tree.map(lambda leaf: leaf[None], plan.receiver)
    links = query.with_indices(jnp.zeros(1, int), jnp.zeros(1, int))
    prepared = field.prepare(links, receivers)
    nothing = jax.tree.map(lambda leaf: jnp.zeros_like(leaf) if leaf.dtype == bool else leaf, prepared)
    heard = jnp.exp(1j * jnp.arange(16.0))[None].astype(jnp.complex64)
    truth = snapshot_to_pas(heard, plan.receiver.element_positions)
    batch = Batch(links, plan.receiver, {"pas": truth, "snapshots": heard}, jax.random.key(0))

    @jax.jit
    def found(params, prepared):
        return jax.value_and_grad(lambda params: field.loss(params, prepared, batch)[0])(params)

    for paths in (prepared, nothing):
        loss, gradient = found(params, paths)
        assert np.isfinite(loss) and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    seen = jax.jit(WaveField.render)(field, params, field.plan(params, plan.receiver, nothing), links)
    assert not np.any(seen.pas)
    if coherent:
        assert not np.any(seen.snapshots) and float(seen.power_db[0]) <= NO_PATH_DB


@pytest.mark.heavy
def test_a_transmitter_in_the_receivers_place_has_no_line_of_sight():
    """What is left is finite, and so are its gradients."""
    field, params, plan = field_of(room(), RX, mirror_areas=(0.0,), **SMALL)

    @jax.jit
    def power(params, position):
        return field.render(params, plan, make_query(position[None], jnp.full(1, 28e9))).power_db[0]

    here = plan.receiver.position
    value, gradient = jax.value_and_grad(power, argnums=(0, 1))(params, here)
    assert np.isfinite(value) and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert value < power(params, here + jnp.array([0.05, 0.0, 0.0])) - 10  # five centimetres away it is heard directly


@pytest.mark.heavy
def test_the_pattern_is_the_receivers():
    """What TR 38.901's element gains in the direction of sight, 8 dB, is in the received power."""
    field = wave.make_field(mesh_of(room()[0]), WaveConfig(mirror_areas=(), **SMALL))
    params, query = field.init(jax.random.key(0)), make_query([[4.0, 1.0, 1.2]], 10e9)
    power = []
    for pattern in ("iso", "tr38901"):
        plan = field.plan(params, make_receiver(RX, pattern=pattern))
        power.append(float(jax.jit(WaveField.render)(field, params, plan, query).power_db[0]))
    assert power[1] - power[0] == pytest.approx(8.0, abs=1e-3)


@pytest.mark.heavy
def test_a_field_of_data_is_asked_within_jit():
    """Its receivers are known, and where they were found to stand is decided on the host."""
    dataset = tiny_dataset()
    field = get_field("wave").build(FIELDS["wave"], DatasetScene(dataset), 0)
    assert len(field.receivers)
    moved = field.motion.receiver.at[0, 0].add(0.01)
    field = dataclasses.replace(field, motion=dataclasses.replace(field.motion, receiver=moved))
    params, receiver, query = field.init(jax.random.key(0)), dataset.receiver(), dataset.query(dataset.train[:2])
    expected = field.render(params, field.plan(params, receiver), query).pas
    found = jax.jit(lambda params, query: fields.pas(field, params, receiver, query))(params, query)
    np.testing.assert_allclose(found, expected, atol=1e-3)
    elsewhere = dataclasses.replace(receiver, position=receiver.position + jnp.array([0.01, 0, 0]))
    unmoved = dataclasses.replace(field, receivers=jnp.zeros((0, 3)))
    np.testing.assert_allclose(unmoved.render(params, unmoved.plan(params, elsewhere), query).pas, expected, atol=1e-3)


def test_what_belongs_to_a_receiver_is_kept_for_the_next_plan():
    """Also if the first plan is made inside `jit`, whose tracers must not be kept; other receivers and fields get their own."""
    field, *_ = field_of(room(), (1, 1, 1))
    here, there = make_receiver([1.0, 1.0, 1.0]), make_receiver([2.0, 1.0, 1.0])
    images = jax.jit(lambda x: x + field.plan(None, here).surfaces.sequences[0].image[0, 0, 0])(0.0)
    first, again = (field.plan(None, here) for _ in range(2))
    assert first.surfaces is again.surfaces and first.lag_basis is again.lag_basis
    assert images == first.surfaces.sequences[0].image[0, 0, 0]
    np.testing.assert_array_equal(field.plan(None, there).surfaces.receiver_position, [2, 1, 1])
    other = dataclasses.replace(field, facets=jax.tree.map(lambda leaf: leaf, field.facets))
    assert other.plan(None, there).surfaces is not field.plan(None, there).surfaces
