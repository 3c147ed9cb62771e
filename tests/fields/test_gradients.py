"""`fields.pas` is differentiable from parameters, receiver and query: every leaf against central finite differences.

In double precision, under `jit`, a directional derivative for every leaf. What the promise leaves out says so: the splatting
fields have no forward mode, and the wave field none with respect to the position of the receiver.
"""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import as_float64, box, mesh_of, rectangle, room
from builders.synthetic import FIELDS

from wbgs_jax import fields
from wbgs_jax._util.pytree import replaced, with_leaves
from wbgs_jax.data.scene import surface_from_points
from wbgs_jax.fields import coherent, get_field, wideband
from wbgs_jax.fields.nerf2 import Nerf2Config, Nerf2Field
from wbgs_jax.propagation.materials import Slabs
from wbgs_jax.propagation.paths import PathGeometry, TracedPaths
from wbgs_jax.propagation.transport import arrivals, specular_transport
from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array
from wbgs_jax.splat import TileLimits
from wbgs_jax.types import Query, Receiver, Transmitter

RX = (1.0, 1.0, 1.2)
LIMITS = TileLimits(entries=4096, jobs=1024)
STEPS = (1e-7, 2e-8, 3e-9)
"""A kink (the edge of a footprint at a pixel, a ReLU, a null of the array) may lie within the longest, hardly within all. Of
millions of them one sometimes does: the gradient is then that of one side."""
RELATIVE, ROUNDING = 2e-5, 1e-5
"""Tolerances: of the derivative and of the terms that it is the sum of; and what differences of sums over all pixels lose."""
SINGLE = {"spectra": 1e-4, "gradients": 5e-3}
"""How far single precision may be from double, of the norm; docs/limits.md states it. Measured: 1e-6, and of gradients 1e-5 in
most draws, 4e-4 in the worst of thirty leaves."""
UNUSED = {
    "wideband": {".antenna.exponents", "['power']"},
    "wrfgs": {".antenna.exponents", ".frequency_hz", "['power']"},
    "nerf2": {".antenna.exponents"},
    "wave": set(),
}
"""Leaves that do not enter, by a part of their names: what a model that sees no single paths knows of elements is where they
are, the network of the received power is none of the spectra's, and WRF-GS knows no frequency."""
INVARIANT = {"wave": {".log_gain"}}
"""Leaves that scale all snapshots alike, which a normalised spectrum does not show: zero up to rounding."""
OUTSIDE = {"wave": {".position"}}
"""Leaves that the promise leaves out."""
SLOW = ("wrfgs", "wave with edges")
"""The wideband field with less, and what compiles for long."""
MARKS = {"wave": pytest.mark.heavy, **dict.fromkeys(SLOW, pytest.mark.slow)}
NAMES = [pytest.param(name, marks=MARKS.get(name, ())) for name in (*UNUSED, "wave with edges")]


SMALL_VOLUME = dict.fromkeys(("skip", "point_octaves", "direction_octaves", "tx_octaves", "frequency_octaves"), 1)
SMALL_VOLUME |= {"samples": 2, "width": 4, "depth": 2, "radiance_widths": (4,)}


@cache
def single_field_of(name):
    """In single precision. The wave field's geometry is compiled in, and without edges it compiles in a third of the time."""
    if name.startswith("wave"):
        parts, materials = [*room(), rectangle((3, 0, 0), (0, 4, 0), (0, 0, 3))], [0, 0, 1, 1, 2, 2, 0]
        if name == "wave with edges":
            parts, materials = [*parts, box((4, 1, 0.5), (5, 2, 1.2))], [*materials, 2]
        tried = {"specular_tried": 32, "specular_kept": 16, "diffracted_tried": 32, "diffracted_kept": 16}
        config = dataclasses.replace(FIELDS["wave"], mirror_areas=(0.0,), **tried)
        made = coherent.make_field(mesh_of(*parts, material=materials), config)
        made = dataclasses.replace(made, known_thickness=jnp.array([0.0, 0.1, 0.0]))
    elif name == "nerf2":
        made = Nerf2Field(jnp.array([[0.0, 0, 0], [6, 4, 3]]), Nerf2Config(**SMALL_VOLUME))
    else:
        points = np.random.default_rng(0).uniform([0.2, 0.2, 0.9], [5.8, 3.8, 3], (20, 3))
        made = wideband.make_field(surface_from_points(points), FIELDS[name], get_field(name))
    return made


@cache
def field_of(name):
    """In double precision."""
    with jax.enable_x64(True):
        return as_float64(single_field_of(name))


