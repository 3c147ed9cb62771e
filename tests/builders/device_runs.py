"""Tiny trainings in a process of their own, with as many devices as XLA_FLAGS say: `python device_runs.py FOLDER FIELD ...`.

Every field is trained in a folder of its name, whose curves the caller reads, and asked afterwards: by all devices and by one.
Where the environment names a coordinator, this is one of several processes.
"""

import os
import sys
from pathlib import Path

import jax
import numpy as np

from builders.synthetic import tiny_dataset, tiny_settings
from builders.toys import GROWING, as_trained
from wbgs_jax._util.devices import COORDINATOR, Devices, connect
from wbgs_jax.config import Settings, changed
from wbgs_jax.data.dataset import Dataset, hold_out_validation
from wbgs_jax.inference import predictor
from wbgs_jax.training.loop import TrainResult, train

FOUR = {"optim": {"batch": 4}, "loop": {"epoch_steps": 4, "checkpoint_every": 4}}
ASKED = 35
"""Queries, so that neither blocks nor devices divide them evenly."""


def settings_of(name: str) -> Settings:
    """Settings under which four devices can share a batch; the wideband field's Gaussians are split half way."""
    return changed(GROWING if name == "wideband" else tiny_settings(name), FOUR)


def data() -> Dataset:
    """What is trained on."""
    return hold_out_validation(tiny_dataset(12), 0.25)


def answers(result: TrainResult, dataset: Dataset) -> list[np.ndarray]:
    """The spectra of links and of queries, by all three ways to ask for many."""
    trained = as_trained(result.field, result.params)
    query, receiver = dataset.query(np.arange(ASKED)), dataset.receiver()
    links = predictor.observe_links(result.field, result.params, dataset, np.arange(ASKED)).pas
    queries = predictor.observe_queries(trained, receiver, query, "pas")
    ask = predictor.make_predictor(trained, receiver)
    return [links, queries, predictor.predict_many(ask, query.tx_position, query.frequency_hz)]


def asked_by_all_and_by_one(result: TrainResult, dataset: Dataset) -> float:
    """The largest difference between the answers of all devices and of one."""
    together = answers(result, dataset)
    predictor.own_devices = predictor.own_devices = Devices  # type: ignore[assignment]
    alone = answers(result, dataset)
    return max(float(np.abs(a - b).max()) for a, b in zip(together, alone, strict=True))


def main(folder: Path, *names: str) -> None:
    """Trains each of the fields."""
    if COORDINATOR in os.environ:
        connect()
    dataset = data()
    for name in names:
        result = train(dataset, name, settings_of(name), 0, folder / name)
    divided = predictor._devices(ASKED).count
    print(jax.device_count(), divided, asked_by_all_and_by_one(result, dataset) if divided > 1 else 0.0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
