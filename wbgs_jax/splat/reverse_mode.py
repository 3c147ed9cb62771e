"""What a hand-written backward pass does not allow, refused in a sentence of our own.

JAX refuses it too, but in words about a function that nobody asked for, or about a loop within it. Both functions below are
the identity, and cost nothing when code runs.
"""

from typing import Any, NoReturn

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

MESSAGE = (
    "splatting is differentiable in reverse mode only: use jax.grad, jax.vjp or jax.jacrev instead of jax.jvp, jax.jacfwd or "
    "jax.linearize, and no second derivatives"
)


def _refuse(*_: Any, **__: Any) -> NoReturn:
    raise TypeError(MESSAGE)


_tangent = Primitive("reverse_mode_only")
"""(x, its tangent) -> the tangent. Reverse mode transposes it away; forward mode comes to evaluate it, to compile it, or to map
it over tangents of one x."""


def _map(arguments: Any, axes: Any) -> Any:
    if axes[0] is None:  # x is not mapped: forward mode over several tangents
        _refuse()
    x, tangent = arguments[0], jnp.moveaxis(arguments[1], axes[1], axes[0])
    return _tangent.bind(x, tangent), axes[0]


def _differentiate_again(arguments: Any, tangents: Any) -> Any:
    (x, tangent), further = arguments, tangents[1]
    return _tangent.bind(x, tangent), further if isinstance(further, ad.Zero) else _tangent.bind(x, further)


_tangent.def_abstract_eval(lambda x, tangent: tangent)
_tangent.def_impl(_refuse)
mlir.register_lowering(_tangent, _refuse)
batching.primitive_batchers[_tangent] = _map
ad.primitive_jvps[_tangent] = _differentiate_again
ad.primitive_transposes[_tangent] = lambda cotangent, x, tangent: [None, cotangent]


@jax.custom_jvp
def reverse_mode_only(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns x; forward-mode differentiation is a TypeError, of jitted code when it is compiled."""
    return x


@reverse_mode_only.defjvp
def _reverse_mode_only_jvp(primals, tangents):
    return reverse_mode_only(*primals), _tangent.bind(*primals, *tangents)


@jax.custom_jvp
def not_differentiable(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns x; differentiation of any kind is a TypeError."""
    return x


not_differentiable.defjvp(_refuse)
