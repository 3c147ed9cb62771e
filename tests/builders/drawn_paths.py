"""Paths with random numbers in them, for round trips; and paths through random points, which are plausible."""

import numpy as np

from wbgs_jax.interchange.ray_paths import DIFFRACTION, NONE, REFRACTION, SPECULAR, RayPaths
from wbgs_jax.radio.array import SPEED_OF_LIGHT


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


def bounced_paths(rng, receivers=6, transmitters=1, depth=3, frequency_hz=2.4e9, direct=True) -> RayPaths:
    """Paths of none (if `direct`), one, ... reflections, with the lengths and directions that their vertices imply."""
    sources, targets = (rng.uniform(1, 9, (n, 3)) for n in (transmitters, receivers))
    counts = np.arange(0 if direct else 1, depth + 1)
    shape = receivers, transmitters, len(counts)
    met = np.broadcast_to(np.where(np.arange(depth)[:, None] < counts, SPECULAR, NONE)[:, None, None], (depth, *shape))
    vertices = np.where((met != NONE)[..., None], rng.uniform(0, 10, (depth, *shape, 3)), np.nan)
    start, end = np.broadcast_to(sources[None, :, None], (*shape, 3)), np.broadcast_to(targets[:, None, None], (*shape, 3))
    points = np.concatenate([start[None], np.where(np.isnan(vertices), end, vertices), end[None]])
    last = points[counts, :, :, np.arange(len(counts))]
    length = np.linalg.norm(np.diff(points, axis=0), axis=-1).sum(0)
    theta_t, phi_t = angles_of(points[1] - start)
    theta_r, phi_r = angles_of(np.moveaxis(last, 0, 2) - end)
    return RayPaths(
        a=np.exp(2j * np.pi * rng.random(shape)) / (100 * length),
        tau=length / SPEED_OF_LIGHT,
        theta_t=theta_t,
        phi_t=phi_t,
        theta_r=theta_r,
        phi_r=phi_r,
        interactions=met.copy(),
        vertices=vertices,
        valid=np.ones(shape, bool),
        sources=sources,
        targets=targets,
        frequency_hz=frequency_hz,
    )


def angles_of(direction):
    """Returns the angles (radians) of vectors."""
    x, y, z = np.moveaxis(direction, -1, 0)
    return np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
