"""Inputs of the renderers: random Gaussians around a receiver, attenuation and signal of some queries."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax import Receiver, make_receiver
from wbgs_jax.splat import Gaussians, TileLimits, geometry_plan, measure_limits, project, render_dense, render_splats
from wbgs_jax.splat.tiles import Tiling

Render = Callable[[Gaussians, Float[Array, "n b"], Float[Array, "n b"]], Float[Array, "b 90 360"]]


@dataclass(frozen=True)
class Scene:
    """N Gaussians and B queries."""

    gaussians: Gaussians
    receiver: Receiver
    attenuation: Float[Array, "n b"]
    signal: Float[Array, "n b"]
    cotangent: Float[Array, "b 90 360"]
    limits: TileLimits

    def inputs(self, b: int) -> tuple[Gaussians, Float[Array, "n b"], Float[Array, "n b"], Float[Array, "b 90 360"]]:
        """Returns the inputs of compiled functions, for the first b queries."""
        return self.gaussians, self.attenuation[:, :b], self.signal[:, :b], self.cotangent[:b]

    def tiled(self, gaussians: Gaussians, attenuation: Float[Array, "n b"], signal: Float[Array, "n b"]):
        """Returns what the project's renderer draws, geometry included."""
        return render_splats(geometry_plan(gaussians, self.receiver, self.limits), attenuation, signal)

    def dense(self, gaussians: Gaussians, attenuation: Float[Array, "n b"], signal: Float[Array, "n b"]):
        """Returns what the reference draws."""
        return render_dense(project(gaussians, self.receiver), attenuation, signal)

    def lower_forward(self, render: Render, b: int) -> jax.stages.Lowered:
        """Returns a renderer, ready to be compiled."""
        return jax.jit(lambda *inputs: render(*inputs[:3])).lower(*self.inputs(b))

    def lower_gradient(self, render: Render, b: int) -> jax.stages.Lowered:
        """Returns a renderer's forward and backward, ready to be compiled."""
        return jax.jit(gradient_of(render)).lower(*self.inputs(b))

    def lower_gradient_one_by_one(self, render: Render, b: int) -> jax.stages.Lowered:
        """Returns the same, query after query: for a renderer that keeps every (Gaussian, pixel, query) for its backward
        pass."""
        gradient = gradient_of(render)

        def gradients(gaussians, *queries):
            def add(total, query):
                own, *others = gradient(gaussians, *(a[..., None] for a in query[:2]), query[2][None])
                return jax.tree.map(jnp.add, total, own), tuple(a[:, 0] for a in others)

            attenuation, signal, cotangent = queries
            total, others = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, gaussians), (attenuation.T, signal.T, cotangent))
            return total, *(a.T for a in others)

        return jax.jit(gradients).lower(*self.inputs(b))


def gradient_of(render: Render) -> Callable[..., tuple[Gaussians, Float[Array, "n b"], Float[Array, "n b"]]]:
    """Returns the gradients of Gaussians, attenuation and signal, given those and a cotangent of the image."""

    def objective(gaussians, attenuation, signal, cotangent):
        return jnp.sum(render(gaussians, attenuation, signal) * cotangent)

    return jax.grad(objective, argnums=(0, 1, 2))


def random_gaussians(rng: np.random.Generator, n: int) -> Gaussians:
    """Returns Gaussians with directions even over the hemisphere, footprints of 2-10 degrees (3 sigma), distances of 1-6 m."""
    cosine, azimuth, distance = rng.uniform(0, 1, n), rng.uniform(-np.pi, np.pi, n), rng.uniform(1, 6, n)
    sine = np.sqrt(1 - cosine**2)
    means = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], -1) * distance[:, None]
    sigma = np.deg2rad(rng.uniform(2, 10, n)) / 3 * distance
    log_scales = np.log(sigma[:, None] * rng.uniform(0.6, 1.4, (n, 3)))
    arrays = (means, log_scales, rng.normal(size=(n, 4)), np.zeros(n))
    return Gaussians(*(jnp.asarray(a, jnp.float32) for a in arrays))


def random_scene(n: int, b: int, seed: int, tiling: Tiling | None = None) -> Scene:
    """Returns a scene for up to b queries, in tiles of the device's size or of another."""
    rng = np.random.default_rng([seed, n])
    gaussians, receiver = random_gaussians(rng, n), make_receiver([0.0, 0.0, 0.0])
    attenuation, signal = (jnp.asarray(rng.uniform(0, 0.6, (n, b)), jnp.float32) for _ in range(2))
    cotangent = jnp.asarray(rng.normal(size=(b, 90, 360)), jnp.float32)
    limits = measure_limits(project(gaussians, receiver), 1.05, tiling)
    return Scene(gaussians, receiver, attenuation, signal, cotangent, limits)


def temporary_gb(compiled: jax.stages.Compiled) -> float:
    """Returns the memory (GB) that a compiled function takes beyond its inputs and outputs."""
    analysis = compiled.memory_analysis()
    assert analysis is not None, "every backend with XLA knows"
    return analysis.temp_size_in_bytes / 1e9
