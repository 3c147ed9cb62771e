"""The kernels of GPUs, interpreted on this CPU, against the dense reference; and lowered for CUDA.

What a GPU makes of them is compared there: `make gpu-check`, part parity.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_splat import random_case, receiver_at

from wbgs_jax.splat import composite, fused_kernels, project, render_dense, tiles
from wbgs_jax.splat import fused_kernels as gpu_arithmetic
from wbgs_jax.splat.composite import assembled
from wbgs_jax.splat.tiles import CHUNK, CPU_TILING, GPU_TILING, TileLimits, Tiling
from wbgs_jax.types import Gaussians

CLOSE = 1e-4
"""Of single precision: sums of up to some thousand terms, relative to the largest."""
LARGE_TILES = Tiling(30, 24)
"""A program a tile and query is interpreted: few tiles are quick."""


def crowded(rng, n):
    """Small Gaussians in nearly one direction: lists of one tile that are longer than what is chained at once."""
    direction = np.array([0.5, -0.4, 0.7]) + rng.normal(0, 0.01, (n, 3))
    means = direction * rng.uniform(1, 4, (n, 1))
    return Gaussians(*map(jnp.float32, (means, np.full((n, 3), -4.0), rng.normal(size=(n, 4)), np.zeros(n))))


def on_the_seam(rng, n):
    """Gaussians left and right of azimuth 180 degrees."""
    means = np.stack([np.full(n, -3.0), rng.normal(0, 0.3, n), rng.uniform(0.2, 2, n)], -1)
    return Gaussians(*map(jnp.float32, (means, np.full((n, 3), -1.5), rng.normal(size=(n, 4)), np.zeros(n))))


def splats_of(kind, rng):
    if kind == "all around":
        gaussians, receiver, *_ = random_case(rng, n=60, dtype=np.float32)
    else:
        receiver = receiver_at(np.zeros(3), [1.0, 0, 0, 0], np.float32)
        gaussians = crowded(rng, 260) if kind == "crowded" else on_the_seam(rng, 40 if kind == "on the seam" else 5)
    return project(gaussians, receiver)


def planned(monkeypatch, splats, tiling, spare=0):
    """The jobs as a GPU makes them: with the slots of every Gaussian."""
    monkeypatch.setattr(tiles, "_slots", lambda *arrays: tiles._slots_of_entries(*arrays))
    build = jax.jit(tiles.build_tile_jobs.__wrapped__, static_argnames="limits")
    rough = build(splats, TileLimits(8192, 1024, tiling.height, tiling.width))
    limits = TileLimits(int(rough.required_entries) + spare, int(rough.required_jobs) + spare, tiling.height, tiling.width)
    jobs = build(splats, limits)
    assert not rough.overflow and not jobs.overflow
    return jobs


@jax.jit
def in_kernels(geometry, attenuation, signal, jobs, cotangent):
    with gpu_arithmetic.interpreted():
        image, *front = composite._forward_by_jobs(geometry, attenuation, signal, jobs)
        d_tiles = jax.vjp(lambda tiles: assembled(tiles, jobs.tiling), image)[1](cotangent)[0]
        gradients = composite._backward_by_jobs(geometry, attenuation, signal, jobs, (image, *front), d_tiles)
    return assembled(image, jobs.tiling), gradients


@jax.jit
def by_the_reference(splats, attenuation, signal, cotangent):
    def image(means2d, conics, attenuation, signal):
        return render_dense(dataclasses.replace(splats, means2d=means2d, conics=conics), attenuation, signal)

    seen, back = jax.vjp(image, splats.means2d, splats.conics, attenuation, signal)
    d_means2d, d_conics, *others = back(cotangent)
    return seen, [jnp.concatenate([d_means2d, d_conics], -1), *others]


def compare(monkeypatch, rng, kind, b, tiling, spare=0):
    splats = splats_of(kind, rng)
    n = len(splats.depths)
    most = 0.9 if kind != "crowded" else 0.1
    attenuation, signal = (jnp.float32(rng.uniform(0, largest, (n, b))) for largest in (most, 0.9))
    cotangent = jnp.float32(rng.normal(size=(b, 90, 360)))
    jobs = planned(monkeypatch, splats, tiling, spare)
    geometry = jnp.concatenate([splats.means2d, splats.conics], -1)
    image, gradients = in_kernels(geometry, attenuation, signal, jobs, cotangent)
    expected, expected_gradients = by_the_reference(splats, attenuation, signal, cotangent)
    assert np.abs(image - expected).max() < CLOSE and np.abs(expected).max() > 0.05
    for found, wanted in zip(gradients, expected_gradients, strict=True):
        for own, other in zip(jnp.moveaxis(found, 1, 0), jnp.moveaxis(wanted, 1, 0), strict=True):
            assert np.abs(own - other).max() <= CLOSE * np.abs(other).max() and np.abs(other).max() > 0
    return jobs


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["all around", "crowded", "on the seam"])
def test_kernels_draw_the_reference_and_have_its_gradients(kind, rng, monkeypatch):
    jobs = compare(monkeypatch, rng, kind, 3, LARGE_TILES, spare=40)
    if kind == "crowded":
        assert int(jobs.count.max()) > fused_kernels.LEVELS and int(jobs.count.min()) == 0  # chained in turns; empty tiles
        assert int(jnp.max(jnp.sum(jobs.gaussian >= 0, -1))) == CHUNK


HEAVY = [pytest.param(b, marks=pytest.mark.heavy) for b in (1, fused_kernels.QUERIES, 32)]


@pytest.mark.parametrize("b", [fused_kernels.QUERIES + 1, *HEAVY])
def test_any_number_of_queries(b, rng, monkeypatch):
    compare(monkeypatch, rng, "a few", b, Tiling(45, 24))


@pytest.mark.heavy
@pytest.mark.parametrize("tiling", [GPU_TILING, CPU_TILING])
def test_tiles_of_any_size(tiling, rng, monkeypatch):
    """Those of a GPU reach beyond the last row; those of a CPU leave lanes idle."""
    compare(monkeypatch, rng, "on the seam", 1, tiling)


@pytest.mark.heavy
def test_few_programs_share_all_jobs(rng, monkeypatch):
    monkeypatch.setattr(fused_kernels, "PROGRAMS", 7)
    compare(monkeypatch, rng, "all around", 2, Tiling(45, 24))


@pytest.mark.heavy
@pytest.mark.parametrize("short", ["entries", "jobs"])
def test_lists_that_do_not_fit_are_empty(short, rng, monkeypatch):
    """No kernel follows them past their end: an overflowed step runs to its end before it is thrown away."""
    monkeypatch.setattr(tiles, "_slots", lambda *arrays: tiles._slots_of_entries(*arrays))
    limits = TileLimits(**({"entries": 8192, "jobs": 1024} | {short: 16}), tile_height=30, tile_width=24)
    splats = splats_of("all around", rng)
    jobs = jax.jit(tiles.build_tile_jobs.__wrapped__, static_argnames="limits")(splats, limits)
    required = {"entries": jobs.required_entries, "jobs": jobs.required_jobs}[short]
    assert bool(jobs.overflow) and int(required) > 16
    assert not np.any(jobs.first) and not np.any(jobs.count) and np.all(np.asarray(jobs.slots.slot) == -1)
    features = jnp.ones((len(splats.depths), 1))
    geometry = jnp.concatenate([splats.means2d, splats.conics], -1)
    image, gradients = in_kernels(geometry, features, features, jobs, jnp.ones((1, 90, 360)))
    assert not np.any(image) and not any(np.any(leaf) for leaf in gradients)


@pytest.mark.parametrize("size", [(0, 8), (9, 7), (9, 30)])
def test_tiles_that_would_draw_another_image_are_refused(size):
    """Wider ones leave the widest footprints no room to wrap around."""
    with pytest.raises(ValueError, match="tiles of"):
        Tiling(*size)


def test_every_slot_is_that_of_its_gaussian(rng, monkeypatch):
    """What is added for a Gaussian is what its slots hold: each once, and no other."""
    splats = splats_of("all around", rng)
    jobs = jax.tree.map(np.asarray, planned(monkeypatch, splats, GPU_TILING, spare=100))
    begin, members = 0, jobs.gaussian.ravel()
    for gaussian, end in zip(jobs.slots.gaussian, jobs.slots.end, strict=True):
        slots = jobs.slots.slot[begin:end]
        own = slots[slots >= 0]
        assert (members[own] == gaussian).all() and len(own) == len(set(own.tolist())) == (members == gaussian).sum()
        begin = end
    assert (jobs.slots.slot[begin:] < 0).all() and begin == jobs.required_entries


@pytest.mark.heavy
def test_kernels_lower_for_cuda_and_nothing_is_added_atomically(rng):
    """A GPU gives the same bits again: the order of every sum is in the program."""
    gaussians, receiver, attenuation, signal = random_case(rng, n=60, dtype=np.float32)
    limits = TileLimits(8192, 1024, GPU_TILING.height, GPU_TILING.width)

    def brightness(gaussians, attenuation, signal):
        splats = project(gaussians, receiver)
        jobs = tiles.build_tile_jobs(splats, limits)
        return jnp.sum(composite.composite(splats.means2d, splats.conics, attenuation, signal, jobs) ** 2)

    program = jax.jit(jax.grad(brightness, (0, 1, 2))).trace(gaussians, attenuation, signal)
    text = program.lower(lowering_platforms=("cuda",)).as_text()
    assert [text.count(name) > 0 for name in ("splat_blend", "splat_chain", "splat_backward", "splat_collect")] == [True] * 4
    assert "atomic_rmw" not in text
    blending = text[: text.index("splat_collect")]
    assert "stablehlo.while" not in blending  # no loop whose every step waits for the host


def test_double_precision_is_left_to_the_other_form(rng, x64):
    """Kernels are of single precision; what is exact for tests stays so on a GPU."""
    gaussians, receiver, attenuation, signal = random_case(rng, n=60)
    splats = project(gaussians, receiver)
    jobs = tiles.build_tile_jobs(splats, TileLimits(8192, 1024))
    traced = jax.jit(lambda a: composite.composite(splats.means2d, splats.conics, a, signal, jobs)).trace(attenuation)
    assert "splat_blend" not in traced.lower(lowering_platforms=("cuda",)).as_text()
