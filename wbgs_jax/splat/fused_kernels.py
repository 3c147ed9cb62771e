"""Alpha blending in four Pallas kernels (Triton backend) for NVIDIA GPUs from Ampere on: what `composite.py` runs there.

A GPU with room for many thousands of threads needs all jobs at once, and XLA would write every intermediate result of a job to
memory. Therefore

* `_blend_kernel` blends every job independently, starting from a blank tile, and stores its image and transmittance;
* `_chain_kernel` joins the jobs of a tile from near to far and stores image and transmittance in front of every job;
* `_backward_kernel` blends a job again, behind what is in front of it, and stores the gradients of its slots;
* `_collect_kernel` sums those gradients for every Gaussian.

A program is one warp. It keeps a tile's pixels in lanes and the footprints of a job's 16 Gaussians in registers for all
queries. Lanes past the last pixel compute values that are never read. A fixed number of programs shares the jobs in use, so
spare capacity in the lists costs nothing. Sums over pixels would dominate the backward pass: the moments of the footprints are
a matrix product on tensor cores, and the other sums are taken over 16 arrays at once.

Nothing is added atomically: all sums have a fixed order, and a program gives the same bits on every run.

Triton neither contracts products and sums into fused multiply-adds here nor flushes subnormal numbers, so `fma`, `exp2` and
`reciprocal` are written as PTX instructions. In interpreted mode (plain operations on any device) they are ordinary formulas.
"""

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plt
from jaxtyping import Array, Float

from wbgs_jax.radio.geometry import AZIMUTH_PERIOD
from wbgs_jax.splat.projection import EDGE, GAIN
from wbgs_jax.splat.tiles import CHUNK, TileJobs, Tiling

_interpreting = ContextVar("interpreting", default=False)


def interpreting() -> bool:
    """Returns whether kernels traced now are to be interpreted."""
    return _interpreting.get()


@contextlib.contextmanager
def interpreted() -> Iterator[None]:
    """Makes kernels traced within this context run as plain operations: slowly, but on any device."""
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
    """Returns 2^x; results below 1e-38 are flushed to zero."""
    return jnp.exp2(x) if interpreting() else _instruction("ex2.approx.ftz.f32", x)


def reciprocal(x: Any) -> Any:
    """Returns 1 / x with an error of about one unit in the last place."""
    return 1 / x if interpreting() else _instruction("rcp.approx.ftz.f32", x)


def product(columns: Float[Array, "k m"], matrix: Float[Array, "k n"]) -> Float[Array, "m n"]:
    """Returns columns^T matrix at float32 accuracy; on tensor cores by three TF32 products."""
    precision: Any = lax.Precision.HIGHEST if interpreting() else lax.DotAlgorithmPreset.TF32_TF32_F32_X3
    return lax.dot_general(columns, matrix, (((0,), (0,)), ((), ())), precision=precision)


PROGRAMS = 132 * 32
"""Programs that share all jobs: as many as an H100 can hold at once. A smaller GPU runs them in several waves."""
QUERIES = 8
"""Maximum number of queries of a program, handled one after another; other programs take the next ones."""
LEVELS = 8
"""Jobs of a tile that are loaded at once while chaining, which hides the memory latency."""
HALF = CHUNK // 2
GEOMETRY = 5
"""Numbers that describe a footprint: the first columns of a Gaussian's row. Attenuation and signal of all queries follow."""
COLUMNS = 8
"""Columns of a row of footprint gradients; the last ones are zero."""
LOG2 = float(np.log(2))


