"""Mechanisms by which waves reach the receiver, one entry of a table each: how its paths are traced, how the field is carried
along them, and how many of them there may be.

A further mechanism is an entry here, with its two functions in a module of its own, and two settings of the field.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float

from wbgs_jax.propagation.image_method import ImageTree
from wbgs_jax.propagation.paths import MAX_ORDER, PathGeometry, TracedPaths, diffracted_paths, specular_paths
from wbgs_jax.propagation.transport import Transport, diffracted_transport, specular_transport


class Mechanism(NamedTuple):
    """A mechanism. Its name is stored in the paths; its place in the table is its row in `WaveParams.excess_loss`."""

    name: str
    trace: Callable[[Float[Array, "3"], ImageTree, int, int], PathGeometry]
    """(transmitter, image tree of the receiver, candidates tested, paths kept) -> paths of this mechanism."""
    transport: Transport
    vertices: int
    """Largest number of vertices of a path: its length depends on the positions of as many surfaces."""
    coherent: bool
    """Whether the amplitudes of its paths add; otherwise their powers do, in means over positions."""
    sizes: tuple[str, str]
    """Settings of the field: number of candidates that are tested for occlusion, and of paths that are kept (0: none is
    traced)."""


MECHANISMS = {
    one.name: one
    for one in (
        # Reflections and transmissions, including the line of sight.
        Mechanism("specular", specular_paths, specular_transport, MAX_ORDER, True, ("specular_tried", "specular_kept")),
        # One diffraction, at most one reflection before or after it, and transmissions.
        Mechanism("diffracted", diffracted_paths, diffracted_transport, 2, True, ("diffracted_tried", "diffracted_kept")),
    )
}
"""Mechanisms by name, in the order in which paths are traced and their waves added."""
Sizes = tuple[tuple[str, int, int], ...]
"""(name of a mechanism, candidates tested, paths kept) of those that are traced."""


def sizes_of(config: Any) -> Sizes:
    """Returns the mechanisms that the settings of a field demand, with their sizes."""
    sizes = ((name, *(getattr(config, size) for size in one.sizes)) for name, one in MECHANISMS.items())
    return tuple((name, tried, kept) for name, tried, kept in sizes if kept)


def trace_paths(tree: ImageTree, tx_position: Float[Array, "3"], sizes: Sizes) -> TracedPaths:
    """Returns the paths of one transmitter. Use `jax.lax.map` for several: batching them needs a lot of memory.

    Args:
        tree: image tree of the receiver (`image_method.make_image_tree`).
        tx_position: world frame, metres.
        sizes: number of candidates that are tested for intersections with all facets, and number of paths returned, the
            strongest of these, by mechanism; fewer paths if fewer are tried.
    """
    return TracedPaths(tuple(MECHANISMS[name].trace(tx_position, tree, tried, kept) for name, tried, kept in sizes))


def transports_of(paths: TracedPaths) -> tuple[Transport, ...]:
    """Returns the transport of the mechanism of each set of paths, for `transport.arrivals`."""
    return tuple(MECHANISMS[some.mechanism].transport for some in paths.sets)
