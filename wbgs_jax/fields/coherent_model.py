"""Settings and presets of the coherent field; its arrivals, snapshots and spectra, computed from parameters and traced paths.

The coherence of waves depends on the uncertainty of the positions of surfaces and transmitters:

    R = sum over pairs of paths  coherence(i, j) y_i y_j^H        PAS = sqrt(a^H R a) / max

with y_i the snapshot of path i alone. If all positions are exact, the coherence is 1 and the PAS is that of the snapshot
itself; if they are uncertain by more than a wavelength, powers add.

`PreparedPaths` holds the paths of many links, traced on the host before training, since every training step needs them.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from wbgs_jax._util.complex_math import phasor
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import map_blocks, pytree, same, static
from wbgs_jax.config import PRESETS as COMMON
from wbgs_jax.config import CalibrationConfig, Settings, check_positive, check_rates
from wbgs_jax.fields.base import Observation
from wbgs_jax.propagation.displacement import Motion, length_changes, path_coherence, tree_at
from wbgs_jax.propagation.image_method import ImageTree, Surfaces
from wbgs_jax.propagation.materials import Slabs, complex_permittivity
from wbgs_jax.propagation.mechanisms import MECHANISMS, sizes_of, trace_paths, transports_of
from wbgs_jax.propagation.paths import DIFFRACTED, REFLECTED, TRANSMITTED, PathGeometry, TracedPaths
from wbgs_jax.propagation.transport import Grid, arrivals, attenuation, covariance_from_paths, smoothed, snapshots_from_paths
from wbgs_jax.radio.antenna import Antenna, upright
from wbgs_jax.radio.array import (
    EXACT,
    SPEED_OF_LIGHT,
    LagBasis,
    covariance_to_pas,
    wide_covariance_to_pas,
)
from wbgs_jax.radio.channel import FAINTEST, Paths, added_powers, decibels
from wbgs_jax.radio.geometry import quaternion_product, rotation_quaternion
from wbgs_jax.types import Links, Query, Receiver, Transmitter, check_query


@dataclass(frozen=True)
class WaveConfig:
    """Settings of the coherent field."""

    max_facets: int = 20_000
    """Maximum number of planar facets of the mesh. Of more than 3,000 only the largest are used that make up 98 % of the area;
    if a tenth of the area would be left out, the mesh is simplified to 3,000."""
    mirror_areas: tuple[float, ...] = (0.0, 0.05, 1.0)
    """Smallest area of a facet in a sequence of 1, 2 and 3 reflections, square metres."""
    mirror_area_after_edge: float = 0.5
    """Smallest area of a reflecting facet after a diffracting edge, square metres."""
    mirror_area_before_edge: float = 3.0
    """Smallest area of a reflecting facet before a diffracting edge, square metres."""
    specular_tried: int = 512
    """Maximum number of candidates without diffraction that are tested for occlusion."""
    specular_kept: int = 128
    """Maximum number of paths without diffraction that are kept."""
    diffracted_tried: int = 1024
    """Maximum number of candidates with a diffraction that are tested for occlusion."""
    diffracted_kept: int = 256
    """Maximum number of paths with a diffraction that are kept."""
    permittivity: float = 4.0
    """Initial relative permittivity of all materials."""
    conductivity: float = 0.02
    """Initial conductivity of all materials at 1 GHz, S/m."""
    slope: float = 1.0
    """Initial exponent of the conductivity over frequency."""
    thickness: float = 0.1
    """Initial thickness of materials whose thickness the scene does not define, metres."""
    excess_amplitude: float = 0.7
    """Initial amplitude factor of diffracted waves at every further interaction, in addition to that of its slab."""
    placement: float = 1e-6
    """Initial standard deviation of the positions of surfaces and transmitters, before calibration, metres."""
    clutter_cells: int = 32_768
    """Maximum number of cells of the absorption grid, for objects that the mesh lacks (`calibration.absorption_spectra`)."""
    clutter_cell: float = 0.25
    """Smallest edge length of a cell of the absorption grid, metres."""
    coherent: bool = True
    """Add the amplitudes of paths; False adds their powers, as phase-blind models do (an ablation)."""
    ssim_weight: float = 0.2
    """lambda of the paper's equation 5."""
    ssim_stride: int = 2
    """Stride of the SSIM windows in the loss, along both axes (paper: 1)."""
    correlation_weight: float = 0.5
    """Weight of one minus the squared correlation of snapshots, if the data contain them."""
    power_weight: float = 0.01
    """Weight of the squared error of the log amplitude of snapshots, if the data contain them."""
    correction_weight: float = 0.1
    """Weight of the mean squared facet corrections."""
    materials_lr: float = 1e-2
    """Learning rate of the logarithms of permittivity and conductivity."""
    thickness_lr: float = 1e-3
    """Learning rate of the logarithm of thickness: at 100 GHz a thousandth of a wall's thickness changes the phase by a tenth
    of a radian."""
    corrections_lr: float = 5e-3
    """Learning rate of facet corrections, additional losses and the overall gain."""
    antennas_lr: float = 3e-4
    """Learning rate of the orientations and exponents of the antennas."""
    clutter_weight: float = 0.02
    """Weight of the mean density of the absorption grid (nepers per metre)."""
    clutter_lr: float = 0.2
    """Learning rate of the density of the absorption grid, which is stored as a logarithm where it is small."""
    placement_lr: float = 2e-2
    """Learning rate of the logarithms of the standard deviations of positions."""

    def check(self, name: str) -> None:
        """Raises a `UserError` for invalid settings; the message names the option with the field's `name`."""
        # Largest number of facets that has been tested; each may reflect waves and obstruct all other paths.
        max_facets = 100_000
        if self.max_facets > max_facets:
            raise UserError(f"--{name}.max-facets is {self.max_facets}; the most is {max_facets}")
        check_rates(name, self)
        check_positive({f"{name}.ssim-stride": self.ssim_stride})
        if self.clutter_cells < 1 or self.clutter_cell <= 0:
            raise UserError(
                f"--{name}.clutter-cells and -cell must be positive; --calibration.absorption-spectra 0 disables the grid"
            )


