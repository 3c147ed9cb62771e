"""The tiled renderer against the dense reference, and both against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.radio.geometry import AZIMUTH_PERIOD
from wbgs_jax.splat import Capacity, Splats, composite, geometry_plan, measure_capacity, project, render_dense, render_splats
from wbgs_jax.splat.project import SUPPORT
from wbgs_jax.splat.tiles import CHUNK, build_tile_jobs
from wbgs_jax.types import Gaussians, Receiver

EXACT = 1e-12


def random_gaussians(rng, n, receiver, dtype=np.float64, dead=0.1, on_axis=True):
    """Gaussians all around a receiver, some below the horizon, one straight above it, some dead."""
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = np.abs(directions[:, 2]) * rng.choice([1, 1, 1, -0.3], n)
    ranges = rng.uniform(1, 6, n)
    local = directions * ranges[:, None]
    if on_axis:
        local[0] = [0, 0, 2.5]
    from wbgs_jax.radio.geometry import rotation_matrix

    means = local @ np.asarray(rotation_matrix(receiver.orientation)).T + np.asarray(receiver.position)
    log_scales = np.log(rng.uniform(0.05, 0.4, (n, 3)) * ranges[:, None] / 3)
    arrays = (means, log_scales, rng.normal(size=(n, 4)), np.zeros(n), rng.random(n) >= dead)
    return Gaussians(*(jnp.asarray(a, dtype) for a in arrays))


def random_case(rng, n=250, b=3, dtype=np.float64, on_axis=True):
    receiver = Receiver(*(jnp.asarray(a, dtype) for a in (rng.normal(size=3), rng.normal(size=4), np.zeros((1, 3)))))
    gaussians = random_gaussians(rng, n, receiver, dtype, on_axis=on_axis)
    attenuation, signal = jnp.asarray(rng.uniform(0, 0.99, (n, b)), dtype), jnp.asarray(rng.uniform(0, 1, (n, b)), dtype)
    return gaussians, receiver, attenuation, signal


render_planned = jax.jit(render_splats)


def render(gaussians, receiver, attenuation, signal):
    return render_planned(geometry_plan(gaussians, receiver), attenuation, signal)


def relative(a, b):
    return float(jnp.max(jnp.abs(a - b)) / jnp.maximum(jnp.max(jnp.abs(b)), 1))


@pytest.mark.parametrize("projection", ["hemisphere", "sphere"])
def test_tiles_equal_the_dense_reference_in_value_and_every_gradient(rng, x64, projection):
    gaussians, receiver, attenuation, signal = random_case(rng)
    cotangent = jnp.asarray(rng.normal(size=(3, 90, 360)))
    capacity = measure_capacity(project(gaussians, receiver, projection))
    probe = jnp.zeros((len(attenuation), 2))

    def tiled(gaussians, receiver, attenuation, signal, probe):
        plan = geometry_plan(gaussians, receiver, capacity, projection, probe)
        return jnp.sum(render_splats(plan, attenuation, signal) * cotangent)

    def dense(gaussians, receiver, attenuation, signal, probe):
        return jnp.sum(render_dense(project(gaussians, receiver, projection, probe), attenuation, signal) * cotangent)

    arguments = (gaussians, receiver, attenuation, signal, probe)
    value, gradients = jax.jit(jax.value_and_grad(tiled, argnums=range(5)))(*arguments)
    expected, expected_gradients = jax.jit(jax.value_and_grad(dense, argnums=range(5)))(*arguments)
    assert relative(value, expected) < EXACT
    for (path, got), want in zip(
        jax.tree_util.tree_leaves_with_path(gradients), jax.tree.leaves(expected_gradients), strict=True
    ):
        assert relative(got, want) < EXACT, jax.tree_util.keystr(path)
    assert all(
        float(jnp.abs(g).max()) > 0 for g in (gradients[0].means, gradients[0].log_scales, gradients[0].quats, *gradients[2:])
    )


def test_both_forms_draw_the_reference_whatever_the_spare_capacity(rng, x64):
    """The form by jobs is what devices other than CPUs run."""
    gaussians, receiver, attenuation, signal = random_case(rng)
    cotangent = jnp.asarray(rng.normal(size=(450, 3, 72)))
    fitting = geometry_plan(gaussians, receiver)
    spare = geometry_plan(gaussians, receiver, Capacity(len(fitting.jobs.gaussian) * 64, len(fitting.jobs.gaussian) + 256))
    geometry = jnp.concatenate([fitting.splats.means2d, fitting.splats.conics], -1)

    def image_and_gradients(form, jobs):
        def total(geometry, attenuation, signal):
            tiles = form(geometry, attenuation, signal, jobs)
            return jnp.sum(tiles * cotangent), tiles

        return jax.value_and_grad(total, argnums=range(3), has_aux=True)(geometry, attenuation, signal)

    image_and_gradients = jax.jit(image_and_gradients, static_argnums=0)
    expected = image_and_gradients(composite._by_tiles, fitting.jobs)
    assert all(float(jnp.abs(leaf).max()) > 0 for leaf in jax.tree.leaves(expected))
    for form, jobs in ((composite._by_jobs, fitting.jobs), (composite._by_tiles, spare.jobs), (composite._by_jobs, spare.jobs)):
        for got, want in zip(jax.tree.leaves(image_and_gradients(form, jobs)), jax.tree.leaves(expected), strict=True):
            assert relative(got, want) < EXACT


def test_what_runs_the_code_chooses_the_form(rng):
    """Not what traces it: lowered here for a CPU and for a GPU; neither holds the other's code."""
    gaussians, receiver, attenuation, signal = random_case(rng, n=20, dtype=np.float32)
    plan = geometry_plan(gaussians, receiver, Capacity(4096, 1024))
    traced = jax.jit(jax.grad(lambda a: jnp.sum(render_splats(plan, a, signal)))).trace(attenuation)
    cpu, cuda = (traced.lower(lowering_platforms=(platform,)).as_text() for platform in ("cpu", "cuda"))
    tiles, jobs = (f"tensor<{n}x3x72xf32>" for n in (composite.TILE_GROUP, 1024 // composite.JOB_GROUPS))
    assert (tiles in cpu, jobs in cpu) == (True, False)
    assert (tiles in cuda, jobs in cuda) == (False, True)


def test_plans_can_be_mapped_over(rng):
    cases = [random_case(rng, n=60, dtype=np.float32) for _ in range(2)]
    arguments = [(geometry_plan(case[0], case[1], Capacity(16384, 2048)), *case[2:]) for case in cases]
    gradient = jax.grad(lambda *args: jnp.sum(render_splats(*args) ** 2), argnums=(1, 2))
    mapped = jax.jit(jax.vmap(gradient))(*jax.tree.map(lambda *leaves: jnp.stack(leaves), *arguments))
    for i, own in enumerate(arguments):
        for got, want in zip(mapped, jax.jit(gradient)(*own), strict=True):
            assert relative(got[i], want) < 1e-4


def test_dense_reference_agrees_with_equation_6_written_pixel_by_pixel(rng, x64):
    gaussians, receiver, attenuation, signal = random_case(rng, n=40, b=1)
    splats = project(gaussians, receiver)
    image = np.asarray(render_dense(splats, attenuation, signal))[0]
    means, conics, depths = (np.asarray(a) for a in (splats.means2d, splats.conics, splats.depths))
    edge = np.exp(-(SUPPORT**2) / 2)
    for row, column in zip(rng.integers(0, 90, 60), rng.integers(0, 360, 60), strict=True):
        total, surviving = 0.0, 1.0
        for i in np.argsort(depths):
            if not np.isfinite(depths[i]):
                continue
            dx = (column - means[i, 0] + AZIMUTH_PERIOD / 2) % AZIMUTH_PERIOD - AZIMUTH_PERIOD / 2
            d = np.array([dx, row - means[i, 1]])
            q = d @ np.array([[conics[i, 0], conics[i, 1]], [conics[i, 1], conics[i, 2]]]) @ d
            g = max(np.exp(-q / 2) - edge, 0) / (1 - edge)
            alpha = float(attenuation[i, 0]) * g
            total += surviving * alpha * float(signal[i, 0])
            surviving *= 1 - alpha
        assert image[row, column] == pytest.approx(total, abs=1e-12)


def test_gradients_agree_with_finite_differences(rng, x64):
    gaussians, receiver, attenuation, signal = random_case(
        rng, n=60, b=2, on_axis=False
    )  # on the axis the azimuth has no derivative
    cotangent = jnp.asarray(rng.normal(size=(2, 90, 360)))
    capacity = measure_capacity(project(gaussians, receiver), slack=2.0)

    def objective(gaussians, attenuation, signal):
        return jnp.sum(render_splats(geometry_plan(gaussians, receiver, capacity), attenuation, signal) * cotangent)

    objective = jax.jit(objective)
    arguments = (gaussians, attenuation, signal)
    gradients = jax.grad(objective, argnums=(0, 1, 2))(*arguments)
    leaves, structure = jax.tree.flatten(arguments)
    for i, gradient in enumerate(jax.tree.leaves(gradients)):
        if not float(jnp.abs(gradient).max()):
            continue
        direction = jnp.asarray(rng.normal(size=gradient.shape))
        step = 1e-8

        def at(t, i=i, direction=direction):
            moved = [leaf + t * direction if j == i else leaf for j, leaf in enumerate(leaves)]
            return float(objective(*jax.tree.unflatten(structure, moved)))

        # A footprint may end at a pixel within the step; such a kink can spoil one side only.
        here, expected = at(0.0), float(jnp.sum(gradient * direction))
        sides = [(at(step) - here) / step, (here - at(-step)) / step]
        assert any(side == pytest.approx(expected, rel=1e-4, abs=1e-4) for side in sides), (expected, sides)


def test_float32_is_close_to_float64(rng, x64):
    gaussians, receiver, attenuation, signal = random_case(rng, n=400)
    exact = render(gaussians, receiver, attenuation, signal)
    single = jax.tree.map(lambda a: a.astype(jnp.float32), (gaussians, receiver, attenuation, signal))
    image = render(*single)
    assert image.dtype == jnp.float32
    # Where two depths are equal to rounding, or a splat is a hair's breadth thin, single precision may differ visibly.
    assert float(jnp.quantile(jnp.abs(image - exact), 0.999)) < 1e-3


def test_the_first_and_last_column_are_the_same_direction(rng):
    gaussians, receiver, attenuation, signal = random_case(rng, dtype=np.float32)
    image = np.asarray(render(gaussians, receiver, attenuation, signal))
    np.testing.assert_allclose(image[..., 0], image[..., -1], atol=1e-5)


def test_turning_the_scene_about_the_zenith_rolls_the_image(rng, x64):
    gaussians, receiver, attenuation, signal = random_case(rng)
    columns = int(rng.integers(1, 359))
    half = np.pi * columns / AZIMUTH_PERIOD
    turned_back = jnp.array([np.cos(half), 0, 0, -np.sin(half)])
    upright = Receiver(receiver.position, jnp.array([1.0, 0, 0, 0]), receiver.element_positions)
    turned = Receiver(receiver.position, turned_back, receiver.element_positions)
    still = render(gaussians, upright, attenuation, signal)
    image = render(gaussians, turned, attenuation, signal)
    rolled = jnp.roll(still[..., :-1], columns, axis=-1)
    # The Gaussian straight above is moved off the axis in a fixed direction, which does not turn with the scene.
    assert float(jnp.median(jnp.abs(image[..., :-1] - rolled))) < 1e-9
    assert float(jnp.abs(image[..., 30:, :-1] - rolled[..., 30:, :]).max()) < 1e-6


def test_one_opaque_gaussian_shows_its_signal_and_hides_what_is_behind(x64):
    receiver = Receiver(jnp.zeros(3), jnp.array([1.0, 0, 0, 0]), jnp.zeros((1, 3)))
    direction = jnp.array([1.0, 1.0, 1.0]) / jnp.sqrt(3)
    means = jnp.stack([direction * 2, direction * 4])
    gaussians = Gaussians(
        means, jnp.log(jnp.full((2, 3), 0.3)), jnp.tile(jnp.array([1.0, 0, 0, 0]), (2, 1)), jnp.zeros(2), jnp.ones(2)
    )
    splats = project(gaussians, receiver)
    x, y = np.asarray(splats.means2d[0])
    assert x == pytest.approx((np.pi / 4 + np.pi) / (2 * np.pi) * 359) and y == pytest.approx(
        np.arccos(3**-0.5) / (np.pi / 2) * 89
    )
    image = render(gaussians, receiver, jnp.array([[0.99], [0.99]]), jnp.array([[0.5], [1.0]]))[0]
    # At the pixel nearest to the centre G is almost 1: 0.99 * 0.5 in front, 1 % of 0.99 * 1.0 from behind.
    assert float(image[round(y), round(x)]) == pytest.approx(0.99 * 0.5 + 0.01 * 0.99, abs=0.02)
    swapped = render(gaussians, receiver, jnp.array([[0.99], [0.99]]), jnp.array([[1.0], [0.5]]))[0]
    assert float(swapped[round(y), round(x)]) == pytest.approx(0.99 + 0.01 * 0.99 * 0.5, abs=0.02)


def test_projected_covariance_matches_samples_of_a_small_gaussian(rng, x64):
    receiver = Receiver(jnp.array([0.5, -0.2, 1.0]), jnp.asarray(rng.normal(size=4)), jnp.zeros((1, 3)))
    gaussians = random_gaussians(rng, 30, receiver, dead=0)
    small = Gaussians(gaussians.means, gaussians.log_scales - 3, gaussians.quats, gaussians.opacity_logits, gaussians.alive)
    from wbgs_jax.radio.geometry import angles_to_pixel, covariance_factor, direction_to_angles, to_local

    splats = project(small, receiver)
    factor = covariance_factor(small.log_scales, small.quats)
    for i in range(1, 30):
        samples = small.means[i] + jnp.asarray(rng.normal(size=(20_000, 3))) @ factor[i].T
        pixels = angles_to_pixel(*direction_to_angles(to_local(samples - receiver.position, receiver.orientation)))
        if float(splats.means2d[i, 1]) < 15:  # near the pole the linearisation is not the sample covariance
            continue
        offset = pixels - splats.means2d[i]
        offset = offset.at[:, 0].add(-AZIMUTH_PERIOD * jnp.round(offset[:, 0] / AZIMUTH_PERIOD))
        sampled = np.cov(np.asarray(offset).T) + 0.3 * np.eye(2)
        a, b, c = np.asarray(splats.conics[i])
        np.testing.assert_allclose(np.linalg.inv([[a, b], [b, c]]), sampled, rtol=0.06, atol=0.02)


def test_dead_gaussians_change_nothing_and_get_no_gradient(rng):
    gaussians, receiver, attenuation, signal = random_case(rng, dtype=np.float32)
    poison = jnp.where(gaussians.alive[:, None] > 0, gaussians.means, jnp.asarray(receiver.position))
    poisoned = Gaussians(
        poison, gaussians.log_scales, gaussians.quats * gaussians.alive[:, None], gaussians.opacity_logits, gaussians.alive
    )
    a = render(gaussians, receiver, attenuation, signal)
    b = render(poisoned, receiver, attenuation, signal)
    np.testing.assert_array_equal(a, b)
    capacity = measure_capacity(project(poisoned, receiver))
    gradient = jax.grad(lambda g: jnp.sum(render_splats(geometry_plan(g, receiver, capacity), attenuation, signal)))(poisoned)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))
    assert float(jnp.abs(gradient.means[gaussians.alive == 0]).max()) == 0


