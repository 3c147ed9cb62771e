"""The tiled renderer against the dense reference, and both against closed forms."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.equation_six import pixel

from wbgs_jax.radio.geometry import (
    AZIMUTH_PERIOD,
    angles_to_pixel,
    covariance_factor,
    direction_to_angles,
    rotation_matrix,
    to_local,
)
from wbgs_jax.splat import (
    GeometryPlan,
    Splats,
    TileLimits,
    composite,
    geometry_plan,
    measure_limits,
    project,
    render_dense,
    render_splats,
)
from wbgs_jax.splat.tiles import CHUNK, CPU_TILING, GPU_TILING, build_tile_jobs, fit_limits, grown_slots, slots_for
from wbgs_jax.types import Gaussians, Receiver, make_receiver

EXACT = 1e-12
N, B = 160, 2
LIMITS = TileLimits(entries=32_768, jobs=2048)
"""They hold all cases of N Gaussians; what does not fit renders NaN."""


def receiver_at(position, orientation, dtype=np.float64) -> Receiver:
    return Receiver(*(jnp.asarray(a, dtype) for a in (position, orientation, np.zeros((1, 3)), np.zeros(2))))


def rotation_of(receiver):
    return np.asarray(jax.jit(rotation_matrix)(receiver.orientation))


def random_gaussians(rng, n, receiver, dtype=np.float64, empty=0.1, on_axis=True):
    """Gaussians all around a receiver, some below the horizon, one straight above it, and some empty slots."""
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = np.abs(directions[:, 2]) * rng.choice([1, 1, 1, -0.3], n)
    ranges = rng.uniform(1, 6, n)
    local = directions * ranges[:, None]
    if on_axis:
        local[0] = [0, 0, 2.5]
    means = local @ rotation_of(receiver).T + np.asarray(receiver.position)
    log_scales = np.log(rng.uniform(0.05, 0.4, (n, 3)) * ranges[:, None] / 3)
    logits = np.where(rng.random(n) < empty, -np.inf, rng.normal(size=n))
    return Gaussians(*(jnp.asarray(a, dtype) for a in (means, log_scales, rng.normal(size=(n, 4)), logits)))


def random_case(rng, n=N, dtype=np.float64, on_axis=True):
    receiver = receiver_at(rng.normal(size=3), rng.normal(size=4), dtype)
    gaussians = random_gaussians(rng, n, receiver, dtype, on_axis=on_axis)
    attenuation, signal = jnp.asarray(rng.uniform(0, 0.99, (n, B)), dtype), jnp.asarray(rng.uniform(0, 1, (n, B)), dtype)
    return gaussians, receiver, attenuation, signal


def single(tree):
    return jax.tree.map(lambda a: np.asarray(a, np.float32), tree)


render_planned = jax.jit(render_splats)


def render(gaussians, receiver, attenuation, signal, limits=LIMITS):
    return np.asarray(render_planned(geometry_plan(gaussians, receiver, limits), attenuation, signal))


@jax.jit
@partial(jax.value_and_grad, argnums=range(3))
def tiled(splats, attenuation, signal, jobs, cotangent):
    return jnp.sum(render_splats(GeometryPlan(splats, jobs), attenuation, signal) * cotangent)


@jax.jit
@partial(jax.value_and_grad, argnums=range(3))
def dense(splats, attenuation, signal, cotangent):
    return jnp.sum(render_dense(splats, attenuation, signal) * cotangent)


@partial(jax.jit, static_argnames="projection")
def gradients_of(d_splats, gaussians, receiver, probe, projection):
    """Of what splats are made of, from those of the splats."""
    return jax.vjp(lambda *made_of: project(*made_of[:2], projection, made_of[2]), gaussians, receiver, probe)[1](d_splats)


def tiled_gradients(gaussians, receiver, attenuation, signal, probe, cotangent, projection="hemisphere"):
    """The weighted sum of all pixels, and its gradient with respect to the first five arguments, by the tiles."""
    plan = geometry_plan(gaussians, receiver, LIMITS, projection, probe)
    value, (d_splats, *others) = tiled(plan.splats, attenuation, signal, plan.jobs, cotangent)
    *made_of, d_probe = gradients_of(d_splats, gaussians, receiver, probe, projection)
    return value, (*made_of, *others, d_probe)


def dense_gradients(gaussians, receiver, attenuation, signal, probe, cotangent, projection="hemisphere"):
    """The same by the dense reference."""
    splats = project(gaussians, receiver, projection, probe)
    value, (d_splats, *others) = dense(splats, attenuation, signal, cotangent)
    *made_of, d_probe = gradients_of(d_splats, gaussians, receiver, probe, projection)
    return value, (*made_of, *others, d_probe)


def relative(a, b):
    a, b = np.asarray(a), np.asarray(b)
    return np.abs(a - b).max() / max(np.abs(b).max(), 1)


@pytest.mark.parametrize("projection", ["hemisphere", "sphere"])
def test_tiles_equal_the_dense_reference_in_value_and_every_gradient(rng, x64, projection):
    arguments = (*random_case(rng), jnp.zeros((N, 2)), rng.normal(size=(B, 90, 360)))
    value, gradients = tiled_gradients(*arguments, projection)
    expected, expected_gradients = dense_gradients(*arguments, projection)
    assert relative(value, expected) < EXACT
    for (path, got), want in zip(
        jax.tree_util.tree_leaves_with_path(gradients), jax.tree.leaves(expected_gradients), strict=True
    ):
        assert relative(got, want) < EXACT, jax.tree_util.keystr(path)
    reached = (gradients[0].means, gradients[0].log_scales, gradients[0].quats, *gradients[2:])
    assert all(np.abs(g).max() > 0 for g in (*reached, gradients[1].position, gradients[1].orientation))


@pytest.mark.heavy
@pytest.mark.parametrize("tiling", [CPU_TILING, GPU_TILING])
def test_tiles_of_any_size_draw_the_reference_whatever_the_spare_room(tiling, rng, x64):
    """Wide Gaussians give a tile several jobs. The last row of a GPU's tiles reaches beyond the image."""
    gaussians, receiver, attenuation, signal = random_case(rng)
    gaussians = dataclasses.replace(gaussians, log_scales=gaussians.log_scales + np.log(4))
    attenuation = attenuation / 3  # so that what is behind is seen
    cotangent = rng.normal(size=(B, 90, 360))
    splats = project(gaussians, receiver)
    spare = build_tile_jobs(splats, TileLimits(65_536, 8192, tiling.height, tiling.width))
    assert not spare.overflow and int(spare.count.max()) >= 4
    fitting = build_tile_jobs(splats, fit_limits(int(spare.required_entries), int(spare.required_jobs), 1.0, tiling))
    assert not fitting.overflow and len(fitting.gaussian) < len(spare.gaussian)
    expected = dense(splats, attenuation, signal, cotangent)
    assert all(
        np.abs(leaf).max() > 0 for leaf in (expected[0], expected[1][0].means2d, expected[1][0].conics, *expected[1][1:])
    )
    for jobs in (spare, fitting):
        found = tiled(splats, attenuation, signal, jobs, cotangent)
        for got, want in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            assert relative(got, want) < EXACT