STEPS = {"smoke": 100, "cpu": 2000, "gpu": 4000}
"""Training steps by preset: few, since only a few numbers per material are learned, and no networks."""
CALIBRATION = {
    "smoke": CalibrationConfig(
        rounds=1, spectra=32, antenna_rounds=0, spurious_spectra=0, array_gain_spectra=0, geometry=False, absorption_spectra=0
    ),
    "cpu": CalibrationConfig(),
    "gpu": CalibrationConfig(),
}


CONFIGS = {
    # Few candidates, from large facets only.
    "smoke": WaveConfig(mirror_areas=(0.05, 1.0), specular_tried=96, specular_kept=24, diffracted_tried=32, diffracted_kept=8),
    "cpu": WaveConfig(),
    "gpu": WaveConfig(),
}


def _preset(name: str) -> Settings:
    common, steps = COMMON[name], STEPS[name]
    optim = dataclasses.replace(common.optim, steps=steps, min_steps=steps // 2, batch=8)
    loop = dataclasses.replace(common.loop, evaluate_every=min(common.loop.evaluate_every, steps // 2))
    return Settings(CONFIGS[name], optim, loop, calibration=CALIBRATION[name])


PRESETS = {name: _preset(name) for name in COMMON}


DENSITIES_HZ = 1e9, 1e11
"""Frequencies (Hz) at which the absorption grid stores a density; interpolated over the logarithm of the frequency in
between, constant beyond."""


@pytree
class Materials:
    """Stored (unconstrained) properties of M materials as in ITU-R P.2040: eps_r, and sigma = c f^d with f in GHz."""

    log_susceptibility: Float[Array, " m"]
    """log(eps_r - 1)."""
    log_conductivity: Float[Array, " m"]
    """log c, c in S/m."""
    slope: Float[Array, " m"]
    """d."""
    log_thickness: Float[Array, " m"]
    """log of the thickness in metres; used if the scene does not define it."""


@pytree
class WaveParams:
    """Parameters of the coherent field."""

    materials: Materials
    facet_correction: Float[Array, "f 2"]
    """Logarithm of amplitude, and phase (radians), of a facet's reflection relative to that of its material."""
    excess_loss: Float[Array, "2 3"]
    """Additional loss per interaction beyond that of the slab or wedge, nepers. Rows: specular and diffracted paths (of any
    further mechanism the last one holds); columns: transmission, reflection, diffraction."""
    log_gain: Float[Array, ""]
    """Logarithm of the overall gain: that of the transmitter, and any other common factor of all snapshots."""
    transmitter: Antenna
    """Antenna of all transmitters without an antenna of their own, in the frame of the transmitter."""
    element: Antenna
    """Antenna of every element of the array in addition to its known pattern, in the receiver's frame."""
    placement: Float[Array, " places"]
    """Logarithm of the standard deviation (metres, along each axis) of the positions of all rigid bodies and, last, of the
    transmitters."""
    thick: Float[Array, ""]
    """Propagation option: 1 to subtract the phase of the air that a slab replaces, as in reality, 0 to keep it, as in ray
    tracers (`materials.slab_coefficients`)."""
    curved: Float[Array, ""]
    """Propagation option: 1 for spherical waves at the array, as in reality, 0 for plane waves
    (`transport.element_voltages`)."""
    clutter: Float[Array, "x y z 2"] | None
    """Stored (unconstrained) density of the absorption grid at both of `DENSITIES_HZ`, for objects that are not in the mesh;
    `densities` returns nepers per metre. None without an absorption grid."""


@pytree
class PreparedPaths:
    """Traced paths of pairs of a receiver and a transmitter."""

    surfaces: Surfaces
    """Facets and edges, shared by all receivers."""
    lag_basis: LagBasis | None
    """Lag basis of the receivers' array; None if they depend on the frequency or on the receiver."""
    paths: TracedPaths
    """Paths; the leading axis is that of the pairs, sorted by receiver, then by transmitter."""
    receiver_index: Int[Array, " pairs"]
    tx_index: Int[Array, " pairs"]

    def place(self, links: Links) -> Int[Array, "*b"]:
        """Returns the index of each link's pair."""
        numbers = jnp.max(self.tx_index) + 1
        pairs, queried = (one.receiver_index * numbers + one.tx_index for one in (self, links))
        return jnp.searchsorted(pairs, queried)

    def subset(self, links: Links) -> "PreparedPaths":
        """Returns the pairs of links only, one per link, so that shapes do not depend on the number of prepared pairs."""
        place = jnp.sort(self.place(links))
        paths, receiver_index, tx_index = jax.tree.map(
            lambda leaf: leaf[place], (self.paths, self.receiver_index, self.tx_index)
        )
        return dataclasses.replace(self, paths=paths, receiver_index=receiver_index, tx_index=tx_index)

    def of(self, links: Links) -> TracedPaths:
        """Returns the paths of links; leading axes are those of the links."""
        place = self.place(links)
        paths: TracedPaths = jax.tree.map(lambda leaf: leaf[place], self.paths)
        return paths


@pytree
class WavePlan:
    """Everything that is independent of the query: geometry only, no parameters."""

    surfaces: Surfaces
    """Facets and edges; a `ImageTree` with the receiver's mirror images unless paths are prepared."""
    receiver: Receiver
    array_gains: Float[Array, "elements 2"] | None
    """Array gains of the receiver: logarithm of amplitude, and phase (radians), of its elements; None for ideal elements."""
    known_thickness: Float[Array, " m"]
    motion: Motion | None
    """Displacements of rigid bodies and of this receiver since the paths were traced, while they are being estimated."""
    lag_basis: LagBasis | None
    """Lag basis of the array; None if they depend on the frequency, or if the positions of its elements are traced by JAX."""
    grid: Grid | None
    """Cells of the absorption grid, or None without one."""
    prepared: PreparedPaths | None
    """Paths of the links that will be queried; None if paths are to be traced for each query."""
    config: WaveConfig = static()

    def paths_of(self, links: Query) -> TracedPaths:
        """Returns the paths of B links, from the prepared ones or by tracing."""
        if self.prepared is None:
            check_query(links)
            return trace(self, links.tx_position)
        if not isinstance(links, Links):
            raise TypeError("a plan with prepared paths traces no others; make a plan without them, or query `Links`")
        return self.prepared.of(links)


def moved_plan(plan: WavePlan, motion: Motion) -> WavePlan:
    """Returns a plan at one instant of a movement, (m, 3) and (3,), with its surfaces and receiver in their places; pure."""
    assert isinstance(plan.surfaces, ImageTree), "of `plan_movement`"
    tree = tree_at(plan.surfaces, motion)
    orientation = quaternion_product(rotation_quaternion(jnp.asarray(motion.receiver_turn)), plan.receiver.orientation)
    receiver = dataclasses.replace(plan.receiver, position=jnp.asarray(tree.receiver_position), orientation=orientation)
    return dataclasses.replace(plan, surfaces=tree, receiver=receiver)


def first_params(config: WaveConfig, facets: int, materials: int, placement: Any, clutter: Any) -> WaveParams:
    """Returns initial parameters, in which all materials are the same; nothing is random. `facets` and `materials` are numbers;
    `placement` and `clutter` are initial values."""
    m = Materials(
        log_susceptibility=jnp.full(materials, np.log(config.permittivity - 1), jnp.float32),
        log_conductivity=jnp.full(materials, np.log(config.conductivity), jnp.float32),
        slope=jnp.full(materials, config.slope, jnp.float32),
        log_thickness=jnp.full(materials, np.log(config.thickness), jnp.float32),
    )
    amplitude = jnp.array([[1.0, 1.0, 1.0], [config.excess_amplitude, config.excess_amplitude, 1.0]], jnp.float32)
    nothing = jnp.zeros((), jnp.float32)
    corrections = jnp.zeros((facets, 2), jnp.float32), -jnp.log(amplitude), jnp.zeros_like(nothing)
    # Training donates every array once, so that none may be shared.
    transmitter, element = (upright(jnp.zeros(2, jnp.float32)) for _ in range(2))
    placement, clutter = jax.tree.map(jnp.array, (placement, clutter))
    return WaveParams(m, *corrections, transmitter, element, placement, nothing, jnp.zeros_like(nothing), clutter)


@jax.jit
def path_snapshots(params: WaveParams, plan: WavePlan, paths: TracedPaths, links: Query) -> Complex[Array, "b elements"]:
    """Returns the snapshots of B links from their paths."""
    return snapshots_of(plan, path_arrivals(params, plan, paths, links), links.frequency_hz)


@jax.jit
def path_arrivals(params: WaveParams, plan: WavePlan, paths: TracedPaths, links: Query) -> Paths:
    """Returns the arrivals over all paths of B links, leading axis B."""
    found: Any = jax.vmap(lambda paths, link: arrivals_at(params, plan, paths, link))(paths, links)
    return found


def snapshots_of(plan: WavePlan, arrived: Paths, frequency_hz: Float[Array, " b"]) -> Complex[Array, "b elements"]:
    """Returns the snapshots of B links from their arrivals."""
    y = jax.vmap(lambda arrived, f: snapshots_from_paths(arrived, plan.receiver, f))(arrived, frequency_hz)
    return y if plan.array_gains is None else y * element_gains(plan.array_gains)


def element_gains(array_gains: Float[Array, "elements 2"]) -> Complex[Array, " elements"]:
    """Returns the complex gains of elements from their stored logarithms and phases."""
    return jnp.exp(array_gains[:, 0] + 1j * array_gains[:, 1])


@jax.jit
def observe(params: WaveParams, plan: WavePlan, paths: TracedPaths, links: Query) -> Observation:
    """Returns spectra, snapshots, received power and arrivals of B links from their paths."""
    if not plan.config.coherent:
        blind = phase_blind_pas(params, plan, paths, links)
        return Observation(blind, paths=path_arrivals(params, plan, paths, links))
    arrived, frequency_hz = path_arrivals(params, plan, paths, links), links.frequency_hz
    covariance, power = path_covariances(params, plan, paths, arrived, frequency_hz)
    pas, y = spectra_of(plan, covariance, frequency_hz), snapshots_of(plan, arrived, frequency_hz)
    return Observation(pas, y, decibels(power), covariance, arrived)


def spectra_of(
    plan: WavePlan, covariance: Complex[Array, "b elements elements"], frequency_hz: Float[Array, " b"]
) -> Float[Array, "b 90 360"]:
    """Returns the spectra of B links from their covariances."""
    if plan.lag_basis is not None:
        return covariance_to_pas(covariance, plan.lag_basis)
    elements = plan.receiver.element_wavelengths(frequency_hz)
    return wide_covariance_to_pas(covariance, jnp.broadcast_to(elements, (covariance.shape[0], *elements.shape[-2:])))


@jax.jit
def path_covariances(
    params: WaveParams, plan: WavePlan, paths: TracedPaths, arrived: Paths, frequency_hz: Float[Array, " b"]
) -> tuple[Complex[Array, "b elements elements"], Float[Array, " b"]]:
    """Returns the mean products y y^H of the snapshots of B transmitters over the possible positions of surfaces and
    transmitters (`WaveParams.placement`), scaled to a trace of 1, and the mean power received by an element."""
    spread = jnp.exp(params.placement)

    # Smallest total power of several paths, relative to the strongest path; if they cancel further, or if there are no paths,
    # there is no spectrum.
    faintest_sum = 1e-12

    def one(paths: TracedPaths, arrived: Paths, f: Float[Array, ""]) -> Any:
        strongest = jax.lax.stop_gradient(jnp.max(jnp.abs(arrived.amplitude)))
        strongest = jnp.where(strongest > FAINTEST, strongest, 1)  # no paths: 1 / FAINTEST^2 would overflow
        arrived = arrived._replace(amplitude=arrived.amplitude / strongest)
        coherence = path_coherence(paths, plan.surfaces, spread, 2 * jnp.pi * f / SPEED_OF_LIGHT)
        covariance = covariance_from_paths(arrived, plan.receiver, f, coherence)
        if plan.array_gains is not None:
            gains = element_gains(plan.array_gains)
            covariance = covariance * gains[:, None] * gains.conj()
        trace = jnp.trace(covariance).real
        return covariance / jnp.maximum(trace, faintest_sum), trace / len(covariance) * strongest**2

    found: Any = jax.vmap(one)(paths, arrived, frequency_hz)
    return found


@jax.jit
def phase_blind_pas(params: WaveParams, plan: WavePlan, paths: TracedPaths, links: Query) -> Float[Array, "b 90 360"]:
    """Returns spectra with the powers of all paths added, which is this model without phases."""

    def one(paths: TracedPaths, link: Query) -> Float[Array, "90 360"]:
        return added_powers(arrivals_at(params, plan, paths, link), plan.receiver.element_wavelengths(link.frequency_hz))

    return jax.vmap(one)(paths, links)


def slabs_at(params: WaveParams, plan: WavePlan, frequency_hz: Float[Array, ""]) -> Slabs:
    """Returns the slabs of all facets at one frequency."""
    m, material = params.materials, plan.surfaces.facets.material
    # The largest conductivity (S/m): beyond it every material is a perfect mirror, and single precision overflows.
    largest_log = float(np.log(1e6))
    sigma = jnp.exp(jnp.minimum(m.log_conductivity + m.slope * jnp.log(frequency_hz / 1e9), largest_log))
    permittivity = complex_permittivity(1 + jnp.exp(m.log_susceptibility), sigma, frequency_hz)
    thickness = jnp.where(plan.known_thickness > 0, plan.known_thickness, jnp.exp(m.log_thickness))
    return Slabs(permittivity[material], thickness[material], params.thick)


def transmitter_antenna(params: WaveParams, transmitter: Transmitter) -> Antenna:
    """Returns the antenna of one transmitter in the world frame: its own one if it has any, else the learned one, after the
    rotation of the transmitter if it has an orientation."""
    antenna = params.transmitter if transmitter.antenna is None else transmitter.antenna
    return antenna if transmitter.orientation is None else antenna.rotated(transmitter.orientation)


def arrivals_at(params: WaveParams, plan: WavePlan, paths: TracedPaths, link: Query) -> Paths:
    """Returns the arrivals over all paths of one link."""
    frequency_hz = link.frequency_hz
    antennas = transmitter_antenna(params, link.transmitter), params.element
    slabs = slabs_at(params, plan, frequency_hz)
    found = arrivals(paths, plan.surfaces, slabs, frequency_hz, plan.receiver, transports_of(paths), *antennas)
    gain = jnp.exp(params.log_gain) * _corrections(params, paths)
    if params.clutter is not None:
        assert plan.grid is not None, "a field with absorption parameters has a grid"
        gain = gain * jnp.exp(-attenuation(found.points, _density_at(params.clutter, frequency_hz), plan.grid))
    if plan.motion is not None:
        cycles = frequency_hz / SPEED_OF_LIGHT * length_changes(paths.together, plan.surfaces, plan.motion)
        gain = gain * phasor(-cycles)
    assert found.polarised is not None, "arrivals of traced paths have it"
    amplitudes = {"amplitude": found.amplitude * gain, "polarised": found.polarised * gain[:, None]}
    return found._replace(**amplitudes, spherical_wave=params.curved)


def transparent_grid(shape: tuple[int, int, int]) -> Float[Array, "x y z 2"]:
    """Returns the initial `WaveParams.clutter`, which is nearly transparent."""
    thin = 1e-3  # initial density of the absorption grid, nepers per metre: a tenth of a decibel across a room
    return stored(jnp.full((*shape, len(DENSITIES_HZ)), thin, jnp.float32))


def densities(stored_density: Float[Array, "x y z 2"]) -> Float[Array, "x y z 2"]:
    """Returns the densities, nepers per metre, of stored values."""
    return jax.nn.softplus(stored_density)


def stored(density: Float[Array, "x y z 2"]) -> Float[Array, "x y z 2"]:
    """Returns the stored values of positive densities, nepers per metre: the inverse of `densities`."""
    return jnp.log(jnp.expm1(density))


def _density_at(stored_density: Float[Array, "x y z 2"], frequency_hz: Float[Array, ""]) -> Float[Array, "x y z"]:
    """Returns the smoothed density at one frequency, nepers per metre."""
    low, high = DENSITIES_HZ
    share = jnp.clip(jnp.log(frequency_hz / low) / np.log(high / low), 0, 1)
    at_low, at_high = jnp.moveaxis(smoothed(densities(stored_density)), -1, 0)  # computed once for all links of a batch
    return (1 - share) * at_low + share * at_high


def _corrections(params: WaveParams, paths: TracedPaths) -> Complex[Array, " k"]:
    """Returns the factors of K paths due to facet corrections and additional losses."""
    whole = paths.together
    reflects = whole.interaction_type == REFLECTED
    correction = params.facet_correction[jnp.where(reflects, whole.interaction_facet, 0)]
    total = jnp.where(reflects[..., None], correction, 0).sum(-2)
    losses = jnp.concatenate([_losses(params, some) for some in paths.sets])
    return jnp.exp(total[:, 0] - losses + 1j * total[:, 1])


def _losses(params: WaveParams, paths: PathGeometry) -> Float[Array, " k"]:
    """Returns the additional losses of K paths of one mechanism, nepers."""
    row = min(list(MECHANISMS).index(paths.mechanism), len(params.excess_loss) - 1)
    counts = [jnp.sum(paths.interaction_type == kind, -1) for kind in (TRANSMITTED, REFLECTED, DIFFRACTED)]
    losses = params.excess_loss[row]
    return jnp.matmul(jnp.stack(counts, -1).astype(losses.dtype), losses, precision=EXACT)


def prepare_paths(links: Links, plan_of: Callable[[int], WavePlan]) -> PreparedPaths:
    """Returns the paths between the transmitters and receivers of links (host).

    Args:
        links: any number of links, of any receivers.
        plan_of: returns the plan of a receiver by its index.
    """
    numbers = np.stack([np.asarray(links.receiver_index), np.asarray(links.tx_index)], -1)
    pairs, first = np.unique(numbers, axis=0, return_index=True)
    positions, found, bases = np.asarray(links.tx_position)[first], [], []
    for receiver in np.unique(pairs[:, 0]):
        plan = plan_of(int(receiver))  # one at a time: the mirror images of many receivers would need much memory
        found.append(_traced_in_blocks(plan, positions[pairs[:, 0] == receiver]))
        bases.append(plan.lag_basis)
    paths = TracedPaths(tuple(_stacked(list(sets)) for sets in zip(*(one.sets for one in found), strict=True)))
    surfaces = Surfaces(plan.surfaces.facets, plan.surfaces.edges)
    return PreparedPaths(surfaces, _shared(bases), paths, *jnp.asarray(pairs.T, jnp.int32))


@jax.jit
def trace(plan: WavePlan, tx_position: Float[Array, "b 3"]) -> TracedPaths:
    """Returns the paths of B transmitters; independent of frequency and materials."""
    config, tree = plan.config, plan.surfaces
    if not isinstance(tree, ImageTree):
        raise TypeError("a plan with prepared paths traces no others; make a plan without them")
    return jax.lax.map(lambda tx: trace_paths(tree, tx, sizes_of(config)), tx_position)


def _traced_in_blocks(plan: WavePlan, positions: Float[np.ndarray, "n 3"]) -> Any:
    traced_at_once = 16  # number of transmitters that are traced together
    return map_blocks(lambda block: trace(plan, jnp.asarray(block)), positions, traced_at_once)


def _stacked(some: list[PathGeometry]) -> PathGeometry:
    """Returns concatenated paths, padded to the largest number of paths, which differs between receivers."""
    room = max(paths.alive.shape[1] for paths in some)

    def filled(leaf: np.ndarray, mode: Any) -> np.ndarray:
        return np.pad(leaf, [(0, 0), (0, room - leaf.shape[1])] + [(0, 0)] * (leaf.ndim - 2), mode)

    together: PathGeometry = jax.tree.map(
        lambda *leaves: jnp.asarray(np.concatenate([filled(leaf, "edge") for leaf in leaves])), *some
    )
    alive = np.concatenate([filled(np.asarray(paths.alive), "constant") for paths in some])
    return dataclasses.replace(together, alive=jnp.asarray(alive))


def _shared(bases: list[LagBasis | None]) -> LagBasis | None:
    """Returns the lag basis of all receivers if they are the same, else None."""
    first, *others = bases
    return first if all(same(first, other) for other in others) else None
