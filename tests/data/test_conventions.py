"""Published folders order the pixels of a spectrum in two ways: both are read, told apart, or refused."""

import dataclasses
import shutil
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from builders.commands import assert_error_for_people, call
from builders.synthetic import tiny_scene
from PIL import Image
from scipy.spatial.transform import Rotation

from wbgs_jax._util.errors import UserError
from wbgs_jax.commands import train as train_command
from wbgs_jax.data import load_dataset
from wbgs_jax.data.conventions import array_of, find_convention, to_pas
from wbgs_jax.data.image_folder import export_layout, load_layout
from wbgs_jax.radio.array import pas_directions
from wbgs_jax.training.run_folder import read_config
from wbgs_jax.types import make_receiver

RFID = Path(__file__).parents[3] / "shared" / "data" / "wrfgs_rfid_40"
POSITION = np.array([2.0, 1.0, 0.5])


def nerf2_directions():
    """Of NeRF2's pixels, written down anew: row i is elevation i, column j azimuth j (degrees)."""
    elevation, azimuth = np.meshgrid(np.radians(np.arange(90)), np.radians(np.arange(360)), indexing="ij")
    return np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)


def beams(directions, elements, towards):
    """Spectra (8 bits) of one plane wave each, by the sum over an array."""
    wave = np.exp(2j * np.pi * towards @ elements.T)
    image = np.abs(np.einsum("ijk,nk->nij", np.exp(-2j * np.pi * directions @ elements.T), wave))
    return np.round(255 * image / image.max((1, 2), keepdims=True)).astype(np.uint8)


def room(rng, n, convention):
    """Transmitters above the horizon of a turned receiver, and spectra of their lines of sight, ordered by a convention."""
    turn = Rotation.random(random_state=rng)
    local = rng.normal(size=(n, 3))
    local[:, 2] = np.abs(local[:, 2]) + 0.2
    local[:, 0] = np.abs(local[:, 0])  # in front of either array
    towards = local / np.linalg.norm(local, axis=1, keepdims=True)
    directions = nerf2_directions() if convention == "elevation" else pas_directions()
    images = beams(directions, array_of(convention), towards)
    x, y, z, w = turn.as_quat()
    return images, make_receiver(POSITION, (w, x, y, z)), POSITION + turn.apply(local), towards


def test_rows_of_elevations_are_moved_to_their_directions(rng):
    """The same waves by the same array on both grids: what differs is a degree."""
    images, _, _, towards = room(rng, 5, "elevation")
    moved, own = to_pas(images, "elevation"), beams(pas_directions(), array_of("elevation"), towards)
    assert np.abs(moved.astype(int) - own).max() < 20
    for image, direction in zip(moved, towards, strict=True):
        row, column = np.unravel_index((pas_directions() @ direction).argmax(), image.shape)
        assert image[row, column] >= 240  # of 255, a degree beside the maximum
    np.testing.assert_array_equal(np.sort(moved, axis=None), np.sort(images, axis=None))  # nothing is lost
    np.testing.assert_array_equal(to_pas(images, "zenith"), images)


@pytest.mark.parametrize("convention", ["zenith", "elevation"])
def test_the_zenith_reveals_the_convention(rng, convention):
    images, receiver, tx, _ = room(rng, 3, convention)
    found = find_convention(images, receiver, tx, np.arange(3))
    assert found.convention == convention and "shows a single direction" in found.reason


@pytest.mark.parametrize("convention", ["zenith", "elevation"])
def test_lines_of_sight_reveal_it_where_noise_hides_the_zenith(rng, convention):
    images, receiver, tx, _ = room(rng, 30, convention)
    noisy = np.clip(images * 0.6 + rng.normal(50, 40, images.shape), 0, 255).astype(np.uint8)
    found = find_convention(noisy, receiver, tx, np.arange(30))
    assert found.convention == convention and "towards the transmitter" in found.reason


def test_noise_and_nothing_reveal_none(rng):
    _, receiver, tx, _ = room(rng, 8, "elevation")
    noise = rng.integers(0, 256, (8, 90, 360)).astype(np.uint8)
    assert find_convention(noise, receiver, tx, np.arange(8)).convention is None
    assert find_convention(0 * noise, receiver, tx, np.arange(8)).convention is None
    below = 2 * POSITION - tx
    assert "horizon" in find_convention(noise, receiver, below, np.arange(8)).reason


def folder_of(images, receiver, tx, place):
    (place / "spectrum").mkdir(parents=True)
    for number, image in enumerate(images, 1):
        Image.fromarray(image).save(place / "spectrum" / f"{number:05d}.png")
    (place / "tx_pos.csv").write_text("x,y,z\n" + "".join(",".join(map(repr, row)) + "\n" for row in tx.tolist()))
    w, x, y, z = np.asarray(receiver.orientation, float).tolist()
    (place / "gateway_info.yml").write_text(f"gateway1:\n  position: {POSITION.tolist()}\n  orientation: {[x, y, z, w]}\n")
    return place


