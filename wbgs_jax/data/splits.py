"""Which spectra train and which test. A split never cuts through a transmitter: its other frequencies would give it away."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.errors import UserError


def group_transmitters(positions: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Transmitter number (0, 1, ... by first appearance) of every spectrum; positions (metres) agree to a micrometre."""
    _, first, group = np.unique(np.round(positions, 6), axis=0, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[group.reshape(-1)]


def tx_disjoint_split(
    tx_index: Int[np.ndarray, "n"], test_fraction: float = 0.2, seed: int = 0
) -> tuple[Int[np.ndarray, "n_train"], Int[np.ndarray, "n_test"]]:
    """Ascending indices of training and test spectra with `test_fraction` of the transmitters, drawn by `seed`, in the test.

    Raises:
        UserError: the fraction is not between 0 and 1, or there are fewer than two transmitters.
    """
    if not 0 < test_fraction < 1:
        raise UserError(f"the test fraction is {test_fraction}; choose a number between 0 and 1, 0.2 for example")
    transmitters = np.unique(tx_index)
    if len(transmitters) < 2:
        raise UserError("a split needs spectra of at least two TX positions; give train_index.txt and test_index.txt instead")
    n_test = int(np.clip(round(test_fraction * len(transmitters)), 1, len(transmitters) - 1))
    test_transmitters = np.random.default_rng(seed).permutation(transmitters)[:n_test]
    in_test = np.isin(tx_index, test_transmitters)
    return np.flatnonzero(~in_test), np.flatnonzero(in_test)


def select_frequencies(
    dataset: Dataset, train_ghz: Sequence[float] | None = None, test_ghz: Sequence[float] | None = None
) -> Dataset:
    """The same spectra with training and test restricted to some frequencies (GHz); None keeps all of them.

    Raises:
        UserError: a frequency does not occur in the data set, or a selection leaves no spectrum.
    """
    train = _keep(dataset, dataset.train, train_ghz, "training")
    test = _keep(dataset, dataset.test, test_ghz, "test")
    return dataclasses.replace(dataset, train=train, test=test)


def unseen_frequencies(dataset: Dataset, train_ghz: Sequence[float]) -> Dataset:
    """Training at some frequencies (GHz) alone, tests at all others and at held-out transmitters; the name says so."""
    known = np.unique(dataset.frequencies_hz) / 1e9
    others = [float(f) for f in known if not np.isclose(f, train_ghz, rtol=1e-6, atol=0).any()]
    name = f"{dataset.name}_f" + "-".join(f"{f:g}" for f in train_ghz)
    return dataclasses.replace(select_frequencies(dataset, train_ghz, others), name=name)


def fewer_transmitters(dataset: Dataset, count: int, seed: int) -> Dataset:
    """Training with `count` of the training transmitters; larger counts contain the smaller ones. The name says so.

    Raises:
        UserError: there are not so many.
    """
    known = np.unique(dataset.tx_index[dataset.train])
    if not 0 < count <= len(known):
        raise UserError(f"{dataset.name} has {len(known)} training transmitters; choose 1 to {len(known)} of them, not {count}")
    chosen = np.random.default_rng([seed, 4]).permutation(known)[:count]
    train = dataset.train[np.isin(dataset.tx_index[dataset.train], chosen)]
    return dataclasses.replace(dataset, train=train, name=f"{dataset.name}_tx{count}")


def _keep(dataset: Dataset, index: np.ndarray, wanted_ghz: Sequence[float] | None, role: str) -> np.ndarray:
    if wanted_ghz is None:
        return index
    known_ghz = np.unique(dataset.frequencies_hz) / 1e9
    for frequency in wanted_ghz:
        if not np.isclose(known_ghz, frequency, rtol=1e-6, atol=0).any():
            have = ", ".join(f"{f:g}" for f in known_ghz)
            raise UserError(f"{dataset.name} has no spectra at {frequency:g} GHz; choose {role} frequencies among {have} GHz")
    ghz = dataset.frequencies_hz[index] / 1e9
    kept = index[np.isclose(ghz[:, None], np.asarray(wanted_ghz, np.float64).reshape(1, -1), rtol=1e-6, atol=0).any(1)]
    if len(kept) == 0:
        raise UserError(f"the chosen {role} frequencies leave no {role} spectrum of {dataset.name}; choose others")
    return kept
