"""Kinds of observation are data: one that is registered here goes from a scene file to a trained field and its score."""

import dataclasses
import hashlib
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_dataset, tiny_scene
from builders.toys import RippleField, registered, toy_settings

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.data import load_dataset, load_scene, save_scene
from wbgs_jax.data.dataset import checksum, hold_out_validation, select_receivers, without_test
from wbgs_jax.data.load import join
from wbgs_jax.evaluation.score import watch
from wbgs_jax.fields import losses
from wbgs_jax.observation_kinds import KINDS, Kind, only_kind, power_of, spectra_of
from wbgs_jax.radio.array import snapshot_to_pas
from wbgs_jax.radio.channel import NO_PATH_DB, received_power_db
from wbgs_jax.training.batches import check_data, training_data
from wbgs_jax.training.loop import train

RSSI = Kind(
    "rssi",
    "readings with their standard deviations",
    np.float32,
    (2,),
    to_power=lambda values: values[..., 0],
    measured=lambda values: values[..., 0] > NO_PATH_DB,
    fault=lambda values: "" if (values[..., 1] > 0).all() else "standard deviations that are not positive",
)


def rssi_loss(seen, rssi):
    return None if seen.power_db is None else jnp.mean(((seen.power_db - rssi[:, 0]) / rssi[:, 1]) ** 2)


@pytree
class LevelField(RippleField):
    """A toy that says one power for all links."""

    name = "level"
    outputs = ("pas", "power")

    def init(self, key):
        return super().init(key) | {"power": jnp.full((), -40.0)}

    def render(self, params, plan, query):
        seen = super().render(params, plan, query)
        return seen._replace(power_db=jnp.broadcast_to(params["power"], query.frequency_hz.shape))


@pytest.fixture
def rssi(monkeypatch):
    """The kind, for a test."""
    monkeypatch.setitem(KINDS, "rssi", RSSI)  # as `register_kind` does, and taken back afterwards
    monkeypatch.setitem(losses.LOSSES, "rssi", rssi_loss)


def readings(n_tx=9, n_rx=2):
    """A scene of readings: powers of snapshots, known to 2 dB; one link is not heard."""
    scene = tiny_scene(n_tx, n_rx=n_rx)
    power = np.asarray(received_power_db(jnp.asarray(scene.snapshots)))
    values = np.stack([power, np.full_like(power, 2.0)], -1)
    values[0, 0, 0, 0] = np.nan
    return dataclasses.replace(scene, snapshots=None, others={"rssi": values})


def test_a_new_kind_goes_through_files_joins_and_splits(tmp_path, rssi):
    scene = readings()
    save_scene(tmp_path / "s.npz", scene)
    np.testing.assert_array_equal(load_scene(tmp_path / "s.npz").others["rssi"], scene.others["rssi"])
    dataset = load_dataset(tmp_path / "s.npz")
    assert len(dataset) == 9 * 2 * 3 - 1 and dataset.has("rssi") and (dataset.has_spectra, dataset.has_scale) == (False, True)
    np.testing.assert_array_equal(dataset.received_db(np.arange(5)), scene.others["rssi"].reshape(-1, 2)[1:6, 0])
    apart = [select_receivers(dataset, [number]) for number in range(2)]
    joined = join(apart)
    assert sorted(joined.received_db(np.arange(len(joined)))) == sorted(dataset.received_db(np.arange(len(dataset))))
    np.testing.assert_array_equal(
        without_test(dataset).observations["rssi"], dataset.observations["rssi"][np.sort(dataset.train)]
    )
    with pytest.raises(UserError, match="readings with their standard deviations, which have no angular spectrum"):
        dataset.pas(np.arange(2))
    with pytest.raises(UserError, match="one contains readings with their standard deviations, the other snapshots"):
        join([apart[0], tiny_dataset(9)])


