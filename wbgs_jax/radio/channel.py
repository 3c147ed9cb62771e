"""What engineers read from a channel: power, beamforming gain, K-factor, delay spread, and how alike two snapshots are.

Pure functions; `snapshot` is the complex voltages of the receiver's elements, `Arrivals` what arrives over
every path. Leading axes are free.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int

from wbgs_jax.radio.array import EXACT, SPEED_OF_LIGHT, squared_magnitude, steering_vector, wide_covariance_to_pas


class Arrivals(NamedTuple):
    """What reaches a receiver over K paths."""

    amplitude: Complex[Array, "*b k"]
    """At the array's centre, carrier phase included; 0 for paths that are none."""
    direction: Float[Array, "*b k 3"]
    """Unit vectors in the receiver's frame, towards where the wave comes from."""
    length: Float[Array, "*b k"]
    """Length of the whole path, metres."""
    departure: Float[Array, "*b k 3"] | None = None
    """Unit vectors in the world frame, in which the wave leaves the transmitter."""
    arrival: Float[Array, "*b k 3"] | None = None
    """Unit vectors in the world frame, in which it travels when it arrives."""
    polarised: Complex[Array, "*b k 2"] | None = None
    """Amplitudes that isotropic elements would see, polarised along theta-hat and along phi-hat of the receiver's frame."""
    interaction: Int[Array, "*b k 5"] | None = None
    """What the wave meets, in its order: `propagation.paths.TRANSMITTED` and so on; 0 beyond the last."""
    material: Int[Array, "*b k 5"] | None = None
    """Index of the material that it meets there; -1 beyond the last."""
    curved: Float[Array, "*b"] | None = None
    """1 where waves reach the array as spheres, 0 where they are plane (`propagation.transport.element_voltages`)."""
    points: Float[Array, "*b k 5 3"] | None = None
    """Transmitter, where the wave is reflected or diffracted, receiver; the receiver fills the rest. World frame, metres."""


FAINTEST = 1e-30
"""Amplitude that stands for nothing; its square would vanish in single precision."""
SMALLEST = 1e-30
"""Power that stands for nothing, so that decibels stay finite."""
NOT_HEARD_DB = -250.0
"""Received powers at or below it say that no path was found, not how weak one is."""


