"""Places are found again from what a field itself says of them; slopes against differences; two places that sound alike."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.mirrors import MirrorsField, trained, trained_field
from builders.rooms import METAL, field_of, rectangle
from builders.synthetic import RX

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.applications.locate import Locator, make_locator
from wbgs_jax.applications.multistart import best_apart, gauss_newton, grid_over, in_blocks
from wbgs_jax.fields.mixture import with_floor
from wbgs_jax.types import Query, make_receiver

HZ = np.array([1e9, 10e9])
BOX = np.array([[0.8, -1.7, 0.3], [2.7, 2.2, 2.5]])
"""Ahead of the array."""


RECEIVERS = [make_receiver(place) for place in (RX, [-2.5, 2.0, 1.5], [2.8, -1.8, 2.4], [2.5, 2.3, 0.4])]


@pytest.fixture(scope="module")
def by_spectra() -> Locator:
    return make_locator(trained(), HZ, box=BOX)


@pytest.fixture(scope="module")
def by_power() -> Locator:
    return make_locator(trained(), HZ[:1], "power", RECEIVERS, BOX)


def somewhere(rng, n=5):
    return rng.uniform(BOX[0] + 0.1, BOX[1] - 0.1, (n, 3)).astype(np.float32)


def mean_slope(slope_at, place, half):
    """The mean of a slope from `half` before a place to `half` behind it: slopes change within millimetres where two waves
    cancel."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    return weights @ [float(slope_at(place + x * half)) for x in nodes] / 2


def said(asked: Locator, place, quantity):
    """What the field says of a place, as an observation."""
    rows = []
    for plan in asked.plans:
        query = Query(jnp.tile(place, (len(asked.frequencies_hz), 1)), asked.frequencies_hz)
        rows.append(getattr(asked.field.render(asked.params, plan, query), quantity))
    return jnp.stack(rows)


def test_places_are_found_again_from_spectra(by_spectra, rng):
    """To 2 cm across their direction from the receiver, and in the median; how far away they are a spectrum may hardly say."""
    errors = []
    for place in somewhere(rng):
        found = by_spectra(said(by_spectra, place, "pas")[0])
        away, off = place - RX, np.asarray(found.position) - place
        errors.append(np.linalg.norm(off))
        assert np.linalg.norm(np.cross(off, away)) / np.linalg.norm(away) < 0.02
        assert errors[-1] < 0.15 and found.loss < 1e-4
        assert (found.other_losses >= found.loss).all()
    assert np.median(errors) < 0.02, errors


def test_places_are_found_again_from_powers_at_four_receivers(by_power, rng):
    for place in somewhere(rng):
        found = by_power(said(by_power, place, "power_db"))
        assert np.linalg.norm(found.position - place) < 0.03


def test_an_unknown_transmitted_power_does_not_matter(rng):
    asked = make_locator(trained(), HZ[:1], "power", RECEIVERS, BOX, known_power=False)
    place = somewhere(rng, 1)[0]
    losses = [
        asked.loss(jnp.asarray(place[None]), said(asked, place, "power_db").reshape(-1) + gain, 0.0)[0] for gain in (0.0, 17.0)
    ]
    np.testing.assert_allclose(losses, 0, atol=1e-6)


@pytree
class Noisy(MirrorsField):
    """One whose data had noise, as it has found."""

    def as_observed(self, params, pas):
        return with_floor(pas, 0.1)


def test_an_observation_has_the_noise_that_the_data_had(rng):
    field = Noisy()
    asked = make_locator(trained_field(field, field.init(jax.random.key(0))), HZ, box=BOX, step=2.0)
    place = jnp.asarray(somewhere(rng, 1)[0])
    clean = said(asked, place, "pas")[0]
    losses = [float(asked.loss(place[None], observed, 0.0)[0]) for observed in (with_floor(clean, 0.1), clean)]
    assert losses[0] == pytest.approx(0, abs=1e-6) and losses[1] > 1e-3


@pytest.mark.heavy
def test_front_and_back_of_a_planar_array_sound_alike(rng):
    asked = make_locator(
        trained(images=1), HZ, box=[RX - np.array([2, 1.5, 0.5]), RX + np.array([2, 1.5, 1.3])], step=1.0, starts=24
    )
    place = (RX + rng.uniform([0.8, -1, 0.2], [1.5, 1, 1.0])).astype(np.float32)
    twin = np.array([2 * RX[0] - place[0], *place[1:]], np.float32)
    observed = said(asked, place, "pas")[0]
    np.testing.assert_allclose(asked.loss(jnp.stack([place, twin]), observed, 0.0), 0, atol=1e-6)
    found = asked(observed)
    other_side = found.position.at[0].set(2 * RX[0] - found.position[0])
    np.testing.assert_allclose(asked.loss(other_side[None], observed, 0.0)[0], found.loss, atol=1e-5)


@pytest.mark.parametrize("what, quantity", [("spectra", "pas"), ("snapshots", "snapshots"), ("power", "power_db")])
def test_slopes_of_the_loss_are_differences(rng, what, quantity):
    asked = make_locator(trained(), HZ, what, box=BOX, step=2.0)
    place, aside = (jnp.asarray(x) for x in somewhere(rng, 2))
    observed = said(asked, place, quantity)[0]
    way = jnp.asarray(rng.normal(size=3), jnp.float32)
    loss = jax.jit(lambda x: asked.loss(x[None], observed, 0.0)[0])
    slope = mean_slope(lambda x: jax.grad(loss)(x) @ way, aside, 0.01 * way)
    ahead, behind = (loss(aside + h * way) for h in (0.01, -0.01))
    assert slope == pytest.approx(float(ahead - behind) / 0.02, rel=0.03, abs=2e-3)


