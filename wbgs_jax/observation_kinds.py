"""Registry of the kinds of observation of a link (docs/architecture.md, "A kind of observation").

Observations are a pytree `{name of the kind: array}` in scene files, datasets, training data and batches. All other code uses
a kind only through the quantities that can be computed from it: spectra, received power, or both.
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Shaped

from wbgs_jax.radio.array import PAS_SHAPE, cbf, normalise, snapshot_to_pas
from wbgs_jax.radio.channel import NO_PATH_DB, received_power_db

Observations = dict[str, Shaped[Array, "n ..."]]
"""Observations of n links by the name of their kind (`KINDS`)."""
HostObservations = dict[str, Shaped[np.ndarray, "n ..."]]
"""The same on the host: in scene files, where n stands for the three axes of links, and in datasets."""
Spectra = Float[Array, "n 90 360"]


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of observation, from which spectra, received power, or both can be computed."""

    name: str
    """Key of the array in scene files, datasets, training data and batches."""
    words: str
    """Plural noun for messages."""
    dtype: type[np.generic]
    """dtype of the array, in files and on the device."""
    axes: tuple[str | int, ...]
    """Axes of the values of a link, after the axes of links: lengths, or names of axes shared with other arrays of a scene
    file, such as "elements"."""
    to_spectra: Callable[..., Spectra] | None = None
    """(values (n, *axes), elements, steering) -> spectra (n, 90, 360) with maximum 1; None if there are no spectra. `elements`
    are the element positions of the receiver's array in wavelengths, (elements, 3), or (n, elements, 3) if they differ between
    links; `steering` are their steering vectors (90, 360, elements) if already computed, otherwise None."""
    to_power: Callable[[Any], Float[Array, " n"]] | None = None
    """values (n, *axes) -> received power relative to the transmitted power, dB; None if the values have no scale."""
    measured: Callable[[np.ndarray], Bool[np.ndarray, "*links"]] | None = None
    """values (*links, *axes) -> mask of the measured links (host); None if all are."""
    fault: Callable[[np.ndarray], str] = lambda values: ""
    """values (*links, *axes) -> description of invalid values for the error message; empty if all are valid (host)."""
    needs_array: bool = False
    """Whether spectra depend on the receiver's array."""
    silence: float = 0
    """Value of links without a received signal, from which no power is learned."""

    def __post_init__(self) -> None:
        if self.to_spectra is None and self.to_power is None:
            raise ValueError(f"{self.words} have neither to_spectra nor to_power; define one of them")


KINDS: dict[str, Kind] = {}
"""All kinds by name. If there are observations of several kinds, spectra are computed from the first kind that has any, and so
is power."""


def register_kind(kind: Kind) -> Kind:
    """Registers a kind for scene files, datasets and batches, and returns it."""
    KINDS[kind.name] = kind
    return kind


def only_kind(names: Iterable[str], holder: str) -> Kind:
    """Returns the only kind among the names of arrays.

    Raises:
        ValueError: there is no kind among them, or several; the message starts with `holder`, the object with the arrays.
    """
    found = [name for name in KINDS if name in set(names)]
    if len(found) != 1:
        raise ValueError(f"{holder} contains {' and '.join(found) or 'none'} of {', '.join(KINDS)}, but must contain one")
    return KINDS[found[0]]


def spectra_of(
    observations: Observations,
    elements: Float[Array, "elements 3"] | Float[Array, "n elements 3"],
    steering: Complex[Array, "90 360 elements"] | None = None,
) -> Spectra | None:
    """Returns the power angular spectra of n links (`Kind.to_spectra`), observed ones as data hold them (8 bits); None if the
    observations have none."""
    for name, kind in KINDS.items():
        if name in observations and kind.to_spectra is not None:
            return kind.to_spectra(observations[name], elements, steering)
    return None


