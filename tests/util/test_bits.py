"""Sets as bits of words, against sets of NumPy."""

import jax
import jax.numpy as jnp
import numpy as np

from wbgs_jax.propagation.occlusion import WORD, in_chunks, located, members, packed


def test_members_come_in_order_with_their_places(rng):
    for count, share in ((1, 1.0), (70, 0.0), (1000, 0.02), (1000, 0.9)):
        bits = rng.random(count) < share
        words = packed(jnp.asarray(bits))
        assert words.shape == (-(-count // WORD),) and np.bitwise_count(words).sum() == bits.sum()
        word, place, there = (np.asarray(a) for a in located(members(words), jnp.arange(count)))
        np.testing.assert_array_equal((word * WORD + place)[there], np.flatnonzero(bits))
        assert there.sum() == bits.sum()


def test_chunks_visit_every_member_once(rng):
    """Also in the last chunk, which is rarely full; without members nothing is visited."""
    for share in (0.0, 0.3):
        bits = rng.random((40, WORD)) < share

        def visit(word, place, there, found):
            return found.at[word, place].add(jnp.where(there, 1, 0))

        some = members(packed(jnp.asarray(bits))[:, 0])
        visited = jax.jit(lambda some: in_chunks(some, 24, visit, jnp.zeros((40, WORD), int)))(some)
        np.testing.assert_array_equal(visited, bits)
