"""Convert a trained field for other programs, or their paths and models to files for training:

wbgs-jax convert --run RUN --tx x,y,z --ghz 28 --out gaussians.ply          Gaussians, for splat viewers
wbgs-jax convert --example --tx x,y,z [x,y,z ...] --ghz 28 --out paths.npz  paths as arrays of sionna.rt.Paths
wbgs-jax convert --run RUN --grid LOW:HIGH:NXxNYxNZ --ghz 28 --out folder   a DeepMIMO scenario
wbgs-jax convert --paths sionna.npz --array 4x4 --out scene.npz             paths of Sionna RT as a scene file
wbgs-jax convert --paths scenario --ghz 28 --array 4x4 --out scene.npz      a DeepMIMO scenario as a scene file
wbgs-jax convert room.glb --materials materials.toml --out data/room.npz    a model of a room, for measured spectra
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from jaxtyping import Float

from wbgs_jax._util.cli import parse_positions, run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import check_writable
from wbgs_jax.commands.options import EXAMPLE, check_effects, load_field, parse_frequencies, warn
from wbgs_jax.inference.queries import parse_array, parse_grid

# Modules that load JAX are imported where they are used, as in predict.py.

RUN, MODEL, SIONNA, DEEPMIMO = "--run", "a model", "paths of Sionna RT", "paths of DeepMIMO"
KINDS = {
    **dict.fromkeys(("materials", "scale"), (MODEL,)),
    "up": (MODEL, SIONNA, DEEPMIMO),
    **dict.fromkeys(("tx", "grid", "rx"), (RUN,)),
    "ghz": (RUN, SIONNA, DEEPMIMO),
    **dict.fromkeys(("array", "mesh", "swap"), (SIONNA, DEEPMIMO)),
    **dict.fromkeys(("port", "tx_antenna"), (SIONNA,)),
    **dict.fromkeys(("tx_set", "tx_index", "rx_set"), (DEEPMIMO,)),
}
"""Inputs that options belong to."""


@dataclass(frozen=True)
class Command:
    """Convert a trained field for other programs, or their paths and models to files for training."""

    out: Path
    """Output. With --run: .ply (Gaussians), .npz (paths) or a folder (DeepMIMO); otherwise a scene or room file, .npz."""
    model: tyro.conf.Positional[Path | None] = None
    """Input, one of four: a model of a room (.glb, .gltf, .obj, .ply, or .xml of Sionna RT), ..."""
    run: Path | None = None
    """... the run folder of a trained field, ..."""
    example: tyro.conf.FlagCreatePairsOff[bool] = False
    """... the trained field in the package, of scene 1, ..."""
    paths: Path | None = None
    """... or paths: an .npz file with the arrays of sionna.rt.Paths, or a DeepMIMO scenario (folder, .npz, .mat)."""
    materials: Path | None = None
    """Model: a .toml file with the materials of its objects (docs/own_scene.md)."""
    up: Literal["y", "z"] | None = None
    """Model, also of --mesh: the axis that points upwards; by default y for .glb and .gltf, z for others."""
    scale: float | None = None
    """Model: length of its unit in metres."""
    tx: tuple[str, ...] = ()
    """Run: transmitters, each as x,y,z in metres."""
    grid: str = ""
    """Run: a grid of transmitters instead, LOWEST:HIGHEST:NXxNYxNZ, such as -2,-2,1.5:2,2,1.5:9x9x1."""
    ghz: float | None = None
    """Frequency; with --paths only if the file lacks it."""
    rx: str = ""
    """Run: the receiver (see `wbgs-jax predict --help`)."""
    array: str = ""
    """Paths: the receivers' array, ROWSxCOLUMNS elements half a wavelength apart; by default that of the file, else 4x4."""
    port: int | None = None
    """Paths with two polarisations: the one to use, 1 or 2."""
    tx_antenna: int | None = None
    """Paths with several antennas per transmitter: the one to use, 1, 2, ..."""
    mesh: Path | None = None
    """Paths: the room, as a room file or a model in metres."""
    swap: bool = False
    """Paths: swap both ends; the transmitters of Sionna RT, or the users of DeepMIMO, become the receivers."""
    tx_set: int | None = None
    """DeepMIMO: index of the set of base stations, ..."""
    tx_index: int | None = None
    """... of one base station in it (by default all), ..."""
    rx_set: int | None = None
    """... and of the set of users."""

    @property
    def folder(self) -> Path | None:
        """The folder of the trained field that is converted, if any."""
        return EXAMPLE if self.example else self.run


