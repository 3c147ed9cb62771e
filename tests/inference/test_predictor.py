"""A trained field as a function: the same answers as the field itself, any leading axes, gradients, blocks, maps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import FREQUENCIES_HZ, RX, tiny_dataset, tiny_scene, tiny_settings
from builders.untrained import make_coherent_run, make_trained
from jax.extend.core import jaxprs_in_params

from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import get_field
from wbgs_jax.fields.base import portable
from wbgs_jax.inference import predictor as inference
from wbgs_jax.inference.predictor import make_predictor, map_queries, predict_blocks, predict_many, predict_map
from wbgs_jax.inference.trained_field import at_receiver, receiver_number
from wbgs_jax.radio.antenna import Pattern
from wbgs_jax.splat import TileLimits
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.types import Query, make_query, make_receiver, stack_receivers

TX = np.array([[1.0, 0.5, 1.5], [-1.0, 1.0, 1.2]])
HZ = np.array([28e9, 5e9])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return make_trained(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def plan(trained):
    return trained.field.plan(trained.params, tiny_dataset().receiver())


@pytest.fixture(scope="module")
def predict(trained):
    return make_predictor(trained)


_render = jax.jit(lambda field, *args: field.render(*args).pas)


@pytest.fixture(scope="module")
def expected(trained, plan):
    """By the field's own functions."""
    return np.asarray(_render(trained.field, trained.params, plan, make_query(TX, HZ)))


def test_the_predictor_is_the_field(predict, expected):
    pas = predict(TX, HZ)
    assert (pas.shape, pas.dtype) == ((2, 90, 360), jnp.float32)
    np.testing.assert_allclose(pas, expected, atol=1e-6)
    assert np.abs(expected[0] - expected[1]).max() > 1e-3  # the two queries differ at all


def test_leading_axes_broadcast(predict, expected):
    np.testing.assert_allclose(predict(TX[0], HZ)[0], expected[0], atol=1e-6)
    np.testing.assert_allclose(predict(TX[:, None], HZ[None, :1])[:, 0], predict(TX, HZ[0]), atol=1e-6)
    one = predict([1, 0.5, 1.5], 28e9)
    assert one.shape == (90, 360)
    np.testing.assert_allclose(one, expected[0], atol=1e-6)
    assert predict(np.zeros((0, 3)), HZ[0]).shape == (0, 90, 360)


def test_vmap_and_jit(predict, expected):
    np.testing.assert_allclose(jax.jit(jax.vmap(predict))(jnp.asarray(TX), jnp.asarray(HZ)), expected, atol=1e-6)


@pytest.mark.heavy
def test_gradients_are_those_of_the_field(trained, plan, predict, rng):
    """tests/fields/test_wideband.py compares the field's own with finite differences."""
    weight = jnp.asarray(rng.normal(size=(2, 90, 360)), jnp.float32)

    def own(tx, ghz):
        return jnp.sum(weight * predict(tx, 1e9 * ghz))

    def direct(tx, ghz):
        return jnp.sum(weight * trained.field.render(trained.params, plan, Query(tx, 1e9 * ghz)).pas)

    args = jnp.asarray(TX, jnp.float32), jnp.asarray(HZ / 1e9, jnp.float32)
    for gradient, expected in zip(*(jax.jit(jax.grad(f, argnums=(0, 1)))(*args) for f in (own, direct)), strict=True):
        size = np.abs(expected).max()
        assert size > 0
        np.testing.assert_allclose(gradient, expected, atol=1e-4 * size)


def test_another_receiver(trained, predict):
    """Where the array stands and how it is turned is part of the function."""
    scene = tiny_scene()
    same = make_predictor(trained, make_receiver(scene.rx_position[0], scene.rx_orientation[0], scene.element_positions[0]))
    moved = make_predictor(trained, make_receiver(RX + np.array([0, 0.5, 0])))
    before = predict(TX, HZ)
    np.testing.assert_allclose(same(TX, HZ), before, atol=1e-6)
    assert np.abs(moved(TX, HZ) - before).max() > 1e-3


@pytest.mark.parametrize(
    ("tx", "frequency", "named"),
    [
        ([1.0, 2.0], 28e9, r"\(2,\)"),
        ([[1.0], [2.0]], 28e9, r"\(2, 1\)"),
        ([1.0, 2.0, 1.5], 28.0, "hertz"),
        ([1.0, 2.0, np.nan], 28e9, "metres"),
        ([[1.0, 2.0, 1.5]] * 2, [28e9] * 3, "[Ii]ncompatible"),
    ],
)
def test_wrong_shapes_and_units(predict, tx, frequency, named):
    with pytest.raises(ValueError, match=named):
        predict(tx, frequency)


