"""The EM feature networks (paper, section 4.2, equations 1-3), as Flax modules.

    attenuation network  (P(G), P(TX), f) -> (h, delta_f)
    radiance network     (h, f)           -> Sig
    power network        (mean of h, P(TX), f) -> received power relative to free space

If the input of a layer is a concatenation of parts that depend on the Gaussian only, on the query only, or on both, the layer
is evaluated part by part and the results are added: the same function as a dense layer on the concatenation, without forming it
N x B times. Parts that depend on the Gaussian only can be evaluated once for all queries (`AttenuationNetwork.gaussian_sums`).

The module also contains the positional and frequency encodings of these networks (paper, section 4.2).
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
"""Inputs of broadcastable shapes, (N or 1, B or 1, features), possibly with more axes."""
GaussianSums = tuple[Float[Array, "... width"], Float[Array, "... width"] | None]
"""Sums of layers `fusion` and `skip` before the query enters; the second is None unless `skip` is after `fusion`."""
Precision = Literal["device", "float32", "tf32", "bfloat16"]
"""Precision of the factors in products; sums are float32. "device" means TF32 on GPUs that support it, else float32."""


def product(a: Any, b: Any, dimension_numbers: Any, precision: Precision = "device") -> Any:
    """Returns `lax.dot_general` of float32 arrays rounded to a precision; gradients are rounded in the same way.

    A device without such products computes float32 products of the rounded numbers: the same accuracy without gain in speed.
    """
    if precision == "bfloat16":
        a, b = a.astype(jnp.bfloat16), b.astype(jnp.bfloat16)
        return lax.dot_general(a, b, dimension_numbers, preferred_element_type=jnp.float32)
    tf32_bits = 8, 10  # bits of exponent and mantissa
    if precision == "tf32":
        a, b = (lax.reduce_precision(array, *tf32_bits) for array in (a, b))
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

        An initialised layer can be summed in several calls.

        Args:
            parts: inputs number `first`, `first` + 1, ... of the layer.
            first: number of the first input.
            total: sum of previous calls, including the bias; None to begin with the bias.
        """
        init = nn.initializers.normal(stddev=(2.0 / sum(part.shape[-1] for part in parts)) ** 0.5)
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,), jnp.float32)
        summed: Any = bias if total is None else jnp.asarray(total)
        for i, part in enumerate(parts, first):
            kernel = self.param(f"kernel_{i}", init, (part.shape[-1], self.features), jnp.float32)
            # Two axes: XLA's CPU backend computes the kernel's gradient three times faster than with three.
            flat = part.reshape(-1, part.shape[-1])
            added = product(flat, kernel.astype(part.dtype), (((1,), (0,)), ((), ())), self.precision)
            summed = summed + added.reshape(*part.shape[:-1], self.features)
        return summed


class AttenuationNetwork(nn.Module):
    """The network (P(G), P(TX), f) -> (h, delta_f). Inputs re-enter before layer `skip`, as in the authors' code and NeRF.

    The query enters at layer `fusion`: the layers before it depend on the Gaussian only and need N instead of N x B
    evaluations. With `fusion` 0 it is the paper's network. `__call__` evaluates it layer by layer, which initialises the
    weights and serves as the reference; `gaussian_sums` and `of_queries` compute the same in two steps, the first of which does
    not depend on the query.
    """

    width: int
    depth: int
    skip: int
    fusion: int = 0
    heads: int = 1
    """Number of outputs; more than one are returned along an additional last axis."""
    precision: Precision = "device"

    def setup(self) -> None:
        self.layers = [PartwiseDense(self.width, self.precision, name=f"PartwiseDense_{i}") for i in range(self.depth)]
        # Initially zero: the final attenuation starts as delta_o, and delta_f learns a correction (paper, section 4.5).
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
        """Returns the sums that depend on the Gaussians only, of shape (N, 1, width), from P(G) of shape (N, 1, features)."""
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
        """Returns (h, delta_f), both of shape (N, B, ...).

        Args:
            sums: result of `gaussian_sums`.
            query: inputs that depend on the query.
            gaussian_parts: number of inputs of `gaussian_sums`.
        """
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
    """The network (h, f) -> Sig before its activation."""

    widths: tuple[int, ...]
    heads: int = 1
    precision: Precision = "device"

    @nn.compact
    def __call__(self, parts: Parts) -> Float[Array, "..."]:
        """Returns the logits of Sig, along an additional last axis if there are several heads."""
        hidden = nn.relu(PartwiseDense(self.widths[0], self.precision)(parts))
        for width in self.widths[1:]:
            hidden = nn.relu(PartwiseDense(width, self.precision)([hidden]))
        small, multiply = nn.initializers.normal(0.01), _dense(self.precision)
        return _values(nn.Dense(self.heads, kernel_init=small, dot_general=multiply)(hidden))


