"""Evaluation of a compiled function for many rows, in blocks of one shape."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def map_blocks(function: Callable[[Any], Any], rows: Any, size: int, full: bool = False) -> Any:
    """Returns `function(rows)`, computed for at most `size` rows at a time, which needs one compilation and little memory.

    Args:
        function: maps a tree like `rows` to a tree of arrays with the same leading axis.
        rows: a tree of arrays with a common leading axis, which must not be empty.
        size: number of rows of a block. The last block is filled up with copies of its last row.
        full: a single block is filled up as well, so that calls with fewer rows share the compilation.

    Returns:
        A tree of NumPy arrays.
    """
    count, parts = len(jax.tree.leaves(rows)[0]), []
    size = size if full else min(size, count)
    for start in range(0, count, size):
        index = np.minimum(np.arange(start, start + size), count - 1)
        block = jax.tree.map(lambda leaf, index=index: leaf[index], rows)
        parts.append(jax.tree.map(np.asarray, function(block)))
    return jax.tree.map(lambda *blocks: np.concatenate(blocks)[:count], *parts)
