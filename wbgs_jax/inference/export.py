"""Exports a trained field to one file that runs without its training code, and loads such files.

The file is a zip archive of `metadata.json` (scene, receiver, training domain, versions) and `field.bin`: the field as a
function (tx_position (n, 3), frequency_hz (n,)) -> {"pas": (n, 90, 360), ...} in StableHLO, including its parameters, written
by `jax.export` for any n >= 1 with the first reverse-mode derivative. The dictionary contains the outputs of the field (`pas`,
`power_db`, `snapshots`) and their prediction intervals (`expected`, `expected_error_db`, `within_db`). Only JAX and NumPy are
needed to run it (docs/inference.md):

    with zipfile.ZipFile(path) as archive:
        predict = jax.export.deserialize(bytearray(archive.read("field.bin"))).call

The function in files of format 1 returns only spectra, as an array.
"""

import contextlib
import json
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import wbgs_jax
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params, portable
from wbgs_jax.inference.evaluate_quantities import domain_of, known_quantities
from wbgs_jax.inference.intervals import PowerConfidence, expected_power, expected_ssim
from wbgs_jax.inference.kriging import correct, for_receiver
from wbgs_jax.inference.predictor import OnAnyShape, Predictor, trained_band
from wbgs_jax.inference.quantities import COMPILED, QUANTITIES
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.types import Query, Receiver, Transmitter

FORMAT = 2
METADATA, FIELD = "metadata.json", "field.bin"
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
"""Platforms for which `jax.export` can lower on any machine."""


class FrozenField(NamedTuple):
    """Everything needed to predict at one receiver, as a tree of arrays."""

    field: Field
    params: Params
    plan: Any
    neighbours: Any
    confidence: Any
    power_confidence: PowerConfidence | None
    receiver: Receiver


def freeze(trained: TrainedField, receiver: Receiver) -> FrozenField:
    """Returns a trained field (`trained_field.at_receiver`) with its plan for a receiver."""
    neighbours, confidence = (for_receiver(one, receiver) for one in (trained.correction, trained.intervals))
    plan = trained.field.plan(trained.params, receiver)
    return FrozenField(trained.field, trained.params, plan, neighbours, confidence, trained.power_intervals, receiver)


def answer_all(frozen: FrozenField, query: Query, names: Sequence[str]) -> dict[str, Array]:
    """Returns those outputs of a field and prediction intervals that exist, for B queries (pure, jittable).

    Args:
        frozen: the field.
        query: B queries.
        names: names of the arrays to return (`quantities.Quantity.outputs`).
    """
    seen = frozen.field.render(frozen.params, frozen.plan, query)
    pas = correct(frozen.neighbours, seen.pas, query)
    found: dict[str, Array | None] = {"pas": pas, "power_db": seen.power_db, "snapshots": seen.snapshots}
    if frozen.confidence is not None:
        found["expected"] = jnp.stack(expected_ssim(frozen.confidence, pas, query, seen.power_db), -1)
    if frozen.power_confidence is not None and seen.power_db is not None:
        interval = expected_power(frozen.power_confidence, seen.power_db, query, frozen.receiver.position)
        found |= {"expected_error_db": interval.error_db, "within_db": interval.within_db}
    return {name: values for name, values in found.items() if values is not None and name in names}


def frozen_outputs(trained: TrainedField, dataset: Dataset) -> tuple[str, ...]:
    """Returns the names of the arrays that `answer_all` can compute for a field."""
    known = known_quantities(trained.field, dataset)
    return tuple(name for what in COMPILED if what in known for name in QUANTITIES[what].outputs)


@dataclass(frozen=True)
class ExportedField:
    """A field read by `load_exported`. It is called like the result of `make_predictor`, with batches: `jax.vmap` is not
    supported. It can be differentiated once with reverse-mode `jax.grad`."""

    metadata: dict[str, Any]
    """The content of `metadata.json`."""
    predict: Predictor
    observe: Callable[[Any, Any], dict[str, Array]]
    """Function (tx_position, frequency_hz) -> all outputs by name; arguments as in `make_predictor`'s result."""

    def __call__(self, tx_position: Any, frequency_hz: Any) -> Float[Array, "*b 90 360"]:
        return self.predict(tx_position, frequency_hz)


