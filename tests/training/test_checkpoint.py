"""Checkpoints: what comes out is what went in, and damage is noticed."""

import os
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.training import checkpoint
from wbgs_jax._util.errors import UserError
from wbgs_jax.types import Query

METADATA = {"sizes": {"gaussians": 64}, "tile_capacity": {"entries": 4096, "jobs": 1024}, "seconds": 0.1}


@pytest.fixture
def state(rng):
    return {
        "params": Query(jnp.asarray(rng.normal(size=(5, 3)), jnp.float32), jnp.asarray(rng.normal(size=5), jnp.float32)),
        "optimizer": (jnp.asarray(rng.integers(0, 9, 4), jnp.int32), {"empty": ()}),
        "step": jnp.asarray(7, jnp.int32),
    }


def shapes(state):
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), state)


def test_round_trip(tmp_path, state):
    checkpoint.save(tmp_path / "a", 7, state, METADATA, keep=2)
    again = checkpoint.load(tmp_path / "a", 7, shapes(state))
    assert jax.tree.structure(again) == jax.tree.structure(state)
    for x, y in zip(jax.tree.leaves(again), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(x, y)
        assert x.dtype == y.dtype
    assert checkpoint.load_metadata(tmp_path / "a", 7) == METADATA


def test_a_part_of_the_state_can_be_read_alone(tmp_path, state):
    checkpoint.save(tmp_path, 7, state, METADATA, keep=2)
    params = checkpoint.load(tmp_path, 7, shapes(state["params"]), prefix="['params']")
    np.testing.assert_array_equal(params.tx_position, state["params"].tx_position)


def test_the_oldest_go_and_equal_steps_are_replaced(tmp_path, state):
    for step in (5, 10, 100, 100):
        checkpoint.save(tmp_path, step, state | {"step": jnp.asarray(step, jnp.int32)}, METADATA, keep=2)
    assert checkpoint.checkpoint_steps(tmp_path) == [10, 100]
    assert int(checkpoint.load(tmp_path, 100, shapes(state))["step"]) == 100


def test_steps_are_numbers_and_nothing_else(tmp_path):
    assert checkpoint.checkpoint_steps(tmp_path / "none") == []
    for name in ("3", "20", "notes", "7.orbax-checkpoint-tmp"):
        (tmp_path / name).mkdir()
    assert checkpoint.checkpoint_steps(tmp_path) == [3, 20]


@pytest.mark.parametrize("change", ["shape", "more", "fewer Gaussians"])
def test_another_structure_does_not_fit(tmp_path, state, change):
    checkpoint.save(tmp_path, 7, state, METADATA, keep=2)
    like = shapes(state)
    if change == "shape":
        like["step"] = jax.ShapeDtypeStruct((1,), jnp.int32)
    elif change == "more":
        like["density"] = like["step"]
    else:
        like["params"] = jax.eval_shape(lambda: Query(jnp.zeros((4, 3)), jnp.zeros(4)))
    with pytest.raises(UserError, match="does not fit this configuration"):
        checkpoint.load(tmp_path, 7, like)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # reads that Orbax gave up
@pytest.mark.parametrize("damage", ["gone", "empty", "cut", "garbage"])
def test_damage_is_an_error_for_people_or_harmless(tmp_path, state, damage):
    """Every file of a checkpoint in turn: both reads give what was written, or one line that names the folder."""
    checkpoint.save(tmp_path / "good", 7, state, METADATA, keep=2)
    files = [path.relative_to(tmp_path / "good") for path in sorted((tmp_path / "good").rglob("*")) if path.is_file()]
    noticed = 0
    for i, name in enumerate(files):
        folder = tmp_path / str(i)
        shutil.copytree(tmp_path / "good", folder)
        content = (folder / name).read_bytes()
        if damage == "gone":
            (folder / name).unlink()
        else:
            (folder / name).write_bytes({"empty": b"", "cut": content[: len(content) // 2], "garbage": os.urandom(99)}[damage])
        try:
            assert checkpoint.load_metadata(folder, 7) == METADATA
            again = checkpoint.load(folder, 7, shapes(state))
        except UserError as error:
            noticed += 1
            assert "\n" not in str(error) and str(folder / "7") in str(error)
        else:
            assert all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(again), jax.tree.leaves(state), strict=True))
    assert noticed >= 3


def test_a_missing_or_empty_folder(tmp_path, state):
    (tmp_path / "3").mkdir()
    for step in (3, 4):
        with pytest.raises(UserError, match="damaged or incomplete"):
            checkpoint.load_metadata(tmp_path, step)
        with pytest.raises(UserError, match="damaged or incomplete"):
            checkpoint.load(tmp_path, step, shapes(state))


def test_a_place_that_cannot_be_written(tmp_path, state):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match="cannot write checkpoint"):
        checkpoint.save(tmp_path / "file" / "checkpoints", 7, state, METADATA, keep=2)
    assert (tmp_path / "file").read_text() == "mine"
