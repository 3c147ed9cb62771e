"""Every reader of the product: how whole files for it are made, and how it is asked to read them."""

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import trimesh
from plyfile import PlyData
from scipy.io import savemat

from builders.drawn_paths import angles_of
from builders.synthetic import tiny_dataset, tiny_scene
from builders.untrained import make_run, make_trained
from data_gen import jobs as batches
from data_gen.example.make_room import HERE as ROOM
from data_gen.example.make_room import OBJECTS
from data_gen.own_scene import own_scene
from experiments.jobs import Job
from experiments.results import Results
from wbgs_jax._util.files import read_json, read_yaml
from wbgs_jax.data import load_dataset, save_scene
from wbgs_jax.data.antenna_file import read_antenna
from wbgs_jax.data.floor_plan import load_walls
from wbgs_jax.data.image_folder import export_layout
from wbgs_jax.data.rssi_folder import cell_means, load_readings
from wbgs_jax.data.scene_file import Room, load_room, save_room
from wbgs_jax.inference.export import export_field, load_exported
from wbgs_jax.inference.intervals import read_confidence, read_power_confidence
from wbgs_jax.inference.kriging import read_neighbours
from wbgs_jax.inference.queries import read_queries
from wbgs_jax.inference.results_file import open_parts
from wbgs_jax.interchange.deepmimo import as_deepmimo, is_deepmimo, load_deepmimo, write_deepmimo
from wbgs_jax.interchange.gaussian_ply import read_gaussians, write_gaussians
from wbgs_jax.interchange.ray_paths import RayPaths, read_paths, save_paths
from wbgs_jax.interchange.scenes import scene_of_paths
from wbgs_jax.interchange.sionna_arrays import scene_of_sionna
from wbgs_jax.mesh.ply import read_ply, write_ply
from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array
from wbgs_jax.training import curves
from wbgs_jax.training.run_folder import (
    load_trained,
    read_config,
    write_manifest,
)
from wbgs_jax.types import Gaussians


@dataclass(frozen=True)
class Readable:
    """Files that are read together."""

    make: Callable[[Path], Any]
    """Writes whole ones into a folder."""
    read: Callable[[Path], Any]
    """Reads them there."""
    damaged: str = "**/*"
    """Which of them are damaged, one at a time."""


def _paths() -> RayPaths:
    """Paths that meet one or two surfaces, with the lengths and directions of the lines through these places."""
    draw = np.random.default_rng(0)
    shape, met = (6, 2, 3), draw.choice([1, 4, 8], (2, 6, 2, 3)).astype(np.int32)
    met[1] *= draw.integers(0, 2, shape)
    first, second = vertices = draw.normal(size=(*met.shape, 3))
    sources, targets = 0.3 * draw.normal(size=(2, 3)), 0.3 * draw.normal(size=(6, 3))
    second = np.where(met[1, ..., None] > 0, second, first)
    legs = first - sources[None, :, None], second - first, targets[:, None, None] - second
    return RayPaths(
        a=0.1 * (draw.normal(size=shape) + 1j * draw.normal(size=shape)),
        tau=sum(np.linalg.norm(leg, axis=-1) for leg in legs) / SPEED_OF_LIGHT,
        **dict(zip(("theta_t", "phi_t", "theta_r", "phi_r"), (*angles_of(legs[0]), *angles_of(-legs[2])), strict=True)),
        interactions=met,
        vertices=vertices,
        valid=np.ones(shape, bool),
        sources=sources,
        targets=targets,
        frequency_hz=28e9,
    )


def _make_format_1(folder: Path) -> None:
    scene = tiny_scene()
    arrays: dict[str, Any] = {f.name: getattr(scene, f.name) for f in dataclasses.fields(scene)}
    kept = {key: value for key, value in arrays.items() if isinstance(value, np.ndarray)}
    for key in ("rx_position", "rx_orientation", "element_positions"):
        kept[key] = kept[key][0]
    meta = {"format": 1, "name": "box", "rx_array": {"pattern": "iso"}, **scene.meta}
    np.savez(folder / "scene.npz", **kept | {"snapshots": scene.snapshots[:, 0]}, meta=np.array(json.dumps(meta)))


