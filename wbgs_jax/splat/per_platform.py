"""Functions with platform-specific implementations, chosen when the code is lowered.

`jax.lax.platform_dependent` decides equally late, but traces all implementations on every platform: a CPU would wait for GPU
kernels to be traced and for the import of Pallas.
"""

import contextlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir


def per_platform(
    name: str, shapes: Callable[..., Any], default: Callable[..., Any], **platforms: Callable[..., Any]
) -> Callable[..., Any]:
    """Returns a function from trees of arrays to a list of arrays: `default`, or the implementation for the target platform.

    It has no derivative, and `jax.vmap` maps it over one row after another.

    Args:
        name: shown in traced programs.
        shapes: returns, for arguments with shapes, a list of objects with the results' `shape` and `dtype`.
        default: computes the results.
        platforms: implementations by platform, such as cuda; traced only when code is lowered for it.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True

    def abstract(*leaves: Any, structure: Any) -> list[Any]:
        found = shapes(*jax.tree.unflatten(structure, leaves))
        return [jax.core.ShapedArray(result.shape, result.dtype) for result in found]

    def lowered(function: Callable[..., Any]) -> Any:
        def computed(*leaves: Any, structure: Any) -> list[Any]:
            return function(*jax.tree.unflatten(structure, leaves))

        def rule(context: Any, *operands: Any, **options: Any) -> Any:
            with _abstract_gpu() if function in platforms.values() else contextlib.nullcontext():
                return mlir.lower_fun(computed, multiple_results=True)(context, *operands, **options)

        return rule

    def one_by_one(leaves: Any, axes: Any, *, structure: Any) -> tuple[Any, Any]:
        mapped = [jnp.moveaxis(a, axis, 0) for a, axis in zip(leaves, axes, strict=True) if axis is not None]

        def of_row(rows: Any) -> Any:
            own = iter(rows)
            row = [a if axis is None else next(own) for a, axis in zip(leaves, axes, strict=True)]
            return primitive.bind(*row, structure=structure)

        results = jax.lax.map(of_row, mapped)
        return results, [0] * len(results)

    def call(*trees: Any) -> list[Any]:
        leaves, structure = jax.tree.flatten(trees)
        return primitive.bind(*leaves, structure=structure)

    primitive.def_abstract_eval(abstract)
    primitive.def_impl(lambda *leaves, structure: jax.jit(lambda *own: primitive.bind(*own, structure=structure))(*leaves))
    mlir.register_lowering(primitive, lowered(default))
    for platform, function in platforms.items():
        mlir.register_lowering(primitive, lowered(function), platform=platform)
    batching.primitive_batchers[primitive] = one_by_one
    return call


def _abstract_gpu() -> contextlib.AbstractContextManager[Any]:
    """Provides an abstract GPU for lowering kernels on a machine without one, as JAX requires from version 0.11 on. Exported
    code runs on this and newer GPUs."""
    if jax.default_backend() == "gpu" or not hasattr(jax.sharding, "AbstractDevice"):
        return contextlib.nullcontext()
    device = jax.sharding.AbstractDevice(device_kind="NVIDIA A100", num_cores=108, platform="gpu")
    return jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), (), abstract_device=device))
