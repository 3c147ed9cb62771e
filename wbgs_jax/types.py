"""Pytrees shared by the packages: receivers, queries, links, batches, Gaussians and surfaces.

SI units: metres, hertz, radians. Constructors check their arguments; arrays are float32 on the device.
"""

import dataclasses
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from wbgs_jax._util.checks import check_array, concrete
from wbgs_jax._util.pytree import pytree, static
from wbgs_jax.observation_kinds import Observations, Observed, power_of
from wbgs_jax.radio.antenna import Antenna, pattern_exponents
from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array

ElementUnit = Literal["wavelengths", "metres"]
"""Unit of element positions: "wavelengths" for an array that scales with the frequency, "metres" for one of fixed size."""
SurfaceSampling = Literal["solid_angle", "area"]
"""Distribution of surface points: uniform over the receiver's directions, or over the area of the surface."""
MIN_FREQUENCY_HZ, MAX_FREQUENCY_HZ = 1e9, 100e9
"""Frequency band of the paper."""
LOWEST_OF_PATHS_HZ = 0.3e9
"""Lower frequency limit of fields that predict paths; below it rays are a poor description of waves in rooms. Data below it or
above the paper's band are rejected: they are probably in another unit, or outside the scope of the models."""
LARGEST_COORDINATE_M = 2e3
"""Larger coordinates are probably in millimetres or on a map, where single precision is too coarse for waves."""


@pytree
class Gaussians:
    """Stored (unconstrained) parameters of N 3D Gaussians in the world frame.

    Empty slots, the spare capacity for density control, have an opacity logit of minus infinity: they attenuate nothing and
    receive no gradient.
    """

    means: Float[Array, "n 3"]
    """Centres, metres."""
    log_scales: Float[Array, "n 3"]
    """Natural logarithm of the standard deviations along the principal axes, metres."""
    quats: Float[Array, "n 4"]
    """Rotation of the principal axes into the world frame, wxyz, not necessarily of unit length."""
    opacity_logits: Float[Array, " n"]
    """delta_o of the paper (section 4.5), before the sigmoid."""
    features: Float[Array, "n k"] | None = None
    """Additional inputs of networks for every Gaussian; ignored by splatting."""

    @property
    def alive(self) -> Bool[Array, " n"]:
        """Mask of slots that hold a Gaussian."""
        return jnp.greater(self.opacity_logits, -jnp.inf)


@pytree
class Receiver:
    """A fixed receiver array; with a leading axis on every array, R receivers with the same number of elements."""

    position: Float[Array, "*r 3"]
    """World frame, metres."""
    orientation: Float[Array, "*r 4"]
    """Unit quaternion (wxyz) that rotates the receiver's local frame into the world frame."""
    element_positions: Float[Array, "*r elements 3"]
    """Local frame, in `unit`."""
    antenna: Antenna
    """Antenna of every element, in the local frame, with leading axes as above."""
    unit: ElementUnit = static(default="wavelengths")

    def __init__(
        self,
        position: Float[Array, "*r 3"],
        orientation: Float[Array, "*r 4"],
        element_positions: Float[Array, "*r elements 3"],
        antenna: Antenna | Float[Array, "*r 2"],
        unit: ElementUnit = "wavelengths",
    ) -> None:
        """Takes the exponents of a parametric antenna for the antenna."""
        antenna = antenna if isinstance(antenna, Antenna) else Antenna(None, antenna)
        values = (position, orientation, element_positions, antenna, unit)
        for one, value in zip(dataclasses.fields(self), values, strict=True):
            object.__setattr__(self, one.name, value)

    @property
    def pattern_exponents(self) -> Float[Array, "*r 2"]:
        """Exponents of the elements' parametric pattern (`Antenna.exponents`)."""
        return self.antenna.exponents

    def element_wavelengths(self, frequency_hz: Float[Array, "*b"]) -> Float[Array, "*b_elements 3"]:
        """Returns the element positions in wavelengths: (elements, 3) if stored in wavelengths, else (*b, elements, 3)."""
        if self.unit == "wavelengths":
            return self.element_positions
        return self.element_positions * (frequency_hz / SPEED_OF_LIGHT)[..., None, None]