def total_of(name, field=None):
    """The weighted sum of all pixels as a function, and the spectra."""
    field, position = field or field_of(name), jnp.asarray(np.array(RX))
    capacity = LIMITS if name in ("wideband", "wrfgs") else None

    def total(arguments, weights):
        params, receiver, query = arguments
        if name.startswith("wave"):  # found on the host: neither field nor position can be traced
            receiver = dataclasses.replace(receiver, position=position)
        spectra = fields.pas(field, params, receiver, query, capacity)
        return jnp.sum(spectra * weights), spectra

    return total


@cache
def differentiated(name, unit="wavelengths"):
    """The weighted sum and its gradient, jitted; the unit of the array is part of the arguments' structure."""
    return jax.jit(jax.value_and_grad(total_of(name), has_aux=True))


@cache
def evaluated(name):
    """The weighted sum alone. All but one are compiled with their gradients already, and evaluated in no time."""
    return jax.jit(total_of(name)) if name == "nerf2" else lambda *arguments: differentiated(name)(*arguments)[0]


def random_arguments(rng, name):
    """(params, receiver, query) as NumPy arrays: nothing is zero by its initialiser, and nothing is compiled to have them."""
    field = field_of(name)
    spread = 0.6 if name == "nerf2" else 0.3
    params = jax.tree.map(lambda a: rng.normal(0, spread, a.shape), jax.eval_shape(field.init, jax.random.key(0)))
    if name.startswith("wave"):
        start = np.log([3.0, 0.02, np.e, 0.1])  # log susceptibility, log conductivity, slope, log thickness
        materials = params.materials
        materials = with_leaves(materials, *(jax.tree.leaves(materials) + start[:, None]))
        params = replaced(params, materials=materials, placement=params.placement + np.log(3e-3))
    elif name != "nerf2":
        points, gaussians = np.asarray(field.surface.points), params.gaussians
        alive = np.arange(len(gaussians.means)) < len(points)
        changes = {
            "means": gaussians.means + np.pad(points, ((0, len(alive) - len(points)), (0, 0))),
            "log_scales": gaussians.log_scales - 1.5,
            "opacity_logits": np.where(alive, gaussians.opacity_logits, -np.inf),
        }
        params = replaced(params, gaussians=replaced(gaussians, **changes))
    orientation = np.array([1.0, 0, 0, 0]) + rng.normal(0, 0.2, 4)
    receiver = Receiver(*map(jnp.asarray, (np.array(RX), orientation, planar_array(3, 2, 0.4), np.array([0.7, 0.4]))))
    places = rng.uniform([1.5, 0.5, 0.5], [5.5, 3.5, 2.5], (2, 3)), rng.uniform(2e9, 4e9, 2)
    return jax.tree.map(np.asarray, (params, receiver, Query(*map(jnp.asarray, places))))


def has(path, names):
    return any(name in jax.tree_util.keystr(path) for name in names)


def disagreements(rng, name):
    """By leaf, what the gradient at a random point says and what finite differences say, where they do not agree."""
    kind = name.split()[0]
    arguments, weights = random_arguments(rng, name), rng.normal(size=(2, 90, 360))
    (value, spectra), gradients = differentiated(name)(arguments, weights)
    pixels = np.asarray(spectra).reshape(2, -1)
    assert np.isfinite(float(value)) and (pixels.std(1) > 0.01 * pixels.mean(1)).all()  # a uniform picture would test nothing
    leaves, structure = jax.tree.flatten(arguments)
    found = {}
    for i, (path, gradient) in enumerate(jax.tree_util.tree_leaves_with_path(gradients)):
        leaf, gradient, where = leaves[i], np.asarray(gradient), jax.tree_util.keystr(path)
        assert np.isfinite(gradient).all(), where
        if has(path, OUTSIDE.get(kind, ())):
            continue
        direction = rng.normal(size=leaf.shape) * (np.abs(leaf) if ".frequency_hz" in where else 1)

        def moved(t, i=i, direction=direction):
            changed = [*leaves[:i], leaves[i] + t * direction, *leaves[i + 1 :]]
            return float(evaluated(name)(jax.tree.unflatten(structure, changed), weights)[0])

        def slope(step, moved=moved):
            return (moved(step) - moved(-step)) / (2 * step)

        def slope_ahead(step, moved=moved):
            return (4 * moved(step) - moved(2 * step) - 3 * float(value)) / (2 * step)

        if has(path, UNUSED[kind]):
            assert not gradient.any() and slope(STEPS[0]) == 0, where
            continue
        exact, magnitude = np.sum(gradient * direction), np.linalg.norm(gradient * direction)
        if has(path, INVARIANT.get(kind, ())):
            assert abs(exact) < 1e-9 and abs(slope(1e-3)) < 1e-7, where
            continue
        if not gradient.any():  # all ReLUs of a narrow layer may be off, once in some hundred draws
            found[where] = "no gradient"
            continue
        tolerance = RELATIVE * (abs(exact) + magnitude) + ROUNDING
        tried = [*((slope, s) for s in STEPS), *((slope_ahead, s * side) for s in STEPS for side in (1, -1))]
        if not any(abs(by(step) - exact) < tolerance for by, step in tried):
            found[where] = f"{exact}, finite differences {[by(step) for by, step in tried]}"
    return found


