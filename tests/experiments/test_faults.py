"""Every fault changes what it says, by as much as it says, and nothing else."""

import dataclasses

import numpy as np
import pytest
from builders.rooms import box, mesh_of, room
from builders.synthetic import tiny_scene

from experiments.faults import Fault, faulty, parts_of
from experiments.variants import FAULTS
from wbgs_jax._util.errors import UserError
from wbgs_jax.data import scene_dataset

PARTS = [*room(), *(box((x, 1, 0.5), (x + 0.5, 1.5, 1.2)) for x in (0.5, 1.5, 2.5, 3.5, 4.5))]


@pytest.fixture(scope="module")
def dataset():
    mesh = mesh_of(*PARTS)
    known = {"name": "", "material": "", "thickness": 0.1}
    parts = [known | {"name": f"{i}", "material": f"{i % 3}"} for i in range(len(PARTS))]
    scene = dataclasses.replace(
        tiny_scene(30),
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        face_part=np.asarray(mesh.part),
        meta={"parts": parts},
    )
    return scene_dataset(scene)


def test_no_fault_changes_nothing(dataset):
    same = faulty(dataset, Fault(), 0)
    np.testing.assert_array_equal(same.faces, dataset.faces)
    np.testing.assert_allclose(same.vertices, dataset.vertices, atol=1e-6)
    np.testing.assert_array_equal(same.snapshots, dataset.snapshots)
    np.testing.assert_allclose(same.receivers.orientation, dataset.receivers.orientation, atol=1e-6)


def test_parts_move_as_a_whole(dataset, rng):
    seed = int(rng.integers(2**31))
    moved = faulty(dataset, Fault(displaced_m=0.05), seed)
    part, step = parts_of(dataset), moved.vertices - dataset.vertices
    parts = np.unique(part[dataset.faces])
    assert len(parts) == len(PARTS)
    for k in parts:
        np.testing.assert_allclose(step[part == k], step[part == k][:1].repeat((part == k).sum(), 0), atol=1e-5)
    assert 0.02 < step.std() < 0.1
    turned = faulty(dataset, Fault(tilted_deg=1.0), seed).vertices
    for k in parts:  # bodies keep their shape
        own, before = (np.linalg.norm(v[part == k] - v[part == k][0], axis=-1) for v in (turned, dataset.vertices))
        np.testing.assert_allclose(own, before, atol=1e-4)
    assert np.abs(turned - dataset.vertices).max() > 1e-3


def test_furniture_goes_or_comes_twice_and_walls_stay(dataset):
    faces_of_a_box = 12
    less, more = (faulty(dataset, fault, 3) for fault in (Fault(missing=0.4), Fault(added=0.4)))
    assert len(dataset.faces) - len(less.faces) == 2 * faces_of_a_box == len(more.faces) - len(dataset.faces)
    for changed in (less, more):
        assert len(changed.materials.material) == len(changed.face_part) == len(changed.faces)
        assert changed.faces.max() < len(changed.vertices)
    centre = dataset.vertices.mean(0)
    assert np.abs(more.vertices - centre).max() < 2 * np.abs(dataset.vertices - centre).max()


def test_noise_is_as_loud_as_it_says_and_spares_the_test(dataset):
    noisy = faulty(dataset, Fault(snr_db=10.0), 0).snapshots
    noise = noisy - dataset.snapshots
    assert not noise[dataset.test].any()
    power = [np.mean(np.abs(v[dataset.train]) ** 2, -1) for v in (noise, dataset.snapshots)]
    assert np.mean(power[0] / power[1]) == pytest.approx(0.1, rel=0.2)


def test_a_receiver_stands_and_looks_elsewhere(dataset):
    off = faulty(dataset, Fault(receiver_m=0.02, receiver_deg=1.0, pattern_unknown=True), 0).receivers
    assert np.linalg.norm(off.position - dataset.receivers.position) == pytest.approx(0.02, rel=1e-3)
    half = np.abs(np.sum(np.asarray(off.orientation) * np.asarray(dataset.receivers.orientation)))
    assert 2 * np.rad2deg(np.arccos(np.clip(half, -1, 1))) == pytest.approx(1.0, rel=0.05)
    assert not np.any(off.pattern_exponents)


def test_transmitters_materials_and_pictures(dataset):
    few = faulty(dataset, Fault(tx=5), 0)
    assert len(np.unique(few.tx_index[few.train])) == 5
    np.testing.assert_array_equal(few.test, dataset.test)
    assert faulty(dataset, Fault(one_material=True), 0).materials.names == ("all",)
    assert not faulty(dataset, Fault(thickness_unknown=True), 0).materials.thickness.any()
    assert (faulty(dataset, Fault(wrong_materials=0.9), 0).materials.material != dataset.materials.material).any()
    pictures = faulty(dataset, Fault(images_only=True), 0)
    assert pictures.snapshots is None
    np.testing.assert_allclose(pictures.pas(dataset.test), dataset.pas(dataset.test), atol=0.5 / 255 + 1e-6)


def test_equal_seeds_draw_equal_faults(dataset):
    every = dataclasses.replace(FAULTS["all_together"].fault, added=0.2, tilted_deg=0.5)
    first, second, other = (faulty(dataset, every, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.snapshots, second.snapshots)
    assert (first.vertices.shape != other.vertices.shape) or (first.vertices != other.vertices).any()


@pytest.mark.parametrize(
    ("fault", "lacking"),
    [
        (Fault(displaced_m=0.01), "mesh"),
        (Fault(missing=0.1), "mesh"),
        (Fault(one_material=True), "materials"),
        (Fault(snr_db=10.0), "snapshots"),
    ],
)
def test_what_data_do_not_have_cannot_be_wrong(fault, lacking):
    scene = scene_dataset(tiny_scene(6))
    nothing = {"vertices": scene.vertices[:0], "faces": scene.faces[:0], "face_part": None, "materials": None}
    powers = {"observations": {"power_db": np.zeros(len(scene), np.float32)}}
    without = dataclasses.replace(scene, **(powers if lacking == "snapshots" else nothing))
    with pytest.raises(UserError, match=f"no {lacking}"):
        faulty(without, fault, 0)
    if lacking != "snapshots":  # and what they have can
        assert not np.array_equal(faulty(without, Fault(snr_db=10.0), 0).snapshots, without.snapshots)
