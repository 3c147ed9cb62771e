"""Draws a plan and a perspective view of a scene with its receiver and transmitters.

python -m data_gen.picture --scene 1 --out docs/images/scene1.png
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import trimesh
import tyro
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch
from scipy.spatial import ConvexHull

from data_gen.options import SceneOptions
from data_gen.scenes import Part, SceneSpec
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.files import atomic_write

COLORS = {
    "concrete": "#9a9a96", "plasterboard": "#e3ddcf", "wood": "#b98a56", "glass": "#8fc3e0", "ceiling_board": "#f0f0ea",
    "chipboard": "#d9b98a", "metal": "#66707c", "brick": "#a8553f", "marble": "#d8d3d6", "plywood": "#c9a26b",
}  # fmt: skip
"""Colours by material ..."""
OTHER_COLOR = "#b7a6c9"
"""... and of all other materials."""
WALL_COLORS = {"concrete": "#6d6d69", "plasterboard": "#b5ac97"}
"""Darker colours for the plan, in which walls are lines."""
RX_COLOR, SEEN_COLOR, HIDDEN_COLOR = "#1f4fbf", "#2e8b3d", "#c0392b"
DPI = 110
PLAN_CUT = 1.45
"""Height of the plan's section above the floor, metres; furniture above it is omitted."""
UNLABELED = {"chair", "monitor", "nightstand", "bench", "screen", "frames", "leaves", "posts"}
"""Words in the names of parts that need no label, because they are small, numerous and obvious."""

ELEVATION, AZIMUTH = 48.0, -66.0
"""Viewing direction in degrees: from above the corner of the +x and the -y wall."""
LIGHT = np.array([0.25, -0.5, 0.85])
PIXELS = 1700
"""Width of the view before it is smoothed to half the size."""
WALL_ALPHA = 0.45
"""Opacity of inner walls, which would otherwise hide the rooms behind them."""


@dataclass(frozen=True, kw_only=True)
class Options(SceneOptions):
    """Draw a scene."""

    out: Path
    """Picture to write (.png)."""


def draw(spec: SceneSpec, out: Path) -> None:
    """Writes a figure of a scene: plan on the left, view without ceiling and near walls on the right."""
    size = np.ptp(spec.bounds(), axis=0)
    beside = size[0] < 2.2 * size[1]  # for a long floor, the view is below the plan
    figure, (plan, view) = plt.subplots(
        *((1, 2) if beside else (2, 1)), figsize=(15, 6.4) if beside else (12, 9.5), layout="constrained"
    )
    tx = spec.accessible_tx()
    seen = spec.line_of_sight(tx)
    _plan(plan, spec, tx, seen)
    _view(view, spec)
    plan.set_title(f"{spec.name}: {len(tx)} transmitters, {seen.mean():.0%} in line of sight", fontsize=11)
    materials = sorted({p.material for p in spec.parts})
    patches = [Patch(facecolor=_color(m), edgecolor="#888888", linewidth=0.5, label=m.split("(")[0]) for m in materials]
    figure.legend(handles=patches + plan.get_legend_handles_labels()[0], loc="outside lower center", ncols=5, fontsize=8)
    figure.draw_without_rendering()  # the layout needs two rounds to keep the legend off the axes
    with atomic_write(out) as stream:
        figure.savefig(stream, dpi=DPI, format="png")
    plt.close(figure)


def _shades(part: Part, normals: np.ndarray) -> np.ndarray:
    color = np.array(to_rgb(_color(part.material)))
    if not part.closed:  # pale surfaces, so that furniture of the same material stands out
        color = (1 + color) / 2
    lit = normals @ (LIGHT / np.linalg.norm(LIGHT))
    if not part.closed:  # a sheet has no outer side
        lit = np.abs(lit)
    return np.clip(np.outer(0.72 + 0.28 * lit, color), 0, 1)


