"""The seam of hooks: what they watch, when they act, and how moments follow whatever they do."""

import dataclasses
import json
import signal
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_dataset
from builders.toys import RippleConfig, RippleField, metrics_of, registered, toy_settings

from wbgs_jax._util.pytree import pytree
from wbgs_jax.config import CalibrationConfig, DensityConfig
from wbgs_jax.fields import Group
from wbgs_jax.training import loop
from wbgs_jax.training.hooks import Context, Edit, Hook
from wbgs_jax.training.loop import Run, train
from wbgs_jax.training.step import loss_and_gradients, run_epoch

DENSITY, SEARCH = DensityConfig(every=4), CalibrationConfig(rounds=1)
SETTINGS = dataclasses.replace(toy_settings(), density=DENSITY, calibration=SEARCH)
SEED = 0


@pytree
class LayeredField(RippleField):
    """Its levels are a sum of layers, whose number hooks change; its groups are called as its parameters are."""

    name: ClassVar[str] = "layered"
    hooks: ClassVar = ("density", "calibration")

    def init(self, key):
        return {"layers": 0.1 * jax.random.normal(key, (2, 4)), "tilt": jnp.zeros(3)}

    def render(self, params, plan, query):
        return super().render({"level": params["layers"].sum(0), "tilt": params["tilt"]}, plan, query)

    def loss(self, params, prepared, batch, capacity=None, probe=None):
        moved = params if probe is None else params | {"layers": params["layers"].at[0].add(probe)}
        return super().loss(moved, prepared, batch, capacity)

    @classmethod
    def param_groups(cls, config, params=None):
        return {"layers": Group(config.learning_rate), "tilt": Group(0.01)}, {"layers": "layers", "tilt": "tilt"}


@dataclass(frozen=True)
class Watching(Hook):
    """Sums what it is shown; asks for nothing."""

    config: Any
    stream: int = 11

    def statistics(self, params):
        return {"gradients": jax.tree.map(jnp.zeros_like, params), "probe": jnp.zeros(4), "steps": jnp.zeros(())}

    def probe(self, params):
        return jnp.zeros(4)

    def accumulate(self, statistics, gradients, probe):
        seen = {"gradients": gradients, "probe": probe, "steps": jnp.ones(())}
        return jax.tree.map(jnp.add, statistics, seen)

    def due(self, step, steps):
        return False

    def apply(self, field, params, statistics, context, step, rng):
        raise AssertionError("it is never due")


@dataclass(frozen=True)
class Growing(Watching):
    """Adds a random layer, whose moments are zero, after every fourth step."""

    def due(self, step, steps):
        return step > 0 and step % self.config.every == 0

    def apply(self, field, params, statistics, context, step, rng):
        assert int(statistics["steps"]) == self.config.every
        layer = jnp.asarray(rng.normal(size=(1, 4)), jnp.float32)
        grown = params | {"layers": jnp.concatenate([params["layers"], layer])}

        def moments(tree):
            assert tree.keys() == params.keys()
            more = jax.tree.map(lambda leaf: jnp.pad(leaf, ((0, 1), (0, 0))), {"layers": tree["layers"]})
            return dict(tree) | more

        return Edit(grown, self.statistics(grown), moments, {"grown": len(grown["layers"])})


@dataclass(frozen=True)
class Halving(Watching):
    """Halves all layers with the others; whatever is stored starts anew."""

    stream: int = 12

    def due(self, step, steps):
        return step > 0 and step % 4 == 0

    def apply(self, field, params, statistics, context, step, rng):
        assert isinstance(context, Context) and isinstance(field, LayeredField)
        halved = params | {"layers": params["layers"] / 2}
        return Edit(halved, self.statistics(halved), None, {"halved": [len(params["layers"]), float(rng.normal())]})


@pytest.fixture(scope="module")
def dataset():
    return tiny_dataset()


@pytest.fixture(autouse=True)
def toys():
    with registered(RippleField, LayeredField):
        yield


def use(monkeypatch, density, search=Watching):
    """Other hooks under the names that settings know."""
    monkeypatch.setitem(loop.HOOKS, "density", density)
    monkeypatch.setitem(loop.HOOKS, "calibration", search)


def entries(folder):
    path = folder / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def adams(optimizer_state):
    """Adam's state of every group by its name."""
    return {name: inner.inner_state[0] for name, inner in optimizer_state.inner_states.items()}


def host(tree):
    return jax.tree.map(np.array, tree)