def _make_layout(folder: Path) -> None:
    export_layout(tiny_scene(3, kind="pas"), folder / "layout")


def _make_ply(folder: Path, text: bool) -> None:
    write_ply(folder / "mesh.ply", tiny_scene().vertices, tiny_scene().faces)
    if text:
        content = PlyData.read(folder / "mesh.ply", mmap=False)
        PlyData(content.elements, text=True).write(folder / "mesh.ply")


def _make_gaussians(folder: Path) -> None:
    draw = np.random.default_rng(0)
    parts = [jnp.asarray(draw.normal(size=(5, n)), jnp.float32) for n in (3, 3, 4)]
    write_gaussians(folder / "splats.ply", Gaussians(*parts, jnp.zeros(5)))


def _make_mat(folder: Path) -> None:
    savemat(folder / "scenario.mat", as_deepmimo(_paths()))


def _scene_of(paths: RayPaths) -> Any:
    return scene_of_paths([paths.reversed()], planar_array(2, 2), "x")


def _read_sionna(folder: Path) -> Any:
    path = folder / "paths.npz"
    return None if is_deepmimo(path) else scene_of_sionna(read_paths(path), "x", swap=True)


def _make_readings(folder: Path) -> None:
    (folder / "readings.csv").write_text(
        "x,y,z,room,rssi_a,rssi_b\n1,2,1,hall,-60,-71.5\n2,2,1,hall,,-70\n3,1,1.2,kitchen,-55,\n"
    )
    (folder / "receivers.csv").write_text("id,x,y,z\na,0,0,2\nb,5,5,2.5\n")
    (folder / "README.md").write_text("# Data\n\nLicence: CC BY 4.0\n")


def _make_room_file(folder: Path) -> None:
    box = trimesh.creation.box()
    parts = [{"name": "box", "material": "wood", "thickness": 0.02}]
    save_room(folder / "room.npz", Room(np.float32(box.vertices), np.int32(box.faces), np.zeros(12, np.int32), parts))


def _make_rssi(folder: Path) -> None:
    (folder / "tx_pos.csv").write_text("x,y,z\n1,2,1\n2,2,1\n")
    (folder / "gateway_position.yml").write_text("gateway1: [0, 0, 2]\ngateway2: [4, 1, 2]\nname: house\n")
    (folder / "gateway_rssi.csv").write_text("g1,g2\n-60,-100\n-70.5,-44\n")


def _make_csi(folder: Path) -> None:
    (folder / "tx_pos.csv").write_text("x,y,z\n1,2,1\n2,2,1\n")
    (folder / "base-station.yml").write_text("base_station: [[0, 0, 2], [4, 1, 2]]\n")
    draw = np.random.default_rng(0)
    np.save(folder / "csidata.npy", draw.normal(size=(2, 2, 4)) + 1j * draw.normal(size=(2, 2, 4)))


def _make_beside(folder: Path) -> None:
    """What lies in a run folder beside its checkpoints."""
    sizes = {
        "rx_position": (3,),
        "tx_position": (4, 3),
        "frequency_hz": (4,),
        "images": (4, 90, 360),
        "scale": (),
        "weight": (),
    }
    np.savez(
        folder / "neighbours.npz", **{k: np.ones(s, np.float32) for k, s in sizes.items()}, own=np.ones(()), length=np.ones(())
    )
    curves.append(folder / "metrics.jsonl", {"step": 2, "loss": 0.5})
    curves.append(folder / "metrics.jsonl", {"step": 4, "loss": 0.25})


def _read_beside(folder: Path) -> Any:
    entries = curves.read(folder / "metrics.jsonl")
    curves.forget_after(folder / "metrics.jsonl", 3)
    return entries, read_neighbours(folder), read_confidence(folder), read_power_confidence(folder)


def _make_manifest(folder: Path) -> None:
    (folder / "manifest.json").write_text(
        json.dumps({"format": 1, "training": {"steps": 5}, "scores": {"test": {"ssim": 0.5}}})
    )


_trained: list[Any] = []