def power_of(observations: Observations) -> Float[Array, " n"] | None:
    """Returns the received power of n links (dB); None for spectra, which have no scale."""
    for name, kind in KINDS.items():
        if name in observations and kind.to_power is not None:
            return kind.to_power(observations[name])
    return None


T = TypeVar("T", bound="Observed")


class Observed:
    """Base class of objects with observations: datasets, training data and batches."""

    observations: Any

    def has(self, kind: str) -> bool:
        """Returns whether there are observations of a kind, by its name."""
        return kind in self.observations

    @property
    def has_spectra(self) -> bool:
        """Whether power angular spectra are available, observed or computed from snapshots."""
        return any(KINDS[name].to_spectra is not None for name in self.observations)

    @property
    def has_scale(self) -> bool:
        """Whether received power is available, observed or computed from snapshots."""
        return any(KINDS[name].to_power is not None for name in self.observations)

    @property
    def snapshots(self) -> Any:
        """Complex array snapshots (n, elements); None if they were not observed."""
        return self.observations.get("snapshots")

    @property
    def power_db(self) -> Any:
        """Observed power relative to the transmitted power (n,), dB; None if power itself was not observed."""
        return self.observations.get("power_db")

    def with_observations(self: T, **observations: Any) -> T:
        """Returns a copy with these observations, by kind, instead of its own."""
        return dataclasses.replace(self, observations=observations)  # type: ignore[type-var]


def _spectra_of_images(values: Any, elements: Any, steering: Any) -> Spectra:
    return jnp.asarray(values, jnp.float32) / 255


def _spectra_of_snapshots(values: Any, elements: Any, steering: Any) -> Spectra:
    return snapshot_to_pas(jnp.asarray(values), elements) if steering is None else normalise(cbf(values, steering))


def _fault_of_snapshots(values: np.ndarray) -> str:
    finite, missing = np.isfinite(values).all(-1), np.isnan(values).all(-1)
    if not (finite | missing).all():
        return "infinity, or NaN in only some elements of a link"
    if not finite.any():
        return "only NaN"
    known = values[finite]
    if not known.any():
        return "only 0: nothing was received anywhere"
    return "real numbers (give complex voltages, not magnitudes)" if known.shape[-1] > 1 and not known.imag.any() else ""


def _fault_of_images(values: np.ndarray) -> str:
    highest = values.max(initial=0)
    return "only 0" if not highest else "spectra of at most 1 (multiply them by 255)" if highest == 1 else ""


def _fault_of_powers(values: np.ndarray) -> str:
    known = values[~np.isnan(values)]
    if not known.size or np.isinf(known).any():
        return "infinity, or only NaN"
    highest_db = 30  # more than antenna gains reach close to a transmitter: a path loss, which is positive
    if known.min() >= 0 or known.max() > highest_db:
        return f"{known.max():g}, as path losses and linear powers do (give 20 log10|h| in dB, which is negative)"
    return ""


register_kind(
    # 255 times a spectrum whose maximum is 1
    Kind(
        "pas",
        "spectra",
        np.uint8,
        PAS_SHAPE,
        to_spectra=_spectra_of_images,
        measured=lambda values: np.asarray(values.any((-2, -1))),  # without a maximum there is no spectrum
        fault=_fault_of_images,
    )
)
register_kind(
    Kind(
        "snapshots",
        "snapshots",
        np.complex64,
        ("elements",),
        to_spectra=_spectra_of_snapshots,
        to_power=lambda values: received_power_db(jnp.asarray(values)),
        measured=lambda values: ~np.isnan(values).all(-1),
        fault=_fault_of_snapshots,
        needs_array=True,
    )
)
register_kind(
    Kind(
        "power_db",
        "received powers",
        np.float32,
        (),
        to_power=lambda values: values,
        measured=lambda values: values > NO_PATH_DB,  # False for NaN
        fault=_fault_of_powers,
        silence=NO_PATH_DB,
    )
)
