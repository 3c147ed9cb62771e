"""How well the tracer of the released scenes repeats itself: beyond that no score can be told from the truth.

Spectra of some transmitters, traced again with three times the rays (`python -m data_gen.repeatability`).
"""

from collections.abc import Iterable

import numpy as np

from wbgs_jax._util.files import read_json
from wbgs_jax.data.load import RELEASED

FILE = "repeatability.json"


def repeatability(scene: str, ghz: Iterable[float]) -> float | None:
    """Returns the truth's median SSIM to itself in a released scene (`scene4`), averaged over frequencies (GHz); None where it
    is not known for all of them."""
    known = read_json(RELEASED / FILE).get(scene, {}).get("median_ssim", {})
    names = [f"{f:g}" for f in ghz]
    return float(np.mean([known[name] for name in names])) if names and all(name in known for name in names) else None