@pytest.mark.parametrize("short", ["entries", "jobs"])
def test_overflow_is_flagged_counted_and_renders_nan(rng, short):
    gaussians, receiver, attenuation, signal = random_case(rng, dtype=np.float32)
    splats = project(gaussians, receiver)
    enough = build_tile_jobs(splats, measure_capacity(splats))
    assert not bool(enough.overflow)
    size = {"entries": 65536, "jobs": 1024, short: 256}
    plan = geometry_plan(gaussians, receiver, Capacity(**size))
    assert bool(plan.jobs.overflow)
    required = {"entries": plan.jobs.required_entries, "jobs": plan.jobs.required_jobs}[short]
    assert int(required) > 256
    assert bool(jnp.isnan(render_planned(plan, attenuation, signal)).all())


def test_tile_lists_hold_every_pair_that_a_brute_force_search_finds(rng):
    gaussians, receiver, *_ = random_case(rng, n=120, dtype=np.float32)
    splats = project(gaussians, receiver)
    jobs = build_tile_jobs(splats, measure_capacity(splats))
    assert jobs.gaussian.shape[1] == CHUNK
    listed = {(int(t), int(g)) for t, row in zip(jobs.tile, np.asarray(jobs.gaussian), strict=True) for g in row if g >= 0}
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
    for tile in range(450):
        first, count = int(jobs.first[tile]), int(jobs.count[tile])
        members = np.asarray(jobs.gaussian[first : first + count]).ravel()
        members = members[members >= 0]
        assert len(set(members.tolist())) == len(members)
        assert (np.diff(depths[members]) >= 0).all()