def check(command: Command) -> None:
    """Raises a `UserError` for an invalid command line."""
    if [command.run, command.example or None, command.paths, command.model].count(None) != 3:
        raise UserError(
            "give one of --run RUN and --example, to convert a trained field, --paths FILE, to create a scene file from paths, "
            "or a model such as room.glb, to create a room file"
        )
    kinds = (RUN,) if command.folder else (MODEL,) if command.model else (SIONNA, DEEPMIMO)
    check_effects(command, KINDS, kinds, " or ".join(kinds))
    if command.paths and command.up and command.mesh is None:
        raise UserError("--up has no effect on paths alone; it belongs to the model, --mesh room.glb")
    if command.folder is None and command.out.suffix != ".npz":
        raise UserError(f"--out {command.out} does not end in .npz, as scene files and room files must")
    if command.folder is None:
        return
    if bool(command.tx) == bool(command.grid) or command.ghz is None:
        raise UserError("--run needs transmitters and a frequency: give either --tx x,y,z or --grid, and --ghz 28")
    if command.out.suffix not in (".ply", ".npz", ""):
        raise UserError(f"--out {command.out} is of an unknown kind; give gaussians.ply, paths.npz, or a folder for DeepMIMO")


def hand_on(command: Command) -> str:
    """Writes the Gaussians or paths of a trained field, and returns a line for the user."""
    assert command.folder is not None and command.ghz is not None, "checked"
    positions = parse_grid(command.grid) if command.grid else parse_positions(command.tx)
    hertz = parse_frequencies((command.ghz,))
    field = load_field(command.folder, command.rx, float(hertz[0]))
    warn(field.domain, field.receiver.position, positions, hertz, 3)
    write = _write_gaussians if command.out.suffix == ".ply" else _write_paths
    return write(command, field.trained, field.receiver, positions, float(hertz[0]))


def _write_gaussians(
    command: Command, trained: Any, receiver: Any, positions: Float[np.ndarray, "tx 3"], frequency_hz: float
) -> str:
    """Writes the Gaussians: brighter colours stand for a stronger signal towards the receiver, opacity for attenuation."""
    from matplotlib import colormaps

    from wbgs_jax.interchange.gaussian_ply import write_gaussians
    from wbgs_jax.types import make_query

    plan = trained.field.plan(trained.params, receiver)
    query = make_query(positions, np.full(len(positions), frequency_hz))
    seen = trained.field.inspect(trained.params, plan, query).gaussians
    if seen is None:
        raise UserError(
            f"the {trained.field.name} field of this run has no Gaussians; train one that has (docs/which_field.md)"
        )
    signal, attenuation = (np.abs(np.asarray(values)).mean(1) for values in (seen.signal, seen.attenuation))
    bright = 0.99  # quantile of the brightness at which the colour map ends
    brightest = max(float(np.quantile(signal[np.asarray(seen.gaussians.alive)], bright)), 1e-12)
    colours = colormaps["viridis"](np.clip(signal / brightest, 0, 1))[:, :3]
    count = write_gaussians(command.out, seen.gaussians, colours, attenuation)
    return f"Gaussians: {command.out} ({count}, coloured by their mean signal at {command.ghz:g} GHz)"


