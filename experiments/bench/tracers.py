"""Ray tracers beside the coherent field: the line of sight and at most two reflections, nothing passed through.

Each is given its best settings for that, found by hand and stated here, a single isotropic antenna polarised upwards at either
end, and the materials and thicknesses of the scene. Amplitudes are relative to the transmitted one, of a first antenna element.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import coherent
from wbgs_jax.propagation.paths import DIFFRACTED, REFLECTED, TRANSMITTED
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.calibration.material_fit import ITU_MATERIALS, with_entry
from wbgs_jax.types import Query, Receiver, Transmitter, make_receiver

ORDERS = (0, 1, 2)
SAME_PLACE_M = 2e-3
"""Two paths are one where their lengths differ by less ..."""
FAINT = 0.01
"""... and both are stronger than this share of the strongest: weaker ones are at the mercy of rounding."""


class Found(NamedTuple):
    """The paths of one transmitter, without those of nothing."""

    length_m: Float[np.ndarray, " k"]
    amplitude: Complex[np.ndarray, "freq k"]


def slab_of(name: str) -> tuple[str, float]:
    """Returns the entry of ITU-R P.2040 and the thickness (metres) of a released scene's material."""
    entry, thickness = name.rsplit(" ", 1)
    return entry.replace("_", " "), float(thickness)


def known_params(field: coherent.WaveField, dataset: Dataset) -> Any:
    """Returns parameters with the materials by the names that a released scene gives them."""
    params = field.init(jax.random.key(0))
    materials, names = params.materials, () if dataset.materials is None else dataset.materials.names
    for number, name in enumerate(names):
        entry = name.rsplit(" ", 1)[0].replace("_", " ")
        if entry in ITU_MATERIALS:
            materials = with_entry(materials, number, entry)
    return dataclasses.replace(params, materials=materials)


class Ours:
    """The coherent field with its materials known; by default, one isotropic element receives."""

    def __init__(self, dataset: Dataset, config: coherent.WaveConfig, receiver: Receiver | None = None):
        begin = time.perf_counter()
        field = coherent.make_field(DatasetScene(dataset).mesh(), config)
        self.params = known_params(field, dataset)
        if receiver is None:
            receiver = make_receiver(dataset.receiver().position, element_positions=np.zeros((1, 3)))
        self.plan = field.plan(self.params, receiver)
        self.set_up_s = time.perf_counter() - begin

    def fields(self, tx: Float[np.ndarray, "tx 3"], frequencies_hz: Float[np.ndarray, " freq"]) -> Any:
        """Traces every transmitter once, and returns what arrives at every frequency."""
        return _ours(self.params, self.plan, jnp.asarray(tx, jnp.float32), jnp.asarray(frequencies_hz, jnp.float32))

    def paths(self, tx: Float[np.ndarray, "tx 3"], frequencies_hz: Float[np.ndarray, " freq"]) -> list[Found]:
        """Returns the reflected paths that pass through nothing."""
        arrived = jax.tree.map(np.asarray, self.fields(tx, frequencies_hz))
        result = []
        for lengths, amplitudes, kinds in zip(arrived.length, arrived.amplitude, arrived.interaction, strict=True):
            through = np.isin(kinds[0], (TRANSMITTED, DIFFRACTED)).any(-1)
            kept = ~through & ((kinds[0] == REFLECTED).sum(-1) <= max(ORDERS)) & (np.abs(amplitudes).max(0) > 0)
            result.append(Found(lengths[0, kept].astype(np.float64), amplitudes[:, kept]))
        return result


@jax.jit
def _ours(params: Any, plan: Any, tx: Any, frequencies_hz: Any) -> Any:
    paths = coherent.trace(plan, tx)
    one = jax.vmap(lambda paths, tx, f: coherent.arrivals_at(params, plan, paths, Query(Transmitter(tx), f)), (None, None, 0))
    return jax.vmap(one, (0, 0, None))(paths, tx, frequencies_hz)


