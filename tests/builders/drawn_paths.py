"""Paths with random numbers in them, for round trips."""

import numpy as np

from wbgs_jax.interchange.ray_paths import DIFFRACTION, NONE, REFRACTION, SPECULAR, RayPaths


def draw_paths(rng, receivers=2, transmitters=6, paths=4, depth=3, frequency_hz=2.4e9) -> RayPaths:
    shape = receivers, transmitters, paths
    valid = rng.uniform(size=shape) < 0.8
    valid[..., 0] = True
    count = np.where(valid, rng.integers(0, depth + 1, shape), 0)
    kinds = rng.choice([SPECULAR, REFRACTION, DIFFRACTION], (depth, *shape))
    met = np.where(np.arange(depth)[:, None, None, None] < count, kinds, NONE)
    return RayPaths(
        a=rng.normal(size=shape) + 1j * rng.normal(size=shape),
        tau=np.where(valid, rng.uniform(1e-9, 1e-7, shape), -1),
        theta_t=rng.uniform(0, np.pi, shape),
        phi_t=rng.uniform(-np.pi, np.pi, shape),
        theta_r=rng.uniform(0, np.pi, shape),
        phi_r=rng.uniform(-np.pi, np.pi, shape),
        interactions=met,
        vertices=np.where((met != NONE)[..., None], rng.normal(size=(depth, *shape, 3)), np.nan),
        valid=valid,
        sources=rng.normal(size=(transmitters, 3)),
        targets=rng.normal(size=(receivers, 3)),
        frequency_hz=frequency_hz,
    )
