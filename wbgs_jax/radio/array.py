"""The receiver's antenna array: element positions, steering vectors, conventional beamforming, snapshot -> PAS.

Frame: the receiver's local one, z towards the zenith of the PAS. A direction is the unit vector
k = (sin t cos p, sin t sin p, cos t) with zenith t and azimuth p in radians. Element positions are in wavelengths, so one
array serves every frequency. A plane wave from k arrives at element position p with phase exp(+j 2 pi p.k).

A power angular spectrum (PAS) pixel is |a(k)^H y| / max: the AMPLITUDE of conventional beamforming of one complex snapshot
y, scaled by its own maximum. Rows are zenith 0..90 degrees (row 0 = zenith), columns azimuth -180..180 degrees; both ends
are included, so the first and last column are the same direction.

A receiver's beams are directions of the hemisphere, given as pixels of its spectrum.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from wbgs_jax._util.checks import concrete
from wbgs_jax._util.complex_math import phasor
from wbgs_jax._util.pytree import AnyArray, pytree

PAS_HEIGHT, PAS_WIDTH = 90, 360
PAS_SHAPE = (PAS_HEIGHT, PAS_WIDTH)
SPEED_OF_LIGHT = 299_792_458.0
"""Metres per second."""
EXACT = jax.lax.Precision.HIGHEST
"""Precision of matrix products on positions and phases: a GPU's default may be TF32, whose ten bits are millimetres in a
room."""


def planar_array(rows: int = 4, columns: int = 4, spacing: float = 0.5) -> Float[np.ndarray, "elements 3"]:
    """Returns the element positions (wavelengths, float64) of a planar array in the local y-z plane, centred on the origin.

    The order is that of Sionna RT's `PlanarArray` with identity orientation: columns of elements from -y to +y, each from
    +z down to -z.

    Args:
        rows: number of elements along z.
        columns: number of elements along y.
        spacing: distance of adjacent elements, wavelengths.

    Returns:
        Positions (rows * columns, 3).

    Example:
        >>> planar_array(1, 2).tolist()
        [[0.0, -0.25, 0.0], [0.0, 0.25, 0.0]]
    """
    y = (np.arange(columns) - (columns - 1) / 2) * spacing
    z = ((rows - 1) / 2 - np.arange(rows)) * spacing
    return np.stack([np.zeros(rows * columns), np.repeat(y, rows), np.tile(z, columns)], -1)


@functools.cache
def _pas_directions() -> Float[np.ndarray, "90 360 3"]:
    zenith = np.linspace(0, np.pi / 2, PAS_HEIGHT)[:, None]
    azimuth = np.linspace(-np.pi, np.pi, PAS_WIDTH)[None]
    ones = np.ones(PAS_SHAPE)
    directions = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith) * ones], -1)
    directions.setflags(write=False)
    return directions


def pas_directions() -> Float[np.ndarray, "90 360 3"]:
    """Returns the unit vectors (float64, read-only) of the PAS pixels in the receiver's local frame.

    Returns:
        Unit vectors (90, 360, 3) in the receiver's frame, NumPy: rows from the zenith down, columns from azimuth -180 degrees
        on.
    """
    return _pas_directions()


@jax.jit
def steering_vector(
    element_positions: Float[Array, "elements 3"], directions: Float[Array, "*n 3"]
) -> Complex[Array, "*n elements"]:
    """Returns the element phases exp(+j 2 pi p.k) of plane waves from unit vectors `directions`; positions in wavelengths.

    Args:
        element_positions: in the receiver's frame, wavelengths.
        directions: unit vectors towards the sources, receiver's frame.

    Returns:
        Phase factors (*n, elements), complex64.

    Example:
        >>> import numpy as np
        >>> np.round(steering_vector(np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]), np.array([1.0, 0.0, 0.0])).real).tolist()
        [1.0, -1.0]
    """
    return phasor(jnp.matmul(directions, element_positions.T, precision=EXACT))


def array_response(
    element_positions: Float[Array, "elements 3"] | Float[Array, "m elements 3"],
    first: Float[Array, "n 3"],
    second: Float[Array, "m 3"],
    steering_first: Complex[Array, "n elements"] | None = None,
) -> Float[Array, "n m"]:
    """Returns |a(u)^H a(v)| / elements, 0..1: the array's response in unit directions u to plane waves from v.

    Args:
        element_positions: wavelengths; the same for all v, or one set for each.
        first, second: unit vectors u and v, receiver's frame.
        steering_first: steering vectors of u, if already computed.
    """
    if element_positions.ndim == 3:
        alone = jax.vmap(lambda positions, v: array_response(positions, first, v[None])[:, 0], out_axes=1)
        return alone(element_positions, second)
    steering_second = steering_vector(element_positions, second)
    if steering_first is None:
        steering_first = steering_vector(element_positions, first)
    return jnp.abs(jnp.matmul(steering_first, steering_second.conj().T, precision=EXACT)) / element_positions.shape[0]


def cbf(snapshot: Complex[Array, "*n elements"], steering: Complex[Array, "*m elements"]) -> Float[Array, "*nm"]:
    """Returns the amplitude of conventional beamforming |a^H y| for every snapshot and steering vector; shape (*n, *m).

    Args:
        snapshot: complex voltages of the elements.
        steering: from `steering_vector`.

    Returns:
        Amplitudes (*n, *m); N elements in phase give N times the voltage of one.
    """
    return jnp.abs(jnp.tensordot(snapshot, steering.conj(), axes=[[-1], [-1]], precision=EXACT))


@jax.jit
def snapshot_to_pas(
    snapshot: Complex[Array, "*n elements"], element_positions: Float[Array, "elements 3"] | Float[Array, "n elements 3"]
) -> Float[Array, "*n 90 360"]:
    """Returns the power angular spectra, each scaled to a maximum of 1, of complex array snapshots; zeros for a zero snapshot.

    Element positions are in wavelengths: one set for all snapshots, or one for each (an array of fixed size in metres).

    Args:
        snapshot: complex voltages of the elements, in any unit.
        element_positions: in the receiver's frame, wavelengths.

    Returns:
        Spectra (*n, 90, 360), amplitudes.
    """
    snapshot = jnp.asarray(snapshot)
    snapshot = snapshot.astype(jnp.promote_types(snapshot.dtype, jnp.complex64))
    positions = jnp.asarray(element_positions, snapshot.real.dtype)
    if positions.ndim == 3:
        return jax.vmap(snapshot_to_pas)(snapshot, positions)
    return normalise(cbf(snapshot, steering_vector(positions, jnp.asarray(pas_directions(), positions.dtype))))


@pytree
class LagBasis:
    """Linear map from the mean product y y^H of an array's snapshots to its squared spectrum, in terms of lags.

    Lags are the differences of element positions.
    """

    basis: Float[Array, "pixels terms"]
    """1, twice the cosine and minus twice the sine of 2 pi lag.k; pixels in row-major order."""
    lag: Int[Array, "elements elements"]
    """Index of the lag of every pair of elements, ..."""
    once: Bool[Array, "elements elements"]
    """... and whether the pair counts: only one of two pairs with opposite lags does."""


def make_lag_basis(element_positions: Float[np.ndarray, "elements 3"]) -> LagBasis:
    """Returns the lag basis of an array whose element positions (wavelengths) are available on the host."""
    positions = np.asarray(element_positions, np.float64)
    lags = np.round(positions[None] - positions[:, None], 6) + 0.0  # single precision separates lags that are the same
    first = np.argmax(np.abs(lags) > 0, -1)
    once = np.take_along_axis(lags, first[..., None], -1)[..., 0] >= 0
    different, lag = np.unique(lags[once], axis=0, return_inverse=True)
    number = np.zeros(once.shape, np.int32)
    number[once] = lag.reshape(-1)
    phase = 2 * np.pi * (_pas_directions().reshape(-1, 3) @ different.T)
    twice = np.where(np.any(different, -1), 2.0, 1.0)
    basis = np.concatenate([twice * np.cos(phase), -twice * np.sin(phase)], -1)
    return LagBasis(jnp.asarray(basis, jnp.float32), jnp.asarray(number), jnp.asarray(once))


@jax.jit
def covariance_to_pas(covariance: Complex[Array, "*n elements elements"], lags: LagBasis) -> Float[Array, "*n 90 360"]:
    """Returns the power angular spectra, each scaled to a maximum of 1, of mean products y y^H of random snapshots: the root of
    the mean of |a^H y|^2. Covariances should have a trace of about 1.

    Without randomness this agrees with `snapshot_to_pas`, to the square root of single precision.
    """
    count, flat = lags.basis.shape[1] // 2, covariance.reshape(-1, *covariance.shape[-2:])
    counted = jnp.where(lags.once, flat, 0).reshape(flat.shape[0], -1)
    sums = jax.vmap(lambda pairs: jnp.zeros(count, pairs.dtype).at[lags.lag.reshape(-1)].add(pairs))(counted)
    power = jnp.matmul(jnp.concatenate([sums.real, sums.imag], -1), lags.basis.T, precision=EXACT)
    return normalise(_root(power).reshape(*covariance.shape[:-2], *PAS_SHAPE))


@jax.jit
def wide_covariance_to_pas(
    covariance: Complex[Array, "n elements elements"], element_positions: Float[Array, "n elements 3"]
) -> Float[Array, "n 90 360"]:
    """Returns `covariance_to_pas` for covariances with individual element positions (wavelengths).

    An array of fixed size in metres has different ones at every frequency.
    """
    grid = jnp.asarray(pas_directions(), covariance.real.dtype)

    def one(own: Complex[Array, "elements elements"], positions: Float[Array, "elements 3"]) -> Float[Array, "90 360"]:
        steering = steering_vector(positions, grid)
        weighted = jnp.matmul(steering.conj(), own, precision=EXACT)
        power = jnp.sum(weighted.real * steering.real - weighted.imag * steering.imag, -1)
        return _root(power)

    return normalise(jax.vmap(one)(covariance, element_positions))


def _root(power: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns the square root of powers, 0 for the faintest, so that zero power has no infinite gradient."""
    faintest_power = 1e-8  # power of a pixel in the spectrum of a covariance of unit trace below which it counts as zero
    return jnp.sqrt(jnp.maximum(power, faintest_power)) - faintest_power**0.5


