"""Sets as bits of 32-bit words: what many cheap tests found, for the few expensive steps that follow.

A set of unknown size has no place in a compiled program. Its bits do, and `in_chunks` goes through them a fixed number at a
time, as often as there are any.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

WORD = 32
"""Bits per word."""


class Members(NamedTuple):
    """Bits that are set in words, numbered from the lowest of the first word to the highest of the last."""

    words: UInt32[Array, " n"]
    ends: Int[Array, " n"]
    """Number of them in a word and all before it."""


def packed(bits: Bool[Array, "*n f"], width: int = WORD) -> UInt32[Array, "*n words"]:
    """Returns bits in words of a width, padded to whole words: bit f is bit f % width of word f // width."""
    bits = jnp.pad(bits, [(0, 0)] * (bits.ndim - 1) + [(0, -bits.shape[-1] % width)])
    values = jnp.left_shift(jnp.uint32(1), jnp.arange(width, dtype=jnp.uint32))
    return jnp.sum(jnp.where(bits.reshape(*bits.shape[:-1], bits.shape[-1] // width, width), values, 0), -1, dtype=jnp.uint32)


def first_of(words: UInt32[Array, " words"], most: int) -> tuple[Int[Array, " most"], Bool[Array, " most"]]:
    """Returns the indices of the first `most` set bits, ascending, and a mask of those that exist; 0 for the others."""
    place = jnp.arange(len(words))

    def take(left, _):
        word = jnp.min(jnp.where(left != 0, place, len(words) - 1))  # a plain minimum: argmin takes ten times as long on a CPU
        bits = left[word]
        lowest = jax.lax.population_count(~bits & (bits - 1)).astype(jnp.int32)
        return left.at[word].set(bits & (bits - 1)), (jnp.where(bits != 0, word * WORD + lowest, 0), bits != 0)

    return jax.lax.scan(take, words, length=most)[1]


def members(words: UInt32[Array, " n"]) -> Members:
    """Returns the bits that are set."""
    return Members(words, jnp.cumsum(jax.lax.population_count(words).astype(jnp.int32)))


def located(some: Members, number: Int[Array, " k"]) -> tuple[Int[Array, " k"], Int[Array, " k"], Bool[Array, " k"]]:
    """Returns the word of each bit by its number, its place in the word, and whether there is such a bit."""
    word = jnp.minimum(jnp.searchsorted(some.ends, number, side="right"), len(some.words) - 1)
    bits, place = some.words[word], jnp.zeros_like(number)
    rank = number - (some.ends[word] - jax.lax.population_count(bits).astype(jnp.int32))
    for half in (16, 8, 4, 2, 1):
        lower = jax.lax.population_count((bits >> place.astype(jnp.uint32)) & jnp.uint32((1 << half) - 1)).astype(jnp.int32)
        beyond = rank >= lower
        place, rank = place + jnp.where(beyond, half, 0), rank - jnp.where(beyond, lower, 0)
    return word, place, number < some.ends[-1]


def in_chunks(
    some: Members, size: int, function: Callable[[Int[Array, " k"], Int[Array, " k"], Bool[Array, " k"], Any], Any], found: Any
) -> Any:
    """Returns what a function has found after all bits: it receives word and place of `size` bits at a time, a mask of those
    that exist, and what was found before. It cannot be differentiated in reverse mode."""

    if not len(some.words):
        return found

    def further(state: Any) -> Any:
        first, found = state
        return first + size, function(*located(some, first + jnp.arange(size)), found)

    return jax.lax.while_loop(lambda state: state[0] < some.ends[-1], further, (jnp.zeros((), int), found))[1]
