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
from rooms import as_float64, mesh_of, rectangle, room
from synthetic import FIELDS

from wbgs_jax import fields
from wbgs_jax.data.surface import surface_from_points
from wbgs_jax.fields import get_field, wave, wideband
from wbgs_jax.fields.nerf2 import Nerf2Field
from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array
from wbgs_jax.splat import TileLimits
from wbgs_jax.types import Query, Receiver, make_query, make_receiver

RX = (1.0, 1.0, 1.2)
LIMITS = TileLimits(entries=4096, jobs=1024)
STEPS = (1e-7, 3e-9)
"""A kink (the edge of a footprint at a pixel, a ReLU) may lie within the longer one, hardly within both."""
UNUSED = {
    "wideband": {".pattern_exponent"},
    "wrfgs": {".pattern_exponent", ".frequency_hz"},
    "nerf2": {".pattern_exponent"},
    "wave": set(),
}
"""Leaves that do not enter, by the end of their names: what a model that sees no single paths knows of elements is where they
are, and WRF-GS knows no frequency."""
INVARIANT = {"wave": {".log_gain"}}
"""Leaves that scale all snapshots alike, which a normalised spectrum does not show: zero up to rounding."""
OUTSIDE = {"wave": {".position"}}
"""Leaves that the promise leaves out."""


@cache
def field_of(name):
    """In double precision; its geometry is the same in all tests, because the wave field's is compiled in."""
    if name == "wave":
        materials = [0, 0, 1, 1, 1, 1, 2]
        mesh = mesh_of(*room(), rectangle((3, 0, 0), (0, 4, 0), (0, 0, 3)), material=materials)
        config = dataclasses.replace(
            FIELDS[name], mirror_areas=(0.0,), specular_tried=32, specular_kept=16, diffracted_tried=16, diffracted_kept=8
        )
        made = dataclasses.replace(wave.make_field(mesh, config), known_thickness=jnp.array([0.0, 0.1, 0.0]))
    elif name == "nerf2":
        made = Nerf2Field(jnp.array([[0.0, 0, 0], [6, 4, 3]]), dataclasses.replace(FIELDS[name], samples=2, width=4))
    else:
        points = np.random.default_rng(0).uniform([0.2, 0.2, 0.9], [5.8, 3.8, 3], (20, 3))
        config = dataclasses.replace(FIELDS[name], depth=3, skip=2)
        made = wideband.make_field(surface_from_points(points), config, get_field(name))
    with jax.enable_x64(True):
        return as_float64(made)


@cache
def differentiated(name, unit):
    """The weighted sum of all pixels, and its gradient, jitted; the arrays' unit is part of their structure."""
    field, position = field_of(name), jnp.asarray(np.array(RX))

    def total(arguments, weights):
        params, receiver, query = arguments
        if name == "wave":  # mirror images are found on the host: neither field nor position can be traced
            receiver = dataclasses.replace(receiver, position=position)
        limits = LIMITS if name in ("wideband", "wrfgs") else None
        spectra = fields.pas(field, params, receiver, query, limits)
        return jnp.sum(spectra * weights), spectra

    return jax.jit(jax.value_and_grad(total, has_aux=True))


def random_arguments(rng, name, unit="wavelengths"):
    """(params, receiver, query): nothing is zero by its initialiser, and nothing is compiled to have them."""
    field = field_of(name)
    shapes = jax.eval_shape(field.init, jax.random.key(0))
    params = jax.tree.map(lambda a: rng.normal(0, 0.3, a.shape), shapes)
    if name == "wave":
        params = dataclasses.replace(
            params, materials=jax.tree.map(lambda stir, at: at + stir, params.materials, as_float64(field.init(None).materials))
        )
    elif name != "nerf2":
        start = jax.tree.map(np.asarray, wideband._initial_gaussians(field.surface))
        stirred = jax.tree.map(lambda at, stir: at + 0.3 * stir, start, params.gaussians)
        params = dataclasses.replace(params, gaussians=stirred)
    orientation = rng.normal(size=4) * [0.2, 0.2, 0.2, 1] + [1, 0, 0, 0]
    receiver = Receiver(np.array(RX), orientation, planar_array(3, 2, 0.4), np.array(0.7), unit)
    return params, receiver, Query(rng.uniform([1.5, 0.5, 0.5], [5.5, 3.5, 2.5], (2, 3)), rng.uniform(2e9, 4e9, 2))
