"""A trained field as one file that runs without its training code, and back.

The file is a zip archive of `metadata.json` (scene, receiver, what it was trained on, versions) and `field.bin`: the field as
a function (tx_position (n, 3), frequency_hz (n,)) -> PAS (n, 90, 360) in StableHLO, parameters included, written by
`jax.export` for any n >= 1 with one reverse-mode derivative. JAX and NumPy read it alone (docs/inference.md):

    with zipfile.ZipFile(path) as archive:
        predict = jax.export.deserialize(bytearray(archive.read("field.bin"))).call
"""

import contextlib
import json
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.export
import numpy as np
from jaxtyping import Array, Float

import wbgs_jax
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields.base import portable
from wbgs_jax.inference.kriging import correct, for_receiver
from wbgs_jax.inference.predictor import OnAnyShape, Predictor, Trained, trained_band
from wbgs_jax.types import Query, Receiver

FORMAT = 1
METADATA, FIELD = "metadata.json", "field.bin"
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
"""What `jax.export` can lower for, on any machine."""


@dataclass(frozen=True)
class ExportedField:
    """A field read by `load_exported`. Calling it is like calling a `predictor`, but `jax.vmap` is not possible: give it
    batches. One reverse-mode `jax.grad` is."""

    metadata: dict[str, Any]
    """What `metadata.json` says."""
    predict: Predictor

    def __call__(self, tx_position: Any, frequency_hz: Any) -> Float[Array, "*b 90 360"]:
        return self.predict(tx_position, frequency_hz)


def export_field(
    trained: Trained, path: Path | str, platforms: Sequence[str] = ("cpu", "cuda"), dataset: Dataset | None = None
) -> None:
    """Writes a trained field to one file (a zip archive) for all of `platforms`: any of `PLATFORMS`.

    `dataset` is what the field was trained on; it is loaded where it is not given.

    Raises:
        UserError: an unknown platform, a file that cannot be written, or the run's data are gone.
    """
    if not platforms or set(platforms) - set(PLATFORMS):
        raise UserError(f"cannot export for {', '.join(platforms) or 'no platform'}; choose from: {', '.join(PLATFORMS)}")
    dataset = trained.dataset() if dataset is None else dataset
    content = {
        METADATA: json.dumps(_metadata(trained, dataset, platforms), indent=2).encode(),
        FIELD: _serialize(trained, dataset.receiver(), platforms),
    }
    with atomic_write(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))  # equal fields, equal files
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, data)


def _metadata(trained: Trained, dataset: Dataset, platforms: Sequence[str]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "scene": dataset.name,
        **trained.origin(),
        "rx_position": np.asarray(dataset.receiver().position, float).tolist(),
        "rx_orientation": np.asarray(dataset.receiver().orientation, float).tolist(),
        "frequency_range_hz": list(trained_band(dataset)),
        "scene_box": DatasetScene(dataset).box.tolist(),
        "inputs": {"tx_position": ["n", 3], "frequency_hz": ["n"]},
        "output": {"pas": ["n", 90, 360]},
        "platforms": list(platforms),
        "versions": {"wbgs_jax": wbgs_jax.__version__, "jax": jax.__version__},
    }


def _serialize(trained: Trained, receiver: Receiver, platforms: Sequence[str]) -> bytes:
    """Returns the field with its parameters and plan as constants, for any number of queries."""
    plan = portable(trained.field.plan(trained.params, receiver))
    neighbours = for_receiver(trained.neighbours, receiver)

    def predict(tx_position: Float[Array, "n 3"], frequency_hz: Float[Array, " n"]) -> Float[Array, "n 90 360"]:
        query = Query(tx_position, frequency_hz)
        return correct(neighbours, trained.field.render(trained.params, plan, query).pas, query)

    (n,) = jax.export.symbolic_shape("n")
    shapes = jax.ShapeDtypeStruct((n, 3), np.float32), jax.ShapeDtypeStruct((n,), np.float32)
    with _no_source_locations():
        return bytes(jax.export.export(jax.jit(predict), platforms=platforms)(*shapes).serialize(vjp_order=1))


@contextlib.contextmanager
def _no_source_locations() -> Iterator[None]:
    """Keeps the paths of this machine's source files out of what is lowered."""
    name = "jax_traceback_in_locations_limit"
    before = getattr(jax.config, name)
    jax.config.update(name, 0)
    try:
        yield
    finally:
        jax.config.update(name, before)


def load_exported(path: Path | str) -> ExportedField:
    """Returns a field that `export_field` wrote; uses nothing of the model's code.

    Raises:
        UserError: the file is missing, damaged, no exported field, or of a version that cannot be read.
    """
    metadata, data = _read(Path(path))
    try:
        exported = jax.export.deserialize(bytearray(data))
        exported.mlir_module()  # parses the code, which `deserialize` leaves to the first call
    except Exception as error:  # of many kinds: it is a parser of binary data
        made, reason = metadata.get("versions", {}).get("jax"), (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"{path} was exported by jax {made} and jax {jax.__version__} cannot read it ({reason}); export it again"
        ) from error
    call = jax.jit(exported.call)
    return ExportedField(metadata, OnAnyShape(lambda query: call(query.tx_position, query.frequency_hz)))


def _read(path: Path) -> tuple[dict[str, Any], bytes]:
    """Returns the two members of the archive, of a format that is known."""
    try:
        with zipfile.ZipFile(path) as archive:
            metadata, data = json.loads(archive.read(METADATA)), archive.read(FIELD)
    except OSError as error:
        raise UserError(f"cannot read exported field {path}: {error.strerror or error}; check the path") from error
    except (ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is damaged or no exported field ({error}); copy it or export it again") from error
    found = metadata.get("format") if isinstance(metadata, dict) else None
    if found != FORMAT:
        raise UserError(f"{path} has export format {found}, this version reads {FORMAT}; export it again or update wbgs-jax")
    return metadata, data