def normalise(pas: Float[Array, "*n 90 360"]) -> Float[Array, "*n 90 360"]:
    """Returns every PAS scaled to a maximum of 1; an all-zero PAS stays zero."""
    peak = _peak(pas)
    return pas / jnp.where(peak > 0, peak, 1)


@jax.custom_jvp
def _peak(pas: Float[Array, "*n h w"]) -> Float[Array, "*n 1 1"]:
    """Returns the largest pixel of every PAS.

    Its derivative is that of the first such pixel. JAX's own counts the pixels that equal the maximum; if it is compiled
    together with the computation of the pixels, these may be rounded differently the second time, so that the count is zero and
    the gradient NaN.
    """
    return jnp.max(pas, axis=(-2, -1), keepdims=True)


@_peak.defjvp
def _peak_jvp(
    primals: tuple[Float[Array, "*n h w"]], tangents: tuple[Float[Array, "*n h w"]]
) -> tuple[Float[Array, "*n 1 1"], Float[Array, "*n 1 1"]]:
    (pas,), (tangent,) = primals, tangents
    flat, flat_tangent = (x.reshape(*x.shape[:-2], -1) for x in (pas, tangent))
    place = jnp.argmax(flat, -1, keepdims=True)
    return _peak(pas), jnp.take_along_axis(flat_tangent, place, -1)[..., None]


