"""A model is one file and its settings: a toy field, defined here and nowhere else, goes through everything that a field goes
through, by the command lines and as a library."""

import dataclasses
import json
import shutil
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.commands import assert_error_for_people, call
from builders.synthetic import FREQUENCIES_HZ, tiny_scene
from builders.toys import metrics_of
from jaxtyping import Array, Float

import wbgs_jax as wb
from wbgs_jax.commands import evaluate as eval_command
from wbgs_jax.commands import predict as predict_command
from wbgs_jax.commands import train as train_command
from wbgs_jax.config import PRESETS
from wbgs_jax.data.dataset import hold_out_validation, select_receivers
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.evaluation.score import evaluate, watch
from wbgs_jax.fields import base
from wbgs_jax.fields.base import Group, with_field
from wbgs_jax.inference.predictor import observe_links
from wbgs_jax.training.checkpoint import checkpoint_steps
from wbgs_jax.training.loop import Run, train


@dataclasses.dataclass(frozen=True)
class ToyConfig:
    """Settings of the toy."""

    brightness: float = 0.5
    """Of all pixels, at the start."""
    learning_rate: float = 0.05
    """Of everything."""


@wb.pytree
class ToyField(wb.Field):
    """An image and a received power for every receiver, whatever is asked."""

    positions: Float[Array, "r 3"]
    config: ToyConfig = wb.static()

    name: ClassVar[str] = "toy"
    presets: ClassVar = with_field(PRESETS, dict.fromkeys(PRESETS, ToyConfig()))
    outputs: ClassVar = ("pas", "power")

    @classmethod
    def build(cls, config, scene, seed):
        return cls(scene.receivers.position, config)

    def init(self, key):
        n = len(self.positions)
        return {"image": self.config.brightness + 0.01 * jax.random.normal(key, (n, 90, 360)), "power_db": jnp.zeros(n)}

    def plan(self, params, receiver, prepared=None, capacity=None):
        nearest = jnp.argmin(jnp.sum((self.positions - receiver.position) ** 2, -1))
        return jax.tree.map(lambda leaf: leaf[nearest], params)

    def render(self, params, plan, links):
        n = links.frequency_hz.shape[0]
        return wb.Observation(jnp.tile(plan["image"], (n, 1, 1)), power_db=jnp.tile(plan["power_db"], n))

    @classmethod
    def param_groups(cls, config, params=None):
        return {"all": Group(config.learning_rate)}, super().param_groups(config, params)[1]


STEPS, STOP = 8, 4
SHORT = ["--optim.steps", STEPS, "--optim.batch", 3, "--loop.epoch-steps", 2]
SHORT += ["--loop.evaluate-every", STOP, "--loop.evaluate-spectra", 5, "--loop.checkpoint-every", STOP]
TRAIN = ["--field", "toy", "--preset", "smoke", *SHORT]
KINDS = [("snapshot", 1), ("snapshot", 3), ("pas", 3), ("power", 3)]
N_TX, TX = 9, "1,0.5,1.5"


