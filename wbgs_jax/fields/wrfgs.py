"""WRF-GS (Wen et al., INFOCOM 2025) as a baseline: the wideband field's Gaussians and networks without any frequency input.

    delta, Sig = F(P(G), P(TX))

Its prediction is the same at every frequency, so one model is trained per frequency. Everything else is as in the wideband
field, so that a comparison shows the effect of the frequency input only; docs/baselines.md describes where this departs from
the authors' system.
"""

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, TypeVar

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.config import PRESETS
from wbgs_jax.fields.base import register, with_field
from wbgs_jax.fields.wideband import CONFIGS, DENSITY, OPTIM, WidebandConfig, WidebandField
from wbgs_jax.types import Scene

C = TypeVar("C", bound=WidebandConfig)


@dataclass(frozen=True)
class WrfgsConfig(WidebandConfig):
    """Settings of the wideband field without frequency inputs."""

    def check(self, name: str) -> None:
        """Raises a `UserError` for invalid settings; the message names the option with the field's `name`."""
        super().check(name)
        if self != without_frequency(self):
            raise UserError("WRF-GS has no frequency input to switch on; train --field wideband")


def without_frequency(config: C) -> C:
    """Returns the same settings without frequency embeddings and frequency heads."""
    return dataclasses.replace(config, attenuation_frequency=False, radiance_frequency=False, frequency_heads=0)


@register
@pytree
class WrfgsField(WidebandField):
    """The wideband field without frequency inputs."""

    name: ClassVar[str] = "wrfgs"
    presets: ClassVar = with_field(
        PRESETS,
        {name: without_frequency(WrfgsConfig(**dataclasses.asdict(c))) for name, c in CONFIGS.items()},
        density=DENSITY,
        optim=OPTIM,
    )

    @classmethod
    def build(cls, config: WidebandConfig, scene: Scene, seed: int) -> "WidebandField":
        """Returns the field of a scene; its networks have no frequency input."""
        return super().build(without_frequency(config), scene, seed)
