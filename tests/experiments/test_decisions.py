"""What decisions by evidence rest on, and what is simulated of them."""

import numpy as np
from builders.synthetic import tiny_dataset

from experiments.studies import decisions_account as account
from experiments.studies.decisions_account import decisions, simulate, stored_gains, transmitters
from wbgs_jax.data.dataset import hold_out_validation


def test_every_decision_names_what_stands_without_evidence_and_counts_transmitters():
    listed, dataset = decisions(), hold_out_validation(tiny_dataset(20))
    assert len({decision.name for decision in listed}) == len(listed) and all(decision.harmless for decision in listed)
    for decision in listed:
        part = np.unique(dataset.tx_index[getattr(dataset, decision.part)])
        assert 1 <= transmitters(dataset, decision) <= min(len(part), decision.spectra)


def test_pairs_are_of_the_same_links(rng):
    pairs = stored_gains(rng)
    assert len(pairs) == account.PAIRS
    assert all(pair.shape[0] == 2 and pair.shape[1] >= account.FEWEST and np.isfinite(pair).all() for pair in pairs)


def test_a_side_that_is_far_worse_is_not_taken(rng, monkeypatch):
    monkeypatch.setattr(account, "stored_gains", lambda _: [np.stack([np.full(120, 0.9), rng.normal(0.5, 0.05, 120)])])
    monkeypatch.setattr(account, "COUNTS", (3, 10))
    monkeypatch.setattr(account, "DRAWS", 6)
    found = simulate(rng)
    assert all(rate == 0 for rates in found.values() for rate in rates.values())