@pytree
class Transmitter:
    """B transmitters. Properties other than the position are optional; None for all of them, or one row for each."""

    position: Float[Array, "*b 3"]
    """World frame, metres."""
    orientation: Float[Array, "*b 4"] | None = None
    """Quaternion (wxyz) that rotates the transmitter's local frame, in which its antenna is described, into the world frame;
    None if they are the same."""
    velocity: Float[Array, "*b 3"] | None = None
    """Metres per second, world frame; None at rest."""
    antenna: Antenna | None = None
    """Antenna, with leading axes as above; None for that which the field has learned or assumes."""
    power_dbm: Float[Array, "*b"] | None = None
    """Transmitted power, dBm; None if unknown: received powers are then relative to it."""


@pytree
class Query:
    """B combinations of a transmitter and a frequency, for which a field is queried at one receiver."""

    transmitter: Transmitter
    frequency_hz: Float[Array, "*b"]
    time_s: Float[Array, "*b"] | None = dataclasses.field(default=None, kw_only=True)
    """Time, seconds; None where nothing moves."""

    def __init__(
        self,
        transmitter: Transmitter | Float[Array, "*b 3"],
        frequency_hz: Float[Array, "*b"],
        *,
        time_s: Float[Array, "*b"] | None = None,
    ) -> None:
        """Takes positions (metres) for transmitters without further properties."""
        if not isinstance(transmitter, Transmitter):
            transmitter = Transmitter(transmitter)
        for name, value in {"transmitter": transmitter, "frequency_hz": frequency_hz, "time_s": time_s}.items():
            object.__setattr__(self, name, value)

    @property
    def tx_position(self) -> Float[Array, "*b 3"]:
        """Positions of the transmitters, world frame, metres."""
        return self.transmitter.position

    def with_indices(self, receiver_index: Int[Array, "*b"], tx_index: Int[Array, "*b"]) -> "Links":
        """Returns these queries as links, given the indices of receivers and transmitters."""
        return Links(self.transmitter, self.frequency_hz, receiver_index, tx_index, time_s=self.time_s)


@pytree
class Links(Query):
    """B combinations of a transmitter, a receiver and a frequency."""

    receiver_index: Int[Array, "*b"]
    """Index of the receiver in the dataset."""
    tx_index: Int[Array, "*b"]
    """Index of the transmitter in the dataset; links with the same position share it."""


@pytree
class Batch(Observed):
    """B links of one receiver and their observations."""

    links: Links
    receiver: Receiver
    observations: Observations
    """Observations by kind, as in datasets, except for spectra: if available, "pas" contains them as float32 with maximum 1."""
    key: Key[Array, ""]
    """Random key of this training step."""

    @property
    def pas(self) -> Float[Array, "b 90 360"] | None:
        """Normalised power angular spectra, observed or computed from snapshots; None if there are none."""
        return self.observations.get("pas")

    @property
    def received_db(self) -> Float[Array, " b"] | None:
        """The received power (dB), observed or computed from snapshots; None for spectra."""
        return power_of(self.observations)


@pytree
class Surface:
    """Points on the scene's surfaces at which Gaussians start."""

    points: Float[Array, "n 3"]
    """World frame, metres."""
    spacing: Float[Array, " n"]
    """Mean distance to the 3 nearest other points, metres."""


@pytree
class Mesh:
    """A scene's surfaces, for fields that use their geometry."""

    vertices: Float[Array, "v 3"]
    """World frame, metres."""
    faces: Int[Array, "t 3"]
    part: Int[Array, " t"]
    """Index of the scene object that a triangle belongs to."""
    material: Int[Array, " t"]
    """Index of the material of every triangle; triangles with the same index share their properties."""
    thickness: Float[Array, " m"]
    """Thickness of every material, metres; 0 if unknown."""


