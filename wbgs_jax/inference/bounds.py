"""Where a trained field was trained, what is doubtful elsewhere, and how lines name links."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.solids import ClosedBody, inside
from wbgs_jax.types import LOWEST_OF_PATHS_HZ, MAX_FREQUENCY_HZ, MIN_FREQUENCY_HZ

CONFIDENCES = ("expected", "expected_error_db", "within_db")
"""Arrays of answers that record how sure they are."""
NEAR = 1e-3
"""Metres outside of a box that are none."""
ROUNDED = 1e-6
"""By what share a frequency that is asked for in gigahertz may miss that of the data."""


class Bounds(NamedTuple):
    """What a field knows by training."""

    name: str
    """Of the data."""
    box: Float[np.ndarray, "2 3"]
    """Lowest and highest corner, metres."""
    band: tuple[float, float]
    """Hertz."""
    beyond: float = 0.0
    """How far (metres) outside of the box answers still have a confidence: nothing where surfaces close it."""
    bodies: tuple[ClosedBody, ...] = ()
    """In which no antenna can stand."""

    def as_json(self) -> list[Any]:
        """Returns what `Bounds.from_json` reads."""
        bodies = [[body.name, np.round(body.triangles, 5).tolist()] for body in self.bodies]
        return [self.name, np.asarray(self.box).tolist(), list(self.band), self.beyond, bodies]

    @classmethod
    def from_json(cls, values: list[Any]) -> "Bounds":
        """Returns what `as_json` gave."""
        name, box, (low, high), beyond, bodies = values
        solids = tuple(ClosedBody(own, np.array(triangles)) for own, triangles in bodies)
        return cls(name, np.array(box), (low, high), beyond, solids)

    def without_confidence(self, positions: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Returns at which places nobody knows how sure an answer is: in a body, or outside of what was trained."""
        low, high = self.box
        away = np.linalg.norm(np.maximum(np.maximum(low - positions, positions - high), 0), axis=-1)
        result = away > self.beyond + NEAR
        for body in self.bodies:
            result |= inside(body, np.asarray(positions, np.float64))
        return result

    def doubts(
        self, rx: Float[np.ndarray, "3"], tx_positions: Float[np.ndarray, "tx 3"], frequencies_hz: Float[np.ndarray, " freq"]
    ) -> list[str]:
        """Returns why some of the answers should not be trusted: one line each."""
        (low, high), band = self.box, self.band
        box = f"the box of {self.name}, {point_words(low)} to {point_words(high)}"
        places = [("RX", rx), *(("TX", tx) for tx in tx_positions)]
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
        for f in frequencies_hz:
            if band[0] * (1 - ROUNDED) <= f <= band[1] * (1 + ROUNDED):
                continue
            if f < MIN_FREQUENCY_HZ:
                lines.append(
                    f"{f / 1e9:g} GHz lies below {MIN_FREQUENCY_HZ / 1e9:g} GHz: rays stand for short waves, and describe "
                    "badly what is not many wavelengths large"
                )
            else:
                trained = f"the trained {band[0] / 1e9:g} to {band[1] / 1e9:g} GHz"
                lines.append(f"{f / 1e9:g} GHz lies outside {trained}; the field was not trained there")
        return lines


def point_words(position: Float[np.ndarray, "3"]) -> str:
    """Returns "(x, y, z) m"."""
    return "({:.6g}, {:.6g}, {:.6g}) m".format(*position)


def link_words(tx_position: Float[np.ndarray, "3"], frequency_hz: float) -> str:
    """Returns how a line names a link."""
    return f"TX {point_words(tx_position)} at {frequency_hz / 1e9:g} GHz"


def frequencies(ghz: tuple[float, ...], source: str = "--ghz") -> Float[np.ndarray, " freq"]:
    """Returns hertz; what no field answers is a `UserError` that names where it was read."""
    low, high = LOWEST_OF_PATHS_HZ / 1e9, MAX_FREQUENCY_HZ / 1e9
    if wrong := [f for f in ghz if not low <= f <= high]:
        raise UserError(f"{source} {wrong[0]:g} is outside the model's {low:g} to {high:g} GHz; give gigahertz in that range")
    return np.array(ghz) * 1e9