class DiffeRT:
    """DiffeRT 0.12: candidates by its exhaustive or its hybrid search, whichever is faster here; fields of what is valid, in
    one compiled call."""

    ROOM = 64
    """Valid paths of a transmitter and order, at most: one compilation."""

    def __init__(self, dataset: Dataset, number: str):
        from differt.em import Material
        from differt.geometry import Mesh

        begin = time.perf_counter()
        mesh = DatasetScene(dataset).mesh()
        assert dataset.materials is not None
        slabs = [slab_of(name) for name in dataset.materials.names]
        names = tuple(f"slab {i}" for i in range(len(slabs)))
        self.mesh = Mesh(
            vertices=mesh.vertices, triangles=mesh.faces, face_materials=mesh.material, material_names=names
        ).dedup_vertices()  # fmt: skip
        self.materials = {
            name: Material(name=name, properties=_law(*ITU_MATERIALS[entry]), thickness=thickness)
            for name, (entry, thickness) in zip(names, slabs, strict=True)
        }
        self.receiver = dataset.receiver().position[None]
        times = {}
        for solver in ("exhaustive", "hybrid"):
            self.solver = solver
            for _ in range(2):  # the first one compiles
                start = time.perf_counter()
                self._trace(np.asarray(dataset.tx_positions[:1]))
                times[solver] = time.perf_counter() - start
        self.solver = min(times, key=lambda solver: times[solver])
        self.set_up_s = time.perf_counter() - begin

    def _trace(self, tx: Float[np.ndarray, "1 3"]) -> list[Any]:
        """Returns the valid paths of each order, filled up."""
        from differt.geometry import Scene, TracedPaths

        scene = Scene(transmitters=jnp.asarray(tx, jnp.float32), receivers=self.receiver, mesh=self.mesh)
        found = []
        for order in ORDERS:
            paths = scene.trace_paths(order, solver=self.solver)
            valid = np.flatnonzero(np.asarray(paths.mask).reshape(-1))
            index = np.resize(valid, self.ROOM) if len(valid) else np.zeros(self.ROOM, int)
            rows = [getattr(paths, name) for name in ("vertices", "objects", "interaction_types")]
            vertices, objects, types = (row.reshape(row.shape[2:])[index] for row in rows)
            found.append(TracedPaths(vertices, objects, jnp.arange(self.ROOM) < len(valid), types))
        return found

    def fields(self, tx: Float[np.ndarray, "tx 3"], frequencies_hz: Float[np.ndarray, " freq"]) -> list[list[Any]]:
        """Returns delays, fields at every frequency, and which are valid: of every transmitter, by order."""
        tens = jnp.asarray(frequencies_hz, jnp.float32)
        return [[self._compiled(paths, tens) for paths in self._trace(one[None])] for one in tx]

    def _compiled(self, paths: Any, frequencies_hz: Any) -> Any:
        import equinox as eqx
        from differt.em import TracedFields

        if not hasattr(self, "_solve"):

            def solve(paths: Any, mesh: Any, frequencies_hz: Any) -> Any:
                def at(f: Any) -> Any:
                    found = TracedFields.from_paths(paths, mesh, frequency=f, radio_materials=self.materials)
                    return found.delay, found.fields

                return *jax.vmap(at)(frequencies_hz), paths.mask

            self._solve = eqx.filter_jit(solve)
        return jax.block_until_ready(self._solve(paths, self.mesh, frequencies_hz))

    def paths(self, tx: Float[np.ndarray, "tx 3"], frequencies_hz: Float[np.ndarray, " freq"]) -> list[Found]:
        """Returns what it found."""
        result = []
        for orders in self.fields(tx, frequencies_hz):
            parts = [
                (np.asarray(delay, np.float64)[0, mask], np.asarray(field)[:, mask])
                for delay, field, mask in ((d, f, np.asarray(m)) for d, f, m in orders)
            ]
            lengths = np.concatenate([delay * SPEED_OF_LIGHT for delay, _ in parts])
            result.append(Found(lengths, np.concatenate([field for _, field in parts], 1)))
        return result


def _law(permittivity: float, c: float, d: float) -> Callable[[Any], tuple[Any, Any]]:
    """Returns permittivity and conductivity (S/m) over hertz."""

    def properties(frequency: Any) -> tuple[Any, Any]:
        ghz = jnp.asarray(frequency) / 1e9
        return jnp.full_like(ghz, permittivity), c * ghz**d

    return properties


