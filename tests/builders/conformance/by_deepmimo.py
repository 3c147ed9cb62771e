"""Scenarios of DeepMIMO, in both directions: what its package computes of ours, and what is read of its own and of SciPy's."""

import contextlib
import io
import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from builders.conformance.by_sionna import Setup, response, trace
from builders.conformance.entries import entries
from wbgs_jax.interchange.deepmimo import as_deepmimo, load_deepmimo, write_deepmimo
from wbgs_jax.interchange.ray_paths import SPECULAR, RayPaths, check_paths
from wbgs_jax.radio.array import SPEED_OF_LIGHT

HERTZ = 3.5e9
STATIONS = np.array([[0.0, 0, 2], [4.0, -9, 3]])
USERS = np.column_stack([np.linspace(3, 21, 24), np.tile(np.linspace(-4, 4.3, 6), 4), np.full(24, 1.5)])


def two_rays(count: int = 1) -> tuple[RayPaths, np.ndarray]:
    """Returns lines of sight and images below a metal floor of isotropic antennas, and the channel (users, stations)."""
    sources = STATIONS[:count]
    ends = np.stack([USERS[:, None] - sources, USERS[:, None] - sources * [1, 1, -1]], 2)
    length = np.linalg.norm(ends, axis=-1)
    wavelength = SPEED_OF_LIGHT / HERTZ
    a = wavelength / (4 * np.pi * length) * np.array([1, -1])
    direction = ends / length[..., None]
    theta, phi = np.arccos(direction[..., 2]), np.arctan2(direction[..., 1], direction[..., 0])
    leaves, arrives = theta.copy(), np.pi - theta
    leaves[..., 1] = np.pi - theta[..., 1]  # towards the floor
    met = np.zeros((1, *length.shape), int)
    met[..., 1] = SPECULAR
    turned = phi + np.pi
    rays = RayPaths(
        a + 0j, length / SPEED_OF_LIGHT, leaves, phi, arrives, turned, met, np.full((*met.shape, 3), np.nan),
        np.ones(length.shape, bool), sources, USERS, HERTZ,
    )  # fmt: skip
    return rays, (a * np.exp(-2j * np.pi * length / wavelength)).sum(-1)


@dataclass
class Scenario:
    """A scenario, and the channel that it stands for."""

    path: Path
    truth: np.ndarray
    """Users, transmitters."""
    options: dict[str, Any] = field(default_factory=dict)
    tolerance: float = 1e-3
    measure: str = field(default="channels", init=False)

    def channel(self) -> np.ndarray:
        """Returns what is read."""
        paths = load_deepmimo(self.path, **self.options)
        check_paths(paths, str(self.path))
        return paths.channel()

    def difference(self) -> float:
        """Returns the distance of the channels of a transmitter's users from the truth, in units of their length."""
        found = self.channel()
        if found.shape != self.truth.shape:
            return float("inf")
        return float((np.linalg.norm(found - self.truth, axis=0) / np.linalg.norm(self.truth, axis=0)).max())


class LoadedThere(Scenario):
    """A scenario that the package loads and computes the channel of."""

    def channel(self) -> np.ndarray:
        """Returns the package's channels."""
        import deepmimo

        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            deepmimo.config.set("scenarios_folder", str(self.path.parent))
            loaded = deepmimo.load(self.path.name)
            how = deepmimo.ChannelParameters()
            how.bs_antenna.shape = how.ue_antenna.shape = np.array([1, 1])
            how.ofdm.subcarriers, how.ofdm.selected_subcarriers, how.ofdm.bandwidth = 1, np.array([0]), 1e5
            found = loaded.compute_channels(how)
            deepmimo.config.reset()
        every = found if isinstance(found, list) else [found]
        return np.stack([np.asarray(one).reshape(-1) for one in every], -1)


def written_here(count: int, kind: type[Scenario] = LoadedThere) -> Callable[[Path], Scenario]:
    """Returns a maker of a folder by this library."""

    def make(folder: Path) -> Scenario:
        rays, channel = two_rays(count)
        for number in range(count):
            write_deepmimo(folder / "street", as_deepmimo(rays, number), HERTZ, tx=number)
        return kind(folder / "street", channel)

    return make


def plain(arrays: Any) -> Any:
    """Returns pickled values, arrays of one number as numbers: the converter takes them for such, as NumPy did before 2.4."""
    if isinstance(arrays, dict):
        return {key: plain(value) for key, value in arrays.items()}
    if isinstance(arrays, list):
        return [plain(value) for value in arrays]
    return arrays.item() if isinstance(arrays, np.ndarray) and arrays.size == 1 else arrays


def converted(folder: Path) -> Scenario:
    """Sionna RT's paths by DeepMIMO's exporter and converter; the truth is Sionna's response."""
    import deepmimo
    from deepmimo.exporters.sionna_exporter import sionna_exporter

    paths, scene = trace(Setup((1, 1), receivers=3))
    how = {"max_depth": 2, "los": True, "specular_reflection": True, "diffuse_reflection": False, "refraction": False}
    how |= {"synthetic_array": True, "samples_per_src": 20_000, "max_num_paths_per_src": 10**6, "seed": 1}
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        sionna_exporter(scene, [paths], how, str(folder / "traced"))
        for name in ("rt_params", "materials"):
            own = folder / "traced" / f"sionna_{name}.pkl"
            own.write_bytes(pickle.dumps(plain(pickle.loads(own.read_bytes()))))
        with contextlib.chdir(folder):
            deepmimo.convert(str(folder / "traced"), scenario_name="street", overwrite=True, vis_scene=False)
    return Scenario(folder / "deepmimo_scenarios" / "street", response(paths)[:, 0, :, 0])