def operations(function, *args):
    """All operations that a call carries out, (name, shapes of the results), whatever they are nested in."""

    def walk(jaxpr):
        for equation in jaxpr.eqns:
            found.append((equation.primitive.name, [tuple(out.aval.shape) for out in equation.outvars]))
            for inner in jaxprs_in_params(equation.params):
                walk(inner)

    found: list[tuple[str, list[tuple[int, ...]]]] = []
    walk(jax.make_jaxpr(function)(*args).jaxpr)
    return found


def products_without(found, size):
    """Shapes of the matrix products whose results are no multiple of a size."""
    return [shape for name, (shape, *_) in found if name == "dot_general" and np.prod(shape) % size]


def test_a_plan_without_what_is_cheaply_computed_again_renders_the_same(trained, plan, expected):
    """What a file holds (`fields.base.portable`) lacks what the networks make of the Gaussians alone."""
    small = portable(plan)
    size, smaller = (sum(leaf.size for leaf in jax.tree.leaves(tree)) for tree in (plan, small))
    assert smaller < size
    again = _render(trained.field, trained.params, small, make_query(TX, HZ))
    np.testing.assert_allclose(again, expected, atol=1e-6)


@pytest.mark.parametrize("name", ["wideband", "wrfgs"])
def test_what_does_not_depend_on_the_query_is_planned(name):
    """With a plan, all matrix products are of queries: encodings of the Gaussians and the layers behind them are not
    computed again. Without it they are."""
    queries = 7  # nothing else comes in sevens
    field = get_field(name).build(tiny_settings(name).field, DatasetScene(tiny_dataset()), 0)
    params = jax.eval_shape(field.init, jax.random.key(0))
    capacity = TileLimits(entries=4096, jobs=1024)
    receiver = tiny_dataset().receiver()
    plan = jax.eval_shape(lambda params: field.plan(params, receiver, None, capacity), params)
    query = make_query(np.ones((queries, 3)), 28e9)
    planned = operations(field.render, params, plan, query)
    again = operations(field.render, params, portable(plan), query)
    assert [name for name, _ in planned].count("dot_general") >= 3
    assert products_without(planned, queries) == []
    assert len(products_without(again, queries)) >= 2

    def count(found, operation):
        return [name for name, _ in found].count(operation)

    assert count(planned, "sin") < count(again, "sin") and count(planned, "dot_general") < count(again, "dot_general")


class Recorder:
    """A predictor of images that hold the query's x, y, z and gigahertz, and the shapes it was asked for."""

    def __init__(self):
        self.shapes = []

    def __call__(self, tx_position, frequency_hz):
        self.shapes.append(frequency_hz.shape)
        image = np.zeros((len(frequency_hz), 90, 360), np.float32)
        image[:, 0, :3], image[:, 0, 3] = tx_position, frequency_hz / 1e9
        return image


@pytest.mark.parametrize(("n", "sizes"), [(0, []), (1, [1]), (4, [4]), (9, [4, 4, 1])])
def test_blocks_have_one_shape(n, sizes, rng):
    record = Recorder()
    tx = rng.normal(size=(n, 3)).astype(np.float32)
    blocks = list(predict_blocks(record, tx, 2e9, block=4))
    assert [len(block) for block in blocks] == sizes
    assert set(record.shapes) <= {(4,)}
    images = predict_many(record, tx, np.full(n, 2e9), block=4)
    assert (images.shape, images.dtype) == ((n, 90, 360), np.float32)
    np.testing.assert_array_equal(images[:, 0, :3], tx)
    assert n == 0 or np.array_equal(np.concatenate(blocks), images)


def test_blocks_are_computed_when_they_are_asked_for():
    record = Recorder()
    blocks = predict_blocks(record, np.zeros((100, 3)), 2e9, block=4)
    next(blocks), next(blocks)
    assert len(record.shapes) == 2