@pytest.mark.heavy
def test_what_runs_the_code_chooses_the_form(rng):
    """Not what traces it: lowered here for a CPU and for a GPU; neither holds the other's code."""
    gaussians, receiver, attenuation, signal = random_case(rng, dtype=np.float32)
    plan = geometry_plan(gaussians, receiver, LIMITS)
    traced = jax.jit(jax.grad(lambda a: jnp.sum(render_splats(plan, a, signal)))).trace(attenuation)
    cpu, cuda = (traced.lower(lowering_platforms=(platform,)).as_text() for platform in ("cpu", "cuda"))
    by_tiles, by_jobs = f"tensor<{composite.TILE_GROUP}x{B}x72xf32>", "splat_blend"
    assert (by_tiles in cpu, by_jobs in cpu) == (True, False)
    assert (by_tiles in cuda, by_jobs in cuda) == (False, True)


def test_plans_can_be_mapped_over(rng, x64):
    cases, cotangent = [random_case(rng) for _ in range(2)], jnp.asarray(rng.normal(size=(B, 90, 360)))
    plans = [geometry_plan(gaussians, receiver, LIMITS) for gaussians, receiver, *_ in cases]
    arguments = [(plan.splats, *case[2:], plan.jobs, cotangent) for plan, case in zip(plans, cases, strict=True)]
    mapped = jax.jit(jax.vmap(tiled))(*jax.tree.map(lambda *leaves: np.stack(leaves), *arguments))
    for i, own in enumerate(arguments):
        for got, want in zip(jax.tree.leaves(mapped), jax.tree.leaves(tiled(*own)), strict=True):
            assert relative(got[i], want) < EXACT


