"""The moving picture: a walk along held-out transmitters, its frequencies in turn, as a file that moves."""

import sys

import numpy as np
import pytest
from builders.commands import call
from builders.untrained import make_coherent_run
from PIL import Image

from experiments.studies import moving_picture
from wbgs_jax.training.run_folder import load_trained


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_coherent_run(tmp_path_factory.mktemp("walk") / "box")


def test_a_walk_shows_held_out_transmitters_and_all_frequencies(run):
    dataset = load_trained(run).dataset()
    links = moving_picture.links_of_walk(dataset, 4, 2)
    assert set(links) <= set(dataset.test)
    changes = np.diff(dataset.tx_index[links])
    assert np.count_nonzero(changes) == len(set(dataset.tx_index[links])) - 1  # every stop once
    assert set(dataset.frequencies_hz[links]) == set(dataset.frequencies_hz[dataset.test])


@pytest.mark.heavy
def test_it_is_a_picture_that_moves(run, tmp_path, monkeypatch):
    out = tmp_path / "walk.gif"
    monkeypatch.setattr(sys, "argv", ["moving_picture", "--run", str(run), "--out", str(out), "--transmitters", "2"])
    moving_picture.main()
    with Image.open(out) as picture:
        assert picture.n_frames > 2 and picture.size[0] > 400


def test_another_kind_of_file_is_refused(run, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["moving_picture", "--run", str(run), "--out", "walk.png"])
    done = call(lambda *_: moving_picture.main())
    assert done.code == 2 and "does not end in .gif" in done.err