def forward(
    geometry: Float[Array, "n 5"],
    attenuation: Float[Array, "n b"],
    signal: Float[Array, "n b"],
    jobs: TileJobs,
) -> tuple[Float[Array, "tiles b lanes"], Float[Array, "jobs b lanes"], Float[Array, "jobs b lanes"]]:
    """Returns the tiles' image, and image and transmittance in front of every job."""
    b, tiling = attenuation.shape[1], jobs.tiling
    of_jobs = jax.ShapeDtypeStruct((jobs.tile.shape[0], b, tiling.lanes), jnp.float32)
    of_tiles = jax.ShapeDtypeStruct((tiling.tiles, b, tiling.lanes), jnp.float32)
    blended = _call(
        partial(_blend_kernel, tiling),
        "splat_blend",
        _grid(jobs, b),
        (of_jobs, of_jobs),
        (jobs.gaussian, jobs.tile, _total(jobs), _rows(geometry, attenuation, signal)),
    )
    arguments = jobs.first, jobs.count, *blended
    return _call(_chain_kernel, "splat_chain", (tiling.tiles, b), (of_tiles, of_jobs, of_jobs), arguments, {2: 1, 3: 2})


def backward(
    geometry: Float[Array, "n 5"],
    attenuation: Float[Array, "n b"],
    signal: Float[Array, "n b"],
    jobs: TileJobs,
    image: Float[Array, "tiles b lanes"],
    front: Float[Array, "jobs b lanes"],
    transmittance: Float[Array, "jobs b lanes"],
    cotangent: Float[Array, "tiles b lanes"],
) -> tuple[Float[Array, "n 5"], Float[Array, "n b"], Float[Array, "n b"]]:
    """Returns the gradients of geometry, attenuation and signal. `cotangent` must be zero in lanes past the last pixel."""
    (n, b), slots = attenuation.shape, jobs.tile.shape[0] * CHUNK
    rows, to_arguments = jax.vjp(_rows, geometry, attenuation, signal)
    own = jobs.gaussian, jobs.tile, _total(jobs), rows
    of_slots = _call(
        partial(_backward_kernel, jobs.tiling),
        "splat_backward",
        _grid(jobs, b),
        (
            jax.ShapeDtypeStruct((_grid(jobs, b)[1], slots, COLUMNS), jnp.float32),
            jax.ShapeDtypeStruct((b, 2 * slots), jnp.float32),
        ),
        (*own, _monomials(jobs.tiling), image, front, transmittance, cotangent),
    )
    d_exponents, d_features = _call(
        _collect_kernel,
        "splat_collect",
        (min(n, PROGRAMS),),
        (jax.ShapeDtypeStruct((n, COLUMNS), jnp.float32), jax.ShapeDtypeStruct((n, 2 * _columns(b)), jnp.float32)),
        (jobs.slots.gaussian, jobs.slots.end, jobs.slots.slot, *of_slots),
    )
    parts = d_exponents[:, :GEOMETRY], d_features[:, :b], d_features[:, _columns(b) : _columns(b) + b]
    return to_arguments(jnp.pad(jnp.concatenate(parts, -1), ((0, 1), (0, 0))))


def _call(kernel: Callable[..., None], name: str, grid: Any, results: Any, arguments: Any, aliases: Any = None) -> Any:
    options: dict[str, Any] = {"grid": grid, "out_shape": results, "name": name, "input_output_aliases": aliases or {}}
    if interpreting():
        options["interpret"] = True
    else:
        options["compiler_params"] = plt.CompilerParams(num_warps=1, num_stages=1)
    return pl.pallas_call(kernel, **options)(*arguments)