def test_dense_reference_agrees_with_equation_6_written_pixel_by_pixel(rng, x64):
    gaussians, receiver, attenuation, signal = random_case(rng)
    splats = project(gaussians, receiver)
    image = np.asarray(jax.jit(render_dense)(splats, attenuation, signal))
    splats, attenuation, signal = jax.tree.map(np.asarray, (splats, attenuation, signal))
    for query, row, column in zip(rng.integers(0, B, 60), rng.integers(0, 90, 60), rng.integers(0, 360, 60), strict=True):
        expected = pixel(splats, attenuation[:, query], signal[:, query], row, column)
        assert image[query, row, column] == pytest.approx(expected, abs=1e-12)


def test_gradients_agree_with_finite_differences(rng, x64):
    # On the axis the azimuth has no derivative.
    arguments, cotangent = (*random_case(rng, on_axis=False), jnp.zeros((N, 2))), rng.normal(size=(B, 90, 360))
    value, gradients = tiled_gradients(*arguments, cotangent)
    leaves, structure = jax.tree.flatten(arguments)
    here, step = float(value), 1e-8
    for i, (path, gradient) in enumerate(jax.tree_util.tree_leaves_with_path(gradients)):
        gradient = np.asarray(gradient)
        if not np.abs(gradient).max():
            assert any(name in jax.tree_util.keystr(path) for name in ("opacity", "element_positions", "antenna.exponents"))
            continue
        direction = rng.normal(size=gradient.shape)

        def at(t, i=i, direction=direction):
            moved = [jnp.asarray(np.asarray(leaf) + t * direction) if j == i else leaf for j, leaf in enumerate(leaves)]
            gaussians, receiver, attenuation, signal, probe = jax.tree.unflatten(structure, moved)
            plan = geometry_plan(gaussians, receiver, LIMITS, means2d_offset=probe)
            return float(tiled(plan.splats, attenuation, signal, plan.jobs, cotangent)[0])

        # A footprint may end at a pixel within the step; such a kink can spoil one side only.
        expected = np.sum(gradient * direction)
        sides = [(at(step) - here) / step, (here - at(-step)) / step]
        assert any(side == pytest.approx(expected, rel=1e-4, abs=1e-4) for side in sides), (expected, sides)


def test_float32_is_close_to_float64(rng, x64):
    case = random_case(rng)
    exact = render(*case)
    with jax.enable_x64(False):
        image = render(*single(case))
    assert image.dtype == np.float32
    # Where two depths are equal to rounding, or a splat is a hair's breadth thin, single precision may differ visibly.
    assert np.quantile(np.abs(image - exact), 0.999) < 1e-3


def test_the_first_and_last_column_are_the_same_direction(rng):
    image = render(*random_case(rng, dtype=np.float32))
    np.testing.assert_allclose(image[..., 0], image[..., -1], atol=1e-5)


def test_turning_the_scene_about_the_zenith_rolls_the_image(rng, x64):
    gaussians, receiver, attenuation, signal = random_case(rng)
    columns = int(rng.integers(1, 359))
    half = np.pi * columns / AZIMUTH_PERIOD
    upright = receiver_at(receiver.position, [1.0, 0, 0, 0])
    turned = receiver_at(receiver.position, [np.cos(half), 0, 0, -np.sin(half)])
    still, image = (render(gaussians, rx, attenuation, signal) for rx in (upright, turned))
    rolled = np.roll(still[..., :-1], columns, axis=-1)
    # The Gaussian straight above is moved off the axis in a fixed direction, which does not turn with the scene.
    assert np.median(np.abs(image[..., :-1] - rolled)) < 1e-9
    assert np.abs(image[..., 30:, :-1] - rolled[..., 30:, :]).max() < 1e-6


def padded(values, fill=0.0):
    """As many rows as the other cases have."""
    values = np.asarray(values, float)
    return np.concatenate([values, np.full((N - len(values), *values.shape[1:]), fill)])


