"""Antennas: polarisation and directional gain.

The field of an antenna is a vector across the direction, of the size of its amplitude gain: 1 for an isotropic antenna without
losses. Its gain is a product of two parametric patterns, each raised to an exponent (the element of 3GPP TR 38.901, with
boresight +x, and the short dipole along z; values between the usual patterns can be learned), and of a tabulated pattern if
there is one. A parametric antenna is vertically polarised in its own frame, along theta-hat.

A `Pattern` is interpolated by cubic convolution (Keys, IEEE Trans. ASSP 29, 1981) on the sphere: beyond a pole the table
continues at the opposite azimuth. Amplitudes along theta-hat are interpolated as they are, vectors by their Cartesian
components, which unlike those along theta-hat and phi-hat are smooth at the poles. The result has a continuous derivative.
"""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.radio.array import EXACT
from wbgs_jax.radio.geometry import direction_to_angles, quaternion_product, rotation_matrix, to_local

PATTERN_EXPONENTS = {
    "": (0.0, 0.0),  # unknown
    "iso": (0.0, 0.0),
    "tr38901": (1.0, 0.0),
    "dipole": (0.0, 1.0),
    "hw_dipole": (0.0, 1.2),  # within 0.41 dB wherever the half-wave dipole is above -10 dB
}
"""Exponents of the directional element and of the dipole, by pattern name."""
SPELLINGS = {
    "isotropic": "iso",
    "tr38901": "tr38901",
    "38901": "tr38901",
    "3gpp38901": "tr38901",
    "3gpptr38901": "tr38901",
    "shortdipole": "dipole",
    "halfwavedipole": "hw_dipole",
    "halfwavelengthdipole": "hw_dipole",
} | {re.sub("[^a-z0-9]", "", name): name for name in PATTERN_EXPONENTS}
"""Pattern names by their spellings in lower case without separators."""
POLE = 1e-12
"""Squared sine of the zenith angle below which a direction counts as vertical."""


