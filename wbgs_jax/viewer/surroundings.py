"""The three-dimensional part of the viewer: room, receiver with its spectrum, paths, Gaussians and maps."""

from collections.abc import Callable
from typing import Literal

import numpy as np
import viser
from jaxtyping import Float, UInt8

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields.base import GaussianState
from wbgs_jax.inference.radio_map import Plane
from wbgs_jax.radio.geometry import covariance_factor, rotation_matrix
from wbgs_jax.types import Receiver
from wbgs_jax.viewer import figures
from wbgs_jax.viewer.session import PathList

VALID, INVALID = (31, 97, 180), (214, 39, 40)
"""Colours of the transmitter where an antenna can stand and the field was trained, and elsewhere."""
FIELD_OF_VIEW = float(np.radians(60))
"""Vertical, of the camera."""


class SceneView:
    """All objects with a position in the room."""

    def __init__(
        self, server: viser.ViserServer, dataset: Dataset, receiver: Receiver, start: Float[np.ndarray, "3"], up: str = "z"
    ):
        self.scene, self.dataset, self.up = server.scene, dataset, "xyz".index(up)
        self.box = DatasetScene(dataset).box
        self.size = float(np.ptp(self.box, axis=0).max())
        self.scene.set_up_direction(np.eye(3)[self.up])
        # Shadows and reflections of the surroundings take four fifths of the time of a picture without a graphics card.
        self.scene.configure_default_lights(cast_shadow=False)
        self.scene.configure_environment_map(hdri=None)
        ambient = 2.0  # intensity of the light from all sides
        self.scene.add_light_ambient("/light", intensity=ambient)
        self._centroids = dataset.vertices[dataset.faces].mean(1) if len(dataset.faces) else np.zeros((0, 3))
        self._draw_fixed()
        self.receiver_frame = self.scene.add_frame("/receiver", axes_length=0.3, axes_radius=0.012)
        self.scene.add_label("/receiver/name", "receiver", position=(0, 0, 0.12))
        self._dome: viser.PointCloudHandle | None = None
        self.receiver_handle: viser.TransformControlsHandle | None = None
        self.show_receiver(receiver)
        self.transmitter = self.scene.add_transform_controls(
            "/transmitter", self.handle_size, disable_rotations=True, position=tuple(start)
        )
        self._ball = self.scene.add_icosphere("/transmitter/ball", 0.1, VALID)
        self.scene.add_label("/transmitter/name", "transmitter", position=(0, 0, 0.15))
        self.clip(*self.heights())

    @property
    def handle_size(self) -> float:
        """Length of the arrows of transmitter and receiver, metres."""
        handle_share = 0.06  # size of the arrows of transmitter and receiver, relative to that of the room
        return handle_share * self.size

    @property
    def dome_radius(self) -> float:
        """Largest distance of the drawn spectrum from the receiver, metres."""
        share = 0.4  # radius of the spectrum around the receiver, relative to the shortest side of the room
        return share * float(np.ptp(self.box, axis=0).min())

    def show_receiver(self, receiver: Receiver) -> None:
        """Shows the receiver at its place."""
        self.rx = np.asarray(receiver.position, float)
        self._rotation = np.asarray(rotation_matrix(receiver.orientation), float)
        self.receiver_frame.position = tuple(self.rx)
        self.receiver_frame.wxyz = tuple(np.asarray(receiver.orientation, float))

    def add_receiver_handle(self) -> viser.TransformControlsHandle:
        """Returns arrows by which the receiver is dragged."""
        self.receiver_handle = self.scene.add_transform_controls(
            "/receiver_handle", 1.15 * self.dome_radius, disable_rotations=True, position=tuple(self.rx)
        )
        return self.receiver_handle

    def mark_transmitter(self, valid: bool) -> None:
        """Colours the transmitter by whether its predictions are valid."""
        color = VALID if valid else INVALID
        if tuple(self._ball.color) != color:
            self._ball.color = color

    def camera(self, aspect: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Returns position and target of a camera that sees the whole room in a picture of an aspect (width over height)."""
        if aspect < 1:  # the longest horizontal axis recedes, which uses a tall picture best
            flat = [axis for axis in range(3) if axis != self.up]
            turned = int(np.ptp(self.box, axis=0)[flat].argmax()) == 0
        else:
            turned = False
        # Direction from the middle of the room to the camera, for z upwards; the second horizontal axis recedes.
        from_middle = (-0.08, -0.45, 0.6)
        aside = np.array([from_middle[1], from_middle[0], from_middle[2]] if turned else from_middle)
        direction = np.roll(aside, self.up - 2)
        # Parts of the picture in which the room is seen: middle and half size, relative to half of the picture. On a tall
        # screen the panel covers the lower half.
        wide_window, tall_window = (0.0, 0.0, 0.88, 0.88), (0.0, 0.52, 0.9, 0.4)
        return camera_of(self.box, direction, np.eye(3)[self.up], aspect, tall_window if aspect < 1 else wide_window)

    def heights(self) -> tuple[float, float]:
        """Returns the initial range of drawn heights, which excludes the ceiling."""
        low, high = self.box[:, self.up]
        # Fraction of the room's height that is initially cut off at the top, so that the interior is visible.
        ceiling_cut = 0.02
        return float(low), float(high - ceiling_cut * (high - low))

    def _draw_fixed(self) -> None:
        low, high = self.box
        self.scene.add_frame("/axes", axes_length=1.0, axes_radius=0.02, position=low)
        for axis, name in enumerate("xyz"):
            self.scene.add_label(f"/axes/{name}", f"{name}, 1 m", position=np.eye(3)[axis] * 1.1)
        flat = [axis for axis in range(3) if axis != self.up]
        width, height = (high - low)[flat]
        under = (low + high) / 2
        under[self.up] = low[self.up] - 0.01
        plane: Literal["xy", "xz", "yz"] = ("yz", "xz", "xy")[self.up]
        self.scene.add_grid("/grid", float(width), float(height), plane=plane, cell_size=1.0, position=under, fade_strength=0)
        places = np.unique(self.dataset.tx_positions, axis=0)
        self.samples = self.scene.add_point_cloud(
            "/samples", places.astype(np.float32), (90, 90, 90), point_size=0.035, point_shape="circle", visible=False
        )

    def clip(self, low: float, high: float) -> None:
        """Draws the triangles whose centroid lies between two heights (metres), with one colour per material."""
        shown = (self._centroids[:, self.up] >= low) & (self._centroids[:, self.up] <= high)
        materials = self.dataset.materials
        number = np.zeros(len(shown), int) if materials is None else materials.material
        for material in np.unique(number):
            faces = self.dataset.faces[shown & (number == material)]
            name = f"/room/{material}"
            if not len(faces):
                self.scene.remove_by_name(name)
                continue
            self.scene.add_mesh_simple(
                name,
                self.dataset.vertices.astype(np.float32),
                faces.astype(np.uint32),
                color=figures.material_color(int(material)),
                opacity=0.4,
                side="double",
                flat_shading=True,
                cast_shadow=False,
                receive_shadow=False,
            )

    def draw_dome(self, pas: Float[np.ndarray, "90 360"]) -> None:
        """Draws the received spectrum around the receiver."""
        radius = self.dome_radius
        points, colors = figures.dome(pas, self._rotation, radius)
        places = (points + self.rx).astype(np.float32)
        dome_point = 0.045  # size of a point of the spectrum, relative to that radius
        if self._dome is None:
            self._dome = self.scene.add_point_cloud(
                "/dome", places, colors, point_size=dome_point * radius, point_shape="circle"
            )
        else:  # changing the points is faster than drawing new ones
            self._dome.points, self._dome.colors = places, colors

    def draw_paths(
        self, paths: PathList | None, count: int, by_power: bool, chosen: int | None, on_click: Callable[[int], None]
    ) -> None:
        """Draws the strongest paths, each with a clickable ball; the chosen path is red."""
        if paths is None or not count or not len(paths.power_db):
            for name in ("/paths", "/path_handles", "/chosen_path"):
                self.scene.remove_by_name(name)
            return
        points = paths.points[:count]
        colors = figures.path_colors(paths.power_db[:count], figures.bounces(paths.interaction[:count]), by_power)
        self._draw_lines("/paths", points, colors, 2.0)
        self._draw_handles(figures.path_handles(points), colors, on_click)
        if chosen is not None and chosen < len(points):
            self._draw_lines("/chosen_path", points[chosen : chosen + 1], np.array([[214, 39, 40]], np.uint8), 5.0)
        else:
            self.scene.remove_by_name("/chosen_path")

    def _draw_lines(
        self, name: str, points: Float[np.ndarray, "k 5 3"], colors: UInt8[np.ndarray, "k 3"], thickness: float
    ) -> None:
        segments, ends = figures.path_segments(points, figures.linear(colors))
        self.scene.add_line_segments(name, segments.astype(np.float32), ends, thickness=thickness, thickness_units="screen")

    def _draw_handles(
        self, places: Float[np.ndarray, "k 3"], colors: UInt8[np.ndarray, "k 3"], on_click: Callable[[int], None]
    ) -> None:
        handle_radius = 0.04  # radius of the clickable balls on paths, metres
        vertices, faces = _ball(handle_radius)
        upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(places), 1))
        handle = self.scene.add_batched_meshes_simple(
            "/path_handles",
            vertices,
            faces,
            upright.astype(np.float32),
            places.astype(np.float32),
            batched_colors=figures.linear(colors),
            lod="off",  # a simplified ball has no normals at its poles
            cast_shadow=False,
            receive_shadow=False,
        )

        @handle.on_click
        def _(event: viser.SceneNodePointerEvent) -> None:
            if event.instance_index is not None:
                on_click(int(event.instance_index))

    def draw_gaussians(self, splatted: GaussianState | None, by: str) -> float:
        """Draws the Gaussians, coloured by "signal" or "attenuation"; None removes them. Returns the value of the last
        colour."""
        if splatted is None:
            self.scene.remove_by_name("/gaussians")
            return 0.0
        gaussians = splatted.gaussians
        alive = np.flatnonzero(np.asarray(gaussians.alive))[:20_000]
        attenuation, signal = (np.asarray(values)[alive, 0] for values in (splatted.attenuation, splatted.signal))
        shown = signal if by == "signal" else attenuation
        top = max(float(np.quantile(shown, 0.99)), 1e-6)
        factor = np.asarray(covariance_factor(gaussians.log_scales[alive], gaussians.quats[alive]))
        self.scene.add_gaussian_splats(
            "/gaussians",
            np.asarray(gaussians.means)[alive].astype(np.float32),
            (factor @ factor.swapaxes(-1, -2)).astype(np.float32),
            (figures.colored(shown, 0.0, top, figures.GAUSSIAN_COLORS) / 255).astype(np.float32),
            np.clip(attenuation, 0.05, 1.0)[:, None].astype(np.float32),
        )
        return top

    def remove_map(self) -> None:
        """Removes the map."""
        self.scene.remove_by_name("/map")

    def draw_map(
        self,
        values: Float[np.ndarray, "ny nx"],
        plane: Plane,
        span: tuple[float, float],
        dim: bool,
        on_click: Callable[[float, float], None],
    ) -> None:
        """Draws a map on its plane.

        Args:
            values: powers; NaN where nothing is received.
            plane: their places.
            span: values of the first and the last colour.
            dim: whether the map is shown as an outdated one.
            on_click: called with the place (x, y) of a click on the map, metres.
        """
        picture = figures.map_picture(values, *span, dim)
        middle = np.array([(plane.xs[0] + plane.xs[-1]) / 2, (plane.ys[0] + plane.ys[-1]) / 2, plane.height])
        width, height = (float(np.ptp(a)) * len(a) / max(len(a) - 1, 1) for a in (plane.xs, plane.ys))
        # The first row of the image is its upper edge; it is rotated about x, so that y decreases along rows and it faces up.
        turned = (0.0, 1.0, 0.0, 0.0)
        handle = self.scene.add_image("/map", picture, width, height, position=middle, wxyz=turned, format="png")

        @handle.on_click
        def _(event: viser.SceneNodePointerEvent) -> None:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            if abs(direction[2]) > 1e-6:
                x, y, _ = origin + (plane.height - origin[2]) / direction[2] * direction
                on_click(float(x), float(y))


def camera_of(
    box: Float[np.ndarray, "2 3"],
    direction: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
    aspect: float,
    window: tuple[float, float, float, float],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Returns position and target of a camera that sees a box inside a part of its picture.

    Args:
        box: lowest and highest corner, metres.
        direction: from the box to the camera.
        up: upward direction, a unit vector.
        aspect: width over height of the picture.
        window: middle (right, up) and half size of the part, relative to half of the picture.
    """
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    forward = -direction / np.linalg.norm(direction)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    axes = np.stack([right, np.cross(right, forward), forward])
    slope = np.tan(FIELD_OF_VIEW / 2)
    middle, half = np.array(window[:2]), np.array(window[2:])
    near, far = 1e-3, 20 * float(np.linalg.norm(box[1] - box[0]))
    position = target = box.mean(0)
    for _ in range(40):
        away = (near + far) / 2
        position = box.mean(0) - away * forward
        for _ in range(4):  # moves the camera sideways until the box is in the middle of the part
            seen = (corners - position) @ axes.T
            ends = seen[:, :2] / np.maximum(seen[:, 2:], 1e-6) / (slope * np.array([aspect, 1.0]))
            off = (ends.min(0) + ends.max(0)) / 2 - middle
            position = position + (off * slope * np.array([aspect, 1.0]) * away) @ axes[:2]
        seen = (corners - position) @ axes.T
        ends = seen[:, :2] / np.maximum(seen[:, 2:], 1e-6) / (slope * np.array([aspect, 1.0]))
        fits = (seen[:, 2] > 0.1).all() and (np.abs(ends - middle) <= half + 0.02).all()
        near, far = (near, away) if fits else (away, far)
        target = position + away * forward
    return position, target


def _ball(radius: float) -> tuple[Float[np.ndarray, "v 3"], np.ndarray]:
    """Returns the vertices and faces of a ball with few triangles."""
    sphere = 8  # number of corners around a ball
    zenith, azimuth = np.meshgrid(np.linspace(0, np.pi, sphere // 2 + 1), np.linspace(0, 2 * np.pi, sphere + 1), indexing="ij")
    vertices = radius * np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], -1)
    index = np.arange(zenith.size).reshape(zenith.shape)
    a, b, c, d = (part.reshape(-1) for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return vertices.reshape(-1, 3).astype(np.float32), faces.astype(np.uint32)