@runtime_checkable
class Scene(Protocol):
    """Information about a scene that fields may use when they are built (`data.scene.DatasetScene`)."""

    @property
    def receivers(self) -> Receiver:
        """All receivers, with a leading axis."""
        ...

    @property
    def box(self) -> Float[np.ndarray, "2 3"]:
        """Smallest and largest coordinates of surfaces, transmitters and receivers, metres."""
        ...

    @property
    def spectra(self) -> int:
        """Number of training links."""
        ...

    def surface(self, count: int, seed: int, sampling: SurfaceSampling) -> Surface:
        """Points on the surfaces; a count of 0 means as many as the mesh has vertices, within bounds."""
        ...

    def mesh(self) -> Mesh:
        """The surfaces themselves; raises a `UserError` if there are only points."""
        ...


def make_receiver(
    position: Any,
    orientation: Any = (1.0, 0.0, 0.0, 0.0),
    element_positions: Any = None,
    unit: ElementUnit = "wavelengths",
    pattern: str = "",
    antenna: Antenna | None = None,
) -> Receiver:
    """Returns a float32 receiver.

    Args:
        position: (3,), world frame, metres.
        orientation: quaternion (wxyz) of any non-zero length that rotates local vectors into world ones.
        element_positions: (elements, 3) in the local frame; by default the 4x4 half-wavelength array in the local y-z plane.
        unit: of the element positions.
        pattern: of the elements, a name in `radio.antenna.PATTERN_EXPONENTS`; empty for isotropic ones.
        antenna: of the elements, instead of a named pattern.

    Returns:
        The receiver, without a leading axis.

    Raises:
        ValueError: the unit is unknown, a shape is wrong, or the quaternion has zero length.

    Example:
        >>> make_receiver([0.0, 0.0, 2.0]).element_positions.shape
        (16, 3)
    """
    if unit not in get_args(ElementUnit):
        raise ValueError(f"unit is {unit!r}; give one of: {', '.join(get_args(ElementUnit))}")
    elements = planar_array() if element_positions is None else element_positions
    quaternion = np.asarray(orientation, np.float64)
    quaternion = quaternion / (np.linalg.norm(quaternion) or 1.0)  # zero length is refused below
    arrays = [jnp.asarray(np.asarray(a), jnp.float32) for a in (position, quaternion, elements, pattern_exponents(pattern))]
    receiver = Receiver(arrays[0], arrays[1], arrays[2], antenna or Antenna(None, arrays[3]), unit)
    check_receiver(receiver)
    return receiver


def stack_receivers(receivers: list[Receiver]) -> Receiver:
    """Returns receivers with the same number of elements and the same unit as one, with a leading axis on every array.

    Args:
        receivers: one or more.

    Returns:
        The receivers, with arrays (r, ...).

    Raises:
        ValueError: there are none, or they differ in the unit, the number of elements or the kind of antenna.
    """
    if not receivers:
        raise ValueError("receivers is empty; give at least one")
    if len({(jax.tree.structure(one), one.element_positions.shape) for one in receivers}) > 1:
        raise ValueError(
            "receivers differ in the unit, the number of elements or the kind of antenna; give receivers of one kind"
        )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *receivers)


def make_query(
    tx_position: Any,
    frequency_hz: Any,
    *,
    orientation: Any = None,
    velocity: Any = None,
    antenna: Antenna | None = None,
    power_dbm: Any = None,
    time_s: Any = None,
) -> Query:
    """Returns a float32 batch of queries from positions (b, 3) or (3,) in metres and frequencies (b,) or one in hertz.

    Args:
        tx_position: of the transmitters, world frame, metres.
        frequency_hz: of the carriers.
        orientation, velocity, antenna, power_dbm: further properties of the transmitters (`Transmitter`), one for all or one
            for each.
        time_s: seconds, one or (b,).

    Returns:
        Positions (b, 3) and frequencies (b,), and the further properties with a leading axis of b where given.

    Raises:
        ValueError: an orientation of zero length, or another number of antennas than one or that of the transmitters.

    Example:
        >>> make_query([[0.0, 0.0, 1.5], [1.0, 0.0, 1.5]], 28e9).frequency_hz.shape
        (2,)
    """
    _check_orientation("orientation", orientation)
    position = jnp.atleast_2d(jnp.asarray(tx_position, jnp.float32))
    count = position.shape[0]

    def rows(values: Any, *shape: int) -> Any:
        return None if values is None else jnp.broadcast_to(jnp.asarray(values, jnp.float32), (count, *shape))

    transmitter = Transmitter(
        position, rows(orientation, 4), rows(velocity, 3), repeat_antenna(antenna, count), rows(power_dbm)
    )
    return Query(transmitter, rows(frequency_hz), time_s=rows(time_s))