def test_values_of_a_new_kind_are_checked(tmp_path, rssi):
    scene = readings()
    scene.others["rssi"][3, 1, 2, 1] = 0
    with pytest.raises(UserError, match="rssi contains standard deviations that are not positive"):
        save_scene(tmp_path / "s.npz", scene)
    with pytest.raises(UserError, match=r"rssi has shape .* expected \(9, 2, 3, 2\)"):
        save_scene(tmp_path / "s.npz", dataclasses.replace(scene, others={"rssi": np.ones((9, 2, 3, 1))}))
    assert not (tmp_path / "s.npz").exists()


def test_a_field_learns_a_new_kind(tmp_path, rssi):
    save_scene(tmp_path / "s.npz", readings())
    dataset = hold_out_validation(load_dataset(tmp_path / "s.npz"))
    with registered(RippleField, LevelField):
        with pytest.raises(UserError, match=r"which the ripple field does not predict; choose one of: .*level"):
            check_data(dataset, RippleField)
        settings = toy_settings(optim={"batch": 4}, field={"learning_rate": 1.0})
        result = train(dataset, "level", settings, 0, tmp_path / "run")
        field = LevelField(settings.field)
        batch = training_data(dataset).batch(jnp.asarray(dataset.train[:3]), jax.random.key(0))
    loss, _ = field.loss(field.init(jax.random.key(0)), None, batch)
    values = np.asarray(dataset.observations["rssi"][dataset.train[:3]])
    assert float(loss) == pytest.approx(np.mean(((-40 - values[:, 0]) / 2) ** 2), rel=1e-5)
    entries = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert result.steps == settings.optim.steps and any("held_out_power_error_db" in entry for entry in entries)
    params = field.init(jax.random.key(0))
    far, near = (watch(field, params | {"power": jnp.float32(p)}, dataset, dataset.validation) for p in (-90.0, -5.0))
    assert near["held_out_power_error_db"] < far["held_out_power_error_db"]


def test_where_several_kinds_are_known_the_spectra_are_those_that_were_stored(rng):
    """And the power is that of the snapshots."""
    dataset = tiny_dataset()
    elements, snapshots = dataset.receiver().element_positions, jnp.asarray(dataset.snapshots[:2])
    images = rng.integers(0, 256, (2, 90, 360), np.uint8)
    both = {"snapshots": snapshots, "pas": jnp.asarray(images), "power_db": jnp.zeros(2)}
    np.testing.assert_allclose(spectra_of(both, elements), np.float32(images) / 255, atol=1e-7)
    np.testing.assert_array_equal(spectra_of({"snapshots": snapshots}, elements), snapshot_to_pas(snapshots, elements))
    assert spectra_of({"power_db": jnp.zeros(2)}, elements) is None
    np.testing.assert_array_equal(power_of(both), received_power_db(snapshots))
    assert power_of({"pas": both["pas"]}) is None


def test_a_kind_has_spectra_or_power():
    with pytest.raises(ValueError, match="colours have neither to_spectra nor to_power"):
        Kind("colour", "colours", np.uint8, (3,))
    with pytest.raises(ValueError, match="a box contains none of pas, snapshots, power_db, but must contain one"):
        only_kind(["colour"], "a box")


@pytest.mark.parametrize(("kind", "name"), [("snapshot", "snapshots"), ("pas", "images"), ("power", "power_db")])
def test_checksums_of_old_run_folders_stay_valid(kind, name):
    """Those of version 0.2, in which every kind was a field of the data set."""
    dataset = tiny_dataset(kind=kind)
    parts = {field.name: getattr(dataset, field.name) for field in dataclasses.fields(dataset)}
    for absent in ("name", "convention", "observations"):
        del parts[absent]
    (parts[name],) = dataset.observations.values()
    parts["materials"] = dataclasses.asdict(dataset.materials) | {"names": ()}
    found = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(parts):
        array = np.ascontiguousarray(leaf)
        found.update(f"{jax.tree_util.keystr(path)} {array.dtype.str} {array.shape}".encode())
        found.update(array.tobytes())
    assert checksum(dataset) == found.hexdigest()