@pytest.fixture(scope="module", autouse=True)
def known():
    """All that the library is told."""
    wb.register(ToyField)
    yield
    del base._FIELDS["toy"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run folder of `wbgs-jax train` by the kind of its data and the number of receivers, made when it is asked for."""
    runs = {}

    def make(kind, n_rx):
        if (kind, n_rx) not in runs:
            folder = tmp_path_factory.mktemp("toy")
            save_scene(folder / "box.npz", tiny_scene(N_TX, n_rx=n_rx, kind=kind))
            arguments = ["--scene", folder / "box.npz", "--validation", 0.2, "--no-neighbours", *TRAIN]
            result = call(train_command.main, *arguments, "--toy.brightness", 0.4, "--out", folder / "run")
            assert (result.code, result.out) == (0, ""), result.err
            assert f"trained {STEPS} steps" in result.err
            runs[kind, n_rx] = folder / "run"
        return runs[kind, n_rx]

    return make


def assert_equal_trees(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(("kind", "n_rx"), KINDS)
def test_it_is_trained_by_the_command_line(trained, kind, n_rx):
    """Its settings are its own, its curves are those of the data, and it learns."""
    folder = trained(kind, n_rx)
    config = json.loads((folder / "config.json").read_text())
    assert config["field"] == "toy" and config["settings"].keys() == {"toy", "optim", "loop"}
    assert config["settings"]["toy"] == {"brightness": 0.4, "learning_rate": 0.05}
    assert checkpoint_steps(folder / "checkpoints") == [STOP, STEPS]
    entries, held_out = metrics_of(folder), "held_out_power_error_db" if kind == "power" else "held_out_ssim"
    assert [entry["step"] for entry in entries] == [2, 4, 6, 8]
    assert [entry["step"] for entry in entries if held_out in entry] == [STOP, STEPS]
    assert all(("batch_ssim" in entry) == (kind != "power") for entry in entries)
    assert entries[0]["parameters"] == n_rx * (90 * 360 + 1)
    run = wb.load_trained(folder)
    dataset = run.dataset()
    assert dataset.has_spectra == (kind != "power") and dataset.has_scale == (kind != "pas") and dataset.n_receivers == n_rx
    before, after = (error(run.field, params, dataset) for params in (run.field.init(jax.random.key(0)), run.params))
    assert after < 0.99 * before


def error(field, params, dataset):
    """Mean absolute error of what is observed on the training links."""
    seen, links = observe_links(field, params, dataset, dataset.train), dataset.train
    if not dataset.has_spectra:
        return np.abs(seen.power_db - dataset.power_db[links]).mean()
    return np.abs(seen.pas - np.asarray(dataset.pas(links))).mean()


@pytest.mark.parametrize(("kind", "n_rx"), KINDS)
def test_its_data_are_split_by_transmitter_and_its_batches_are_of_one_receiver(trained, kind, n_rx, tmp_path):
    run = wb.load_trained(trained(kind, n_rx))
    dataset = run.dataset()
    parts = [set(dataset.tx_index[part]) for part in (dataset.train, dataset.validation, dataset.test)]
    assert [len(part) for part in parts] == [4, 2, 3] and len(set.union(*parts)) == N_TX
    assert all(len(dataset.receiver_index[part]) % n_rx == 0 for part in (dataset.train, dataset.validation, dataset.test))
    again = Run(dataset, "toy", run.config.settings, 0, tmp_path)
    drawn = again.batches(0, 30)
    assert (np.ptp(np.asarray(again.data.links.receiver_index)[drawn], axis=1) == 0).all()
    observed = again.numbers[np.setdiff1d(drawn, np.concatenate(again.virtual))]
    assert set(observed) <= set(dataset.train)
    assert set(dataset.receiver_index[observed]) == set(range(n_rx))
    assert set(again.numbers[again.watched]) <= set(dataset.validation)


@pytest.mark.parametrize(("kind", "n_rx"), KINDS)
@pytest.mark.parametrize("part", ["test", "validation"])
def test_it_is_evaluated_by_the_command_line(trained, kind, n_rx, part):
    folder = trained(kind, n_rx)
    result = call(eval_command.main, "--run", folder, "--part", part, "--json", "--no-pictures")
    assert result.code == 0, result.err
    report, dataset = json.loads(result.out), wb.load_trained(folder).dataset()
    assert (report["scene"], report["field"], report["part"]) == ("box", "toy", part)
    assert report["n"] == len(getattr(dataset, part)) == {"test": 3, "validation": 2}[part] * n_rx * len(FREQUENCIES_HZ)
    assert [row["n"] for row in report["per_frequency"]] == [report["n"] // 3] * 3
    if kind == "power":
        assert report["power_error_db"] > 0 and report["baselines"].keys() == {"free_space", "nearest_tx"}
        return
    assert 0 < report["median_ssim"] < 1
    assert report["baselines"].keys() == {"mean_image", "nearest_tx", "inverse_distance", "line_of_sight"}
    assert all(0 < scores["median_ssim"] < 1 for scores in report["baselines"].values())


def test_its_report_for_people_has_pictures(trained):
    folder = trained("snapshot", 3)
    result = call(eval_command.main, "--run", folder)
    assert result.code == 0 and "box, toy: held-out SSIM" in result.out and "inverse distance" in result.out
    drawn = {path.name for path in (folder / "pictures").iterdir()}
    assert drawn == {"spectra.png", "spectra_polar.png", "ssim_by_frequency.png", "curves.png"}
    result = call(eval_command.main, "--run", trained("power", 3))
    assert result.code == 0 and "received power" in result.out and not (trained("power", 3) / "pictures").exists()


@pytest.mark.parametrize(("kind", "n_rx"), KINDS)
def test_it_resumes_bit_for_bit(trained, tmp_path, kind, n_rx):
    whole = trained(kind, n_rx)
    shutil.copytree(whole, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / str(STEPS))
    scene = wb.load_trained(whole).config.source
    arguments = [
        "--scene",
        scene,
        "--validation",
        0.2,
        "--no-neighbours",
        *TRAIN,
        "--toy.brightness",
        0.4,
        "--out",
        tmp_path / "run",
    ]
    assert_error_for_people(call(train_command.main, *arguments), "--resume")
    other = call(train_command.main, *arguments, "--resume", "--toy.learning-rate", 0.1)
    assert_error_for_people(other, "settings.toy.learning_rate: 0.05, not 0.1")
    result = call(train_command.main, *arguments, "--resume")
    assert (result.code, result.out) == (0, ""), result.err
    a, b = wb.load_trained(whole), wb.load_trained(tmp_path / "run")
    assert b.step == STEPS
    assert_equal_trees((a.params, a.field), (b.params, b.field))
    assert metrics_of(whole) == metrics_of(tmp_path / "run")


@pytest.mark.parametrize(("kind", "n_rx"), [("snapshot", 1), ("power", 3)])
def test_it_predicts_and_is_exported_by_the_command_line(trained, tmp_path, kind, n_rx):
    folder = trained(kind, n_rx)
    ask = ["--run", folder, "--tx", TX, "-1,1,1.2", "--ghz", 28, 94]
    files = ["--out", tmp_path / "spectra.npz", "--export", tmp_path / "toy.zip"]
    result = call(predict_command.main, *ask, *files)
    if kind == "power":
        assert_error_for_people(result, "the toy field learned no spectra")
    else:
        assert (result.code, result.out) == (0, ""), result.err
        image = np.asarray(wb.load_trained(folder).params["image"][0])
        exported = wb.load_exported(tmp_path / "toy.zip")
        with np.load(tmp_path / "spectra.npz") as answer:
            assert answer["pas"].shape == (2, 2, 90, 360)
            for pas in (*answer["pas"].reshape(4, 90, 360), np.asarray(exported([1.0, 0.5, 1.5], 28e9))):
                np.testing.assert_allclose(pas, image, atol=1e-6)
        assert (exported.metadata["field"], exported.metadata["step"]) == ("toy", STEPS)
    result = call(predict_command.main, *ask, "--what", "power", "--out", tmp_path / "power.npz")
    assert result.code == 0, result.err
    with np.load(tmp_path / "power.npz") as answer:
        np.testing.assert_allclose(answer["power_db"], float(wb.load_trained(folder).params["power_db"][0]), rtol=1e-6)
    refused = call(predict_command.main, *ask, "--what", "delay-spread", "--out", tmp_path / "none.npz")
    assert_error_for_people(refused, "the toy field does not provide delay-spread")


def test_it_is_used_as_a_library(trained, tmp_path):
    """Trained, resumed, asked, differentiated, evaluated, exported: by functions alone."""
    by_command = wb.load_trained(trained("snapshot", 3))
    dataset = hold_out_validation(wb.load_dataset(by_command.config.source), 0.2)
    settings = by_command.config.settings
    result = train(dataset, "toy", settings, 0, tmp_path / "run")
    assert (result.steps, result.compilations, result.sizes) == (STEPS, 1, {"parameters": 3 * 32401})
    assert_equal_trees((result.params, result.field), (by_command.params, by_command.field))
    shutil.rmtree(tmp_path / "run" / "checkpoints" / str(STEPS))
    assert_equal_trees(train(dataset, "toy", settings, 0, tmp_path / "run", resume=True).params, result.params)

    receiver, query = dataset.receiver(1), wb.make_query([1.0, 2.0, 1.5], 5e9)
    pas = wb.pas(result.field, result.params, receiver, query)
    np.testing.assert_array_equal(pas[0], result.params["image"][1])
    slopes = jax.grad(lambda params: wb.pas(result.field, params, receiver, query).sum())(result.params)
    np.testing.assert_array_equal(slopes["image"], np.arange(3)[:, None, None] == np.ones((90, 360)))

    predict = wb.make_predictor(by_command, receiver)
    np.testing.assert_array_equal(wb.predict_many(predict, dataset.tx_positions[:5], 5e9, block=2), np.tile(pas, (5, 1, 1)))
    report, predicted = evaluate(by_command, dataset, "validation")
    of = dataset.receiver_index[dataset.validation]
    np.testing.assert_array_equal(predicted, np.asarray(result.params["image"])[of])
    assert report["median_ssim"] == watch(result.field, result.params, dataset, dataset.validation)["held_out_ssim"]

    wb.export_field(by_command, tmp_path / "toy.zip", platforms=("cpu",))
    again = wb.load_exported(tmp_path / "toy.zip")
    np.testing.assert_allclose(again([1.0, 2.0, 1.5], 5e9), result.params["image"][0], atol=1e-6)


@pytest.mark.heavy
def test_a_receiver_alone_is_looked_at_as_if_it_were_the_only_one(trained, tmp_path):
    """`--receiver 1` of three, and the field made of it."""
    scene = wb.load_trained(trained("snapshot", 3)).config.source
    result = call(train_command.main, "--scene", scene, "--receiver", 1, *TRAIN, "--out", tmp_path / "run")
    assert result.code == 0, result.err
    alone = wb.load_trained(tmp_path / "run")
    whole = wb.load_dataset(scene)
    assert alone.field.positions.shape == (1, 3) and alone.dataset().name == "box_rx1"
    np.testing.assert_array_equal(alone.field.positions[0], whole.receiver(1).position)
    np.testing.assert_array_equal(alone.dataset().snapshots, select_receivers(whole, [1]).snapshots)


def test_what_it_does_not_know_is_an_error_for_people(tmp_path):
    """Data of powers, of which a field without powers knows nothing."""

    @wb.pytree
    class Blind(ToyField):
        name: ClassVar[str] = "blind"
        outputs: ClassVar = ("pas",)

        def render(self, params, plan, links):
            return wb.Observation(super().render(params, plan, links).pas)

    save_scene(tmp_path / "power.npz", tiny_scene(kind="power"))
    wb.register(Blind)
    try:
        arguments = ["--scene", tmp_path / "power.npz", "--field", "blind", *TRAIN[2:], "--out", tmp_path / "run"]
        refused = call(train_command.main, *arguments)
        assert_error_for_people(refused, "received powers, which the blind field does not predict", "toy", "wave")
        assert not (tmp_path / "run").exists()
    finally:
        del base._FIELDS["blind"]


@pytest.mark.heavy
def test_simple_methods_answer_unless_their_file_is_gone(tmp_path):
    """By the command line: the toy knows little of the room, the transmitters next door more."""
    save_scene(tmp_path / "box.npz", tiny_scene(24))
    run = tmp_path / "run"
    result = call(train_command.main, "--scene", tmp_path / "box.npz", *TRAIN, "--out", run)
    assert result.code == 0 and "the field's weight is 0.00" in result.err, result.err

    def median() -> float:
        report = json.loads(call(eval_command.main, "--run", run, "--json", "--no-pictures").out)
        return float(report["median_ssim"])

    with_methods = median()
    (run / "neighbours.npz").unlink()
    assert with_methods > median() + 0.05
    again = call(train_command.main, "--scene", tmp_path / "box.npz", *TRAIN, "--out", run, "--resume")
    assert again.code == 0 and (run / "neighbours.npz").exists() and median() == pytest.approx(with_methods)