def _check_orientation(name: str, orientation: Any) -> None:
    """Raises an error for quaternions (..., 4) of zero length; None and traced ones pass."""
    known = None if orientation is None else concrete(jnp.asarray(orientation))
    if known is not None and not (np.linalg.norm(known, axis=-1) > 1e-6).all():
        raise ValueError(f"{name} has zero length; pass a quaternion (w, x, y, z), (1, 0, 0, 0) for no rotation")


def repeat_antenna(antenna: Antenna | None, count: int) -> Antenna | None:
    """Returns an antenna with a leading axis of `count` equal ones, unless it has one of this length already."""
    if antenna is None:
        return None
    if antenna.exponents.ndim > 1:
        if (stacked := len(antenna.exponents)) != count:
            raise ValueError(f"antenna is a stack of {stacked} for {count} transmitters; give one for all or one for each")
        return antenna
    repeated: Antenna = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), antenna)
    return repeated


def check_query(query: Query) -> None:
    """Raises an error unless positions are (b, 3) in metres, frequencies (b,) in hertz, and further properties of transmitters
    have one row for each."""
    transmitter = query.transmitter
    check_array("tx_position", query.tx_position, ("b", 3))
    count = query.tx_position.shape[0]
    check_array("frequency_hz", query.frequency_hz, (count,))
    optional = {"orientation": (count, 4), "velocity": (count, 3), "power_dbm": (count,)}
    for name, shape in optional.items():
        if (values := getattr(transmitter, name)) is not None:
            check_array(f"transmitter.{name}", values, shape)
    _check_orientation("transmitter.orientation", transmitter.orientation)
    if query.time_s is not None:
        check_array("time_s", query.time_s, (count,))
    frequency, position = concrete(query.frequency_hz), concrete(query.tx_position)
    if frequency is not None and frequency.size and not frequency.min() >= LOWEST_OF_PATHS_HZ:
        raise ValueError(f"frequency_hz is {frequency.min():g}; frequencies are in hertz (2.4e9 for 2.4 GHz) and positive")
    if frequency is not None and not np.isfinite(frequency).all():
        raise ValueError("frequency_hz is infinite; frequencies are in hertz (2.4e9 for 2.4 GHz) and finite")
    if position is not None and position.size and not np.abs(position).max() <= LARGEST_COORDINATE_M:
        raise ValueError(f"tx_position is {np.abs(position).max():g}; positions are in metres and finite")


def check_receiver(receiver: Receiver) -> None:
    """Raises an error unless it is a single receiver: position (3,), quaternion (4,) of non-zero length, element positions
    (elements, 3)."""
    check_array("receiver.position", receiver.position, (3,))
    check_array("receiver.orientation", receiver.orientation, (4,))
    check_array("receiver.element_positions", receiver.element_positions, ("elements", 3))
    check_array("receiver.antenna.exponents", receiver.antenna.exponents, (2,))
    orientation = concrete(receiver.orientation)
    if orientation is not None and not np.linalg.norm(orientation) > 1e-6:
        raise ValueError("receiver.orientation has zero length; pass a quaternion (w, x, y, z), (1, 0, 0, 0) for no rotation")


def check_surface(surface: Surface) -> None:
    """Raises an error unless points are (n, 3) and their spacing is (n,)."""
    check_array("surface.points", surface.points, ("n", 3))
    check_array("surface.spacing", surface.spacing, (surface.points.shape[0],))