def test_one_opaque_gaussian_shows_its_signal_and_hides_what_is_behind(x64):
    receiver = receiver_at(np.zeros(3), [1.0, 0, 0, 0])
    direction = np.array([1.0, 1.0, 1.0]) / np.sqrt(3)
    means, quats = padded(np.stack([direction * 2, direction * 4])), np.tile([1.0, 0, 0, 0], (N, 1))
    gaussians = Gaussians(*map(jnp.asarray, (means, np.full((N, 3), np.log(0.3)), quats, padded(np.zeros(2), -np.inf))))
    x, y = np.asarray(project(gaussians, receiver).means2d[0])
    assert x == pytest.approx((np.pi / 4 + np.pi) / (2 * np.pi) * 359)
    assert y == pytest.approx(np.arccos(3**-0.5) / (np.pi / 2) * 89)
    # At the pixel nearest to the centre G is almost 1: 0.99 * 0.5 in front, 1 % of 0.99 * 1.0 from behind; and swapped.
    image = render(gaussians, receiver, padded(np.full((2, B), 0.99)), padded([[0.5, 1.0], [1.0, 0.5]]))
    first, swapped = image[:, round(y), round(x)]
    assert first == pytest.approx(0.99 * 0.5 + 0.01 * 0.99, abs=0.02)
    assert swapped == pytest.approx(0.99 + 0.01 * 0.99 * 0.5, abs=0.02)


@jax.jit
def _pixels(samples, receiver):
    return angles_to_pixel(*direction_to_angles(to_local(samples - receiver.position, receiver.orientation)))


def test_projected_covariance_matches_samples_of_a_small_gaussian(rng, x64):
    receiver = receiver_at([0.5, -0.2, 1.0], rng.normal(size=4))
    gaussians = random_gaussians(rng, N, receiver, empty=0)
    small = dataclasses.replace(gaussians, log_scales=gaussians.log_scales - 3)
    splats = jax.tree.map(np.asarray, project(small, receiver))
    factor = np.asarray(jax.jit(covariance_factor)(small.log_scales, small.quats))
    samples = np.asarray(small.means)[:30, None] + np.einsum("nij,nsj->nsi", factor[:30], rng.normal(size=(30, 20_000, 3)))
    pixels = np.asarray(_pixels(jnp.asarray(samples), receiver))
    for i in range(1, 30):
        if splats.means2d[i, 1] < 15:  # near the pole the linearisation is not the sample covariance
            continue
        offset = pixels[i] - splats.means2d[i]
        offset[:, 0] -= AZIMUTH_PERIOD * np.round(offset[:, 0] / AZIMUTH_PERIOD)
        sampled = np.cov(offset.T) + 0.3 * np.eye(2)
        a, b, c = splats.conics[i]
        np.testing.assert_allclose(np.linalg.inv([[a, b], [b, c]]), sampled, rtol=0.06, atol=0.02)


def test_empty_slots_change_nothing_and_get_no_gradient(rng, x64):
    gaussians, receiver, attenuation, signal = random_case(rng)
    alive = np.asarray(gaussians.alive)
    assert not alive.all() and np.array_equal(alive, np.asarray(gaussians.opacity_logits) > -np.inf)
    poisoned = dataclasses.replace(
        gaussians,
        means=jnp.asarray(np.where(alive[:, None], gaussians.means, receiver.position)),
        quats=jnp.asarray(np.where(alive[:, None], gaussians.quats, 0)),
    )
    a, b = (render(g, receiver, attenuation, signal) for g in (gaussians, poisoned))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a).max() > 0
    _, (gradient, _, d_attenuation, d_signal, d_probe) = tiled_gradients(
        poisoned, receiver, attenuation, signal, jnp.zeros((N, 2)), np.ones((B, 90, 360))
    )
    for leaf in (*jax.tree.leaves(gradient), d_attenuation, d_signal, d_probe):
        assert np.isfinite(leaf).all() and not np.asarray(leaf)[~alive].any()


@pytest.mark.parametrize("short", ["entries", "jobs"])
def test_overflow_is_flagged_counted_and_renders_nan(rng, short):
    gaussians, receiver, attenuation, signal = random_case(rng, dtype=np.float32)
    splats = project(gaussians, receiver)
    enough = build_tile_jobs(splats, LIMITS)
    assert not bool(enough.overflow)
    limits = TileLimits(**({"entries": LIMITS.entries, "jobs": LIMITS.jobs} | {short: 256}))
    jobs = build_tile_jobs(splats, limits)
    assert bool(jobs.overflow)
    required = {"entries": jobs.required_entries, "jobs": jobs.required_jobs}[short]
    assert int(required) > 256
    if short == "entries":
        assert int(required) == int(enough.required_entries)  # known at once, for limits that hold
    assert np.isnan(render(gaussians, receiver, attenuation, signal, limits=limits)).all()


