"""The positions and frequencies that a training covered, and warnings about queries outside of them."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from wbgs_jax._util.cli import point_words
from wbgs_jax._util.pytree import AnyArray
from wbgs_jax.inference.quantities import INTERVALS
from wbgs_jax.mesh.bodies import ClosedBody, inside
from wbgs_jax.types import MIN_FREQUENCY_HZ

ROUNDED = 1e-6
"""Relative tolerance of frequencies, which users give in rounded gigahertz."""


class Domain(NamedTuple):
    """Positions and frequencies that the training covered."""

    name: str
    """Name of the dataset."""
    box: Float[np.ndarray, "2 3"]
    """Lowest and highest corner of the scene, metres."""
    band: tuple[float, float]
    """Lowest and highest training frequency, hertz."""
    beyond: float = 0.0
    """Distance (metres) from the box up to which prediction intervals are valid; 0 if surfaces enclose the scene."""
    bodies: tuple[ClosedBody, ...] = ()
    """Closed bodies, in which no antenna can be placed."""

    def as_json(self) -> list[Any]:
        """Returns a JSON representation, for `Domain.from_json`."""
        bodies = [[body.name, np.round(body.triangles, 5).tolist()] for body in self.bodies]
        return [self.name, np.asarray(self.box).tolist(), list(self.band), self.beyond, bodies]

    @classmethod
    def from_json(cls, values: list[Any]) -> "Domain":
        """Returns the domain that `as_json` represents."""
        name, box, (low, high), beyond, bodies = values
        solids = tuple(ClosedBody(own, np.array(triangles)) for own, triangles in bodies)
        return cls(name, np.array(box), (low, high), beyond, solids)

    def outside(self, positions: Float[AnyArray, "n 3"], xp: Any = np) -> Bool[AnyArray, " n"]:
        """Returns which positions (metres) have no valid prediction interval: inside a body, or outside the training domain.
        `xp` is the module of the arrays: NumPy, or `jax.numpy` in compiled code."""
        low, high = self.box
        away = xp.linalg.norm(xp.maximum(xp.maximum(low - positions, positions - high), 0), axis=-1)
        near = 1e-3  # tolerance of the box, metres
        result = away > self.beyond + near
        for body in self.bodies:
            result = result | inside(body, positions, xp)
        return result

    def out_of_band(self, frequencies_hz: Float[AnyArray, "*n"]) -> Bool[AnyArray, "*n"]:
        """Returns which frequencies (hertz) have no valid prediction interval: below or above all training frequencies."""
        low, high = self.band
        return (frequencies_hz < low * (1 - ROUNDED)) | (frequencies_hz > high * (1 + ROUNDED))

    def without_intervals(
        self,
        answer: dict[str, Any],
        positions: Float[AnyArray, "tx 3"],
        frequencies_hz: Float[AnyArray, " tx_or_freq"],
        paired: bool = True,
        xp: Any = np,
    ) -> dict[str, Any]:
        """Returns predictions with NaN in place of invalid intervals.

        Args:
            answer: arrays by name, with the leading axis (tx,), or (tx, freq) if not paired.
            positions: of the transmitters, metres.
            frequencies_hz: one for each transmitter, or those at which each is queried if not paired.
            paired: whether the i-th transmitter is queried at the i-th frequency only.
            xp: module of the arrays, as in `outside`.
        """
        if not set(INTERVALS) & set(answer):
            return answer
        outside, beyond = self.outside(positions, xp), self.out_of_band(frequencies_hz)
        nowhere = outside | beyond if paired else outside[:, None] | beyond

        def masked(values: Any) -> Any:
            beside = nowhere.reshape(*nowhere.shape, *[1] * (values.ndim - nowhere.ndim))
            return xp.where(beside, xp.nan, values).astype(values.dtype)

        return {name: masked(values) if name in INTERVALS else values for name, values in answer.items()}

    def warnings(
        self,
        rx: Float[np.ndarray, "*rx 3"],
        tx_positions: Float[np.ndarray, "tx 3"],
        frequencies_hz: Float[np.ndarray, " freq"],
    ) -> list[str]:
        """Returns warnings about queries of one or more receivers with unreliable predictions, one line each."""
        (low, high), band = self.box, self.band
        box = f"the box of {self.name}, {point_words(low)} to {point_words(high)}"
        places = [*(("RX", own) for own in rx.reshape(-1, 3)), *(("TX", tx) for tx in tx_positions)]
        lines = [
            f"{end} {point_words(place)} lies outside {box}; the field was not trained there"
            for end, place in places
            if ((place < low) | (place > high)).any()
        ]
        points = np.array([place for _, place in places], np.float64)
        within = [inside(body, points) for body in self.bodies]
        lines += [
            f"{end} {point_words(place)} is inside a closed body ({body.name} of {self.name}), where no antenna can stand"
            for number, (end, place) in enumerate(places)
            for body, there in zip(self.bodies, within, strict=True)
            if there[number]
        ]
        for f in frequencies_hz[self.out_of_band(frequencies_hz)]:
            if f < MIN_FREQUENCY_HZ:
                lines.append(
                    f"{f / 1e9:g} GHz lies below {MIN_FREQUENCY_HZ / 1e9:g} GHz: ray methods assume short waves and are "
                    "inaccurate for objects that are not many wavelengths large"
                )
            else:
                trained = f"the trained {band[0] / 1e9:g} to {band[1] / 1e9:g} GHz"
                lines.append(f"{f / 1e9:g} GHz lies outside {trained}; the field was not trained there")
        return lines
