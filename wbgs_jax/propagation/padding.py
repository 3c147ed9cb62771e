"""Edges and chains filled up to sizes that seldom change: surfaces that are moved a little have a few more or fewer of them,
and everything that is compiled for one number would be compiled anew for the next.

What is added is never a path: edges of no length, and mirror images that lie in the plane of their mirror (`image_method.py`).
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Shaped

from wbgs_jax.propagation.edges import Edges
from wbgs_jax.propagation.facets import AnyArray

PARTS = 8
"""Sizes between a power of two and the next one: at most an eighth of what is searched is padding."""


def padded_size(count: int) -> int:
    """Returns the next size that seldom changes; 0 for nothing."""
    step = max(2 ** (count.bit_length() - 1) // PARTS, 1)
    return -(-count // step) * step


def padded_edges(edges: Edges) -> Edges:
    """Returns edges, and behind them copies of the first one without length, which diffract nothing (host)."""
    count = len(edges.length)
    more: Edges = jax.tree.map(filled, edges)
    return dataclasses.replace(more, length=np.where(np.arange(len(more.length)) < count, more.length, 0))


def filled(rows: Shaped[AnyArray, "n ..."]) -> Shaped[np.ndarray, "k ..."]:
    """Returns rows, and behind them the first one again."""
    missing = padded_size(len(rows)) - len(rows)
    return np.concatenate([rows, np.broadcast_to(rows[:1], (missing, *rows.shape[1:]))])