def test_tile_lists_hold_every_pair_that_a_brute_force_search_finds(rng):
    gaussians, receiver, *_ = random_case(rng, dtype=np.float32)
    splats = project(gaussians, receiver)
    jobs = jax.tree.map(np.asarray, build_tile_jobs(splats, LIMITS))
    assert not jobs.overflow and jobs.gaussian.shape[1] == CHUNK
    listed = {(int(t), int(g)) for t, row in zip(jobs.tile, jobs.gaussian, strict=True) for g in row if g >= 0}
    means, conics, alive = (np.asarray(a, np.float64) for a in (splats.means2d, splats.conics, gaussians.alive))
    rows, columns = np.mgrid[0:90, 0:360]
    needed = set()
    for i in np.flatnonzero(alive):
        dx = columns - means[i, 0]
        dx -= AZIMUTH_PERIOD * np.round(dx / AZIMUTH_PERIOD)
        dy = rows - means[i, 1]
        touched = conics[i, 0] * dx**2 + 2 * conics[i, 1] * dx * dy + conics[i, 2] * dy**2 < 8.999
        needed |= {(int(t), int(i)) for t in np.unique((rows[touched] // 9) * 45 + columns[touched] // 8)}
    assert needed <= listed
    depths = np.asarray(splats.depths)
    for first, count in zip(jobs.first, jobs.count, strict=True):
        members = jobs.gaussian[first : first + count].ravel()
        members = members[members >= 0]
        assert len(set(members.tolist())) == len(members)
        assert (np.diff(depths[members]) >= 0).all()


def test_limits_hold_what_is_measured_and_come_from_buckets(rng):
    gaussians, receiver, *_ = random_case(rng, dtype=np.float32)
    splats = project(gaussians, receiver)
    jobs = build_tile_jobs(splats, LIMITS)
    limits = measure_limits(splats)
    assert limits == fit_limits(int(jobs.required_entries), int(jobs.required_jobs))
    assert limits.entries >= 1.25 * jobs.required_entries and limits.jobs >= 1.25 * jobs.required_jobs
    counts = np.geomspace(1, 1e6, 500).astype(int)
    sizes = np.array([[limits.entries, limits.jobs] for limits in (fit_limits(n, n) for n in counts.tolist())])
    assert (np.diff(sizes, axis=0) >= 0).all() and len(np.unique(sizes[:, 0])) < 25


def test_slots_hold_the_gaussians_and_change_rarely():
    slots = [slots_for(n) for n in range(1, 5000)]
    assert all(n <= size <= max(64, 1.25 * n + 16) for n, size in enumerate(slots, 1))
    assert len(set(slots)) < 30


def test_slots_double_where_gaussians_outgrow_them_and_never_exceed_the_most(rng):
    """A field of any size is compiled once for each doubling."""
    assert [grown_slots(64, n, 10_000) for n in (10, 64, 65, 128)] == [64, 64, 128, 128]
    for most in rng.integers(100, 90_000, 20).tolist():
        slots, sizes = slots_for(64), []
        for gaussians in [*sorted(rng.integers(64, most, 300).tolist()), most]:
            slots = grown_slots(slots, gaussians, most)
            assert gaussians <= slots <= max(64, most + 15)
            sizes.append(slots)
        assert len(set(sizes)) <= np.ceil(np.log2(most / 64)) + 1 and sizes == sorted(sizes)


def test_limits_cannot_be_measured_under_jit(rng):
    gaussians, receiver, *_ = random_case(rng, dtype=np.float32)
    with pytest.raises(ValueError, match="limits"):
        jax.jit(lambda g: geometry_plan(g, receiver).jobs.count)(gaussians)


def test_splats_are_finite_for_gaussians_anywhere():
    receiver = make_receiver((0, 0, 0))
    means = jnp.array([[0, 0, 0], [0, 0, 1e-6], [1e-7, 0, 3], [0, 0, -2], [1e4, 0, 0], [1e-3, 1e-3, 1e-3]], jnp.float32)
    gaussians = Gaussians(means, jnp.zeros((6, 3)), jnp.tile(jnp.array([1.0, 0, 0, 0]), (6, 1)), jnp.zeros(6))

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def total(g):
        splats = project(g, receiver)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in (splats.means2d, splats.conics, splats.depths)), splats

    (_, splats), gradient = total(gaussians)
    assert isinstance(splats, Splats)
    for leaf in (*jax.tree.leaves(splats), *jax.tree.leaves(gradient)):
        assert np.isfinite(leaf).all()
