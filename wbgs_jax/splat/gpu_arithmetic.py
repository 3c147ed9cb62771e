"""What Triton does not do by itself: it contracts no products and sums, and is careful with numbers too small to matter.

Where kernels are interpreted, by plain operations on any device, these are the formulas that the instructions stand for.
"""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental.pallas import triton as plt
from jaxtyping import Array, Float

_interpreting = ContextVar("interpreting", default=False)


def interpreting() -> bool:
    """Whether kernels that are traced now are to be interpreted."""
    return _interpreting.get()


@contextlib.contextmanager
def interpreted() -> Iterator[None]:
    """Lets kernels that are traced within be computed by plain operations: slowly, and on any device."""
    token = _interpreting.set(True)
    try:
        yield
    finally:
        _interpreting.reset(token)


def _instruction(code: str, *arguments: Any) -> Any:
    shape = jnp.broadcast_shapes(*map(jnp.shape, arguments))
    arrays = [jnp.broadcast_to(jnp.asarray(a, jnp.float32), shape) for a in arguments]
    (result,) = plt.elementwise_inline_asm(
        f"{code} {', '.join(f'${i}' for i in range(len(arrays) + 1))};",
        args=arrays,
        constraints=",".join(["=f"] + ["f"] * len(arrays)),
        pack=1,
        result_shape_dtypes=[jax.ShapeDtypeStruct(shape, jnp.float32)],
    )
    return result


def fma(a: Any, b: Any, c: Any) -> Any:
    """Returns a b + c."""
    return a * b + c if interpreting() else _instruction("fma.rn.f32", a, b, c)


def exp2(x: Any) -> Any:
    """Returns 2^x; what is below 1e-38 is zero."""
    return jnp.exp2(x) if interpreting() else _instruction("ex2.approx.ftz.f32", x)


def reciprocal(x: Any) -> Any:
    """Returns 1 / x, to the last digit but one."""
    return 1 / x if interpreting() else _instruction("rcp.approx.ftz.f32", x)


def product(columns: Float[Array, "k m"], matrix: Float[Array, "k n"]) -> Float[Array, "m n"]:
    """Returns columns^T matrix as exactly as float32 can: on tensor cores by three products in TF32."""
    precision: Any = lax.Precision.HIGHEST if interpreting() else lax.DotAlgorithmPreset.TF32_TF32_F32_X3
    return lax.dot_general(columns, matrix, (((0,), (0,)), ((), ())), precision=precision)