def _color(material: str) -> str:
    return COLORS.get(material, OTHER_COLOR)


def _plan(axes: Axes, spec: SceneSpec, tx: Float[np.ndarray, "tx 3"], seen: Bool[np.ndarray, " tx"]) -> None:
    low, high = spec.bounds()
    for part in spec.parts:
        if part.closed:
            _plan_solid(axes, part)
        else:
            _plan_sheet(axes, part)
    columns, which = np.unique(tx[:, :2], axis=0, return_inverse=True)
    share = np.bincount(which.ravel(), seen) / np.bincount(which.ravel())
    for chosen, color, label in (
        (share >= 0.5, SEEN_COLOR, "TX, mostly in line of sight"),
        (share < 0.5, HIDDEN_COLOR, "TX, mostly hidden"),
    ):
        axes.scatter(columns[chosen, 0], columns[chosen, 1], s=7, color=color, alpha=0.8, linewidths=0, zorder=4, label=label)
    x, y, _ = spec.rx_position
    axes.scatter(x, y, s=60, marker="s", color=RX_COLOR, zorder=7, label="RX and its boresight")
    arrow = {"arrowstyle": "->", "color": RX_COLOR, "linewidth": 2}
    axes.annotate("", (x + 0.8, y), (x, y), arrowprops=arrow, zorder=7)
    axes.set(xlim=(low[0] - 0.2, high[0] + 0.2), ylim=(low[1] - 0.2, high[1] + 0.2), aspect="equal")
    axes.set(xlabel="x (m)", ylabel="y (m)")


def _plan_solid(axes: Axes, part: Part) -> None:
    """Draws the outlines of a solid's bodies, the higher over the lower."""
    bodies = [body for body in part.mesh.split() if body.bounds[0, 2] < PLAN_CUT]
    for body in bodies:
        outline = np.asarray(body.vertices)[ConvexHull(body.vertices[:, :2]).vertices, :2]  # every body is a box or a prism
        color, order = _shades(part, np.array([[0.0, 0.0, 1.0]])), 2 + body.bounds[1, 2] / 10
        axes.fill(*outline.T, facecolor=color[0], edgecolor="#00000066", linewidth=0.5, zorder=order)
    if bodies and not UNLABELED & set(part.name.split("_")):
        _label(axes, part)


def _plan_sheet(axes: Axes, part: Part) -> None:
    """Draws the section of a wall at the height of the plan; doorways are gaps."""
    lines = trimesh.intersections.mesh_plane(part.mesh, (0, 0, 1), (0, 0, PLAN_CUT))
    width, color = (5 if part.kind == "shell" else 3), WALL_COLORS.get(part.material, _color(part.material))
    axes.add_collection(LineCollection(list(lines[:, :, :2]), colors=color, linewidths=width, capstyle="butt", zorder=3))


def _label(axes: Axes, part: Part) -> None:
    (x0, y0, _), (x1, y1, _) = part.mesh.bounds
    box = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 0.6}
    turned = 90 if y1 - y0 > 1.5 * (x1 - x0) else 0
    name = part.name.replace("_", " ")
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    axes.text(x, y, name, ha="center", va="center", fontsize=6, rotation=turned, bbox=box, zorder=5)


def _view(axes: Axes, spec: SceneSpec) -> None:
    picture = _Raster(spec.bounds())
    shown = [p for p in spec.parts if p.kind != "shell" or spec.in_room(p.mesh.triangles_center + 1e-3 * picture.toward).all()]
    for part in sorted(shown, key=lambda p: p.kind == "partition"):  # transparent parts last
        alpha = WALL_ALPHA if part.kind == "partition" else 1.0
        shades = _shades(part, np.asarray(part.mesh.face_normals))
        for triangle, normal, shade in zip(np.asarray(part.mesh.triangles), part.mesh.face_normals, shades, strict=True):
            picture.fill(triangle, normal, shade, alpha)
    picture.mark(np.asarray(spec.rx_position), np.array(to_rgb(RX_COLOR)))
    axes.imshow(picture.finish())
    axes.set_axis_off()
    axes.set_title("without ceiling and near walls", fontsize=11)


