"""What a hand-written backward pass does not allow, refused in a sentence of our own.

JAX refuses it too, but in words about a function that nobody asked for, or about a loop within it. Nothing here costs
anything when code runs.
"""

import contextlib
from collections.abc import Iterator
from typing import Any, NoReturn

import jax
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
"""The identity of tangents. Reverse mode transposes it away; forward mode comes to evaluate it, or to lower it under `jit`."""
_tangent.def_abstract_eval(lambda tangent: tangent)
_tangent.def_impl(_refuse)
mlir.register_lowering(_tangent, _refuse)
ad.deflinear2(_tangent, lambda cotangent, _: [cotangent])
batching.defvectorized(_tangent)


@jax.custom_jvp
def reverse_mode_only(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns x; forward-mode differentiation is a TypeError, under `jit` when the code is compiled."""
    return x


@reverse_mode_only.defjvp
def _reverse_mode_only_jvp(primals, tangents):
    return reverse_mode_only(*primals), _tangent.bind(*tangents)


@jax.custom_jvp
def not_differentiable(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns x; differentiation of any kind is a TypeError."""
    return x


not_differentiable.defjvp(_refuse)


@contextlib.contextmanager
def reworded() -> Iterator[None]:
    """Says it where JAX comes first: mapped over tangents under `jit`, as `jax.jacfwd` does."""
    try:
        yield
    except TypeError as error:
        if "custom_vjp" not in str(error):
            raise
        raise TypeError(MESSAGE) from error