@pytest.mark.heavy
@pytest.mark.parametrize("name", NAMES)
def test_every_leaf_agrees_with_central_finite_differences(rng, x64, name):
    """A wrong gradient is wrong everywhere; differences err where many kinks meet, and hardly at two points in turn."""
    if found := disagreements(rng, name):
        again = disagreements(rng, name)
        assert not found.keys() & again.keys(), {where: (found[where], again[where]) for where in found.keys() & again.keys()}


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["wideband", *(pytest.param(name, marks=pytest.mark.slow) for name in ("nerf2", "wave"))])
def test_single_precision_is_near_double(rng, x64, name):
    """Training is in single precision. At 2 to 4 GHz: phases at 94 GHz are in tests/propagation/test_transport.py."""
    arguments, weights = random_arguments(rng, name), rng.normal(size=(2, 90, 360))
    (_, spectra), gradients = differentiated(name)(arguments, weights)
    with jax.enable_x64(False):
        program = jax.jit(jax.value_and_grad(total_of(name, single_field_of(name)), has_aux=True))
        (_, found), single_gradients = program(*jax.tree.map(lambda a: np.asarray(a, np.float32), (arguments, weights)))
    assert found.dtype == np.float32
    assert distance(found, spectra) < SINGLE["spectra"]
    for (path, got), want in zip(
        jax.tree_util.tree_leaves_with_path(single_gradients), jax.tree.leaves(gradients), strict=True
    ):
        if not has(path, {*UNUSED[name], *INVARIANT.get(name, ()), *OUTSIDE.get(name, ())}):
            assert distance(got, want) < SINGLE["gradients"], jax.tree_util.keystr(path)


def distance(found, expected):
    """The norm of the difference by the norm of what is expected."""
    return np.linalg.norm(np.asarray(found, float) - expected) / np.linalg.norm(expected)


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["wideband", "wrfgs"])
def test_empty_slots_have_no_gradient(rng, x64, name):
    arguments = random_arguments(rng, name)
    _, (params, _, _) = differentiated(name)(arguments, rng.normal(size=(2, 90, 360)))
    empty = np.asarray(arguments[0].gaussians.opacity_logits) == -np.inf
    assert 0 < empty.sum() < len(empty)
    for leaf in jax.tree.leaves(params.gaussians):
        assert not np.asarray(leaf)[empty].any() and np.asarray(leaf)[~empty].any()


@pytest.mark.heavy
def test_materials_of_known_thickness_have_no_gradient_of_it(rng, x64):
    _, (params, _, _) = differentiated("wave")(random_arguments(rng, "wave"), rng.normal(size=(2, 90, 360)))
    assert (np.asarray(params.materials.log_thickness) != 0).tolist() == [True, False, True]


@pytest.mark.heavy
def test_what_is_no_path_has_no_gradient_and_spoils_none(x64):
    """Candidates without strength fill the list of paths up; their legs may have no length."""
    field = field_of("wave")
    plan = field.plan(None, Receiver(*map(jnp.asarray, (np.array(RX), np.array([1.0, 0, 0, 0]), np.zeros((1, 3)), np.ones(2)))))
    slabs = Slabs(jnp.full(7, 4 - 0.1j), jnp.full(7, 0.1))
    points = np.array([[[4.0, 3, 2], *[RX] * 4], [RX] * 5])
    nothing = jnp.zeros((2, 5), jnp.int32)

    @jax.jit
    @partial(jax.grad, argnums=(0, 1))
    def gradients(points, orientation):
        paths = TracedPaths((PathGeometry(points, nothing, nothing, nothing, jnp.array([True, False])),))
        receiver = dataclasses.replace(plan.receiver, orientation=orientation)
        found = arrivals(paths, plan.surfaces, slabs, jnp.asarray(3e9), receiver, (specular_transport,))
        return found.amplitude.real.sum()

    for gradient in map(np.asarray, gradients(jnp.asarray(points), plan.receiver.orientation)):
        assert np.isfinite(gradient).all() and gradient.any()
        assert gradient.ndim == 1 or not gradient[1].any()


