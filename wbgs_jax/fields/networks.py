"""The EM feature networks (paper, section 4.2, equations 1-3), as Flax modules.

    attenuation network  (P(G), P(TX), f) -> (h, delta_f)
    radiance network     (h, f)           -> Sig
    power network        (mean of h, P(TX), f) -> received power relative to free space

A layer whose input is a concatenation of parts that depend on the Gaussian only, on the query only, or on both is evaluated
part by part and added: the same function as a dense layer on the concatenation, without forming it N x B times. What depends
on the Gaussian only can be evaluated once for all queries (`AttenuationNetwork.gaussian_sums`).

Positional and frequency encodings of the EM feature networks (paper, section 4.2).
"""

import math
from collections.abc import Sequence
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.types import MAX_FREQUENCY_HZ, MIN_FREQUENCY_HZ

Parts = Sequence[Float[Array, "... _"]]
"""Inputs of broadcastable shapes, (N or 1, B or 1, features), or of more axes."""
GaussianSums = tuple[Float[Array, "... width"], Float[Array, "... width"] | None]
"""What layers `fusion` and `skip` (None if it is no later one) add up before the query enters."""
Precision = Literal["device", "float32", "tf32", "bfloat16"]
"""Of the numbers that layers multiply; sums are of float32. "device": TF32 on GPUs that have it, else float32."""
TF32_BITS = 8, 10
"""Of exponent and mantissa."""


def product(a: Any, b: Any, dimension_numbers: Any, precision: Precision = "device") -> Any:
    """Returns `lax.dot_general` of float32 arrays, which are rounded to a precision, and so are gradients on their way back.

    On a device with no such products they are computed of rounded numbers: as exact as there, and no faster.
    """
    if precision == "bfloat16":
        a, b = a.astype(jnp.bfloat16), b.astype(jnp.bfloat16)
        return lax.dot_general(a, b, dimension_numbers, preferred_element_type=jnp.float32)
    if precision == "tf32":
        a, b = (lax.reduce_precision(array, *TF32_BITS) for array in (a, b))
    exact = lax.Precision.HIGHEST if precision == "float32" else None
    return lax.dot_general(a, b, dimension_numbers, precision=exact)


def _dense(precision: Precision) -> Any:
    """Returns the `dot_general` of a flax layer."""
    return lambda a, b, dimension_numbers, **_: product(a, b, dimension_numbers, precision)


class PartwiseDense(nn.Module):
    """A dense layer on the concatenation of broadcastable parts."""

    features: int
    precision: Precision = "device"

    @nn.compact
    def __call__(
        self, parts: Parts, first: int = 0, total: Float[Array, "... features"] | float | None = None
    ) -> Float[Array, "... features"]:
        """Returns the bias plus the products of all parts with their kernels.

        A layer whose weights are known can be summed in several calls: `parts` are then its inputs number `first`, `first` + 1,
        ..., and `total` the sum so far, bias included.
        """
        init = nn.initializers.normal(stddev=(2.0 / sum(part.shape[-1] for part in parts)) ** 0.5)
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,), jnp.float32)
        summed: Any = bias if total is None else jnp.asarray(total)
        for i, part in enumerate(parts, first):
            kernel = self.param(f"kernel_{i}", init, (part.shape[-1], self.features), jnp.float32)
            # On two axes: XLA's CPU backend takes the kernel's gradient three times faster than on three.
            flat = part.reshape(-1, part.shape[-1])
            added = product(flat, kernel.astype(part.dtype), (((1,), (0,)), ((), ())), self.precision)
            summed = summed + added.reshape(*part.shape[:-1], self.features)
        return summed


class AttenuationNetwork(nn.Module):
    """(P(G), P(TX), f) -> (h, delta_f). Inputs re-enter before layer `skip`, as in the authors' code and NeRF.

    The query enters at layer `fusion`: layers before it see the Gaussian alone and cost N instead of N x B evaluations. At 0
    it is the paper's network. Calling it evaluates it layer by layer, which makes its weights and is the reference;
    `gaussian_sums` and `of_queries` are the same in two steps, the first of which does not depend on the query.
    """

    width: int
    depth: int
    skip: int
    fusion: int = 0
    heads: int = 1
    """Values instead of delta_f alone, along a further axis if there are several."""
    precision: Precision = "device"

    def setup(self) -> None:
        self.layers = [PartwiseDense(self.width, self.precision, name=f"PartwiseDense_{i}") for i in range(self.depth)]
        # Zero at the start: the final attenuation begins as delta_o, and delta_f learns a correction (paper, section 4.5).
        zeros, multiply = nn.initializers.zeros_init(), _dense(self.precision)
        self.head = nn.Dense(self.heads, kernel_init=zeros, dot_general=multiply, name="Dense_0")

    def __call__(self, gaussian: Parts, query: Parts) -> tuple[Float[Array, "... width"], Float[Array, "..."]]:
        """Returns the hidden features h and delta_f, both of shape (N, B, ...)."""
        hidden: list[Float[Array, "... _"]] = []
        for layer in range(self.depth):
            inputs = hidden + self._gaussian_inputs(layer, gaussian)
            if layer == self.fusion or (layer == self.skip and layer > self.fusion):
                inputs += query
            hidden = [nn.relu(self.layers[layer](inputs))]
        return hidden[0], _values(self.head(hidden[0]))

    def gaussian_sums(self, gaussian: Parts) -> GaussianSums:
        """Returns what the Gaussians alone decide: P(G) of shape (N, 1, features) gives sums of shape (N, 1, width)."""
        hidden: list[Float[Array, "... _"]] = []
        for layer in range(self.fusion):
            hidden = [nn.relu(self.layers[layer](hidden + self._gaussian_inputs(layer, gaussian)))]
        at_fusion = self.layers[self.fusion](hidden + self._gaussian_inputs(self.fusion, gaussian))
        if not self.fusion < self.skip < self.depth:
            return at_fusion, None
        return at_fusion, self.layers[self.skip](gaussian, first=1, total=0.0)

    def of_queries(
        self, sums: GaussianSums, query: Parts, gaussian_parts: int = 1
    ) -> tuple[Float[Array, "... width"], Float[Array, "..."]]:
        """Returns (h, delta_f) from `gaussian_sums` of so many Gaussian inputs, and the inputs of the queries."""
        at_fusion, at_skip = sums
        first = bool(self.fusion) + gaussian_parts * (self.fusion in (0, self.skip))
        hidden = nn.relu(self.layers[self.fusion](query, first=first, total=at_fusion))
        for layer in range(self.fusion + 1, self.depth):
            total = self.layers[layer]([hidden])
            if at_skip is not None and layer == self.skip:
                total = self.layers[layer](query, first=1 + gaussian_parts, total=total + at_skip)
            hidden = nn.relu(total)
        return hidden, _values(self.head(hidden))

    def _gaussian_inputs(self, layer: int, gaussian: Parts) -> list[Float[Array, "... _"]]:
        return list(gaussian) if layer in (0, self.skip) else []