def test_a_folder_is_read_as_it_reveals_or_as_it_is_named(tmp_path, rng):
    images, receiver, tx, _ = room(rng, 8, "elevation")
    folder = folder_of(images, receiver, tx, tmp_path / "den")
    with pytest.warns(UserWarning, match="elevation is used, because the last row"):
        found = load_layout(folder)
    assert found.convention == "elevation"
    np.testing.assert_array_equal(found.observations["pas"], to_pas(images, "elevation"))
    assert np.ptp(np.asarray(found.receivers.element_positions[0, :, 2])) == 0  # the array lies flat
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (folder / "gateway_info.yml").write_text("convention: elevation\n" + (folder / "gateway_info.yml").read_text())
        found = [load_layout(folder, 1e9, convention=name) for name in (None, "elevation")]
        assert [one.convention for one in found] == ["elevation"] * 2
    (folder / "gateway_info.yml").write_text((folder / "gateway_info.yml").read_text().replace(": elevation", ": zenith"))
    with pytest.warns(UserWarning, match="the convention zenith is given, but the last row shows a single direction"):
        np.testing.assert_array_equal(load_layout(folder, 1e9).observations["pas"], images)
    (folder / "gateway_info.yml").write_text((folder / "gateway_info.yml").read_text().replace(": zenith", ": elevation"))
    with pytest.raises(UserError, match="specifies the convention elevation; leave out zenith"):
        load_layout(folder, convention="zenith")
    (folder / "gateway_info.yml").write_text((folder / "gateway_info.yml").read_text().replace(": elevation", ": north"))
    with pytest.raises(UserError, match="convention is 'north'; it must be zenith or elevation"):
        load_layout(folder)


@pytest.mark.parametrize("convention", ["zenith", "elevation"])
def test_a_quaternion_in_another_order_is_noted(tmp_path, rng, convention):
    """From ten transmitters on."""
    images, receiver, tx, _ = room(rng, 20, convention)
    for n, written, noted in ((20, 1, True), (20, 0, False), (11, 1, False)):
        turn = dataclasses.replace(receiver, orientation=jnp.roll(receiver.orientation, written))
        folder = folder_of(images[:n], turn, tx[:n], tmp_path / f"{n}-{written}")
        with warnings.catch_warnings(record=True) as notes:
            warnings.simplefilter("always")
            load_layout(folder, 1e9, convention=convention)
        assert ["clearly better if the orientation is w, x, y, z" in str(note.message) for note in notes] == [True] * noted


@pytest.mark.parametrize("convention", ["zenith", "elevation"])
def test_spectra_of_other_transmitters_are_noted(tmp_path, rng, convention):
    """Rows in another order, images whose strong directions are dark or mirrored; never right ones."""
    images, receiver, tx, _ = room(rng, 60, convention)
    cases = {
        "right": (images, tx),
        "shuffled": (images, tx[rng.permutation(60)]),
        "inverted": (255 - images, tx),
        "few": (images[:12], tx[:12][::-1]),
    }
    for name, (shown, places) in cases.items():
        folder = folder_of(shown, receiver, places, tmp_path / name)
        with warnings.catch_warnings(record=True) as notes:
            warnings.simplefilter("always")
            load_layout(folder, 1e9, convention=convention)
        noted = ["no brighter towards their own transmitters" in str(note.message) for note in notes]
        assert noted == [True] * (name in ("shuffled", "inverted")), name


def test_what_the_test_shows_does_not_decide(tmp_path, rng):
    """Spectra of the test part are never looked at."""
    images, receiver, tx, _ = room(rng, 10, "elevation")
    images[:5] = rng.integers(0, 256, (5, 90, 360))
    folder = folder_of(images, receiver, tx, tmp_path / "den")
    (folder / "train_index.txt").write_text("".join(f"{k}\n" for k in range(1, 6)))
    (folder / "test_index.txt").write_text("".join(f"{k}\n" for k in range(6, 11)))
    with pytest.raises(UserError, match="give --convention zenith or elevation"):
        load_layout(folder)


def test_what_is_written_names_its_convention(tmp_path):
    export_layout(tiny_scene(kind="pas"), tmp_path / "out")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_dataset(tmp_path / "out").convention == "zenith"


def test_the_command_takes_it_and_the_run_keeps_it(tmp_path, rng, monkeypatch):
    def enough(*_, **__):
        raise UserError("trained enough")

    monkeypatch.setattr(train_command, "train", enough)
    images, receiver, tx, _ = room(rng, 8, "elevation")
    folder = folder_of(rng.permutation(images.ravel()).reshape(images.shape), receiver, tx, tmp_path / "den")
    short = ["--field", "wideband", "--preset", "smoke", "--out", tmp_path / "run"]
    refused = call(train_command.main, "--data", folder, *short)
    assert_error_for_people(refused, "does not record the order of its pixels", "--convention zenith or elevation")
    assert not (tmp_path / "run").exists()
    nowhere = call(train_command.main, "--scene", "1", "--convention", "elevation", *short)
    assert_error_for_people(nowhere, "--convention is for folders of spectra")
    folder_of(images, receiver, tx, tmp_path / "plain")
    for given, data in (["--convention", "elevation"], folder), ([], tmp_path / "plain"):
        assert "trained enough" in call(train_command.main, "--data", data, *given, *short).err
        assert read_config(tmp_path / "run").convention == "elevation"
        assert read_config(tmp_path / "run").dataset().convention == "elevation"
        shutil.rmtree(tmp_path / "run")


@pytest.mark.skipif(not RFID.exists(), reason="the published sample is not beside the repository")
def test_the_published_rfid_sample_has_rows_of_elevations():
    with pytest.warns(UserWarning, match="elevation is used"):
        assert load_dataset(RFID).convention == "elevation"
