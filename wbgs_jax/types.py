"""Pytrees that cross module borders."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax.array import planar_array
from wbgs_jax.pytree import pytree


@pytree
class Gaussians:
    """Stored (unconstrained) parameters of N 3D Gaussians in the world frame; `alive` masks the padding of the capacity."""

    means: Float[Array, "n 3"]
    """Centres, metres."""
    log_scales: Float[Array, "n 3"]
    """Natural logarithm of the standard deviations along the own axes, metres."""
    quats: Float[Array, "n 4"]
    """Rotation of the own axes into the world, wxyz, not necessarily of unit length."""
    opacity_logits: Float[Array, "n"]
    """delta_o of the paper (section 4.5), before the sigmoid."""
    alive: Float[Array, "n"]
    """1 for a Gaussian, 0 for padding up to the capacity, which never contributes and never receives a gradient. A float, so
    that `jax.grad` works on the whole pytree; its gradient is zero."""


@pytree
class Receiver:
    """A fixed receiver array."""

    position: Float[Array, "3"]
    """World frame, metres."""
    orientation: Float[Array, "4"]
    """Unit quaternion (wxyz) that turns the receiver's local frame into the world frame."""
    element_positions: Float[Array, "elements 3"]
    """Local frame, wavelengths."""


@pytree
class Query:
    """What is asked of a field: a batch of transmitter positions and frequencies."""

    tx_position: Float[Array, "*b 3"]
    """World frame, metres."""
    frequency_hz: Float[Array, "*b"]


@pytree
class Surface:
    """Points on the scene's surfaces, where Gaussians start."""

    points: Float[Array, "n 3"]
    """World frame, metres."""
    spacing: Float[Array, "n"]
    """Mean distance to the 3 nearest other points, metres."""


@pytree
class Mesh:
    """A scene's surfaces, for fields that know where they are."""

    vertices: Float[Array, "v 3"]
    """World frame, metres."""
    faces: Int[Array, "t 3"]
    cluster: Int[Array, "t"]
    """Material of every triangle: what shares a cluster shares its properties."""
    thickness: Float[Array, "m"]
    """Of every material, metres; 0 where it is not known."""
    directivity: Float[Array, ""]
    """Of the receiver's elements: 1 for 3GPP TR 38.901, 0 for isotropic ones."""


def make_receiver(position: Any, orientation: Any = (1.0, 0.0, 0.0, 0.0), element_positions: Any = None) -> Receiver:
    """A float32 receiver; the default array is the 4x4 half-wavelength one in the local y-z plane."""
    elements = planar_array() if element_positions is None else element_positions
    quaternion = np.asarray(orientation, np.float64)
    quaternion = quaternion / np.linalg.norm(quaternion)
    return Receiver(*(jnp.asarray(np.asarray(a), jnp.float32) for a in (position, quaternion, elements)))


def make_query(tx_position: Any, frequency_hz: Any) -> Query:
    """A float32 batch of queries from positions (b, 3) or (3,) in metres and frequencies (b,) or one number in hertz."""
    position = jnp.atleast_2d(jnp.asarray(tx_position, jnp.float32))
    frequency = jnp.broadcast_to(jnp.asarray(frequency_hz, jnp.float32), position.shape[:1])
    return Query(position, frequency)
