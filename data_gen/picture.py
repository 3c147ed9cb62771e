"""Draws a plan and a perspective view of a scene with its receiver and transmitters.

python -m data_gen.picture --scene 1 --out docs/scene1.png
"""

from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from data_gen.scenes import Part, SceneSpec, get_scene
from wbgs_jax.errors import run_command
from wbgs_jax.files import atomic_write

COLORS = {
    "concrete": "#9a9a96", "plasterboard": "#e3ddcf", "wood": "#b98a56", "glass": "#8fc3e0", "ceiling_board": "#f0f0ea",
    "chipboard": "#d9b98a", "metal": "#66707c",
}  # fmt: skip
"""By material."""
DPI = 150
ELEVATION, AZIMUTH = 38.0, -62.0
"""Degrees: where the perspective is seen from, over the corner of the +x and the -y wall."""
LIGHT = np.array([0.15, -0.5, 0.85])


@dataclass(frozen=True)
class Options:
    """Draw a scene."""

    out: Path
    """Picture to write (.png)."""
    scene: int = 1
    """Number of the scene."""


def draw(spec: SceneSpec, out: Path) -> None:
    """Write the picture of a scene: plan on the left, perspective without ceiling and near walls on the right."""
    figure = plt.figure(figsize=(15, 5.6), layout="constrained")
    grid = figure.add_gridspec(1, 2, width_ratios=(1, 1.15))
    plan, view = figure.add_subplot(grid[0]), figure.add_subplot(grid[1], projection="3d")
    assert isinstance(view, Axes3D)
    tx = spec.accessible_tx()
    _plan(plan, spec, tx)
    _perspective(view, spec, tx)
    materials = sorted({p.material for p in spec.parts})
    patches = [Patch(color=COLORS[m], label=m) for m in materials]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches))
    with atomic_write(out) as stream:
        figure.savefig(stream, dpi=DPI, format="png")
    plt.close(figure)


def _shades(part: Part, normals: np.ndarray) -> np.ndarray:
    color = np.array(to_rgb(COLORS[part.material]))
    if not part.closed:  # pale surfaces, so that furniture of the same material stands out
        return np.tile((1 + color) / 2, (len(normals), 1))
    lit = normals @ (LIGHT / np.linalg.norm(LIGHT))
    return np.clip(np.outer(0.72 + 0.28 * lit, color), 0, 1)


def _plan(axes: Axes, spec: SceneSpec, tx: np.ndarray) -> None:
    low, high = spec.bounds()
    for part in spec.parts:
        triangles, colors = np.asarray(part.mesh.triangles), _shades(part, np.asarray(part.mesh.face_normals))
        flat = np.ptp(part.mesh.bounds, axis=0)
        if not part.closed and flat[2] < 1e-6:
            continue  # floor and ceiling
        if not part.closed:  # a wall seen from above is a line
            (x0, y0, _), (x1, y1, _) = part.mesh.bounds
            axes.plot([x0, x1], [y0, y1], color=COLORS[part.material], linewidth=7 if part.material == "glass" else 5, zorder=3)
            continue
        by_height = np.argsort(triangles[:, :, 2].mean(1))
        outlines, shades = list(triangles[by_height][:, :, :2]), colors[by_height]
        axes.add_collection(PolyCollection(outlines, zorder=2, facecolors=shades, edgecolors=shades, linewidths=0.2))
        if not part.name.startswith("chair"):
            _label(axes, part)
    columns = np.unique(tx[:, :2], axis=0)
    axes.scatter(columns[:, 0], columns[:, 1], s=7, color="#c0392b", zorder=4, label=f"{len(tx)} TX (all heights)")
    axes.scatter(spec.rx_position[0], spec.rx_position[1], s=90, marker="s", color="#1f4fbf", zorder=6, label="RX")
    axes.annotate("", (spec.rx_position[0] + 0.7, spec.rx_position[1]), spec.rx_position[:2],
                  arrowprops={"arrowstyle": "->", "color": "#1f4fbf", "linewidth": 2}, zorder=6)  # fmt: skip
    axes.set(xlim=(low[0] - 0.2, high[0] + 0.2), ylim=(low[1] - 0.2, high[1] + 0.2), aspect="equal")
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_title(f"{spec.name}: plan", loc="right")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2, fontsize=8, frameon=False)


def _label(axes: Axes, part: Part) -> None:
    (x0, y0, _), (x1, y1, _) = part.mesh.bounds
    box = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1}
    turned = 90 if y1 - y0 > 2 * (x1 - x0) else 0
    center = ((x0 + x1) / 2, (y0 + y1) / 2)
    axes.annotate(part.name, center, ha="center", va="center", fontsize=8, rotation=turned, bbox=box, zorder=5)


def _perspective(axes: Axes3D, spec: SceneSpec, tx: np.ndarray) -> None:
    low, high = spec.bounds()
    toward = _toward_camera()
    axes.computed_zorder = False
    shown = [p for p in spec.parts if p.closed or not _hides_the_view(p, low, high)]
    for part in shown:
        # Bodies are drawn from far to near and without their back faces: matplotlib has no depth buffer.
        for body in part.mesh.split() if part.closed else [part.mesh]:
            front = (np.asarray(body.face_normals) @ toward > 0) | (not part.closed)
            colors = _shades(part, np.asarray(body.face_normals)[front])
            order = 2 + (body.bounds.mean(0) @ toward) / 100 if part.closed else 1
            faces = np.asarray(body.triangles)[front]
            axes.add_collection3d(Poly3DCollection(faces, facecolors=colors, edgecolors=colors, linewidths=0.2, zorder=order))
    axes.scatter(*tx.T, s=2, color="#c0392b", alpha=0.35, zorder=3, depthshade=False)
    axes.scatter(*np.reshape(spec.rx_position, (3, 1)), s=70, marker="s", color="#1f4fbf", zorder=4, depthshade=False)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_axis_off()
    axes.set_box_aspect(high - low, zoom=1.0)
    axes.view_init(elev=ELEVATION, azim=AZIMUTH)
    axes.set_title("perspective, without ceiling and near walls")


def _toward_camera() -> np.ndarray:
    elevation, azimuth = np.radians([ELEVATION, AZIMUTH])
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def _hides_the_view(part: Part, low: np.ndarray, high: np.ndarray) -> bool:
    (x0, _, z0), (_, y1, _) = part.mesh.bounds
    return bool(z0 > high[2] - 1e-6 or x0 > high[0] - 1e-6 or y1 < low[1] + 1e-6)


def main() -> None:
    """Command line."""
    options = tyro.cli(Options)
    draw(get_scene(options.scene), options.out)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    run_command(main)
