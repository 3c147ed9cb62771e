"""What a field shows of a batch of spectra while it is trained."""

from typing import Any, NamedTuple

from jaxtyping import Array, Complex, Float


class Observation(NamedTuple):
    """Predictions, and what the training step has to watch."""

    pas: Float[Array, "b 90 360"]
    snapshots: Complex[Array, "b elements"] | None = None
    """Of a field that knows phases."""
    penalty: Float[Array, ""] | float = 0.0
    """Added to the loss: what the field wants small."""
    jobs: Any = None
    """`splat.TileJobs` of a field that splats: they may have overflowed."""