def test_a_plan_from_outside_has_the_wrong_gradient(rng, x64):
    """The reason for `fields.pas`: what is planned outside of the differentiated function is a constant to it.

    Scales and rotations enter through the plan alone: their gradient is zero, without a warning.
    """
    arguments, weights = random_arguments(rng, "wideband"), rng.normal(size=(2, 90, 360))
    field, (params, receiver, query) = field_of("wideband"), jax.tree.map(jnp.asarray, arguments)
    _, (right, _, _) = differentiated("wideband")(arguments, weights)
    plan = jax.jit(lambda params: field.plan(params, receiver, capacity=LIMITS))(params)

    @jax.jit
    @jax.grad
    def gradients(params, plan):
        return jnp.sum(wideband.render(params, plan, query) * weights)

    wrong = gradients(params, plan)
    for name in ("log_scales", "quats"):
        assert not np.asarray(getattr(wrong.gaussians, name)).any()
        assert np.asarray(getattr(right.gaussians, name)).any()
    assert np.asarray(wrong.gaussians.means).any()  # a part: that of the networks' inputs
    assert relative(wrong.gaussians.means, right.gaussians.means) > 0.1
    # What does not pass through the plan is right.
    assert relative(wrong.gaussians.opacity_logits, right.gaussians.opacity_logits) < 1e-9


def relative(a, b):
    a, b = np.asarray(a), np.asarray(b)
    finite = np.isfinite(b)
    return np.abs(a - b)[finite].max() / np.abs(b[finite]).max()


DESIGN_HZ = 3e9


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["wideband", *(pytest.param(name, marks=pytest.mark.slow) for name in ("nerf2", "wave"))])
def test_an_array_in_metres_is_one_in_wavelengths_at_its_design_frequency(rng, x64, name):
    """The same spectrum and the same gradient; that of the frequency has a part more, for the array grows with it."""
    params, receiver, query = random_arguments(rng, name)
    query = replaced(query, frequency_hz=np.full(2, DESIGN_HZ))
    metre = DESIGN_HZ / SPEED_OF_LIGHT
    fixed = replaced(receiver, element_positions=receiver.element_positions / metre, unit="metres")
    for _ in range(3):  # by chance the part is none of one draw in a thousand
        weights = rng.normal(size=(2, 90, 360))
        (_, expected), (d_params, d_receiver, d_query) = differentiated(name)((params, receiver, query), weights)
        grown = np.sum(d_receiver.element_positions * receiver.element_positions) / DESIGN_HZ
        if abs(grown) > 1e-3 * np.abs(d_query.frequency_hz).max():
            break
    assert abs(grown) > 1e-3 * np.abs(d_query.frequency_hz).max()
    (_, found), gradients = differentiated(name, "metres")((params, fixed, query), weights)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(
        np.sum(gradients[2].frequency_hz), np.sum(d_query.frequency_hz) + grown, rtol=1e-6, atol=1e-6 * abs(grown)
    )
    same = replaced(d_receiver, element_positions=d_receiver.element_positions * metre)
    for (path, got), want in zip(
        jax.tree_util.tree_leaves_with_path((gradients[0], gradients[1], gradients[2].tx_position)),
        jax.tree.leaves((d_params, same, d_query.tx_position)),
        strict=True,
    ):
        scale = np.abs(want).max() + 1e-3
        np.testing.assert_allclose(got / scale, want / scale, atol=1e-8, err_msg=jax.tree_util.keystr(path))


@pytest.mark.parametrize("name", ["wideband", "wrfgs"])
def test_forward_mode_of_splatting_fields_is_refused(rng, x64, name):
    """Before anything is compiled; all ways to ask for it: tests/splat/test_reverse_mode.py."""
    field, arguments = field_of(name), jax.tree.map(jnp.asarray, random_arguments(rng, name))
    _, receiver, query = arguments
    render = jax.jit(lambda arguments: fields.pas(field, *arguments, LIMITS))
    with pytest.raises(TypeError, match="reverse mode only"):
        jax.jvp(render, (arguments,), (jax.tree.map(jnp.ones_like, arguments),))
    with pytest.raises(TypeError, match="reverse mode only"):
        jax.jacfwd(lambda tx: render((arguments[0], receiver, replaced(query, transmitter=Transmitter(tx)))))(query.tx_position)


def test_the_wave_field_says_that_its_mirror_images_are_found_on_the_host(rng, x64):
    field, (params, receiver, query) = field_of("wave"), random_arguments(rng, "wave")

    def total(receiver):
        return jnp.sum(fields.pas(field, params, receiver, query))

    for transformed in (jax.grad(total), jax.jit(total)):
        with pytest.raises(TypeError, match=r"mirror images on the host.*close over both"):
            transformed(jax.tree.map(jnp.asarray, receiver))
    with pytest.raises(TypeError, match="mirror images on the host"):
        jax.jit(lambda field: field.plan(params, jax.tree.map(jnp.asarray, receiver)))(field)
