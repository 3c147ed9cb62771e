"""Answers block by block: in memory and in files they read alike, and go on where they were interrupted."""

import numpy as np
import pytest

from wbgs_jax._util.errors import UserError
from wbgs_jax.inference.results_file import Answers, open_parts, write_archive

QUESTION = {"what": "power", "numbers": [1, 2]}


@pytest.fixture(params=["memory", "files"])
def answers(request, tmp_path):
    kept = Answers() if request.param == "memory" else open_parts(tmp_path / "a.npz", QUESTION, False)
    for start in (0, 4, 8):
        count = min(4, 10 - start)
        kept.add(
            {
                "power": np.arange(start, start + count) / 2,
                "word": np.array(["ab" * (start + 1)] * count),
                "delays_s": np.ones(3),
            }
        )
    return kept


def test_an_archive_of_blocks(answers, tmp_path):
    path = tmp_path / "a.npz"
    write_archive(path, answers, (5, 2), {"known": np.eye(2)}, {"scene": "box"})
    answers.remove()
    with np.load(path) as archive:
        np.testing.assert_array_equal(archive["power"], (np.arange(10) / 2).reshape(5, 2))
        assert archive["word"][4, 1] == "ab" * 9
        np.testing.assert_array_equal(archive["delays_s"], np.ones(3))
        np.testing.assert_array_equal(archive["known"], np.eye(2))
        assert str(archive["meta"]) == '{"scene": "box"}'
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.npz"]


def test_rows_of_blocks(answers):
    np.testing.assert_array_equal(answers.rows("power", np.array([0, 5, 9])), [0, 2.5, 4.5])
    np.testing.assert_array_equal(answers.whole("power", 3), [0, 0.5, 1])
    assert answers.names() == ["power", "word"]


def test_blocks_that_are_there_are_used_only_when_that_is_said(tmp_path):
    target = tmp_path / "a.npz"
    open_parts(target, QUESTION, False).add({"power": np.ones(2)})
    with pytest.raises(UserError, match="add --resume"):
        open_parts(target, QUESTION, False)
    with pytest.raises(UserError, match=r"another command \(numbers changed\)"):
        open_parts(target, QUESTION | {"numbers": [1, 3]}, True)
    assert len(open_parts(target, QUESTION, True)) == 1


def test_a_damaged_block_is_named(tmp_path):
    parts = open_parts(tmp_path / "a.npz", QUESTION, False)
    parts.add({"power": np.ones(2)})
    (block,) = parts.folder.glob("*.npz")
    block.write_bytes(block.read_bytes()[:-30])
    with pytest.raises(UserError, match=r"000000.npz is damaged .*--resume"):
        parts.names()