def test_controls_are_what_their_protocol_says():
    for made in (
        *(make(config) for make, config in zip(loop.HOOKS.values(), (DENSITY, SEARCH, None), strict=True)),
        Growing(DENSITY),
    ):
        assert isinstance(made, Hook)
        assert hash(made) == hash(dataclasses.replace(made))


_gradients = jax.jit(loss_and_gradients, static_argnames="capacity")


def test_a_control_is_shown_the_gradients_of_every_step(dataset, tmp_path, monkeypatch):
    """Those of parameters and probe, at the parameters of that step: against the gradients by themselves."""
    use(monkeypatch, Watching)
    run, expected = Run(dataset, "layered", SETTINGS, SEED, tmp_path), []
    for step, index in enumerate(jnp.asarray(run.batches(0, 2))):
        key = jax.random.fold_in(run.key, step)
        _, both = _gradients(run.field, run.state.params, run.prepared, run.data, index, None, key, None, jnp.zeros(4))
        expected.append(host(both))
        run.state, report = run_epoch(
            run.state,
            run.field,
            run.prepared,
            run.data,
            index[None],
            jnp.asarray(0, jnp.int32),
            run.key,
            optimizer=run.optimizer,
            hooks=run.hooks,
        )
        assert int(report.good_steps) == 1
    total = jax.tree.map(np.add, *expected)
    for seen in run.state.statistics:
        assert int(seen["steps"]) == 2
        for x, y in zip(jax.tree.leaves((seen["gradients"], seen["probe"])), jax.tree.leaves(total), strict=True):
            assert np.abs(y).max() > 0
            np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-7)
        # The probe shifts the first layer, and the gradient of a layer is that of the sum of all.
        np.testing.assert_allclose(seen["probe"], seen["gradients"]["layers"][0], rtol=1e-5)


def test_two_controls_that_are_due_at_once_act_in_the_order_the_field_names_them(dataset, tmp_path, monkeypatch):
    """The second sees what the first left; each has random numbers of its own; both are reported."""
    use(monkeypatch, Growing, Halving)
    run = Run(dataset, "layered", SETTINGS, SEED, tmp_path)
    run.run_hooks()
    assert entries(tmp_path) == [] and run.compilations == 1  # nothing is due before the first step
    run.epoch(), run.epoch()
    before = host(run.state)
    run.run_hooks()
    layer, other = (np.random.default_rng([SEED, stream, 4]).normal(size=4) for stream in (11, 12))
    expected = np.concatenate([before.params["layers"], layer[None]]) / 2
    np.testing.assert_allclose(run.state.params["layers"], expected, rtol=1e-6)
    np.testing.assert_array_equal(run.state.params["tilt"], before.params["tilt"])
    assert entries(tmp_path) == [{"step": 4, "grown": 3}, {"step": 4, "halved": [3, float(other[0])]}]
    assert int(run.state.step) == 4 and run.compilations == 2
    for seen in run.state.statistics:  # all of them of the new shapes, and from zero
        assert seen["gradients"]["layers"].shape == (3, 4)
        assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(seen))
    run.epoch()
    assert run.step == 6 and all(int(seen["steps"]) == 2 for seen in run.state.statistics)


def test_moments_follow_the_parameters_where_groups_are_called_as_they_are(dataset, tmp_path, monkeypatch):
    """The optimiser's dictionary of groups is no tree of parameters, though it has their keys."""
    use(monkeypatch, Growing)
    run = Run(dataset, "layered", SETTINGS, SEED, tmp_path)
    run.epoch(), run.epoch()
    before = host(adams(run.state.optimizer))
    run.run_hooks()
    after = adams(run.state.optimizer)
    for moment in ("mu", "nu"):
        layers = getattr(after["layers"], moment)["layers"]
        np.testing.assert_array_equal(layers[:2], getattr(before["layers"], moment)["layers"])
        assert np.asarray(layers[:2]).any() and not np.asarray(layers[2]).any()
        np.testing.assert_array_equal(getattr(after["tilt"], moment)["tilt"], getattr(before["tilt"], moment)["tilt"])
    assert all(int(adam.count) == 4 for adam in after.values())


def test_moments_start_anew_where_a_control_knows_nothing_of_them(dataset, tmp_path, monkeypatch):
    use(monkeypatch, Watching, Halving)
    run = Run(dataset, "layered", SETTINGS, SEED, tmp_path)
    run.epoch(), run.epoch()
    watched = host(run.state.statistics[0])
    run.run_hooks()
    fresh = run.optimizer.init(run.state.params)
    for x, y in zip(jax.tree.leaves(run.state.optimizer), jax.tree.leaves(fresh), strict=True):
        np.testing.assert_array_equal(x, y)
    for x, y in zip(jax.tree.leaves(run.state.statistics[0]), jax.tree.leaves(watched), strict=True):
        np.testing.assert_array_equal(x, y)  # of equal shapes: the other hook goes on watching
    assert run.compilations == 1


