"""Clutter against closed forms, and against a walk from cell to cell."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.propagation.transport import SAMPLES, Grid, attenuation, grid_around, smoothed

SHAPE, CELL = (7, 5, 4), 0.5
LOW = np.array([-1.0, 0.5, 0.0])
GRID = Grid(np.array(LOW, np.float32), np.array(CELL, np.float32))


def drawn_paths(rng, count=20):
    """Of up to four legs inside the grid; what is left of the five points is the last one again."""
    points = LOW + rng.uniform(0, 1, (count, 5, 3)) * CELL * np.array(SHAPE)
    legs = rng.integers(1, 5, count)
    return points[np.arange(count)[:, None], np.minimum(np.arange(5), legs[:, None])]


def walked(points, density):
    """Integral along one path and the number of cells on it: every leg is cut where it enters another cell."""
    total, pieces = 0.0, 0
    for start, end in pairwise(points):
        leg = end - start
        planes = [LOW[axis] + CELL * np.arange(SHAPE[axis] + 1) for axis in range(3)]
        cuts = np.concatenate([(planes[axis] - start[axis]) / leg[axis] for axis in range(3) if leg[axis]] or [[]])
        cuts = np.sort([0, *cuts[(cuts > 0) & (cuts < 1)], 1])
        middles = start + 0.5 * (cuts[1:] + cuts[:-1])[:, None] * leg
        cells = np.clip(np.floor((middles - LOW) / CELL).astype(int), 0, np.array(SHAPE) - 1)
        total += np.sum(np.diff(cuts) * np.linalg.norm(leg) * density[tuple(cells.T)])
        pieces += len(middles)
    return total, pieces


def test_it_is_the_integral_of_the_density(rng):
    points, density = drawn_paths(rng), rng.exponential(1.0, SHAPE)
    found = np.asarray(attenuation(jnp.asarray(points, jnp.float32), jnp.asarray(density, jnp.float32), GRID))
    for one, path in zip(found, points, strict=True):
        expected, pieces = walked(path, density)
        spacing = np.linalg.norm(np.diff(path, axis=0), axis=-1).sum() / SAMPLES
        assert abs(one - expected) <= pieces * spacing / 2 * np.ptp(density) + 1e-4  # half a step at every change


def test_of_one_density_everywhere_it_is_the_length_of_the_path(rng):
    points = rng.uniform(-5, 9, (30, 5, 3))  # beyond the grid too
    found = attenuation(jnp.asarray(points, jnp.float32), jnp.full(SHAPE, 0.7), GRID)
    np.testing.assert_allclose(found, 0.7 * np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(-1), rtol=1e-4)


def test_gradients_are_lengths_in_cells(rng):
    """Of the sum over all cells, the length; and those of cells far from the path are zero."""
    points = jnp.asarray(drawn_paths(rng, 1), jnp.float32)
    slope = jax.grad(lambda density: attenuation(points, density, GRID)[0])(jnp.zeros(SHAPE))
    length = np.linalg.norm(np.diff(np.asarray(points[0]), axis=0), axis=-1).sum()
    np.testing.assert_allclose(np.sum(slope), length, rtol=1e-4)
    dense = np.asarray(points[0])
    along = np.concatenate([a + np.linspace(0, 1, 400)[:, None] * (b - a) for a, b in pairwise(dense)])
    near = np.zeros(SHAPE, bool)
    near[tuple(np.clip(np.floor((along - LOW) / CELL).astype(int), 0, np.array(SHAPE) - 1).T)] = True
    assert np.sum(np.asarray(slope)[~near]) < 0.05 * length  # a point may lie just across a face


def test_a_path_of_no_length_loses_nothing_and_has_gradients(rng):
    points = jnp.asarray(np.repeat(rng.normal(size=(1, 1, 3)), 5, 1), jnp.float32)
    found, slope = jax.value_and_grad(lambda points: attenuation(points, jnp.ones(SHAPE), GRID)[0])(points)
    assert abs(found) < 1e-6
    assert np.all(np.isfinite(slope))


def test_smoothing_keeps_what_is_the_same_everywhere_and_spreads_the_rest(rng):
    np.testing.assert_allclose(smoothed(jnp.full(SHAPE, 1.3)), 1.3, rtol=1e-6)
    cell = tuple(rng.integers(1, np.array(SHAPE) - 1))
    spread = np.asarray(smoothed(jnp.zeros(SHAPE).at[cell].set(64.0)))
    around = spread[tuple(slice(i - 1, i + 2) for i in cell)]
    weights = np.array([1, 2, 1])
    np.testing.assert_allclose(around, weights[:, None, None] * weights[:, None] * weights, rtol=1e-6)
    assert spread.sum() == pytest.approx(64.0)


@pytest.mark.parametrize("most", [1, 50, 10_000])
def test_grids_hold_their_points_in_as_few_cells_as_asked(most, rng):
    points = rng.uniform(-3, 8, (40, 3))
    grid, shape = grid_around(points, 0.25, most)
    assert np.prod(shape) <= most
    assert grid.cell >= 0.25
    assert np.all(points >= grid.low - 1e-5)
    assert np.all(points <= grid.low + grid.cell * np.array(shape) + 1e-4)
