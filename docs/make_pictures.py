"""Draws pictures of concepts.md, formats.md and applications.md from the library: python docs/make_pictures.py [NAME ...].

Colours are viridis and cividis, and lines differ in style as well, so that nothing depends on telling red from green.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

import wbgs_jax as wb
from wbgs_jax.data.conventions import CONVENTIONS, array_of
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.radio.geometry import angles_to_direction, direction_to_angles

FOLDER = Path(__file__).parent / "images"
SPAN = (-180, 180, 90, 0)
"""Degrees at the left, right, bottom and top of a spectrum."""
ROOM = np.array([6.0, 4.0, 2.7])
WALL = 0.1
"""Thickness, metres."""
GHZ = 28e9


def show_pas(axis, pas, title: str, cmap: str = "viridis"):
    """Draws a spectrum over azimuth and zenith in degrees; returns the picture, for a colour bar."""
    picture = axis.imshow(np.asarray(pas), vmin=0, vmax=1, cmap=cmap, extent=SPAN, aspect="auto")
    axis.set(title=title, xticks=range(-180, 181, 90), yticks=(0, 45, 90), xlabel="azimuth φ [deg]", ylabel="zenith θ [deg]")
    return picture


def direction(azimuth: float, zenith: float):
    """Returns the unit vector of angles in degrees."""
    return angles_to_direction(jnp.deg2rad(azimuth), jnp.deg2rad(zenith))


def draw_array() -> Figure:
    """Returns the array in its frame, with one direction and its angles."""
    figure = Figure(figsize=(6.4, 4.8))
    axis = figure.add_axes((0, 0, 1, 1), projection="3d")
    axis.scatter(*wb.radio.planar_array().T, color=colormaps["viridis"](0.3), s=36, depthshade=False)
    for vector, name in zip(np.eye(3), ("x, where the array looks", "y", "z, zenith of the spectrum"), strict=True):
        axis.quiver(0, 0, 0, *(1.5 * vector), color="black", arrow_length_ratio=0.07)
        axis.text(*(1.6 * vector + [0, 0, 0.04 if vector[2] else -0.15]), name, ha="center")
    azimuth, zenith = 50.0, 55.0
    k = np.asarray(direction(azimuth, zenith)) * 1.5
    axis.quiver(0, 0, 0, *k, color=colormaps["viridis"](0.65), linewidth=2.5, arrow_length_ratio=0.08)
    axis.text(*(1.08 * k), "k, towards the source")
    axis.plot([0, k[0], k[0]], [0, k[1], k[1]], [0, 0, k[2]], "--", color="grey")
    draw_arc(axis, np.linspace(0, azimuth, 30), 90.0, 0.6, "φ")
    draw_arc(axis, azimuth, np.linspace(0, zenith, 30), 0.6, "θ")
    axis.set(xlim=(-0.8, 1.6), ylim=(-0.8, 1.6), zlim=(-0.8, 1.6))
    axis.set_box_aspect((1, 1, 1), zoom=1.2)
    axis.set_axis_off()
    axis.view_init(20, 40)
    return figure


def draw_arc(axis, azimuth, zenith, radius: float, name: str) -> None:
    """Draws the arc of an angle in degrees, one of the two an array, with its name in the middle."""
    arc = radius * np.asarray(direction(*np.broadcast_arrays(azimuth, zenith)))
    axis.plot(*arc.T, ":", color="black")
    axis.text(*(1.2 * arc[len(arc) // 2]), name, fontsize=12)


def draw_conventions() -> Figure:
    """Returns, for both orders of a folder's pixels, the plane of the array and the same wave as the folder's image."""
    figure = Figure(figsize=(10, 6.4), layout="constrained")
    towards = np.asarray(direction(60.0, 50.0))
    for row, name in enumerate(CONVENTIONS):
        elements = np.asarray(array_of(name))
        axis = figure.add_subplot(2, 2, 2 * row + 1, projection="3d")
        axis.scatter(*elements.T, color=colormaps["viridis"](0.3), s=24, depthshade=False)
        for vector, label in zip(np.eye(3), ("x, azimuth 0°", "y, azimuth 90°", "z, zenith"), strict=True):
            axis.quiver(0, 0, 0, *(1.5 * vector), color="black", arrow_length_ratio=0.07)
            axis.text(*(1.7 * vector), label, ha="center")
        axis.quiver(0, 0, 0, *(1.5 * towards), color=colormaps["viridis"](0.65), linewidth=2.5, arrow_length_ratio=0.08)
        axis.set(xlim=(-0.8, 1.6), ylim=(-0.8, 1.6), zlim=(-0.8, 1.6), title=f"convention: {name}")
        axis.set_box_aspect((1, 1, 1), zoom=1.15)
        axis.set_axis_off()
        axis.view_init(20, 40)
        flat = figure.add_subplot(2, 2, 2 * row + 2)
        wave = wb.radio.steering_vector(jnp.asarray(elements), jnp.asarray(towards, jnp.float32))
        pas = np.asarray(wb.radio.snapshot_to_pas(wave, jnp.asarray(elements)))
        if name == "zenith":
            show_pas(flat, pas, "image in the folder")
            continue
        flat.imshow(np.roll(pas, -180, 1)[::-1], vmin=0, vmax=1, extent=(0, 359, 89, 0), aspect="auto")
        flat.set(title="image in the folder", xticks=range(0, 360, 90), yticks=(0, 45, 89))
        flat.set(xlabel="azimuth φ [deg]", ylabel="elevation 90° - θ [deg]")
    return figure


def draw_plane_wave() -> Figure:
    """Returns the spectrum of one plane wave, which has a twin behind the array, and that of an 8 x 8 array."""
    figure = Figure(figsize=(10, 3.1), layout="constrained")
    wave = direction(40.0, 60.0)
    for axis, side in zip(figure.subplots(1, 2), (4, 8), strict=True):
        elements = jnp.asarray(wb.radio.planar_array(side, side), jnp.float32)
        pas = wb.radio.snapshot_to_pas(wb.radio.steering_vector(elements, wave), elements)
        picture = show_pas(axis, pas, f"{side} x {side} elements")
        axis.plot(40, 60, "o", mec="white", mfc="none", ms=12, mew=2)
        axis.plot(140, 60, "s", mec="white", mfc="none", ms=12, mew=2)
        axis.annotate("source", (40, 60), (-40, 32), color="white", arrowprops={"arrowstyle": "->", "color": "white"})
        axis.annotate("twin", (140, 60), (110, 20), color="white", arrowprops={"arrowstyle": "->", "color": "white"})
    figure.colorbar(picture, ax=figure.axes, label="normalised amplitude")
    return figure


def made_up_gaussians(count: int = 14) -> wb.splat.Gaussians:
    """Returns elongated Gaussians around a receiver at the origin."""
    rng = np.random.default_rng(4)
    azimuth, zenith = rng.uniform(-2.9, 2.9, count), rng.uniform(0.5, 1.45, count)
    means = rng.uniform(1.5, 4, (count, 1)) * np.asarray(angles_to_direction(jnp.asarray(azimuth), jnp.asarray(zenith)))
    scales = np.log(rng.uniform([0.05, 0.1, 0.2], [0.15, 0.3, 0.6], (count, 3)))
    arrays = means, scales, rng.normal(size=(count, 4)), np.zeros(count)
    return wb.splat.Gaussians(*(jnp.asarray(a, jnp.float32) for a in arrays))


def draw_splatting() -> Figure:
    """Returns Gaussians around a receiver, and what becomes of them on the hemisphere of the spectrum."""
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    gaussians, receiver = made_up_gaussians(), wb.make_receiver([0.0, 0.0, 0.0])
    n = len(gaussians.means)
    signal = jnp.linspace(0.25, 1.0, n)[:, None]
    space = figure.add_subplot(1, 2, 1, projection="3d")
    space.scatter(*np.asarray(gaussians.means).T, c=np.asarray(signal[:, 0]), s=60, vmin=0, vmax=1, depthshade=False)
    space.scatter(0, 0, 0, marker="^", color="black", s=60)
    for mean in np.asarray(gaussians.means):
        space.plot(*np.stack([0 * mean, mean]).T, ":", color="grey", linewidth=0.8)
    space.set(title="Gaussians around the receiver (triangle)", xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    flat = figure.add_subplot(1, 2, 2)
    plan = wb.splat.geometry_plan(gaussians, receiver)
    image = wb.splat.render_splats(plan, attenuation=jnp.full((n, 1), 0.9), signal=signal)[0]
    picture = show_pas(flat, image, "the same, projected and blended")
    for degrees in np.rad2deg(np.stack(direction_to_angles(gaussians.means), -1)):
        flat.plot(*degrees, "+", color="white")
    figure.colorbar(picture, ax=flat, label="signal times attenuation")
    return figure


def two_paths(frequency_hz: float, longer: float):
    """Returns the snapshots (2, 16) of two plane waves of equal strength, the second one `longer` metres behind."""
    elements = jnp.asarray(wb.radio.planar_array(), jnp.float32)
    steering = wb.radio.steering_vector(elements, jnp.stack([direction(-10.0, 55.0), direction(20.0, 75.0)]))
    turn = jnp.exp(-2j * jnp.pi * frequency_hz / SPEED_OF_LIGHT * jnp.array([0.0, longer]))
    return steering * turn[:, None]


def draw_coherent() -> Figure:
    """Returns spectra of two paths whose lengths differ by nothing, a third and half of a wavelength, and without phases."""
    figure = Figure(figsize=(10, 4.4), layout="constrained")
    elements = jnp.asarray(wb.radio.planar_array(), jnp.float32)
    axes = figure.subplots(2, 2).ravel()
    millimetres = 1e3 * SPEED_OF_LIGHT / GHZ
    for axis, share in zip(axes, (0.0, 1 / 3, 1 / 2), strict=False):
        waves = two_paths(GHZ, share * SPEED_OF_LIGHT / GHZ)
        name = f"phases known, second path {share * millimetres:.1f} mm longer"
        picture = show_pas(axis, wb.radio.snapshot_to_pas(waves.sum(0), elements), name)
    steering = wb.radio.steering_vector(elements, jnp.asarray(wb.radio.pas_directions(), jnp.float32))
    blind = jnp.sqrt(jnp.sum(wb.radio.cbf(two_paths(GHZ, 0.0), steering) ** 2, 0))
    show_pas(axes[3], blind / blind.max(), "phases unknown: powers added")
    for axis in axes[:2]:
        axis.set_xlabel("")
    figure.colorbar(picture, ax=list(axes), label="normalised amplitude")
    figure.suptitle("Two equally strong paths at 28 GHz: a wavelength is 10.7 mm", fontsize=11)
    return figure


def box_mesh() -> wb.Mesh:
    """Returns the walls, floor and ceiling of a room of concrete that is open to nothing."""
    corners = np.stack(np.meshgrid(*([0.0, side] for side in ROOM), indexing="ij"), -1).reshape(-1, 3)
    quads = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
    faces = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    none = np.zeros(len(faces), np.int32)
    thickness = jnp.full(1, WALL, jnp.float32)
    return wb.Mesh(jnp.asarray(corners, jnp.float32), jnp.asarray(faces), jnp.asarray(none), jnp.asarray(none), thickness)


def draw_paths() -> Figure:
    """Returns the paths of one transmitter in a room, from above, and the spectrum of their sum."""
    figure = Figure(figsize=(10, 3.8), layout="constrained", dpi=100)
    plan_view, flat = figure.subplots(1, 2, width_ratios=(1.1, 1))
    field = wb.coherent.make_field(box_mesh())
    params, receiver = field.init(jax.random.key(0)), wb.make_receiver([0.8, 1.0, 1.0])
    plan, query = field.plan(params, receiver), wb.make_query([4.6, 3.0, 1.8], GHZ)
    traced = jax.tree.map(lambda a: np.asarray(a[0]), wb.coherent.trace(plan, query.tx_position).specular)
    for points, alive, types in zip(traced.points, traced.alive, traced.interaction_type, strict=True):
        order = int((types == 2).sum())
        if alive and order < 3 and np.ptp(points[:, 2]) < 1:  # those that stay between floor and ceiling, seen from above
            style = ("-", "--", ":")[order]
            plan_view.plot(*points[:, :2].T, style, color=colormaps["viridis"](0.05 + 0.32 * order), linewidth=2 - 0.5 * order)
    for order, style in enumerate(("-", "--", ":")):
        name = ("line of sight", "one reflection", "two reflections")[order]
        plan_view.plot([], [], style, color=colormaps["viridis"](0.05 + 0.32 * order), label=name)
    draw_room(plan_view, np.asarray(receiver.position), np.asarray(query.tx_position[0]))
    picture = show_pas(flat, wb.coherent.render(params, plan, query)[0], "what the array sees at 28 GHz")
    figure.colorbar(picture, ax=flat, label="normalised amplitude")
    return figure


def draw_room(axis, receiver, transmitter) -> None:
    """Draws the walls from above with receiver, transmitter and legend."""
    axis.plot([0, ROOM[0], ROOM[0], 0, 0], [0, 0, ROOM[1], ROOM[1], 0], color="black", linewidth=3)
    axis.plot(*receiver[:2], "^", color="black", ms=10, label="receiver")
    axis.plot(*transmitter[:2], "o", color="black", ms=8, label="transmitter")
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="paths between floor and ceiling, from above")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=3, fontsize=8, frameon=False)


def draw_movement() -> Figure:
    """Returns a person who walks through a link of 60 GHz in a room: received power over time, and the spectrogram."""
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    field, receiver = wb.coherent.make_field(box_mesh()), wb.make_receiver([0.8, 2.0, 1.2])
    field, params, body = wb.applications.add_body(
        field, field.init(jax.random.key(0)), wb.applications.person([2.4, 0.6, 0.0], azimuth=np.pi / 2)
    )
    rate, instants = 2000.0, 5000
    seconds = np.arange(instants) / rate
    motion = wb.applications.make_movement(field, instants, {body: 1.2 * seconds[:, None] * np.array([0, 1, 0])})
    tx = np.broadcast_to([5.0, 2.2, 1.4], (instants, 3))
    plan = wb.applications.plan_movement(field, params, receiver, tx, motion)
    paths = wb.applications.paths_over_time(params, plan, wb.make_query(tx, 60e9), motion)
    response = paths.amplitude.sum(-1)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1, 1.4))
    above.plot(seconds, 20 * np.log10(np.abs(response)), linewidth=0.8, color=colormaps["viridis"](0.3))
    above.set(ylabel="received power [dB]", title="A person walks through a link of 60 GHz at 1.2 m/s")
    hertz, times, power = wb.applications.doppler_spectrogram(response - response.mean(), rate, 256)
    picture = below.pcolormesh(times, hertz, power, vmin=float(power.max()) - 50, shading="nearest", rasterized=True)
    below.set(xlabel="time [s]", ylabel="Doppler shift [Hz]", xlim=seconds[[0, -1]], ylim=(-600, 600))
    figure.colorbar(picture, ax=below, label="power density [dB]")
    return figure


PICTURES: dict[str, Callable[[], Figure]] = {
    "array": draw_array,
    "plane_wave": draw_plane_wave,
    "splatting": draw_splatting,
    "coherent": draw_coherent,
    "paths": draw_paths,
    "conventions": draw_conventions,
    "movement": draw_movement,
}


def main(names: list[str]) -> None:
    """Draws the pictures of some names, or all."""
    for name in names or PICTURES:
        file = FOLDER / f"concept_{name}.png"
        PICTURES[name]().savefig(file, dpi=90, metadata={"Software": None})
        print(file.relative_to(FOLDER.parent))


if __name__ == "__main__":
    main(sys.argv[1:])
