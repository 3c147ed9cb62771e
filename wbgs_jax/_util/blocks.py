"""Many rows through a function that was compiled for a few."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def map_blocks(function: Callable[[Any], Any], rows: Any, size: int) -> Any:
    """Returns `function(rows)`, computed for at most `size` rows at a time: one compilation, and little memory.

    Args:
        function: of a tree like `rows`, to a tree of arrays with the same leading axis.
        rows: a tree of arrays with one leading axis, which is not empty.
        size: rows of a block. The last block repeats its last row until it is full.

    Returns:
        A tree of NumPy arrays.
    """
    count, parts = len(jax.tree.leaves(rows)[0]), []
    size = min(size, count)
    for start in range(0, count, size):
        index = np.minimum(np.arange(start, start + size), count - 1)
        block = jax.tree.map(lambda leaf, index=index: leaf[index], rows)
        parts.append(jax.tree.map(np.asarray, function(block)))
    return jax.tree.map(lambda *blocks: np.concatenate(blocks)[:count], *parts)