class _Raster:
    """An image with a depth buffer, in parallel projection along a fixed direction.

    matplotlib has no depth buffer, and trimesh renders only through OpenGL and a window.
    """

    def __init__(self, bounds: Float[np.ndarray, "2 3"]) -> None:
        elevation, azimuth = np.radians([ELEVATION, AZIMUTH])
        flat = np.cos(elevation)
        self.toward = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        self._axes = np.stack([right, -np.cross(self.toward, right), self.toward])  # right, down, towards the viewer
        corners = np.array(np.meshgrid(*bounds.T)).reshape(3, -1).T @ self._axes.T
        self._low, size = corners.min(0), np.ptp(corners, axis=0)
        self._scale = (PIXELS - 1) / size[0]
        shape = (int(size[1] * self._scale) + 3, PIXELS + 2)
        self._depth = np.full(shape, -np.inf)
        self._color = np.ones((*shape, 3))
        self._plane = np.zeros((2, *shape, 4))  # planes of opaque and transparent surfaces; edges are drawn where they change

    def fill(self, triangle: np.ndarray, normal: np.ndarray, color: np.ndarray, alpha: float) -> None:
        """Draws a triangle where nothing is nearer; with alpha < 1 it is transparent."""
        for rows, columns, depth in self._pixels(triangle):
            window = (rows, columns)
            front = depth > self._depth[window] + 1e-6
            self._color[window][front] = (1 - alpha) * self._color[window][front] + alpha * color
            self._plane[int(alpha < 1)][window][front] = [*normal, normal @ triangle[0]]
            if alpha == 1:
                self._depth[window][front] = depth[front]

    def _pixels(self, triangle: np.ndarray) -> Iterator[tuple[slice, slice, np.ndarray]]:
        """Yields the pixels around a triangle and its depth there, -inf outside it; nothing if it is seen edge-on."""
        points = (triangle @ self._axes.T - self._low) * self._scale
        (x0, y0), (x1, y1) = np.floor(points[:, :2].min(0)).astype(int), np.ceil(points[:, :2].max(0)).astype(int)
        a, b, c = points
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(area) < 1e-9:
            return
        y, x = np.mgrid[y0 : y1 + 1, x0 : x1 + 1]
        u = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        v = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        inside = (u >= 0) & (v >= 0) & (u + v <= 1)
        yield slice(y0, y1 + 1), slice(x0, x1 + 1), np.where(inside, a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2]), -np.inf)

    def mark(self, point: np.ndarray, color: np.ndarray) -> None:
        """Draws a disc with a white rim on top of everything."""
        x, y, _ = (self._axes @ point - self._low) * self._scale
        rows, columns = np.indices(self._depth.shape)
        away = np.hypot(columns - x, rows - y)
        self._color[away < 19] = 1.0
        self._color[away < 15] = color

    def finish(self) -> Float[np.ndarray, "height width 3"]:
        """Returns the image at half the size, with an edge wherever two planes meet."""
        edge = np.zeros(self._depth.shape, bool)
        edge[1:] |= (np.abs(np.diff(self._plane, axis=1)) > 1e-6).any((0, -1))
        edge[:, 1:] |= (np.abs(np.diff(self._plane, axis=2)) > 1e-6).any((0, -1))
        color = np.where(edge[..., None], 0.55 * self._color, self._color)
        height, width = color.shape[0] // 2 * 2, color.shape[1] // 2 * 2
        return color[:height, :width].reshape(height // 2, 2, width // 2, 2, 3).mean((1, 3))


def main() -> None:
    """Runs the command line."""
    options = tyro.cli(Options)
    draw(options.spec(), options.out)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    run_command(main)