def _read_manifest(folder: Path) -> Any:
    if not _trained:
        _trained.append(make_trained(folder))
    return write_manifest(folder, _trained[0], None)


QUESTION = {"what": "power", "queries": "0123", "source": {"receiver": {"position": [0, 0, 1]}}}


def _make_parts(folder: Path) -> None:
    parts = open_parts(folder / "out.npz", QUESTION, resume=False)
    for _ in range(2):
        parts.add({"power_db": np.zeros(4, np.float32), "pas": np.zeros((4, 9, 36), np.float32)})


def _read_parts(folder: Path) -> Any:
    parts = open_parts(folder / "out.npz", QUESTION, resume=True)
    return [parts.whole(name) for name in parts.names()] if len(parts) else None


def _make_result(folder: Path) -> None:
    job = Job("1", "baselines")
    Results("quick", folder).write(job, {"ssim": {"1": [0.5]}, "tx": [0], "average_of_medians": 0.5, "training_seconds": 1.0})


def _read_result(folder: Path) -> Any:
    found = Results("quick", folder).get(Job("1", "baselines"))
    return found and (found.ghz, found.tx, found.ssim, found.seconds)


def _make_room(folder: Path, suffix: str) -> None:
    for name in ("room.obj", "materials.toml"):
        (folder / name).write_bytes((ROOM / name).read_bytes())
    if suffix == ".glb":
        scene = trimesh.Scene()
        for name, quads in OBJECTS.items():
            turned = np.reshape(quads, (-1, 3))[:, [0, 2, 1]] * [1, 1, -1]  # y is up
            corners = np.arange(len(turned)).reshape(-1, 4)
            mesh = trimesh.Trimesh(turned, corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3), process=False)
            scene.add_geometry(mesh, node_name=name, geom_name=name)
        scene.export(folder / "room.glb")


XML = """<scene version="2.1.0"><bsdf type="itu-radio-material" id="panes"><string name="type" value="glass"/>
<float name="thickness" value="0.007"/></bsdf><shape type="ply" id="walls"><string name="filename" value="walls.ply"/>
<transform name="to_world"><scale value="2"/><rotate x="0" y="0" z="1" angle="90"/><translate x="1" y="0" z="0"/>
<matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/></transform><ref id="panes" name="bsdf"/></shape></scene>"""


def _make_xml(folder: Path) -> None:
    (folder / "room.xml").write_text(XML)
    write_ply(folder / "walls.ply", tiny_scene().vertices, tiny_scene().faces)


def _read_room(folder: Path, suffix: str) -> Any:
    toml = folder / "materials.toml"
    return own_scene(
        folder / f"room{suffix}", toml if toml.exists() else None, rx="0.8,2.4,1.2", tx_grid="1.6,0.5,0.5:5.4,4,2.3:2,2,2"
    )


def _make_batch(folder: Path) -> None:
    np.savez(folder / "0000.npz", n_paths=np.ones((4, 2), int), snapshots=np.ones((4, 2, 16), np.complex64))


def _make_antennas(folder: Path) -> None:
    """The same pattern as a table, as an archive and as two cuts."""
    rows = [f"{azimuth},{zenith},3" for zenith in range(0, 181, 45) for azimuth in range(0, 360, 90)]
    (folder / "a.csv").write_text("\n".join(["azimuth_deg,zenith_deg,gain_dbi", *rows]))
    zenith, azimuth = np.radians(np.arange(0, 181, 45)), np.radians(np.arange(0, 360, 90))
    np.savez(folder / "a.npz", e_theta=np.ones((5, 4), complex), e_phi=np.ones((5, 4), complex), zenith=zenith, azimuth=azimuth)
    cut = [f"{i} {i % 7}" for i in range(360)]
    (folder / "a.msi").write_text("\n".join(["GAIN 3 dBi", "HORIZONTAL 360", *cut, "VERTICAL 360", *cut]))