def lag_basis(element_positions: Float[np.ndarray, "elements 3"], tolerance: float = 1e-9) -> Float[np.ndarray, "pixels rank"]:
    """Returns an orthonormal basis (float64) of the space of all squared PAS of an array, pixels in row-major order.

    |a^H y|^2 is a trigonometric polynomial whose frequencies are the differences of element positions (the array's lags);
    the 4x4 half-wavelength array has 49 of them. `tolerance` is relative to the largest singular value.
    """
    positions = np.asarray(element_positions, np.float64)
    lags = (positions[:, None] - positions[None]).reshape(-1, 3)
    lags = np.unique(np.round(lags, 9), axis=0)
    phase = 2 * np.pi * (_pas_directions().reshape(-1, 3) @ lags.T)
    waves = np.concatenate([np.cos(phase), np.sin(phase)], -1)
    u, s, _ = np.linalg.svd(waves, full_matrices=False)
    return u[:, s > tolerance * s[0]]


def squared_magnitude(z: Complex[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns |z|^2, with a gradient that is finite at 0."""
    return z.real**2 + z.imag**2


def peak_direction_error(
    predicted: Float[AnyArray, "*b 90 360"],
    truth: Float[AnyArray, "*b 90 360"],
    element_positions: Float[AnyArray, "elements 3"] | None = None,
) -> Float[Array, "*b"]:
    """Returns the angle (degrees) between the strongest directions of predicted and true spectra.

    A planar array receives a wave and its mirror image at the array's plane alike, a linear array all waves on a cone around
    its line. If the array is given, the smallest angle to any direction that it receives like the predicted one counts.

    Args:
        predicted: spectra (*b, 90, 360) in the receiver's frame.
        truth: observed spectra of the same links.
        element_positions: of the receiver (`Receiver.element_positions`), wavelengths or metres; None: no two directions are
            taken for alike.

    Returns:
        Degrees (*b).

    Example:
        >>> import jax.numpy as jnp, wbgs_jax as wb
        >>> front, back = (jnp.zeros((90, 360)).at[45, column].set(1) for column in (234, 304))
        >>> [round(float(wb.radio.peak_direction_error(front, back, array))) for array in (None, wb.radio.planar_array())]
        [48, 0]
    """
    across = None if element_positions is None else _not_resolved(element_positions)
    return _peak_angle(predicted, truth, across)


def _not_resolved(element_positions: Float[AnyArray, "elements 3"]) -> Float[AnyArray, "3 3"]:
    """Returns the unit vectors, as rows, of the components of directions that an array does not resolve; zeros for the others.
    The host finds them where positions are known, since a compiled SVD differs from device to device."""
    known = concrete(element_positions)
    xp, positions = (jnp, element_positions) if known is None else (np, known)
    centred = positions - positions.mean(0)
    _, sizes, axes = xp.linalg.svd(centred, full_matrices=True)
    sizes = xp.pad(sizes, (0, 3))[:3]
    flat = 1e-4  # largest extent of an array across its plane or line, relative to its size
    return xp.where((sizes <= flat * sizes[0])[:, None], axes, 0)


@jax.jit
def _peak_angle(
    predicted: Float[AnyArray, "*b 90 360"], truth: Float[AnyArray, "*b 90 360"], across: Float[AnyArray, "3 3"] | None
) -> Float[Array, "*b"]:
    """Returns the angle between strongest directions (degrees), up to the components that an array does not resolve."""
    directions = jnp.asarray(_pas_directions().reshape(-1, 3))
    a, b = (directions[jnp.argmax(pas.reshape(*pas.shape[:-2], PAS_HEIGHT * PAS_WIDTH), -1)] for pas in (predicted, truth))
    if across is not None:
        across = jnp.asarray(across, a.dtype)
        (p, q) = (jnp.matmul(direction, across.T, precision=EXACT) for direction in (a, b))
        length = jnp.linalg.norm(q, axis=-1, keepdims=True)
        turned = jnp.where(length > 0, q / jnp.where(length > 0, length, 1) * jnp.linalg.norm(p, axis=-1, keepdims=True), p)
        a = a + jnp.matmul(turned - p, across, precision=EXACT)
    return jnp.degrees(jnp.arctan2(jnp.linalg.norm(jnp.cross(a, b), axis=-1), jnp.sum(a * b, -1)))


ALIKE = 0.05
"""Relative difference allowed between the amplitudes of mirrored beams ahead and behind: pixels are not exactly symmetric."""
RINGS, SECTORS = 4, 16
"""The codebook has beams on four rings of constant zenith angle, sixteen on each."""


@functools.cache
def codebook() -> Int[np.ndarray, " beams"]:
    """Returns the pixels (row-major indices) in the directions of the codebook's beams."""
    rows = (np.arange(RINGS) + 0.5) * (PAS_HEIGHT - 1) / RINGS
    columns = np.arange(SECTORS) * (PAS_WIDTH - 1) / SECTORS
    return (rows.round().astype(int)[:, None] * PAS_WIDTH + columns.round().astype(int)).reshape(-1)


def best_beams(spectra: Float[np.ndarray, "n 90 360"]) -> Int[np.ndarray, " n"]:
    """Returns the index of the strongest beam of every spectrum. A planar array in the local y-z plane receives the same ahead
    and behind; of such a pair, the beam ahead (towards local +x, the boresight of directional elements) is chosen."""
    received = spectra.reshape(len(spectra), -1)[:, codebook()]
    best = received.argmax(1)
    ring, sector = np.divmod(best, SECTORS)
    twin = ring * SECTORS + (SECTORS // 2 - sector) % SECTORS
    ahead, row = pas_directions().reshape(-1, 3)[codebook(), 0], np.arange(len(received))
    return np.where((received[row, twin] >= (1 - ALIKE) * received[row, best]) & (ahead[twin] > ahead[best]), twin, best)