def _grid(jobs: TileJobs, b: int) -> tuple[int, int]:
    return min(jobs.tile.shape[0], PROGRAMS), -(-b // QUERIES)


def _total(jobs: TileJobs) -> Any:
    """Returns the number of jobs in use."""
    return (jobs.first[-1] + jobs.count[-1])[None]


def _rows(
    geometry: Float[Array, "n 5"], attenuation: Float[Array, "n b"], signal: Float[Array, "n b"]
) -> Float[Array, "n_1 c"]:
    """Returns one row per Gaussian, and a row of zeros for empty slots: the centre (u, v), the coefficients A, B, C of the
    footprint's exponential exp(-q/2) = 2^(A dx^2 + B dx dy + C dy^2), and the attenuation and signal of every query."""
    exponents = geometry * jnp.array([1, 1, -0.5 / LOG2, -1 / LOG2, -0.5 / LOG2], geometry.dtype)
    return jnp.pad(jnp.concatenate([exponents, attenuation, signal], -1), ((0, 1), (0, 0)))


def _columns(b: int) -> int:
    """Returns the smallest power of two that is at least the number of queries."""
    return 1 << (b - 1).bit_length()


def _monomials(tiling: Tiling) -> Float[Array, "lanes monomials"]:
    table = tiling.monomials()
    # Columns of the matrix of monomials 1, x, y, x^2, xy, y^2, padded with zeros to a size that tensor cores accept.
    monomials = 16
    dead = tiling.lanes - tiling.pixels, monomials - table.shape[1]
    return jnp.asarray(np.pad(table, [(0, size) for size in dead]), jnp.float32)


# The kernels


def _blend_kernel(tiling, gaussian_ref, tile_ref, total_ref, rows_ref, image_ref, through_ref):
    b, queries = image_ref.shape[1], _own_queries(image_ref.shape[1])

    def of_job(job):
        rows, footprints = _footprints(tiling, gaussian_ref, rows_ref, job, plt.load(tile_ref.at[job]))

        def of_query(query, _):
            image, transmittance = jnp.zeros(tiling.lanes, jnp.float32), jnp.ones(tiling.lanes, jnp.float32)
            for row, footprint in zip(rows, footprints, strict=True):
                weight = plt.load(rows_ref.at[row, GEOMETRY + query]) * footprint * transmittance
                image = fma(plt.load(rows_ref.at[row, GEOMETRY + b + query]), weight, image)
                transmittance = transmittance - weight
            plt.store(image_ref.at[job, query, :], image)
            plt.store(through_ref.at[job, query, :], transmittance)

        lax.fori_loop(*queries, of_query, None)

    _shared_out(plt.load(total_ref.at[np.int32(0)]), of_job)


def _chain_kernel(first_ref, count_ref, image_ref, through_ref, out_ref, front_ref, transmittance_ref):
    tile, query, lanes = pl.program_id(0), pl.program_id(1), out_ref.shape[-1]
    first, count = plt.load(first_ref.at[tile]), plt.load(count_ref.at[tile])

    def of_levels(block, state):
        image, transmittance = state
        level = [block * LEVELS + i for i in range(LEVELS)]
        live = [jnp.broadcast_to(own < count, (lanes,)) for own in level]
        jobs = [first + jnp.minimum(own, count - 1) for own in level]
        masked_jobs = list(zip(jobs, live, strict=True))
        images = [plt.load(image_ref.at[job, query, :], mask=mask, other=0.0) for job, mask in masked_jobs]
        throughs = [plt.load(through_ref.at[job, query, :], mask=mask, other=1.0) for job, mask in masked_jobs]
        for (job, mask), own, through in zip(masked_jobs, images, throughs, strict=True):
            plt.store(front_ref.at[job, query, :], image, mask=mask)
            plt.store(transmittance_ref.at[job, query, :], transmittance, mask=mask)
            image, transmittance = image + transmittance * own, transmittance * through
        return image, transmittance

    blank = jnp.zeros(lanes, jnp.float32)
    image, _ = lax.fori_loop(0, (count + LEVELS - 1) // LEVELS, of_levels, (blank, blank + 1))
    plt.store(out_ref.at[tile, query, :], image)


def _backward_kernel(
    tiling, gaussian_ref, tile_ref, total_ref, rows_ref, monomials_ref,
    image_ref, front_ref, transmittance_ref, cotangent_ref, d_exponents_ref, d_features_ref,
):  # fmt: skip
    n, b, block, queries = rows_ref.shape[0] - 1, image_ref.shape[1], pl.program_id(1), _own_queries(image_ref.shape[1])

    def of_job(job):
        tile = plt.load(tile_ref.at[job])
        rows, footprints = _footprints(tiling, gaussian_ref, rows_ref, job, tile)

        def of_query(query, d_footprints):
            cotangent, transmittance = plt.load(cotangent_ref.at[tile, query, :]), plt.load(transmittance_ref.at[job, query, :])
            behind, d_found = plt.load(image_ref.at[tile, query, :]) - plt.load(front_ref.at[job, query, :]), []
            for half in range(0, CHUNK, HALF):  # one half after the other, to stay within the registers
                to_attenuation, to_signal = [], []
                for k in range(half, half + HALF):
                    attenuation = plt.load(rows_ref.at[rows[k], GEOMETRY + query])
                    signal = plt.load(rows_ref.at[rows[k], GEOMETRY + b + query])
                    alpha = attenuation * footprints[k]
                    weight = alpha * transmittance
                    behind = fma(-signal, weight, behind)
                    d_alpha = cotangent * fma(-behind, reciprocal(1 - alpha), signal * transmittance)
                    transmittance = transmittance - weight
                    d_found.append(fma(attenuation, d_alpha, d_footprints[k]))
                    to_attenuation.append(d_alpha * footprints[k])
                    to_signal.append(cotangent * weight)
                sums = jnp.sum(_stacked(to_attenuation + to_signal), axis=0)
                plt.store(d_features_ref.at[query, pl.ds((job * CHUNK + half) * 2, CHUNK)], sums)
            return tuple(d_found)

        d_footprints = lax.fori_loop(*queries, of_query, (jnp.zeros(tiling.lanes, jnp.float32),) * CHUNK)
        # Gradients of the exponents up to a factor log 2: on its support, the exponential is footprint / GAIN + EDGE.
        d_exponents = [jnp.where(g > 0, d * (g + EDGE * GAIN), 0.0) for g, d in zip(footprints, d_footprints, strict=True)]
        moments = product(_stacked(d_exponents), plt.load(monomials_ref.at[:, :]))
        which = lax.broadcasted_iota(jnp.int32, moments.shape, 1)
        m, mx, my, mxx, mxy, myy = (jnp.sum(jnp.where(which == k, moments, 0.0), axis=1) for k in range(6))
        gaussian = plt.load(gaussian_ref.at[job, :])
        row = jnp.where(gaussian >= 0, gaussian, n)
        u, v, a, b_, c = (plt.load(rows_ref.at[row, jnp.full_like(row, k)]) for k in range(GEOMETRY))
        u, v = _relative(tiling, u, v, tile)
        dx, dy = u * m - mx, v * m - my
        dxx, dxy, dyy = u * (dx - mx) + mxx, u * dy - v * mx + mxy, v * (dy - my) + myy
        found = [LOG2 * d for d in (2 * a * dx + b_ * dy, 2 * c * dy + b_ * dx, dxx, dxy, dyy)]
        found += [jnp.zeros_like(dx)] * (COLUMNS - GEOMETRY)
        plt.store(d_exponents_ref.at[block, pl.ds(job * CHUNK, CHUNK), :], _stacked(found))

    _shared_out(plt.load(total_ref.at[np.int32(0)]), of_job)


def _collect_kernel(gaussian_ref, end_ref, slot_ref, of_exponents_ref, of_features_ref, d_exponents_ref, d_features_ref):
    (blocks, _, columns), b, width = of_exponents_ref.shape, of_features_ref.shape[0], d_features_ref.shape[1] // 2
    entries = 16  # slots of a Gaussian whose gradients are loaded at once
    entry, column = lax.broadcasted_iota(jnp.int32, (entries,), 0), lax.broadcasted_iota(jnp.int32, (1, columns), 1)
    feature = lax.broadcasted_iota(jnp.int32, (1, 2 * width), 1)
    query, kind = jnp.minimum(feature % width, b - 1), feature // width

    def of_gaussian(rank):
        begin, end = jnp.where(rank > 0, plt.load(end_ref.at[jnp.maximum(rank - 1, 0)]), 0), plt.load(end_ref.at[rank])

        def of_entries(turn, state):
            d_exponents, d_features = state
            number = begin + turn * entries + entry
            slot = plt.load(slot_ref.at[jnp.minimum(number, slot_ref.shape[0] - 1)])
            live = ((number < end) & (slot >= 0))[:, None]
            slot = jnp.where(live, slot[:, None], 0)
            for block in range(blocks):
                found = plt.load(of_exponents_ref.at[jnp.full_like(slot, block), slot, column])
                d_exponents = d_exponents + jnp.sum(jnp.where(live, found, 0.0), axis=0)
            # Half a job stores the gradients of its attenuations first, then those of its signals.
            place = slot // HALF * CHUNK + slot % HALF + kind * HALF
            found = plt.load(of_features_ref.at[jnp.broadcast_to(query, place.shape), place])
            return d_exponents, d_features + jnp.sum(jnp.where(live, found, 0.0), axis=0)

        blank = jnp.zeros(columns, jnp.float32), jnp.zeros(2 * width, jnp.float32)
        d_exponents, d_features = lax.fori_loop(0, (end - begin + entries - 1) // entries, of_entries, blank)
        gaussian = plt.load(gaussian_ref.at[rank])
        plt.store(d_exponents_ref.at[gaussian, :], d_exponents)
        plt.store(d_features_ref.at[gaussian, :], d_features)

    _shared_out(gaussian_ref.shape[0], of_gaussian)


# Helpers


def _shared_out(count: Any, work: Callable[[Any], None]) -> None:
    """Runs this program's share of the work."""
    share, programs = pl.program_id(0), pl.num_programs(0)
    turns = (count - share + programs - 1) // programs
    lax.fori_loop(0, turns, lambda turn, _: work(share + turn * programs), None)


def _own_queries(b: int) -> tuple[Any, Any]:
    """Returns the range (first, end) of this program's queries."""
    first = pl.program_id(1) * QUERIES
    return first, jnp.minimum(first + QUERIES, b)


def _footprints(tiling: Tiling, gaussian_ref: Any, rows_ref: Any, job: Any, tile: Any) -> tuple[list[Any], list[Any]]:
    """Returns the row of each slot of a job, and its footprint (lanes,)."""
    lane, n = lax.broadcasted_iota(jnp.int32, (tiling.lanes,), 0), rows_ref.shape[0] - 1
    x, y = _centred(lane % tiling.width, tiling.width), _centred(lane // tiling.width, tiling.height)
    rows, footprints = [], []
    for slot in range(CHUNK):
        gaussian = plt.load(gaussian_ref.at[job, np.int32(slot)])
        row = jnp.where(gaussian >= 0, gaussian, n)
        u, v, a, b, c = (plt.load(rows_ref.at[row, np.int32(k)]) for k in range(GEOMETRY))
        u, v = _relative(tiling, u, v, tile)
        dx, dy = u - x, v - y
        exponential = exp2(fma(fma(a, dx, b * dy), dx, c * dy * dy))
        rows.append(row)
        footprints.append(jnp.maximum(fma(exponential, GAIN, -EDGE * GAIN), 0))
    return rows, footprints


def _centred(pixel: Any, size: int) -> Any:
    return pixel.astype(jnp.float32) - (size - 1) / 2


def _relative(tiling: Tiling, u: Any, v: Any, tile: Any) -> tuple[Any, Any]:
    """Returns centres relative to a tile's centre, at the nearest alias in azimuth."""
    u = u - (tile % tiling.columns).astype(jnp.float32) * tiling.width - (tiling.width - 1) / 2
    v = v - (tile // tiling.columns).astype(jnp.float32) * tiling.height - (tiling.height - 1) / 2
    return u - AZIMUTH_PERIOD * jnp.floor(u / AZIMUTH_PERIOD + 0.5), v


def _stacked(rows: list[Any]) -> Any:
    """Returns arrays of shape (lanes,), whose number is a power of two, as the columns of one array. Nothing moves: the
    registers only get new names."""
    count = len(rows)
    while len(rows) > 1:
        half = len(rows) // 2
        rows = [jnp.stack(pair, -1) for pair in zip(rows[:half], rows[half:], strict=True)]
    return rows[0].reshape(-1, count)
