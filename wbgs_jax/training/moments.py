"""What an optimiser stores beside the parameters, when these change their shapes."""

from collections.abc import Callable
from typing import Any

import jax
import optax


def map_moments(moments: Any, params: Any, function: Callable[[Any], Any]) -> Any:
    """Returns the optimiser's state with every tree in it that is like the parameters transformed. In the tree of a group the
    leaves of all others are masked."""
    leaves, structure = jax.tree.flatten(params)
    known: Any = structure

    def alike(value: Any) -> bool:
        own, found = jax.tree.flatten(value, is_leaf=_is_masked)
        same = (_is_masked(a) or (a.shape, a.dtype) == (b.shape, b.dtype) for a, b in zip(own, leaves, strict=False))
        return bool(found == known) and not _is_masked(value) and all(same)

    return jax.tree.map(lambda leaf: function(leaf) if alike(leaf) else leaf, moments, is_leaf=alike)


def _is_masked(node: Any) -> bool:
    return isinstance(node, optax.MaskedNode)
