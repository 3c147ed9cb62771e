"""WRF-GS (Wen et al., INFOCOM 2025) as a baseline: the wideband field's Gaussians and networks without any frequency input.

    delta, Sig = F(P(G), P(TX))

It answers every frequency alike, so one model is trained a frequency. Everything else is the wideband field, so that a
comparison is about the frequency and nothing else; docs/baselines.md says where that departs from the authors' system.
"""

from jaxtyping import Array, Key

from wbgs_jax.config import WidebandConfig, without_frequency
from wbgs_jax.fields import wideband
from wbgs_jax.fields.wideband import STARTS_FROM, WidebandParams, observe, plan, remember, render, sizes
from wbgs_jax.types import Surface

__all__ = ["STARTS_FROM", "init", "observe", "plan", "remember", "render", "sizes", "skeleton"]


def init(key: Key[Array, ""], surface: Surface, config: WidebandConfig, capacity: int | None = None) -> WidebandParams:
    """Gaussians on the surface points, as the wideband field's, and networks that never see a frequency."""
    return wideband.init(key, surface, without_frequency(config), capacity)


def skeleton(config: WidebandConfig, sizes: dict[str, int]) -> WidebandParams:
    """The shapes of parameters."""
    return wideband.skeleton(without_frequency(config), sizes)