def arrays_of(count: int = 1) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Returns the arrays of the first station, and the channel."""
    rays, channel = two_rays(count)
    return as_deepmimo(rays), channel[:, :1]


def one_file(name: str, change: Callable[[dict], dict] | None = None, hertz: float | None = HERTZ, **how: Any) -> Callable:
    """Returns a maker of a single file by SciPy or NumPy."""

    def make(folder: Path) -> Scenario:
        from scipy.io import savemat

        arrays, channel = arrays_of()
        arrays = change(arrays) if change else arrays
        save = savemat if name.endswith(".mat") else lambda path, content: np.savez(path, **content)
        save(folder / name, arrays, **how)
        return Scenario(folder / name, channel, {"frequency_hz": hertz})

    return make


def folder_of_mat(folder: Path) -> Scenario:
    """A .mat file for each array, as versions before 4.0 have it, with parameters."""
    from scipy.io import savemat

    arrays, channel = arrays_of()
    (folder / "street").mkdir()
    for name, values in arrays.items():
        savemat(folder / "street" / f"{name}_t001_tx000_r000.mat", {name: values})
    (folder / "street" / "params.json").write_text(json.dumps({"rt_params": {"frequency": HERTZ, "raytracer_name": "own"}}))
    return Scenario(folder / "street", channel)


def without_propagation(arrays: dict) -> dict:
    """Returns phases as Sionna has them."""
    turns = np.degrees(2 * np.pi * HERTZ * arrays["delay"].astype(np.float64))
    return {**arrays, "phase": arrays["phase"] + turns}


def doubles(arrays: dict) -> dict:
    """Returns double precision."""
    return {name: np.asarray(values, np.float64) for name, values in arrays.items()}


def in_radians(arrays: dict) -> dict:
    """Returns angles in another unit."""
    return arrays | {name: np.radians(arrays[name]) for name in ("aoa_az", "aoa_el", "aod_az", "aod_el")}


def phases_in_radians(arrays: dict) -> dict:
    """Returns phases in another unit."""
    return {**arrays, "phase": np.radians(arrays["phase"])}


def from_the_horizon(arrays: dict) -> dict:
    """Returns elevations that count from the horizon."""
    return arrays | {name: 90 - arrays[name] for name in ("aoa_el", "aod_el")}


def in_nanoseconds(arrays: dict) -> dict:
    """Returns delays in another unit."""
    return {**arrays, "delay": 1e9 * arrays["delay"]}


def linear(arrays: dict) -> dict:
    """Returns powers that are no decibels."""
    return {**arrays, "power": 10 ** (arrays["power"] / 10)}


def without(name: str) -> Callable[[dict], dict]:
    """Returns what leaves an array out."""
    return lambda arrays: {key: values for key, values in arrays.items() if key != name}


THERE = {
    ("folder", "one station, loaded by the package"): written_here(1),
    ("folder", "two stations, loaded by the package"): written_here(2),
}
ENTRIES = entries(
    "wbgs-jax, for DeepMIMO", {**THERE, ("folder", "and back"): written_here(2, Scenario)}, ("deepmimo",), "deepmimo"
)
ENTRIES += entries(
    "DeepMIMO", {("folder", "converted from Sionna RT"): converted}, ("deepmimo", "sionna"), "deepmimo", heavy=True
)
MAT = {
    ("mat", "one file"): one_file("scenario.mat"),
    ("mat", "one file, compressed"): one_file("scenario.mat", do_compression=True),
    ("mat", "one file, double precision"): one_file("scenario.mat", doubles),
    ("mat", "one file, phases without the propagation"): one_file("scenario.mat", without_propagation),
    ("mat", "without places of interactions"): one_file("scenario.mat", without("inter_pos")),
    ("mat", "a file for each array"): folder_of_mat,
    ("mat", "version 4"): (one_file("scenario.mat", lambda arrays: {"power": arrays["power"]}, format="4"), "refused"),
    ("mat", "without delays"): (one_file("scenario.mat", without("delay")), "refused"),
    ("mat", "without a frequency"): (one_file("scenario.mat", hertz=None), "refused"),
    ("mat", "delays in nanoseconds"): (one_file("scenario.mat", in_nanoseconds), "refused"),
    ("mat", "powers that are no decibels"): (one_file("scenario.mat", linear), "refused"),
    ("mat", "angles in radians"): (one_file("scenario.mat", in_radians), "refused"),
    ("mat", "phases in radians"): (one_file("scenario.mat", phases_in_radians), "refused"),
    ("mat", "elevations from the horizon"): (one_file("scenario.mat", from_the_horizon), "refused"),
}
ENTRIES += entries("SciPy", MAT, ("scipy",), "scipy")
NPZ = {
    ("npz", "one file of DeepMIMO's arrays"): one_file("scenario.npz"),
    ("npz", "DeepMIMO's arrays without interactions"): one_file(
        "scenario.npz", lambda a: without("inter")(without("inter_pos")(a))
    ),
    ("npz", "DeepMIMO's arrays, powers that are no decibels"): (one_file("scenario.npz", linear), "refused"),
}
ENTRIES += entries("NumPy", NPZ, ("numpy",), "numpy")