@pytest.mark.heavy
def test_a_wall_of_metal_gives_the_coherent_field_slopes_too(rng):
    """One wave off a wall: the loss of a blurred and of a sharp answer has slopes that add up to differences."""
    sizes = {"specular_tried": 4, "specular_kept": 4, "diffracted_tried": 4, "diffracted_kept": 4, "mirror_areas": (0.0,)}
    field, params, plan = field_of([rectangle((-5, 3, -5), (15, 0, 0), (0, 0, 15))], (0, 0, 1), conductivity=METAL, **sizes)
    rest = jnp.float32([1e9]), jnp.asarray(BOX, jnp.float32), jnp.zeros((1, 3)), jnp.zeros((1, 1, 324))
    asked = Locator(field, params, (plan,), *rest, "spectra")
    loss = jax.jit(jax.value_and_grad(lambda x, pas, blur: asked.loss(x[None], pas, blur)[0]))
    aside = jnp.asarray(somewhere(rng, 1)[0])
    observed, way = jnp.asarray(rng.random((1, 90, 360)), jnp.float32), jnp.asarray(rng.normal(size=3), jnp.float32)
    for blur in (0.0, 0.2):
        ahead, behind = (float(loss(aside + h * way, observed, blur)[0]) for h in (0.003, -0.003))
        slope = mean_slope(lambda x, blur=blur: loss(x, observed, blur)[1] @ way, aside, 0.003 * way)
        assert (ahead - behind) / 0.006 == pytest.approx(slope, rel=0.03, abs=2e-3)


def test_an_observation_of_another_shape_and_a_field_that_knows_too_little_are_refused(by_spectra):
    with pytest.raises(ValueError, match="expected"):
        by_spectra(jnp.zeros((3, 90, 360)))
    with pytest.raises(UserError, match="is not enough"):
        make_locator(trained(), HZ[:1], "power", RECEIVERS[:1], BOX, known_power=False)
    with pytest.raises(UserError, match="predicts no snapshots"):
        make_locator(trained_field(Silent(), None), HZ, "snapshots")


def test_too_few_received_powers_are_no_match(by_power, rng):
    """Of which a transmitter of unknown power needs two."""
    unknown = make_locator(trained(), HZ[:1], "power", RECEIVERS, BOX, known_power=False)
    place = jnp.asarray(somewhere(rng, 1))
    for asked, observed in (
        (by_power, [np.nan] * 4),
        (by_power, [-300.0] * 4),
        (unknown, [-300.0, np.nan, -60.0, -300.0]),
    ):
        observed = jnp.array(observed)
        with pytest.raises(ValueError, match=r"at least [12] are needed"):
            asked(observed[:, None])
        with pytest.raises(ValueError, match=r"at least [12] are needed"):
            asked.loss(place, observed, 0.0)
    assert np.isfinite(by_power.loss(place, jnp.array([-60.0, *[np.nan] * 3]), 0.0)).all()


def test_losses_take_powers_of_receivers_and_frequencies(rng):
    asked = make_locator(trained(), HZ, "power", RECEIVERS[:2], BOX, step=2.0)
    place, aside = somewhere(rng, 2)
    observed = said(asked, place, "power_db")
    both = jnp.asarray(np.stack([place, aside]))
    losses = asked.loss(both, observed, 0.0)
    np.testing.assert_array_equal(losses, asked.loss(both, observed.reshape(-1), 0.0))
    np.testing.assert_allclose(losses[0], 0, atol=1e-6)


class Silent(MirrorsField):
    """Spectra alone."""

    outputs: ClassVar = ("pas",)


def test_the_descent_finds_the_least_squares_of_a_line_and_stays_in_its_box(rng):
    target, matrix = rng.uniform(-1, 1, 3), rng.normal(size=(5, 3))
    box = jnp.asarray([[-1.0] * 3, [1.0] * 3])

    def residuals(places, blur):
        return (places - jnp.asarray(target, jnp.float32)) @ jnp.asarray(matrix.T, jnp.float32)

    found = gauss_newton(residuals, jnp.zeros((2, 3)), box, np.float32([1.0, 0.1]), 4)
    np.testing.assert_allclose(found.place[0], target, atol=5e-3)
    cut = gauss_newton(residuals, jnp.zeros((1, 3)), 0.01 * box, np.float32([1.0]), 4)
    assert jnp.abs(cut.place).max() <= 0.01


def test_starts_stand_apart_and_blocks_are_the_whole(rng):
    places = jnp.asarray(grid_over(np.array([[0.0, 0, 0], [3, 2, 1]]), 0.5))
    assert len(places) == 6 * 4 * 2 and float(places.min()) == 0.25
    losses = jnp.asarray(rng.random(len(places)), jnp.float32)
    chosen = np.asarray(best_apart(places, losses, 4, 0.75))
    assert chosen[0] == int(losses.argmin())
    away = np.linalg.norm(places[chosen][:, None] - places[chosen], axis=-1)
    assert (away[~np.eye(4, dtype=bool)] >= 0.75).all()
    np.testing.assert_allclose(in_blocks(lambda some: some.sum(-1), places), places.sum(-1), rtol=1e-6)
    with pytest.raises(UserError, match="lowest corner first"):
        grid_over(np.array([[0.0, 0, 0], [1, -1, 1]]), 0.5)