class SionnaRT:
    """Sionna RT's own path solver. It searches anew at every frequency, for its rays choose their ways by power."""

    SAMPLES = 200_000
    """Rays of every transmitter: with fewer it misses paths, with more it takes longer and finds no more."""

    def __init__(self, dataset: Dataset, number: str):
        from data_gen.llvm import ensure_backend

        begin = time.perf_counter()
        ensure_backend()
        import sionna.rt as rt

        from data_gen.scenes import get_scene
        from data_gen.settings import ArraySettings, SolverSettings
        from data_gen.solve import Simulator

        settings = SolverSettings(solver="simulator", max_depth=max(ORDERS), diffraction=False)
        self.scene = Simulator(get_scene(int(number)), settings, ArraySettings(1, 1, pattern="iso")).scene
        self.solver, self.transmitter = rt.PathSolver(), rt.Transmitter
        self.set_up_s = time.perf_counter() - begin

    def fields(self, tx: Float[np.ndarray, "tx 3"], frequencies_hz: Float[np.ndarray, " freq"]) -> list[Any]:
        """Returns delays, amplitudes and which are valid, by frequency."""
        import drjit as dr
        import mitsuba as mi

        for name in list(self.scene.transmitters):
            self.scene.remove(name)
        for i, position in enumerate(tx):
            self.scene.add(self.transmitter(f"tx{i}", position=[float(value) for value in position]))
        found = []
        for frequency in frequencies_hz:
            self.scene.frequency = dr.opaque(mi.Float, float(frequency))
            paths = self.solver(
                self.scene, max_depth=max(ORDERS), samples_per_src=self.SAMPLES, refraction=False, diffraction=False,
            )  # fmt: skip
            real, imaginary = (np.array(part)[0, 0, :, 0] for part in paths.a)
            found.append((np.array(paths.tau)[0], real + 1j * imaginary, np.array(paths.valid)[0]))
        return found

    def paths(self, tx: Float[np.ndarray, "tx 3"], frequencies_hz: Float[np.ndarray, " freq"]) -> list[Found]:
        """Returns what it found at all frequencies alike: it draws its rays anew at each."""
        found, result = self.fields(tx, frequencies_hz), []
        for i in range(len(tx)):
            lengths = [tau[i, valid[i]].astype(np.float64) * SPEED_OF_LIGHT for tau, _, valid in found]
            rows = [_matches(lengths[0], other) for other in lengths]
            everywhere = np.all([row >= 0 for row in rows], 0)
            amplitude = [a[i, valid[i]][row[everywhere]] for (_, a, valid), row in zip(found, rows, strict=True)]
            result.append(Found(lengths[0][everywhere], np.array(amplitude)))
        return result


RIVALS: dict[str, tuple[str, Any]] = {"differt": ("differt", DiffeRT), "sionna": ("sionna", SionnaRT)}


def _matches(lengths: Float[np.ndarray, " k"], others: Float[np.ndarray, " l"]) -> np.ndarray:
    """Returns the nearest of other lengths for every length; -1 where it is not the same."""
    if not len(others):
        return np.full(len(lengths), -1)
    apart = np.abs(lengths[:, None] - others)
    return np.where(apart.min(1) < SAME_PLACE_M, apart.argmin(1), -1)


def compare(ours: list[Found], theirs: list[Found]) -> dict[str, tuple[float, str, str]]:
    """Returns, over paths stronger than `FAINT` of the strongest at some frequency: the share of each side's that the other
    finds too, and of those that both find the medians and largest differences of amplitudes (relative) and delays (ps)."""
    both, counts, amplitudes, delays = np.zeros(2), np.zeros(2), [], []
    for own, other in zip(ours, theirs, strict=True):
        own, other = (_strong(found) for found in (own, other))
        own_match, other_match = _matches(own.length_m, other.length_m), _matches(other.length_m, own.length_m)
        both += [(own_match >= 0).sum(), (other_match >= 0).sum()]
        counts += [len(own_match), len(other_match)]
        mutual = np.flatnonzero(own_match >= 0)
        mutual = mutual[other_match[own_match[mutual]] == mutual]
        a, b = own.amplitude[:, mutual], other.amplitude[:, own_match[mutual]]
        loudest = np.abs(a) >= FAINT * np.abs(a).max(1, keepdims=True, initial=0)
        amplitudes.append((np.abs(np.abs(a) - np.abs(b)) / np.maximum(np.abs(a), 1e-30))[loudest])
        delays.append(np.abs(own.length_m[mutual] - other.length_m[own_match[mutual]]) / SPEED_OF_LIGHT * 1e12)
    shares = {
        "found_of_ours": (float(both[0] / max(counts[0], 1)), "", "higher"),
        "ours_found_of": (float(both[1] / max(counts[1], 1)), "", "higher"),
        "paths_compared": (float(sum(map(len, delays))), "", "higher"),
    }
    if not shares["paths_compared"][0]:
        return shares
    amplitude, delay = np.concatenate(amplitudes), np.concatenate(delays)
    return shares | {
        "amplitude_median": (float(np.median(amplitude)), "", "lower"),
        "amplitude_90_percent": (float(np.quantile(amplitude, 0.9)), "", "lower"),
        "delay_largest": (float(delay.max()), "ps", "lower"),
    }


def _strong(found: Found) -> Found:
    level = np.abs(found.amplitude)
    keep = (level >= FAINT * level.max(1, keepdims=True, initial=0)).any(0)
    return Found(found.length_m[keep], found.amplitude[:, keep])
