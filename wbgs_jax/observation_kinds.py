"""Kinds of observation: what a link can be measured by, as data (docs/architecture.md, "A kind of observation").

Observations are one pytree, `{name of the kind: array}`, in scene files, data sets, training data and batches. Everything
else asks a kind what follows from it: spectra, received power, or both.
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Shaped

from wbgs_jax.radio.array import PAS_SHAPE, cbf, normalise, snapshot_to_pas
from wbgs_jax.radio.channel import NOT_HEARD_DB, received_power_db

Observations = dict[str, Shaped[Array, "n ..."]]
"""What was observed on n links, by the name of the kind (`KINDS`)."""
HostObservations = dict[str, Shaped[np.ndarray, "n ..."]]
"""The same in scene files, where n stands for three axes of links, and in data sets."""
Spectra = Float[Array, "n 90 360"]


@dataclasses.dataclass(frozen=True)
class Kind:
    """What one link can be measured by. Spectra, received power, or both follow from it."""

    name: str
    """Key of the array in scene files, data sets, training data and batches."""
    words: str
    """What people call several of them."""
    dtype: type[np.generic]
    """Of the array, in files and on the device."""
    axes: tuple[str | int, ...]
    """Of one link's values, behind the axes of links: lengths, or names of those that other arrays of a scene file share, such
    as "elements"."""
    to_spectra: Callable[..., Spectra] | None = None
    """(values (n, *axes), elements, steering) -> spectra (n, 90, 360), of maximum 1; None: there are none. `elements`
    are the positions (elements, 3) of the receiver's array, or (n, elements, 3) where every link has its own, in wavelengths;
    `steering` their steering vectors (90, 360, elements) where these are known, else None."""
    to_power: Callable[[Any], Float[Array, " n"]] | None = None
    """values (n, *axes) -> received power relative to the transmitted power, dB; None: they have no scale."""
    measured: Callable[[np.ndarray], Bool[np.ndarray, "*links"]] | None = None
    """values (*links, *axes) -> which links were measured (host); None: all of them."""
    fault: Callable[[np.ndarray], str] = lambda values: ""
    """values (*links, *axes) -> what they must not contain, in words; empty if they may be what they are (host)."""
    needs_array: bool = False
    """Spectra depend on the receiver's array."""
    silence: float = 0
    """Value of links on which nothing is heard: no power is learned from it."""

    def __post_init__(self) -> None:
        if self.to_spectra is None and self.to_power is None:
            raise ValueError(f"neither spectra nor power follow from {self.words}; define one of them")


KINDS: dict[str, Kind] = {}
"""All kinds by name. Where observations of several kinds are known, the first that has spectra gives the spectra, and the first
that has a power gives the power."""


def register_kind(kind: Kind) -> Kind:
    """Makes a kind known to scene files, data sets and batches."""
    KINDS[kind.name] = kind
    return kind


def only_kind(names: Iterable[str], holder: str) -> Kind:
    """Returns the one kind among the names of some arrays.

    Raises:
        ValueError: there is none, or there are several; the message starts with `holder`, what holds the arrays.
    """
    found = [name for name in KINDS if name in set(names)]
    if len(found) != 1:
        raise ValueError(f"{holder} holds {' and '.join(found) or 'none'} of {', '.join(KINDS)}, and needs one")
    return KINDS[found[0]]


def spectra_of(
    observations: Observations,
    elements: Float[Array, "elements 3"] | Float[Array, "n elements 3"],
    steering: Complex[Array, "90 360 elements"] | None = None,
) -> Spectra | None:
    """Returns the power angular spectra of n links (`Kind.to_spectra`); None where none follow from what was observed."""
    for name, kind in KINDS.items():
        if name in observations and kind.to_spectra is not None:
            return kind.to_spectra(observations[name], elements, steering)
    return None


def power_of(observations: Observations) -> Float[Array, " n"] | None:
    """Returns the received power of n links (dB); None where spectra alone are known, which have no scale."""
    for name, kind in KINDS.items():
        if name in observations and kind.to_power is not None:
            return kind.to_power(observations[name])
    return None


T = TypeVar("T", bound="Observed")


class Observed:
    """What has observations: data sets, training data, batches."""

    observations: Any

    def has(self, kind: str) -> bool:
        """Returns whether observations of a kind, by its name, are known."""
        return kind in self.observations

    @property
    def has_spectra(self) -> bool:
        """Whether power angular spectra are known, observed or of the snapshots."""
        return any(KINDS[name].to_spectra is not None for name in self.observations)

    @property
    def has_scale(self) -> bool:
        """Whether received power is known, observed or of the snapshots."""
        return any(KINDS[name].to_power is not None for name in self.observations)

    @property
    def snapshots(self) -> Any:
        """Complex array snapshots (n, elements); None where they are not known."""
        return self.observations.get("snapshots")

    @property
    def power_db(self) -> Any:
        """Observed power relative to the transmitted power (n,), dB; None where it was not measured itself."""
        return self.observations.get("power_db")

    def with_observations(self: T, **observations: Any) -> T:
        """Returns the same links with these observations, by kind, instead of those that it has."""
        return dataclasses.replace(self, observations=observations)  # type: ignore[type-var]


def _spectra_of_images(values: Any, elements: Any, steering: Any) -> Spectra:
    return jnp.asarray(values, jnp.float32) / 255


def _spectra_of_snapshots(values: Any, elements: Any, steering: Any) -> Spectra:
    return snapshot_to_pas(jnp.asarray(values), elements) if steering is None else normalise(cbf(values, steering))


def _fault_of_snapshots(values: np.ndarray) -> str:
    known, nothing = np.isfinite(values).all(-1), np.isnan(values).all(-1)
    if not (known | nothing).all():
        return "infinity, or NaN in some elements of a link alone"
    return "" if known.any() else "NaN alone"


register_kind(
    Kind("pas", "spectra", np.uint8, PAS_SHAPE, to_spectra=_spectra_of_images)  # 255 times a spectrum whose maximum is 1
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
        measured=lambda values: values > NOT_HEARD_DB,  # nor is NaN
        fault=lambda values: "infinity, or NaN alone" if np.isinf(values).any() or np.isnan(values).all() else "",
        silence=NOT_HEARD_DB,
    )
)