class RadianceNetwork(nn.Module):
    """(h, f) -> Sig before its activation."""

    widths: tuple[int, ...]
    heads: int = 1
    precision: Precision = "device"

    @nn.compact
    def __call__(self, parts: Parts) -> Float[Array, "..."]:
        """Returns the logits of Sig, along a further axis if there are several heads."""
        hidden = nn.relu(PartwiseDense(self.widths[0], self.precision)(parts))
        for width in self.widths[1:]:
            hidden = nn.relu(PartwiseDense(width, self.precision)([hidden]))
        small, multiply = nn.initializers.normal(0.01), _dense(self.precision)
        return _values(nn.Dense(self.heads, kernel_init=small, dot_general=multiply)(hidden))


class PowerNetwork(nn.Module):
    """(mean of h over the Gaussians, P(TX), f) -> received power relative to free space, in units of 10 dB."""

    width: int

    @nn.compact
    def __call__(self, parts: Parts) -> Float[Array, "..."]:
        """Returns a value for every query; free space at the start."""
        hidden = nn.relu(PartwiseDense(self.width)(parts))
        hidden = nn.relu(PartwiseDense(self.width)([hidden]))
        return nn.Dense(1, kernel_init=nn.initializers.zeros_init())(hidden)[..., 0]


def _values(heads: Float[Array, "... heads"]) -> Float[Array, "..."]:
    return heads[..., 0] if heads.shape[-1] == 1 else heads


def signal_activation(logits: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns Sig > 0; the bias makes a zero logit a mid-grey image of the normalised spectra."""
    return jax.nn.softplus(logits - 1.0)


def attenuation_activation(delta_o: Float[Array, " n"], delta_f: Float[Array, "n b"], maximum: float) -> Float[Array, "n b"]:
    """Returns delta = delta_o + delta_f, the sum taken before the squash so that it lies in (0, maximum) for any network
    output."""
    return maximum * jax.nn.sigmoid(delta_o[:, None] + delta_f)


FrequencyScale = Literal["log", "ghz"]
"""The logarithm maps the band of the paper to -1..1 and extrapolates smoothly beyond."""


def positional_encoding(x: Float[Array, "*n d"], octaves: int) -> Float[Array, "*n d_out"]:
    """Returns (x, sin(2^k x), cos(2^k x), k = 0..octaves-1), input included: d_out = d (1 + 2 octaves)  (NeRF, equation 4)."""
    scaled = x[..., None, :] * (2.0 ** jnp.arange(octaves, dtype=x.dtype))[:, None]
    waves = jnp.concatenate([jnp.sin(scaled), jnp.cos(scaled)], -2)
    return jnp.concatenate([x, waves.reshape((*x.shape[:-1], -1))], -1)


def scale_frequency(frequency_hz: Float[Array, "*n"], scale: FrequencyScale = "log") -> Float[Array, "*n"]:
    """Returns a frequency as a network input: "log" maps 1..100 GHz to -1..1 by its logarithm, "ghz" gives raw gigahertz."""
    if scale == "ghz":
        return frequency_hz / 1e9
    middle = 0.5 * (math.log(MIN_FREQUENCY_HZ) + math.log(MAX_FREQUENCY_HZ))
    half = 0.5 * (math.log(MAX_FREQUENCY_HZ) - math.log(MIN_FREQUENCY_HZ))
    return (jnp.log(frequency_hz) - middle) / half


def frequency_encoding(frequency_hz: Float[Array, "*n"], octaves: int, scale: FrequencyScale = "log") -> Float[Array, "*n d"]:
    """Returns the positional encoding of the scaled frequency: d = 1 + 2 octaves."""
    return positional_encoding(scale_frequency(frequency_hz, scale)[..., None], octaves)


def legendre(x: Float[Array, "*n"], degree: int) -> Float[Array, "*n d"]:
    """Returns the Legendre polynomials P_1 ... P_degree of numbers in -1..1: d = degree."""
    values = [jnp.ones_like(x), x]
    for k in range(1, degree):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
    return jnp.stack(values[1 : degree + 1], -1)


def check_octaves(name: str, config: Any, inputs: tuple[str, ...]) -> None:
    """Raises a `UserError` for settings with an encoding of fewer than no octaves; `name` is that of the field."""
    for part in inputs:
        if getattr(config, f"{part}_octaves") < 0:
            raise UserError(f"--{name}.{part}-octaves is negative; give 0 or more")
