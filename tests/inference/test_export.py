"""An exported field: the same answers without the training code, what the file says, damaged files; docs/inference.md runs."""

import dataclasses
import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import FREQUENCIES_HZ, RX, tiny_dataset
from builders.toys import RippleConfig, RippleField
from builders.untrained import STEP, make_field, make_params, make_run, make_trained

import wbgs_jax
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import get_field
from wbgs_jax.fields.coherent import WaveConfig
from wbgs_jax.fields.hybrid import HybridConfig
from wbgs_jax.inference.evaluate_quantities import LoadedField
from wbgs_jax.inference.export import export_field, load_exported
from wbgs_jax.inference.intervals import write_confidence
from wbgs_jax.inference.predictor import make_predictor
from wbgs_jax.inference.quantities import QUANTITIES
from wbgs_jax.inference.queries import Product
from wbgs_jax.training.fit_intervals import learn_confidence


@pytree
class BrokenField(RippleField):
    """Renders nothing."""

    def render(self, params, plan, query):
        raise ZeroDivisionError


GUIDE = (Path(__file__).parents[2] / "docs" / "inference.md").read_text()
FOREIGN = ["wbgs_jax", "flax", "optax", "orbax", "jaxtyping"]
TX = np.array([[1.0, 0.5, 1.5], [-1.0, 1.0, 1.2], [0.0, 2.0, 0.4]])
HZ = np.array([28e9, 5e9, 1e9])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return make_trained(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def predict(trained):
    return make_predictor(trained, tiny_dataset().receiver())


@pytest.fixture(scope="module")
def path(tmp_path_factory, trained):
    path = tmp_path_factory.mktemp("exported") / "field.zip"
    export_field(trained, path)
    return path


@pytest.fixture(scope="module")
def exported(path):
    return load_exported(path)


@pytest.mark.heavy
def test_the_answers_are_those_of_the_predictor(exported, predict):
    """For more than one number of queries, and for any leading axes."""
    expected = np.asarray(predict(TX, HZ))
    np.testing.assert_allclose(exported(TX, HZ), expected, atol=1e-5)
    one = exported(TX[0], HZ[0])
    assert (one.shape, one.dtype) == ((90, 360), jnp.float32)
    np.testing.assert_allclose(one, expected[0], atol=1e-5)
    assert exported(TX[:0], HZ[0]).shape == (0, 90, 360)
    with pytest.raises(ValueError, match="hertz"):
        exported(TX, 28.0)


@pytest.mark.heavy
def test_all_outputs_and_their_intervals(tmp_path):
    """Of a field that outputs power and snapshots, with intervals of its spectra."""
    dataset = hold_out_validation(tiny_dataset(30))
    field = get_field("wave").build(WaveConfig(specular_tried=32, specular_kept=8, diffracted_kept=8), DatasetScene(dataset), 0)
    params = field.init(jax.random.key(1))
    confidence, of_powers = learn_confidence(field, params, dataset, None)
    whole = dataclasses.replace(
        make_trained(tmp_path), field=field, params=params, intervals=confidence, power_intervals=of_powers
    )
    export_field(whole, tmp_path / "field.zip", platforms=("cpu",), dataset=dataset)
    found = load_exported(tmp_path / "field.zip").observe(TX, HZ)
    loaded = LoadedField(whole, dataset, dataset.receiver())
    block = [Product(np.arange(3)[i : i + 1], np.arange(1), TX[i : i + 1], HZ[i : i + 1]) for i in range(3)]
    compared = set()
    for what in ("spectra", "power", "snapshot"):
        expected = {
            name: np.concatenate([loaded.answer(what, [one])[name] for one in block]) for name in QUANTITIES[what].outputs
        }
        for name, values in expected.items():
            known = np.isfinite(values)
            assert known.any() and found[name].shape == values.shape
            np.testing.assert_array_equal(np.isnan(found[name]), np.isnan(values), err_msg=name)
            np.testing.assert_allclose(np.asarray(found[name])[known], values[known], rtol=1e-3, atol=2e-4, err_msg=name)
            compared.add(name)
    assert compared == {"pas", "expected", "power_db", "expected_error_db", "within_db", "snapshots"} == set(found)
    away = load_exported(tmp_path / "field.zip").observe(TX + 99, HZ)
    beyond = load_exported(tmp_path / "field.zip").observe(TX, 0.5e9)  # the data begin at 1 GHz
    for name in ("expected", "expected_error_db", "within_db"):
        assert np.isnan(away[name]).all() and np.isnan(beyond[name]).all()
    assert np.isfinite(away["pas"]).all() and np.isfinite(beyond["power_db"]).all()


def test_files_of_the_first_format_are_read(tmp_path):
    """They hold spectra alone."""

    def spectra(tx_position, frequency_hz):
        return jnp.broadcast_to((tx_position[:, :1] * frequency_hz[:, None])[..., None], (tx_position.shape[0], 90, 360))

    (n,) = jax.export.symbolic_shape("n")
    shapes = jax.ShapeDtypeStruct((n, 3), np.float32), jax.ShapeDtypeStruct((n,), np.float32)
    with zipfile.ZipFile(tmp_path / "old.zip", "w") as archive:
        archive.writestr("metadata.json", json.dumps({"format": 1, "scene": "box"}))
        archive.writestr("field.bin", jax.export.export(jax.jit(spectra), platforms=["cpu"])(*shapes).serialize(vjp_order=1))
    old = load_exported(tmp_path / "old.zip")
    np.testing.assert_allclose(old(TX, HZ)[:, 3, 4], TX[:, 0] * HZ, rtol=1e-6)
    assert old.observe(TX[:0], HZ[0]).keys() == {"pas"}


@pytest.mark.heavy
def test_the_gradient_too(exported, predict, rng):
    weight = jnp.asarray(rng.normal(size=(3, 90, 360)), jnp.float32)

    def gradient(function):
        objective = lambda tx, frequency: jnp.sum(weight * function(tx, 1e9 * frequency))  # noqa: E731
        return jax.jit(jax.grad(objective, argnums=(0, 1)))(jnp.asarray(TX, jnp.float32), jnp.asarray(HZ / 1e9, jnp.float32))

    for own, theirs in zip(gradient(exported), gradient(predict), strict=True):
        size = np.abs(theirs).max()
        assert size > 0
        np.testing.assert_allclose(own, theirs, atol=1e-4 * size)


def test_metadata(exported):
    said = exported.metadata
    assert (said["format"], said["scene"], said["field"], said["step"]) == (2, "box", "wideband", STEP)
    np.testing.assert_allclose(said["rx_position"], RX, rtol=1e-6)
    assert said["rx_orientation"] == [1, 0, 0, 0]
    assert said["frequency_range_hz"] == [FREQUENCIES_HZ.min(), FREQUENCIES_HZ.max()]
    assert np.shape(said["scene_box"]) == (2, 3)
    assert said["platforms"] == ["cpu", "cuda"]
    assert said["outputs"] == ["pas", "power_db"]
    assert said["versions"] == {"wbgs_jax": wbgs_jax.__version__, "jax": jax.__version__}


@pytest.mark.heavy
def test_the_file_holds_no_paths_of_this_machine_and_equal_fields_make_equal_files(trained, path, tmp_path):
    with zipfile.ZipFile(path) as archive:
        assert sorted(archive.namelist()) == ["field.bin", "metadata.json"]
        code = archive.read("field.bin")
    assert str(Path(__file__).parents[2]).encode() not in code and b".py" not in code
    export_field(trained, tmp_path / "again.zip", dataset=tiny_dataset())
    assert (tmp_path / "again.zip").read_bytes() == path.read_bytes()


def blocks(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


@pytest.mark.heavy
def test_the_guide_runs(tmp_path, monkeypatch):
    """Block after block, and the one that loads a field elsewhere in a process that can import nothing of the library."""
    run = make_run(tmp_path / "runs" / "scene1-hybrid-cpu-seed0")
    write_confidence(run, *learn_confidence(make_field(), make_params(), hold_out_validation(tiny_dataset(30)), None))
    monkeypatch.chdir(tmp_path)
    here, elsewhere = GUIDE.split("## Loading elsewhere")
    names: dict = {}
    for block in blocks(here):
        exec(compile(block, "inference.md", "exec"), names)
    assert names["pas"].shape == (90, 360)
    assert names["grid"].shape == (2, 3, 4, 90, 360)
    np.testing.assert_allclose(names["strongest"], names["grid"].max((3, 4)), atol=1e-6)
    assert (names["sure"].low < names["sure"].high).all()
    assert names["slope"].shape == (3,) and float(jnp.abs(names["slope"]).max()) > 0
    (block,) = blocks(elsewhere)
    block_imports = f"import sys\nsys.modules.update(dict.fromkeys({FOREIGN!r}))\n"
    source = block_imports + block + "np.savez('elsewhere.npz', pas=pas, slope=slope)\n"
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with np.load("elsewhere.npz") as result:
        expected = names["predict"]([[1.0, 0.5, 1.5], [0.0, 1.0, 1.2]], 28e9)
        np.testing.assert_allclose(result["pas"], expected, atol=1e-5)
        assert result["slope"].shape == (2, 3) and np.abs(result["slope"]).max() > 0


def rewritten(path, target, edit):
    """A copy of an archive whose members {name: bytes} were edited."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    edit(members)
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return target


def metadata(**changes):
    def edit(members):
        members["metadata.json"] = json.dumps(json.loads(members["metadata.json"]) | changes).encode()

    return edit


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (metadata(format=3), ["export format 3", "reads 1 and 2"]),
        (lambda m: m.update({"metadata.json": b"[]"}), ["export format None"]),
        (lambda m: m.update({"metadata.json": b"{"}), ["damaged"]),
        (lambda m: m.pop("metadata.json"), ["metadata.json"]),
        (lambda m: m.pop("field.bin"), ["field.bin"]),
        (lambda m: m.update({"field.bin": b""}), [f"exported by jax {jax.__version__}", "export it again"]),
        (lambda m: m.update({"field.bin": m["field.bin"][:3000]}), ["export it again"]),
        (lambda m: m.update({"field.bin": m["field.bin"].replace(b"multiply_v1", b"multiply_v9")}), ["export it again"]),
    ],
)
def test_files_that_cannot_be_read(path, tmp_path, edit, words):
    with pytest.raises(UserError) as error:
        load_exported(rewritten(path, tmp_path / "field.zip", edit))
    (line,) = str(error.value).splitlines()
    for word in (str(tmp_path / "field.zip"), *words):
        assert word in line


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "flipped", "folder", "text"])
def test_damaged_files(path, tmp_path, damage):
    data = bytearray(path.read_bytes())
    target = tmp_path / "field.zip"
    if damage == "folder":
        target.mkdir()
    elif damage != "missing":
        data[len(data) // 2] ^= 0xFF
        target.write_bytes({"empty": b"", "cut": data[: len(data) // 2], "flipped": data, "text": b"a field"}[damage])
    with pytest.raises(UserError, match=str(target)):
        load_exported(target)


@pytest.mark.parametrize("platforms", [(), ("gpu",), ("cpu", "abacus")])
def test_unknown_platforms(trained, tmp_path, platforms):
    with pytest.raises(UserError, match="cpu, cuda"):
        export_field(trained, tmp_path / "field.zip", platforms)
    assert list(tmp_path.iterdir()) == []


def test_an_export_that_fails_leaves_nothing(trained, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match="cannot write"):
        export_field(trained, tmp_path / "file" / "field.zip", ("cpu",), tiny_dataset())
    broken = dataclasses.replace(trained, field=BrokenField(RippleConfig()))
    before = jax.config.jax_traceback_in_locations_limit
    with pytest.raises(ZeroDivisionError):
        export_field(broken, tmp_path / "field.zip", dataset=tiny_dataset())
    assert jax.config.jax_traceback_in_locations_limit == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


@pytest.mark.heavy
@pytest.mark.parametrize(("name", "unit"), [pytest.param("hybrid", "wavelengths", marks=pytest.mark.slow), ("wave", "metres")])
def test_fields_with_paths_trace_them_in_the_file(tmp_path, name, unit):
    coherent = WaveConfig(specular_tried=32, specular_kept=8, diffracted_tried=32, diffracted_kept=8)
    blurred = make_trained(tmp_path).field.config
    config = coherent if name == "wave" else HybridConfig(coherent, blurred)
    dataset = tiny_dataset(unit=unit)
    field = get_field(name).build(config, DatasetScene(dataset), 0)
    whole = dataclasses.replace(make_trained(tmp_path), field=field, params=field.init(jax.random.key(1)))
    export_field(whole, tmp_path / "field.zip", platforms=("cpu",), dataset=dataset)
    exported, predict = load_exported(tmp_path / "field.zip"), make_predictor(whole, dataset.receiver())
    expected = predict(TX, HZ)
    np.testing.assert_allclose(exported(TX, HZ), expected, atol=2e-4)
    np.testing.assert_allclose(exported(TX[:1], HZ[:1]), expected[:1], atol=2e-4)
    if name == "wave":
        return  # the hybrid field's derivative is its own, too
    slopes = [jax.grad(lambda tx, f=f: jnp.sum(f(tx, HZ) ** 2))(jnp.asarray(TX, jnp.float32)) for f in (exported, predict)]
    assert float(jnp.abs(slopes[1]).max()) > 0
    np.testing.assert_allclose(*slopes, rtol=0.02, atol=0.02 * float(jnp.abs(slopes[1]).max()))