def test_blocks_refuse_positions_that_are_none():
    with pytest.raises(ValueError):
        predict_blocks(Recorder(), np.zeros((4, 3)), np.full(3, 2e9))
    for several in (predict_blocks, predict_many):
        with pytest.raises(ValueError, match="block is 0; give at least 1"):
            several(Recorder(), np.zeros((4, 3)), 2e9, block=0)
        with pytest.raises(ValueError, match="expected \\(n, 3\\)"):  # frequencies would be paired with the wrong axis
            several(Recorder(), np.zeros((2, 2, 3)), 2e9, block=2)


def test_no_places_have_no_spectra(predict):
    for none in ([], np.zeros((0, 3))):
        assert predict_many(predict, none, 28e9).shape == (0, 90, 360)
        assert list(predict_blocks(predict, none, 28e9)) == []


def test_a_receiver_of_the_data_is_known_by_place_array_and_antenna(trained):
    dataset, lattice = tiny_dataset(), np.mgrid[:1, :4, :4].reshape(3, -1).T
    own = dataset.receiver()
    turned = dataclasses.replace(own, orientation=-own.orientation, position=own.position + 5e-4)
    assert at_receiver(trained, turned, dataset) is trained and receiver_number(dataset, turned) == 0
    pattern = Pattern(jnp.ones((3, 4, 1)))
    for change in ({"slant": jnp.asarray(0.5)}, {"pattern": pattern}, {"exponents": own.antenna.exponents + 1e-3}):
        other = dataclasses.replace(own, antenna=dataclasses.replace(own.antenna, **change))
        assert receiver_number(dataset, other) is None
    narrow, wide = (make_receiver(RX, element_positions=lattice * metres, unit="metres") for metres in (1.6e-3, 2.4e-3))
    of_narrow = dataclasses.replace(dataset, receivers=stack_receivers([narrow]))
    assert (receiver_number(of_narrow, narrow), receiver_number(of_narrow, wide)) == (0, None)


def test_a_map_runs_over_x_then_y_then_frequency():
    xs, ys, ghz = np.arange(3.0), np.arange(10.0, 12), np.array([1.0, 60.0])
    images = predict_map(Recorder(), xs, ys, 1.5, ghz * 1e9, block=4)
    grid = images[:, 0, :4].reshape(2, 2, 3, 4)
    for i, j, k in np.ndindex(2, 2, 3):
        np.testing.assert_allclose(grid[i, j, k], [xs[k], ys[j], 1.5, ghz[i]], rtol=1e-6)
    positions, frequencies = map_queries(0.0, 1.0, 2.0, 5e9)
    np.testing.assert_array_equal(positions, [[0, 1, 2]])
    np.testing.assert_array_equal(frequencies, [5e9])


def test_spectra_of_a_dataset_are_those_of_its_queries(trained, predict, monkeypatch):
    monkeypatch.setattr(inference, "BLOCK", 2)
    dataset, index = tiny_dataset(), np.array([7, 2, 11])
    images = inference.predict_spectra(trained.field, trained.params, dataset, index)
    expected = predict_many(predict, dataset.tx_positions[index], dataset.frequencies_hz[index], block=2)
    np.testing.assert_allclose(images, expected, atol=1e-6)


@pytest.mark.heavy
def test_links_of_any_number_share_a_compiled_program(tmp_path, monkeypatch):
    """Paths are prepared for all links and handed over for those of a block: the answers are those of the whole plan."""
    coherent = load_trained(make_coherent_run(tmp_path / "run"))
    field, params, dataset = coherent.field, coherent.params, coherent.dataset()
    monkeypatch.setattr(inference, "BLOCK", 4)
    inference._observe.clear_cache()
    few, all_links = np.arange(3), np.arange(len(dataset))[::-1]
    found = [np.asarray(inference.observe_links(field, params, dataset, index).pas) for index in (few, all_links)]
    assert inference._observe._cache_size() == 1
    links = dataset.links(all_links)
    whole = field.plan(params, dataset.receiver(), field.prepare(links, dataset.receivers))
    np.testing.assert_allclose(found[1], _render(field, params, whole, links), atol=2e-6)
    np.testing.assert_allclose(found[0], found[1][::-1][:3], atol=2e-6)


def test_what_is_known_about_the_training():
    dataset = tiny_dataset()
    np.testing.assert_allclose(DatasetScene(dataset).box, [dataset.vertices.min(0), dataset.vertices.max(0)], rtol=1e-6)
    assert inference.trained_band(dataset) == (FREQUENCIES_HZ.min(), FREQUENCIES_HZ.max())