READABLES: dict[str, Readable] = {
    "scene file": Readable(lambda f: save_scene(f / "scene.npz", tiny_scene()), lambda f: load_dataset(f / "scene.npz")),
    "scene file of powers": Readable(
        lambda f: save_scene(f / "scene.npz", tiny_scene(n_rx=2, kind="power")), lambda f: load_dataset(f / "scene.npz")
    ),
    "scene file, format 1": Readable(_make_format_1, lambda f: load_dataset(f / "scene.npz")),
    "published layout": Readable(_make_layout, lambda f: load_dataset(f / "layout")),
    "binary PLY mesh": Readable(lambda f: _make_ply(f, False), lambda f: read_ply(f / "mesh.ply")),
    "text PLY mesh": Readable(lambda f: _make_ply(f, True), lambda f: read_ply(f / "mesh.ply")),
    "Gaussians in PLY": Readable(_make_gaussians, lambda f: read_gaussians(f / "splats.ply")),
    "DeepMIMO folder": Readable(
        lambda f: write_deepmimo(f / "s", as_deepmimo(_paths()), 28e9),
        lambda f: _scene_of(load_deepmimo(f / "s")),
    ),
    "DeepMIMO archive": Readable(
        lambda f: np.savez(f / "s.npz", **as_deepmimo(_paths())),
        lambda f: _scene_of(load_deepmimo(f / "s.npz", 28e9)),
    ),
    "DeepMIMO in MATLAB's format": Readable(_make_mat, lambda f: _scene_of(load_deepmimo(f / "scenario.mat", 28e9))),
    "paths of Sionna RT": Readable(lambda f: save_paths(f / "paths.npz", _paths()), _read_sionna),
    "queries": Readable(
        lambda f: (f / "q.csv").write_text("x,y,z,ghz\n1,2,1.5,28\n-1,0.5,1,2.4\n"), lambda f: read_queries(f / "q.csv")
    ),
    "YAML": Readable(
        lambda f: (f / "g.yml").write_text("a: [1, 2.5]\nb: {c: x, d: [null, true]}\ne: |\n  text\n"),
        lambda f: read_yaml(f / "g.yml"),
    ),
    "JSON": Readable(lambda f: (f / "x.json").write_text('{"a": [1, {"b": null}]}'), lambda f: read_json(f / "x.json")),
    "configuration of a run": Readable(lambda f: make_run(f / "run"), lambda f: read_config(f / "run"), "run/config.json"),
    "checkpoint": Readable(lambda f: make_run(f / "run"), lambda f: load_trained(f / "run"), "run/checkpoints/**/*"),
    "curves and neighbours of a run": Readable(_make_beside, _read_beside),
    "manifest of a run": Readable(_make_manifest, _read_manifest, "manifest.json"),
    "exported field": Readable(
        lambda f: export_field(make_trained(f), f / "field.zip", ("cpu",), tiny_dataset()),
        lambda f: load_exported(f / "field.zip"),
        "field.zip",
    ),
    "answers of an interrupted prediction": Readable(_make_parts, _read_parts),
    "readings of powers": Readable(_make_readings, lambda f: cell_means(load_readings(f, 1.3), 0.5)),
    "walls": Readable(
        lambda f: (f / "walls.csv").write_text("x1,y1,x2,y2\n0,0,5,0\n5,0,5,4\n"), lambda f: load_walls(f / "walls.csv")
    ),
    "NeRF2's powers": Readable(_make_rssi, lambda f: load_readings(f, 1.3)),
    "NeRF2's channel state": Readable(_make_csi, lambda f: load_readings(f, 1.3)),
    "result of an experiment": Readable(_make_result, _read_result),
    "room in OBJ": Readable(lambda f: _make_room(f, ".obj"), lambda f: _read_room(f, ".obj")),
    "room in GLB": Readable(lambda f: _make_room(f, ".glb"), lambda f: _read_room(f, ".glb"), "room.glb"),
    "room in Mitsuba's XML": Readable(_make_xml, lambda f: _read_room(f, ".xml")),
    "room file": Readable(_make_room_file, lambda f: load_room(f / "room.npz")),
    "antenna patterns": Readable(_make_antennas, lambda f: [read_antenna(path) for path in sorted(f.glob("a.*"))]),
    "batch of the generator": Readable(_make_batch, lambda f: batches._load(f / "0000.npz")),
}