class PowerNetwork(nn.Module):
    """The network (mean of h over the Gaussians, P(TX), f) -> received power relative to free space, in units of 10 dB."""

    width: int

    @nn.compact
    def __call__(self, parts: Parts) -> Float[Array, "..."]:
        """Returns a value for every query; initially 0, which is free space."""
        hidden = nn.relu(PartwiseDense(self.width)(parts))
        hidden = nn.relu(PartwiseDense(self.width)([hidden]))
        return nn.Dense(1, kernel_init=nn.initializers.zeros_init())(hidden)[..., 0]


def _values(heads: Float[Array, "... heads"]) -> Float[Array, "..."]:
    return heads[..., 0] if heads.shape[-1] == 1 else heads


def signal_activation(logits: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns Sig > 0; the bias is chosen so that a zero logit gives a mid-grey image of the normalised spectra."""
    return jax.nn.softplus(logits - 1.0)


def attenuation_activation(delta_o: Float[Array, " n"], delta_f: Float[Array, "n b"], maximum: float) -> Float[Array, "n b"]:
    """Returns delta = delta_o + delta_f; both are added before the sigmoid, so that delta lies in (0, maximum) for any network
    output."""
    return maximum * jax.nn.sigmoid(delta_o[:, None] + delta_f)


FrequencyScale = Literal["log", "ghz"]
"""Scale of the frequency as an input: "log" maps the band of the paper to -1..1 and extrapolates smoothly, "ghz" is linear."""


def positional_encoding(x: Any, octaves: int) -> Float[Array, "*n d_out"]:
    """Returns (x, sin(2^k x), cos(2^k x), k = 0..octaves-1), which includes the input: d_out = d (1 + 2 octaves)  (NeRF,
    equation 4).

    Args:
        x: coordinates (*n, d) of order 1.
        octaves: number of doublings of the frequency.

    Returns:
        The encoding (*n, d (1 + 2 octaves)).

    Example:
        >>> import jax.numpy as jnp
        >>> positional_encoding(jnp.zeros(3), 6).shape
        (39,)
    """
    x = jnp.asarray(x)
    scaled = x[..., None, :] * (2.0 ** jnp.arange(octaves, dtype=x.dtype))[:, None]
    waves = jnp.concatenate([jnp.sin(scaled), jnp.cos(scaled)], -2)
    return jnp.concatenate([x, waves.reshape((*x.shape[:-1], -1))], -1)


def scale_frequency(frequency_hz: Float[Array, "*n"], scale: FrequencyScale = "log") -> Float[Array, "*n"]:
    """Returns a frequency as a network input: "log" maps 1..100 GHz to -1..1 by its logarithm, "ghz" returns gigahertz."""
    if scale == "ghz":
        return frequency_hz / 1e9
    middle = 0.5 * (math.log(MIN_FREQUENCY_HZ) + math.log(MAX_FREQUENCY_HZ))
    half = 0.5 * (math.log(MAX_FREQUENCY_HZ) - math.log(MIN_FREQUENCY_HZ))
    return (jnp.log(frequency_hz) - middle) / half


def frequency_encoding(frequency_hz: Any, octaves: int, scale: FrequencyScale = "log") -> Float[Array, "*n d"]:
    """Returns the positional encoding of the scaled frequency: d = 1 + 2 octaves.

    Args:
        frequency_hz: of the carriers (*n).
        octaves: number of doublings of the frequency of the encoding.
        scale: "log" or "ghz" (`scale_frequency`).

    Returns:
        The encoding (*n, 1 + 2 octaves).
    """
    return positional_encoding(scale_frequency(jnp.asarray(frequency_hz), scale)[..., None], octaves)


def legendre(x: Float[Array, "*n"], degree: int) -> Float[Array, "*n d"]:
    """Returns the Legendre polynomials P_1 ... P_degree of numbers in -1..1: d = degree."""
    values = [jnp.ones_like(x), x]
    for k in range(1, degree):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
    return jnp.stack(values[1 : degree + 1], -1)


def check_octaves(name: str, config: Any, inputs: tuple[str, ...]) -> None:
    """Raises a `UserError` if the number of octaves of an encoding is negative.

    Args:
        name: name of the field, for the message.
        config: settings.
        inputs: encoded inputs; their settings are called `<input>_octaves`.
    """
    for part in inputs:
        if getattr(config, f"{part}_octaves") < 0:
            raise UserError(f"--{name}.{part}-octaves is negative; give 0 or more")