@pytree
class Pattern:
    """Field of an antenna in its own frame on a regular grid: zenith angles 0..pi with both ends, azimuths 0..2 pi without the
    end."""

    values: Inexact[Array, "*n zenith azimuth parts"]
    """One part: the amplitude gain along theta-hat; three parts: the Cartesian components of the field."""

    def at(self, direction: Float[Array, "*m 3"]) -> Inexact[Array, "*m 3"]:
        """Returns the field of one antenna in unit directions of its own frame."""
        direction = off_the_axis(direction)
        azimuth, zenith = direction_to_angles(direction)
        rows, columns, parts = self.values.shape[0] - 1, self.values.shape[1], self.values.shape[2]
        row, row_weights = _cubic(zenith * (rows / jnp.pi))
        column, column_weights = _cubic(azimuth * (columns / (2 * jnp.pi)))
        beyond = (row < 0) | (row > rows)
        row = jnp.where(row < 0, -row, jnp.where(row > rows, 2 * rows - row, row))
        opposite = jnp.where(beyond, columns // 2, 0)
        near = self.values[row[..., :, None], (column[..., None, :] + opposite[..., :, None]) % columns]
        found = jnp.sum(row_weights[..., :, None, None] * column_weights[..., None, :, None] * near, (-3, -2))
        if parts == 1:
            return found * zenith_vector(direction)
        return found - jnp.sum(found * direction, -1, keepdims=True) * direction


def off_the_axis(direction: Float[Array, "*m 3"]) -> Float[Array, "*m 3"]:
    """Returns directions of which none is exactly vertical: there angles have no derivative, and theta-hat is not defined."""
    x, y, z = jnp.moveaxis(direction, -1, 0)
    vertical = x * x + y * y < POLE
    return jnp.stack([jnp.where(vertical, POLE**0.5, x), jnp.where(vertical, 0, y), z], -1)


def _cubic(place: Float[Array, "*m"]) -> tuple[Int[Array, "*m 4"], Float[Array, "*m 4"]]:
    """Returns the indices of the four nearest nodes of a place on an axis, and their weights."""
    first = jnp.floor(jax.lax.stop_gradient(place))
    t = place - first
    weights = [((2 - t) * t - 1) * t / 2, ((3 * t - 5) * t * t + 2) / 2, ((4 - 3 * t) * t + 1) * t / 2, (t - 1) * t * t / 2]
    return first.astype(jnp.int32)[..., None] + jnp.arange(-1, 3), jnp.stack(weights, -1)


@pytree
class Antenna:
    """An antenna; with leading axes on every array, several antennas with tables of the same size."""

    orientation: Float[Array, "*n 4"] | None
    """Quaternion (wxyz) of any non-zero length that rotates the antenna's own frame into that of the directions; None if they
    are the same."""
    exponents: Float[Array, "*n 2"]
    """Exponents of the gains of the TR 38.901 element and of the short dipole."""
    pattern: Pattern | None = None
    """Tabulated pattern, which is multiplied by these gains; None for a parametric antenna."""
    slant: Float[Array, "*n"] | None = None
    """Angle (radians) by which the field is rotated about each direction, from theta-hat towards phi-hat: 0 for vertical,
    pi / 2 for horizontal polarisation, +-pi / 4 for the two ports of a cross-polarised antenna (3GPP TR 38.901, 7.3.2, model
    2). None for 0."""

    @jax.jit
    def field(self, direction: Float[Array, "*m 3"]) -> Inexact[Array, "*m 3"]:
        """Returns the polarised amplitude gain of one antenna in unit directions: a vector across each direction.

        Raises:
            ValueError: several antennas; use `jax.vmap`.
        """
        self._check_single()
        rotation = None if self.orientation is None else rotation_matrix(self.orientation)
        own = direction if rotation is None else jnp.matmul(direction, rotation, precision=EXACT)
        gain = _parametric_gain(own, self.exponents)
        field = zenith_vector(own) if self.pattern is None else self.pattern.at(own)
        if self.slant is not None:
            field = jnp.cos(self.slant) * field + jnp.sin(self.slant) * jnp.cross(own, field)
        return gain[..., None] * (field if rotation is None else jnp.matmul(field, rotation.T, precision=EXACT))

    def parametric_gain(self, direction: Float[Array, "*m 3"]) -> Float[Array, "*m"]:
        """Returns the amplitude gain of the two parametric patterns of one antenna in unit directions.

        Raises:
            ValueError: several antennas; use `jax.vmap`.
        """
        self._check_single()
        own = direction if self.orientation is None else to_local(direction, self.orientation)
        return _parametric_gain(own, self.exponents)

    def _check_single(self) -> None:
        if self.exponents.ndim != 1:
            raise ValueError(f"exponents of the antenna have shape {self.exponents.shape}; use jax.vmap for several antennas")

    def rotated(self, orientation: Float[Array, "4"]) -> "Antenna":
        """Returns one antenna after a further rotation by a quaternion (wxyz)."""
        turned = orientation if self.orientation is None else quaternion_product(orientation, self.orientation)
        return dataclasses.replace(self, orientation=turned)


def _parametric_gain(direction: Float[Array, "*m 3"], exponents: Float[Array, "2"]) -> Float[Array, "*m"]:
    directional, dipole = exponents
    return element_gain(direction) ** directional * dipole_gain(direction) ** dipole


def upright(exponents: Float[Array, "2"]) -> Antenna:
    """Returns an unrotated antenna; exponents of zero make it isotropic."""
    return Antenna(jnp.array([1, 0, 0, 0], exponents.dtype), exponents)


def is_directional(antenna: Antenna) -> bool:
    """Returns whether an antenna, or any of several, has a pattern (host)."""
    return antenna.pattern is not None or bool(np.any(np.asarray(antenna.exponents) != 0))


def pattern_exponents(pattern: str) -> tuple[float, float]:
    """Returns the exponents of a named pattern, in any usual spelling.

    Raises:
        UserError: an unknown pattern.
    """
    plain = re.sub(r"[^a-z0-9]", "", pattern.lower())
    if plain not in SPELLINGS:
        choices = ", ".join(filter(None, PATTERN_EXPONENTS))
        raise UserError(f"unknown antenna pattern {pattern[:40]!r}; choose {choices}, or an empty name if it is unknown")
    return PATTERN_EXPONENTS[SPELLINGS[plain]]


def tabulated(e_theta: Inexact[np.ndarray, "zenith azimuth"], e_phi: Inexact[np.ndarray, "zenith azimuth"] | None) -> Antenna:
    """Returns an antenna of which the amplitude gains along theta-hat and phi-hat are tabulated (host).

    Args:
        e_theta, e_phi: on zenith angles 0..pi with both ends and azimuths 0..2 pi without the end; an even number of azimuths.
            Without `e_phi` the antenna is vertically polarised, as parametric ones are. Where theta-hat and phi-hat are not
            defined, at the poles, the mean over azimuths is used.

    Raises:
        ValueError: the table is too small, or has an odd number of azimuths.
    """
    rows, columns = e_theta.shape
    if rows < 4 or columns < 4 or columns % 2:
        raise ValueError(f"{rows} zenith angles and {columns} azimuths; give at least 4 of both, azimuths in even number")
    if e_phi is None:
        values = np.array(e_theta)[..., None]
    else:
        zenith, azimuth = np.linspace(0, np.pi, rows)[:, None], np.arange(columns) * (2 * np.pi / columns)
        flat, level = np.zeros_like(zenith * azimuth), np.ones_like(zenith * azimuth)
        theta_hat = np.stack([np.cos(zenith) * np.cos(azimuth), np.cos(zenith) * np.sin(azimuth), -np.sin(zenith) * level], -1)
        phi_hat = np.stack([-np.sin(azimuth) * np.ones_like(zenith), np.cos(azimuth) * np.ones_like(zenith), flat], -1)
        values = np.asarray(e_theta)[..., None] * theta_hat + np.asarray(e_phi)[..., None] * phi_hat
    values[[0, -1]] = values[[0, -1]].mean(1, keepdims=True)
    kind = np.complex64 if np.iscomplexobj(values) else np.float32
    return Antenna(None, jnp.zeros(2, jnp.float32), Pattern(jnp.asarray(values.astype(kind))))


def zenith_weights(rows: int) -> Float[np.ndarray, " rows"]:
    """Returns the share of the sphere of every row of a regular grid of zenith angles 0..pi with both ends: the integrals of
    sin(zenith) / 2 and of functions that are linear between rows."""
    step = np.pi / (rows - 1)
    weights = np.sin(np.arange(rows) * step) * (1 - np.cos(step)) / step
    weights[[0, -1]] = 0.5 * (1 - np.sin(step) / step)
    return weights


def element_gain(direction: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """Returns the amplitude gain of the element of 3GPP TR 38.901 (table 7.3-1) in unit directions: boresight +x, 8 dBi.

    In the vertical directions, where the azimuth is undefined, gain and gradient are those of azimuth 0.
    """
    x, y, z = jnp.moveaxis(direction, -1, 0)
    squared = x * x + y * y
    pole = squared < POLE
    zenith = jnp.degrees(jnp.arctan2(jnp.sqrt(jnp.maximum(squared, POLE)), z))
    azimuth = jnp.degrees(jnp.arctan2(jnp.where(pole, 0, y), jnp.where(pole, 1, x)))
    vertical = jnp.minimum(12 * ((zenith - 90) / 65) ** 2, 30.0)
    horizontal = jnp.minimum(12 * (azimuth / 65) ** 2, 30.0)
    return 10 ** ((8 - jnp.minimum(vertical + horizontal, 30.0)) / 20)


def dipole_gain(direction: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """Returns the amplitude gain of a short dipole along z in unit directions, sqrt(1.5) sin(zenith): 1.8 dBi."""
    x, y, _ = jnp.moveaxis(direction, -1, 0)
    return jnp.sqrt(1.5 * jnp.maximum(x * x + y * y, POLE))


def zenith_vector(direction: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Returns the unit vector theta-hat of a unit direction: the electric field direction of a vertically polarised antenna. In
    the vertical directions, where the azimuth is undefined, it is that of azimuth 0."""
    x, y, z = jnp.moveaxis(off_the_axis(direction), -1, 0)
    horizontal = jnp.sqrt(x * x + y * y)
    return jnp.stack([z * x / horizontal, z * y / horizontal, -horizontal], -1)
