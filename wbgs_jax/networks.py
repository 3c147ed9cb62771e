"""The EM feature networks (paper, section 4.2, equations 1-3), as Flax modules.

    attenuation network  (P(G), P(TX), f) -> (h, delta_f)
    radiance network     (h, f)           -> Sig

A layer whose input is a concatenation of parts that depend on the Gaussian only, on the query only, or on both is evaluated
part by part and added: the same function as a dense layer on the concatenation, without forming it N x B times.
"""

from collections.abc import Sequence

import flax.linen as nn
import jax
from jaxtyping import Array, Float


class PartwiseDense(nn.Module):
    """A dense layer on the concatenation of broadcastable parts, each of shape (N or 1, B or 1, features), or of more axes."""

    features: int

    @nn.compact
    def __call__(self, parts: Sequence[Float[Array, "... _"]]) -> Float[Array, "... features"]:
        fan_in = sum(part.shape[-1] for part in parts)
        init = nn.initializers.normal(stddev=(2.0 / fan_in) ** 0.5)
        total = self.param("bias", nn.initializers.zeros_init(), (self.features,))
        for i, part in enumerate(parts):
            kernel = self.param(f"kernel_{i}", init, (part.shape[-1], self.features))
            # On two axes: XLA's CPU backend takes the kernel's gradient three times faster than on three.
            flat = part.reshape(-1, part.shape[-1])
            total = total + (flat @ kernel.astype(part.dtype)).reshape(*part.shape[:-1], self.features)
        return total


class AttenuationNetwork(nn.Module):
    """(P(G), P(TX), f) -> (h, delta_f). Inputs re-enter before layer `skip`, as in the authors' code and NeRF.

    The query enters at layer `fusion`: layers before it see the Gaussian alone and cost N instead of N x B evaluations. At 0
    it is the paper's network.
    """

    width: int
    depth: int
    skip: int
    fusion: int = 0

    @nn.compact
    def __call__(
        self, gaussian: Sequence[Float[Array, "... _"]], query: Sequence[Float[Array, "... _"]]
    ) -> tuple[Float[Array, "... width"], Float[Array, "..."]]:
        hidden: list[Float[Array, "... _"]] = []
        for layer in range(self.depth):
            inputs = list(hidden)
            if layer in (0, self.skip):
                inputs += gaussian
            if layer == self.fusion or (layer == self.skip and layer > self.fusion):
                inputs += query
            hidden = [nn.relu(PartwiseDense(self.width)(inputs))]
        # Zero at the start: the final attenuation begins as delta_o, and delta_f learns a correction (paper, section 4.5).
        delta_f = nn.Dense(1, kernel_init=nn.initializers.zeros_init())(hidden[0])[..., 0]
        return hidden[0], delta_f


class RadianceNetwork(nn.Module):
    """(h, f) -> Sig before its activation."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, parts: Sequence[Float[Array, "... _"]]) -> Float[Array, "..."]:
        hidden = nn.relu(PartwiseDense(self.widths[0])(parts))
        for width in self.widths[1:]:
            hidden = nn.relu(PartwiseDense(width)([hidden]))
        return nn.Dense(1, kernel_init=nn.initializers.normal(0.01))(hidden)[..., 0]


def signal_activation(logits: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Sig > 0; the bias makes a zero logit a mid-grey image of the normalised spectra."""
    return jax.nn.softplus(logits - 1.0)


def attenuation_activation(delta_o: Float[Array, "n"], delta_f: Float[Array, "n b"], maximum: float) -> Float[Array, "n b"]:
    """delta = delta_o + delta_f, the sum taken before the squash so that it lies in (0, maximum) for any network output."""
    return maximum * jax.nn.sigmoid(delta_o[:, None] + delta_f)