def decibels(power: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns 10 log10 of powers."""
    return 10 * jnp.log10(jnp.maximum(power, SMALLEST))


def received_power_db(snapshot: Complex[Array, "*b elements"]) -> Float[Array, "*b"]:
    """Returns the mean power an element receives, relative to the transmitted power (dB): the negative path loss."""
    return decibels(jnp.mean(squared_magnitude(snapshot), -1))


def free_space_db(distance: Float[Array, "*b"], frequency_hz: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns the power that an isotropic element receives over a line of sight (metres, hertz), relative to the transmitted
    power (dB; Friis)."""
    return 20 * jnp.log10(SPEED_OF_LIGHT / (4 * jnp.pi * frequency_hz * distance))


def beyond_free_space_db(
    power_db: Float[Array, "*b"],
    tx_position: Float[Array, "*b 3"],
    rx_position: Float[Array, "*rx 3"],
    frequency_hz: Float[Array, "*b"],
) -> Float[Array, "*b"]:
    """Returns received powers relative to those over a line of sight (dB): how deep in the shadow transmitters stand."""
    distance = jnp.sqrt(jnp.sum((tx_position - rx_position) ** 2, -1) + 1e-4)
    return power_db - free_space_db(distance, frequency_hz)


def beamforming_gain_db(snapshot: Complex[Array, "*b elements"], peak: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns the power of the best conventional beam over that of one element (dB, at most 10 log10 of the elements' number).

    `peak` is the largest |a^H y| over all directions.
    """
    mean = jnp.mean(squared_magnitude(snapshot), -1)
    return decibels(peak**2 / snapshot.shape[-1] / jnp.maximum(mean, SMALLEST))


def k_factor_db(arrivals: Arrivals) -> Float[Array, "*b"]:
    """Returns the power of the strongest path over that of all others (dB; Rice)."""
    power = squared_magnitude(arrivals.amplitude)
    strongest = jnp.max(power, -1)
    return decibels(strongest / jnp.maximum(jnp.sum(power, -1) - strongest, SMALLEST))


def delay_spread_s(arrivals: Arrivals) -> Float[Array, "*b"]:
    """Returns the r.m.s. delay spread (seconds), weighted by power."""
    power = squared_magnitude(arrivals.amplitude)
    weight = power / jnp.maximum(jnp.sum(power, -1, keepdims=True), SMALLEST)
    delay = arrivals.length / SPEED_OF_LIGHT
    mean = jnp.sum(weight * delay, -1, keepdims=True)
    return jnp.sqrt(jnp.sum(weight * (delay - mean) ** 2, -1))


def angular_spread_deg(arrivals: Arrivals) -> Float[Array, "*b 2"]:
    """Returns the spreads of azimuth and zenith of arrival (in this order) in the receiver's frame, degrees, weighted by power
    (3GPP TR 38.901, annex A); 0 where nothing arrives."""
    power = squared_magnitude(arrivals.amplitude)
    total = jnp.sum(power, -1, keepdims=True)
    weight = power / jnp.maximum(total, SMALLEST)
    x, y, z = jnp.moveaxis(arrivals.direction, -1, 0)
    level = jnp.sqrt(jnp.maximum(x * x + y * y, SMALLEST))
    unit = jnp.stack([jnp.stack([x / level, y / level], -1), jnp.stack([z, level], -1)], -3)  # (*b, 2, k, 2)
    mean = jnp.sum(weight[..., None, :, None] * unit, -2)
    length = jnp.clip(jnp.sum(mean**2, -1), SMALLEST, 1.0)
    return jnp.where(total > 0, jnp.degrees(jnp.sqrt(-jnp.log(length))), 0.0)


def doppler_hz(
    arrivals: Arrivals, frequency_hz: Float[Array, ""], tx_velocity: Float[Array, "3"], rx_velocity: Float[Array, "3"]
) -> Float[Array, "*b k"]:
    """Returns the Doppler shifts of all paths (hertz) while transmitter and receiver move (metres a second, world frame)."""
    assert arrivals.departure is not None and arrivals.arrival is not None, "arrivals of traced paths have them"
    along_departure = jnp.sum(arrivals.departure * tx_velocity, -1)
    return frequency_hz / SPEED_OF_LIGHT * (along_departure - jnp.sum(arrivals.arrival * rx_velocity, -1))


def unit_snapshots(
    snapshots: Complex[Array, "*b elements"],
) -> tuple[Complex[Array, "*b elements"], Float[Array, "*b 1"]]:
    """Returns snapshots of norm 1, zeros where there were zeros, and their norms."""
    norm = jnp.sqrt(jnp.sum(squared_magnitude(snapshots), -1, keepdims=True))
    return snapshots / jnp.where(norm > 0, norm, 1), norm


def correlation(a: Complex[Array, "*b elements"], b: Complex[Array, "*b elements"]) -> Float[Array, "*b"]:
    """Returns |a^H b| / (|a| |b|): 1 for snapshots that are equal but for a common phase and scale; 0 for one of nothing."""
    # Of unit vectors: the square of a product of faint ones would vanish in single precision.
    (unit_a, _), (unit_b, _) = unit_snapshots(a), unit_snapshots(b)
    return jnp.sqrt(squared_magnitude(jnp.sum(unit_a.conj() * unit_b, -1)))


def added_powers(arrivals: Arrivals, elements: Float[Array, "elements 3"]) -> Float[Array, "90 360"]:
    """Returns the spectrum, maximum 1, that an array sees of one transmitter's paths if their powers are added instead of their
    amplitudes. Element positions are in wavelengths."""
    strongest = jax.lax.stop_gradient(jnp.max(jnp.abs(arrivals.amplitude)))
    power = squared_magnitude(arrivals.amplitude / jnp.where(strongest > FAINTEST, strongest, 1))  # the root of nothing's
    steering = steering_vector(elements, arrivals.direction)
    weighted = steering * (power / jnp.maximum(jnp.sum(power), FAINTEST**0.5))[:, None]
    covariance = jnp.matmul(steering.T, weighted.conj(), precision=EXACT)
    return wide_covariance_to_pas(covariance[None], elements[None])[0]
