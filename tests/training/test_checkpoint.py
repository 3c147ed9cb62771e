"""Checkpoints: what comes out is what went in, and damage is noticed."""

import os
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import with_leaves
from wbgs_jax.training import checkpoint
from wbgs_jax.types import Query

METADATA = {"limits": {"entries": 4096, "jobs": 1024}, "seconds": 0.1}
FIELD = {"frame": Query(jnp.ones((2, 3)), jnp.zeros(2)), "nothing": jnp.zeros((0, 2))}
"""Of a field: arrays that are never trained, one of them empty."""


@pytest.fixture
def state(rng):
    return {
        "params": Query(jnp.asarray(rng.normal(size=(5, 3)), jnp.float32), jnp.asarray(rng.normal(size=5), jnp.float32)),
        "optimizer": (jnp.asarray(rng.integers(0, 9, 4), jnp.int32), {"empty": ()}),
        "step": jnp.asarray(7, jnp.int32),
    }


def save(folder, state, step=7, keep=2):
    checkpoint.save(folder, step, state, FIELD, METADATA, keep)


def shapes(state):
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), state)


def test_round_trip(tmp_path, state):
    save(tmp_path / "a", state)
    saved = checkpoint.read(tmp_path / "a", 7)
    again = checkpoint.fill_like(saved, shapes(state))
    assert jax.tree.structure(again) == jax.tree.structure(state)
    for x, y in zip(jax.tree.leaves(again), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(x, y)
        assert x.dtype == y.dtype
    assert saved.metadata == METADATA
    assert saved.path == tmp_path / "a" / "7"


def test_the_field_comes_along_and_is_no_part_of_the_state(tmp_path, state):
    """Also arrays without elements, which Orbax would refuse."""
    save(tmp_path, state)
    saved = checkpoint.read(tmp_path, 7)
    expected = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(FIELD)}
    assert saved.field.keys() == expected.keys() and not saved.field.keys() & saved.state.keys()
    for key, leaf in expected.items():
        np.testing.assert_array_equal(saved.field[key], leaf)
        assert (saved.field[key].shape, saved.field[key].dtype) == (leaf.shape, leaf.dtype)


def test_a_part_of_the_state_can_be_read_alone(tmp_path, state):
    save(tmp_path, state)
    params = checkpoint.fill_like(checkpoint.read(tmp_path, 7), shapes(state["params"]), prefix="['params']")
    np.testing.assert_array_equal(params.tx_position, state["params"].tx_position)


def init(rows):
    """A function as `Field.init`: what it returns matters by its structure alone."""
    return lambda key: Query(jax.random.normal(key, (rows, 3)), jnp.zeros(rows))


@pytest.mark.parametrize("rows", [2, 5, 9])
def test_parameters_have_as_many_rows_as_were_saved(tmp_path, state, rows):
    """Density control changes their number; `init` knows the first one only."""
    save(tmp_path, state)
    params = checkpoint.fill(checkpoint.read(tmp_path, 7), init(rows), jax.random.key(0), prefix="['params']")
    assert jax.tree.structure(params) == jax.tree.structure(state["params"])
    np.testing.assert_array_equal(params.tx_position, state["params"].tx_position)
    np.testing.assert_array_equal(params.frequency_hz, state["params"].frequency_hz)


@pytest.mark.parametrize(
    "other",
    [
        lambda key: with_leaves(init(5)(key), jnp.zeros((5, 2)), jnp.zeros(5)),
        lambda key: init(5)(key).tx_position,
        lambda key: {"more": init(5)(key)},
    ],
)
def test_parameters_of_another_structure_do_not_fit(tmp_path, state, other):
    save(tmp_path, state)
    with pytest.raises(UserError, match="does not fit this configuration"):
        checkpoint.fill(checkpoint.read(tmp_path, 7), other, jax.random.key(0), prefix="['params']")


def test_the_oldest_go_and_equal_steps_are_replaced(tmp_path, state):
    for step in (5, 10, 100, 100):
        save(tmp_path, state | {"step": jnp.asarray(step, jnp.int32)}, step)
    assert checkpoint.checkpoint_steps(tmp_path) == [10, 100]
    assert int(checkpoint.fill_like(checkpoint.read(tmp_path, 100), shapes(state))["step"]) == 100


def test_steps_are_numbers_and_nothing_else(tmp_path):
    assert checkpoint.checkpoint_steps(tmp_path / "none") == []
    for name in ("3", "20", "notes", "7.orbax-checkpoint-tmp"):
        (tmp_path / name).mkdir()
    assert checkpoint.checkpoint_steps(tmp_path) == [3, 20]


@pytest.mark.parametrize("change", ["shape", "more", "fewer Gaussians"])
def test_another_structure_does_not_fit(tmp_path, state, change):
    save(tmp_path, state)
    like = shapes(state)
    if change == "shape":
        like["step"] = jax.ShapeDtypeStruct((1,), jnp.int32)
    elif change == "more":
        like["density"] = like["step"]
    else:
        like["params"] = jax.eval_shape(lambda: Query(jnp.zeros((4, 3)), jnp.zeros(4)))
    with pytest.raises(UserError, match="does not fit this configuration"):
        checkpoint.fill_like(checkpoint.read(tmp_path, 7), like)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # reads that Orbax gave up
@pytest.mark.parametrize("damage", ["gone", "empty", "cut", "garbage"])
def test_damage_is_an_error_for_people_or_harmless(tmp_path, state, damage):
    """Every file of a checkpoint in turn: a read gives what was written, or one line that names the folder."""
    save(tmp_path / "good", state)
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
            saved = checkpoint.read(folder, 7)
            again = checkpoint.fill_like(saved, shapes(state))
            assert saved.metadata == METADATA
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
            checkpoint.read(tmp_path, step)


def test_a_place_that_cannot_be_written(tmp_path, state):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match="cannot write checkpoint"):
        save(tmp_path / "file" / "checkpoints", state)
    assert (tmp_path / "file").read_text() == "mine"


def test_what_a_killed_process_had_begun_to_remove_is_removed_and_a_number_is_a_whole_checkpoint(tmp_path, state, monkeypatch):
    for step in (1, 2, 3):
        checkpoint.save(tmp_path, step, state, {}, METADATA, 3)

    def killed(path, **options):
        if any(path.iterdir() if path.is_dir() else ()):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shutil, "rmtree", killed)
        checkpoint.tidy(tmp_path, 2)
    assert checkpoint.checkpoint_steps(tmp_path) == [2, 3] and (tmp_path / "1.removed").exists()
    checkpoint.tidy(tmp_path, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["3"]
    checkpoint.tidy(tmp_path / "none", 2)


def test_files_of_a_large_checkpoint_are_small_enough_to_be_sent(tmp_path, rng):
    """No more than 16 MB each, whatever the checkpoint holds."""
    large = {f"part{i}": rng.normal(size=(500_000, 3)).astype(np.float32) for i in range(5)}
    checkpoint.save(tmp_path, 1, large, {}, METADATA, 1)
    sizes = [path.stat().st_size for path in (tmp_path / "1").rglob("*") if path.is_file()]
    assert sum(sizes) > 20e6 and max(sizes) < 16e6
    found = checkpoint.read(tmp_path, 1).state
    assert all(np.array_equal(found[f"['{name}']"], values) for name, values in large.items())