def test_a_run_with_two_controls_resumes_bit_for_bit(dataset, tmp_path, monkeypatch):
    """From after the hooks, and from before them."""
    use(monkeypatch, Growing, Halving)
    whole = train(dataset, "layered", SETTINGS, SEED, tmp_path / "whole")
    assert whole.params["layers"].shape == (4, 4) and whole.compilations == 3  # the last of them after the last step
    for stop in (2, 4, 6):
        stopped = Run(dataset, "layered", SETTINGS, SEED, tmp_path / str(stop))
        while stopped.step < stop:
            stopped.epoch()
            stopped.run_hooks()
        stopped.save()
        again = train(dataset, "layered", SETTINGS, SEED, tmp_path / str(stop), resume=True)
        for x, y in zip(jax.tree.leaves(whole.params), jax.tree.leaves(again.params), strict=True):
            np.testing.assert_array_equal(x, y)


def test_a_field_that_asks_for_no_control_has_none(dataset, tmp_path):
    """Even where the settings hold what a hook would want."""
    run = Run(dataset, "ripple", SETTINGS, SEED, tmp_path)
    assert run.hooks == () and run.state.statistics == ()
    before = host(run.state.params)
    run.run_hooks()
    for x, y in zip(jax.tree.leaves(run.state.params), jax.tree.leaves(before), strict=True):
        np.testing.assert_array_equal(x, y)
    result = train(dataset, "ripple", SETTINGS, SEED, tmp_path)
    assert result.steps == 8 and result.compilations == 1
    assert all("loss" in entry for entry in entries(tmp_path))


def test_a_control_is_left_out_where_its_settings_are(dataset, tmp_path, monkeypatch):
    use(monkeypatch, Growing, Halving)
    run = Run(dataset, "layered", dataclasses.replace(SETTINGS, density=None), SEED, tmp_path)
    assert run.hooks == (Halving(SEARCH),)


def test_the_settings_of_the_toy_are_its_own():
    assert SETTINGS.field == RippleConfig()


@dataclass(frozen=True)
class Seeking(Watching):
    """Long work before the first step: two stages, which change the tilt."""

    def due(self, step, steps):
        return step == 0

    def apply(self, field, params, statistics, context, step, rng):
        for stage in ("seeking", "found"):
            context.say(stage)
        found = params | {"tilt": jnp.full(3, 0.25)}
        return Edit(found, self.statistics(found), None, {"found": 3})


def test_long_work_before_the_first_step_is_shown_and_kept(dataset, tmp_path, monkeypatch, capsys):
    """It is killed in the first epoch; resumed, it goes on with what was found, and seeks nothing."""
    use(monkeypatch, Watching, Seeking)

    def killed(run, go_on=False):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Run, "epoch", killed)
        with pytest.raises(KeyboardInterrupt):
            train(dataset, "layered", SETTINGS, SEED, tmp_path)
    stages = ["seeking", "found", "compiling; first steps"]
    assert [line.split(" (")[0] for line in capsys.readouterr().err.splitlines()] == stages
    again = Run(dataset, "layered", SETTINGS, SEED, tmp_path)
    assert again.restore() and again.step == 0
    np.testing.assert_array_equal(again.state.params["tilt"], 0.25)
    train(dataset, "layered", SETTINGS, SEED, tmp_path, resume=True)
    assert "seeking" not in capsys.readouterr().err
    assert [entry for entry in entries(tmp_path) if "found" in entry] == [{"step": 0, "found": 3}]
    train(dataset, "layered", SETTINGS, SEED, tmp_path / "whole")
    assert metrics_of(tmp_path) == metrics_of(tmp_path / "whole")


def test_an_interrupt_does_not_wait_for_the_end_of_long_work(dataset, tmp_path, monkeypatch, capsys):
    class Impatient(Seeking):
        def apply(self, field, params, statistics, context, step, rng):
            signal.raise_signal(signal.SIGINT)
            return super().apply(field, params, statistics, context, step, rng)

    use(monkeypatch, Watching, Impatient)
    with pytest.raises(loop.Interrupted, match=r"before the first step.*--resume"):
        train(dataset, "layered", SETTINGS, SEED, tmp_path)
    assert "found" not in capsys.readouterr().err
    use(monkeypatch, Watching, Seeking)
    assert train(dataset, "layered", SETTINGS, SEED, tmp_path, resume=True).steps == SETTINGS.optim.steps
