"""Search for the antennas of transmitters and elements where nobody has said what they are.

An antenna is turned along the axes, and isotropic, a short dipole or the directional element of 3GPP TR 38.901. All
transmitters share theirs. A wrong one misplaces the power of every path: in the authors' published sample the transmitters look
down the scene's -z axis, and a field that takes them for isotropic says of half of them less than the mean image does.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from wbgs_jax._util.pytree import replaced
from wbgs_jax.config import SearchConfig
from wbgs_jax.fields.coherent_model import WaveParams
from wbgs_jax.radio.antenna import PATTERN_EXPONENTS, Antenna
from wbgs_jax.training.calibration.objective import Scores, by_transmitter, surely_better

AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
ENDS = "transmitter", "element"
"""Whose antennas are searched."""
UP = ("+x", "+y", "+z")
"""Axes that an antenna may stand along: upside down it differs by a sign."""
LARGE, SURE_OF_LARGE = 0.3, 1.5
"""A gain of so much (natural logarithm: a quarter less is left) is taken by as many standard errors. With few transmitters it
costs far more to miss the antenna than to take a wrong one, which gains nothing: docs/history.md has the chances of both."""


@dataclass(frozen=True)
class AntennaReport:
    """What a search did."""

    before: float
    """Mean score of the spectra that were looked at."""
    after: float
    """The same with the antennas that were taken."""
    taken: dict[str, str]
    """What was taken for the transmitters and for the elements; nothing: what they were."""


def antenna_candidates() -> dict[str, Antenna]:
    """Returns the antennas that are tried, by a description."""
    found = {}
    for up in UP:
        for pattern in ("iso", "dipole"):
            forward = next(axis for axis in UP if axis != up)
            found[f"{pattern} along {up}"] = _antenna(pattern, forward, up)
        for forward in AXES:
            if forward[1] != up[1]:
                found[f"tr38901 along {up} towards {forward}"] = _antenna("tr38901", forward, up)
    return found


def _antenna(pattern: str, forward: str, up: str) -> Antenna:
    x, z = np.array(AXES[forward], float), np.array(AXES[up], float)
    quaternion = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], -1)).as_quat()
    return Antenna(
        jnp.asarray(np.roll(quaternion, 1), jnp.float32), jnp.asarray(PATTERN_EXPONENTS[pattern], jnp.float32)
    )  # SciPy has w last


def search_antennas(
    params: WaveParams,
    score: Scores,
    tx_index: Int[np.ndarray, " n"],
    config: SearchConfig,
    known_elements: bool,
) -> tuple[WaveParams, AntennaReport]:
    """Returns parameters with the antennas whose scores are best, in turn for transmitters and elements, where they are surely
    better than what is there, or better by much; elements whose pattern the data say are left alone."""
    taken, settled, before, after = dict[str, str](), 0, np.zeros(1), np.zeros(1)
    ends = ENDS[:1] if known_elements else ENDS
    for turn in range(config.antenna_rounds * len(ends)):
        end, candidates = ends[turn % len(ends)], antenna_candidates()  # anew: training gives every array away once
        # What is there is scored among the others: by itself it would need a program of its own.
        tried = [params, *(replaced(params, **{end: antenna}) for antenna in candidates.values())]
        scores = score(tried)
        best = 1 + int(np.argmin(scores[1:].mean(1)))
        before, after = before if turn else scores[0], scores[0]
        settled += 1
        if surely_better(scores[0] - scores[best], tx_index, config.antenna_sure) or gains_much(scores, tx_index):
            taken[end], params, after, settled = list(candidates)[best - 1], tried[best], scores[best], 1
        if settled == len(ends):  # the other end is what it was when this one was looked at
            break
    return params, AntennaReport(float(before.mean()), float(after.mean()), taken)


def gains_much(scores: Float[np.ndarray, "k n"], tx_index: Int[np.ndarray, " n"]) -> bool:
    """Returns whether the best of several candidates gains `LARGE` over the first one.

    For every transmitter the candidate is chosen by the others: so that it was chosen among many adds nothing to its gain.
    """
    of_tx = np.stack([by_transmitter(own, tx_index) for own in scores])
    chosen = 1 + (of_tx.sum(1, keepdims=True) - of_tx)[1:].argmin(0)
    transmitters = np.arange(of_tx.shape[1])
    gains = of_tx[0] - of_tx[chosen, transmitters]
    return bool(gains.mean() > LARGE and surely_better(gains, transmitters, SURE_OF_LARGE))