def _write_paths(
    command: Command, trained: Any, receiver: Any, positions: Float[np.ndarray, "tx 3"], frequency_hz: float
) -> str:
    from wbgs_jax.inference.evaluate_quantities import predict_paths
    from wbgs_jax.interchange.deepmimo import as_deepmimo, write_deepmimo
    from wbgs_jax.interchange.ray_paths import from_paths, save_paths

    found = predict_paths(trained, receiver, positions, frequency_hz)
    paths = from_paths(found, positions, np.asarray(receiver.position), frequency_hz)
    if command.out.suffix == ".npz":
        save_paths(command.out, paths)
        return f"paths: {command.out} ({paths.valid.sum()} paths, transmitters: {len(positions)})"
    write_deepmimo(command.out, as_deepmimo(paths.reversed()), frequency_hz)
    return f"DeepMIMO scenario: {command.out} (the receiver as base station, {len(positions)} transmitters as users)"


def take_in(command: Command) -> str:
    """Writes a scene file from the paths of another program, and returns a line for the user."""
    from wbgs_jax.data.load import check_kind
    from wbgs_jax.data.scene_file import save_scene
    from wbgs_jax.interchange.deepmimo import is_deepmimo, load_deepmimo
    from wbgs_jax.interchange.ray_paths import check_paths, read_paths
    from wbgs_jax.interchange.rooms import check_upright, open_room
    from wbgs_jax.interchange.scenes import scene_of_paths
    from wbgs_jax.interchange.sionna_arrays import DEFAULT, scene_of_sionna
    from wbgs_jax.radio.array import planar_array

    assert command.paths is not None, "checked"
    hertz = None if command.ghz is None else 1e9 * command.ghz
    if command.paths.is_file() and command.paths.suffix.lower() not in (".npz", ".mat"):
        check_kind(command.paths)
        raise UserError(
            f"{command.paths} is of an unknown kind; give an .npz file with Sionna's arrays, or a DeepMIMO scenario"
        )
    of_deepmimo = is_deepmimo(command.paths)
    kind = DEEPMIMO if of_deepmimo else SIONNA
    check_effects(command, KINDS, (kind,), kind)
    room = None if command.mesh is None else open_room(command.mesh, command.up)
    shape, name = parse_array(command.array, "--array") if command.array else None, command.out.stem
    if of_deepmimo:
        paths = load_deepmimo(command.paths, hertz, command.tx_set, command.tx_index, command.rx_set)
        check_paths(paths, str(command.paths))
        paths = paths if command.swap else paths.reversed()
        scene = scene_of_paths([paths], planar_array(*(shape or DEFAULT)), name, room=room)
    else:
        choice = shape, command.port, command.tx_antenna, command.swap
        scene = scene_of_sionna(read_paths(command.paths), name, hertz, *choice, room, str(command.paths))
    if room is not None and command.mesh is not None:
        check_upright(command.mesh, room, np.concatenate([scene.tx_positions, scene.rx_position]))
    save_scene(command.out, scene)
    connected = int((np.abs(scene.observations["snapshots"]) > 0).any((-1, -2, -3)).sum())
    count = f"{len(scene.tx_positions)} transmitters, {connected} with paths"
    return f"scene: {command.out} ({count}); next: wbgs-jax train --scene {shlex.quote(str(command.out))}"


def take_room(command: Command) -> str:
    """Writes a room file from a model, lists its objects, and returns a line for the user."""
    from wbgs_jax.data.scene_file import save_room
    from wbgs_jax.interchange.rooms import describe_room, read_room, room_of

    assert command.model is not None, "checked"
    objects = read_room(command.model, command.materials, command.up, command.scale, named=False)
    room = room_of(objects)
    save_room(command.out, room)
    say(describe_room(objects, ["closed" if one.mesh.is_watertight else "sheet" for one in objects]))
    low, high = (", ".join(f"{value:.4g}" for value in corner) for corner in (room.vertices.min(0), room.vertices.max(0)))
    beside = "put it into a folder of spectra as room.npz, or use it with snapshots (docs/own_scene.md)"
    return f"room: {command.out} ({len(objects)} objects from ({low}) to ({high}) m); {beside}"


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax convert")
    check(command)
    check_writable(command.out if command.out.suffix else command.out / "scenario")
    use_compilation_cache()
    job = take_in if command.paths is not None else take_room if command.folder is None else hand_on
    say(job(command))


if __name__ == "__main__":
    run_command(main)