def test_capacity_cannot_be_measured_under_jit(rng):
    gaussians, receiver, *_ = random_case(rng, n=20, dtype=np.float32)
    with pytest.raises(ValueError, match="capacity"):
        jax.jit(lambda g: geometry_plan(g, receiver).jobs.count)(gaussians)


def test_splats_are_finite_for_gaussians_anywhere(rng):
    receiver = Receiver(jnp.zeros(3), jnp.array([1.0, 0, 0, 0]), jnp.zeros((1, 3)))
    means = jnp.array([[0, 0, 0], [0, 0, 1e-6], [1e-7, 0, 3], [0, 0, -2], [1e4, 0, 0], [1e-3, 1e-3, 1e-3]], jnp.float32)
    gaussians = Gaussians(means, jnp.zeros((6, 3)), jnp.tile(jnp.array([1.0, 0, 0, 0]), (6, 1)), jnp.zeros(6), jnp.ones(6))

    def total(g):
        splats = project(g, receiver)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in (splats.means2d, splats.conics, splats.depths)), splats

    (_, splats), gradient = jax.value_and_grad(total, has_aux=True)(gaussians)
    assert isinstance(splats, Splats)
    for leaf in (*jax.tree.leaves(splats), *jax.tree.leaves(gradient)):
        assert bool(jnp.isfinite(leaf).all())
