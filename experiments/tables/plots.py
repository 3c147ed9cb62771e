"""Parts that the figures share: the style of a model's curve, and saving."""

from pathlib import Path
from typing import Any

import matplotlib
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from wbgs_jax._util.files import atomic_write

matplotlib.use("Agg")

STYLES: dict[tuple[str, str], dict[str, Any]] = {
    ("wideband", ""): {"color": "C0", "lw": 1.4, "marker": "o", "ms": 3, "ls": "--"},
    ("wideband", "long"): {"color": "C0", "lw": 2, "marker": "o", "ms": 4},
    ("wideband", "pooled"): {"color": "C4", "lw": 1.2, "marker": "d", "ms": 3, "ls": ":"},
    ("wrfgs", ""): {"color": "C1", "lw": 1.4, "marker": "s", "ms": 3, "ls": "--"},
    ("wrfgs", "long"): {"color": "C1", "lw": 1.4, "marker": "s", "ms": 3},
    ("nerf2", ""): {"color": "C3", "lw": 1, "marker": "x", "ms": 3},
    ("wave", ""): {"color": "C2", "lw": 2, "marker": "^", "ms": 4},
}


def save(figure: Figure, images: Path, name: str, alt: str) -> str:
    """Write results_<name>.png in a folder beside the page; returns the markdown that shows it."""
    path = images / f"results_{name}.png"
    with atomic_write(path) as stream:
        figure.savefig(stream, format="png", dpi=100, metadata={"Software": None})
    plt.close(figure)
    return f"![{alt}]({images.name}/{path.name})"
