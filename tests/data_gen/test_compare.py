"""Two truths in one table. No simulator."""

import dataclasses

import numpy as np
import pytest
from builders.synthetic import tiny_scene

from data_gen.compare import HEADING, compare
from wbgs_jax._util.errors import UserError


def cells(table):
    heading, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines())
    assert tuple(heading) == HEADING
    return rows


@pytest.mark.parametrize("unit", ["wavelengths", "metres"])
def test_a_louder_truth_is_the_same_truth(unit):
    scene = tiny_scene(unit=unit)
    louder = dataclasses.replace(scene, snapshots=(1e-9j * scene.snapshots).astype(np.complex64))
    rows = cells(compare(scene, louder))
    assert [row[0] for row in rows] == ["1", "10", "94"]
    for row in rows:
        assert row[1:] == [str(len(scene.tx_positions)), "1.000", "1.000", "1.000", "1.000", "-180.00"]


def test_what_both_have_is_compared_in_whatever_order():
    scene = tiny_scene()
    kept = np.array([4, 1, 3])
    part = dataclasses.replace(
        scene, snapshots=scene.snapshots[kept][:, :, [2, 0]], tx_positions=scene.tx_positions[kept], split=scene.split[kept],
        frequencies_hz=scene.frequencies_hz[[2, 0]],
    )  # fmt: skip
    rows = cells(compare(scene, part))
    assert [row[:3] for row in rows] == [["1", "3", "1.000"], ["94", "3", "1.000"]]


def test_another_truth_is_another(rng):
    scene = tiny_scene()
    noise = rng.normal(size=(2, *scene.snapshots.shape)) * np.abs(scene.snapshots).mean()
    other = dataclasses.replace(scene, snapshots=(scene.snapshots + noise[0] + 1j * noise[1]).astype(np.complex64))
    assert all(float(row[3]) <= float(row[2]) < 1 and float(row[4]) < 1 for row in cells(compare(scene, other)))


def test_scenes_without_anything_in_common_are_told():
    scene = tiny_scene()
    moved = dataclasses.replace(scene, tx_positions=scene.tx_positions + 0.1)
    with pytest.raises(UserError, match="in common"):
        compare(scene, moved)
    with pytest.raises(UserError, match="different arrays"):
        compare(scene, dataclasses.replace(scene, element_positions=2 * scene.element_positions))