def export_field(
    trained: TrainedField, path: Path | str, platforms: Sequence[str] = ("cpu", "cuda"), dataset: Dataset | None = None
) -> None:
    """Writes a trained field to one file (a zip archive) that runs on all of `platforms`, a selection of `PLATFORMS`.

    Args:
        trained: a trained field.
        path: of the file.
        platforms: those on which the file is to run.
        dataset: the training data; loaded if not passed.

    Raises:
        UserError: a platform is unknown, the file cannot be written, or the run's data are missing.
    """
    if not platforms or set(platforms) - set(PLATFORMS):
        raise UserError(f"cannot export for {', '.join(platforms) or 'no platform'}; choose from: {', '.join(PLATFORMS)}")
    dataset = trained.dataset() if dataset is None else dataset
    outputs, program = _serialize(trained, dataset, platforms)
    content = {
        METADATA: json.dumps(_metadata(trained, dataset, platforms) | {"outputs": outputs}, indent=2).encode(),
        FIELD: program,
    }
    with atomic_write(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))  # equal fields give equal files
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, data)


def _metadata(trained: TrainedField, dataset: Dataset, platforms: Sequence[str]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "scene": dataset.name,
        **trained.origin(),
        "rx_position": np.asarray(dataset.receiver().position, float).tolist(),
        "rx_orientation": np.asarray(dataset.receiver().orientation, float).tolist(),
        "frequency_range_hz": list(trained_band(dataset)),
        "scene_box": DatasetScene(dataset).box.tolist(),
        "inputs": {"tx_position": ["n", 3], "frequency_hz": ["n"]},
        "platforms": list(platforms),
        "versions": {"wbgs_jax": wbgs_jax.__version__, "jax": jax.__version__},
    }


def _serialize(trained: TrainedField, dataset: Dataset, platforms: Sequence[str]) -> tuple[list[str], bytes]:
    """Returns the names of the outputs, and the field with constant parameters and plan, for any number of queries."""
    frozen, names = freeze(trained, dataset.receiver()), frozen_outputs(trained, dataset)
    frozen, domain = frozen._replace(plan=portable(frozen.plan)), domain_of(dataset)

    def answer(tx_position: Float[Array, "n 3"], frequency_hz: Float[Array, " n"]) -> dict[str, Array]:
        answers = answer_all(frozen, Query(Transmitter(tx_position), frequency_hz), names)
        return domain.without_intervals(answers, tx_position, frequency_hz, xp=jnp)

    (n,) = jax.export.symbolic_shape("n")
    shapes = jax.ShapeDtypeStruct((n, 3), np.float32), jax.ShapeDtypeStruct((n,), np.float32)
    with _no_source_locations():
        exported = jax.export.export(jax.jit(answer), platforms=platforms)(*shapes)
        outputs = jax.tree.unflatten(exported.out_tree, exported.out_avals)
        return list(outputs), bytes(exported.serialize(vjp_order=1))


@contextlib.contextmanager
def _no_source_locations() -> Iterator[None]:
    """Keeps the paths of this machine's source files out of the lowered code."""
    name = "jax_traceback_in_locations_limit"
    before = getattr(jax.config, name)
    jax.config.update(name, 0)
    try:
        yield
    finally:
        jax.config.update(name, before)


def load_exported(path: Path | str) -> ExportedField:
    """Returns a field that `export_field` wrote. The model's code is not needed.

    Args:
        path: of the file.

    Returns:
        The field, called like the result of `make_predictor`, with its `metadata`.

    Raises:
        UserError: the file is missing, damaged, not an exported field, or of an unsupported version.
    """
    metadata, data = _read(Path(path))
    try:
        exported = jax.export.deserialize(bytearray(data))
        exported.mlir_module()  # parses the code, which `deserialize` would defer to the first call
    except Exception as error:  # the parser of binary data raises many kinds of errors
        made, reason = metadata.get("versions", {}).get("jax"), (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"{path} was exported by jax {made}, but jax {jax.__version__} cannot read it ({reason}); export it again"
        ) from error

    @jax.jit
    def observe(query: Query) -> dict[str, Array]:
        found = exported.call(query.tx_position, query.frequency_hz)
        return found if isinstance(found, dict) else {"pas": found}

    @jax.jit
    def predict(query: Query) -> Float[Array, "n 90 360"]:
        return observe(query)["pas"]  # the other outputs are not computed

    return ExportedField(metadata, OnAnyShape(predict), OnAnyShape(observe))


def _read(path: Path) -> tuple[dict[str, Any], bytes]:
    """Returns the two members of the archive, if its format is supported."""
    try:
        with zipfile.ZipFile(path) as archive:
            metadata, data = json.loads(archive.read(METADATA)), archive.read(FIELD)
    except OSError as error:
        raise UserError(f"cannot read exported field {path}: {error.strerror or error}; check the path") from error
    except (ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is damaged or not an exported field ({error}); copy it again or export it again") from error
    found = metadata.get("format") if isinstance(metadata, dict) else None
    if found not in (1, FORMAT):
        raise UserError(
            f"{path} has export format {found}, but this version reads 1 and {FORMAT}; export it again or update wbgs-jax"
        )
    return metadata, data
