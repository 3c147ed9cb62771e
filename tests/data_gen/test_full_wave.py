"""The full-wave cabin: what the solver is told, what a person would model, and how fields become a scene file."""

import dataclasses
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
from trimesh.sample import sample_surface

from data_gen.full_wave import cabin, openems
from data_gen.full_wave.assemble import assemble
from data_gen.full_wave.calibration import calibrate, dipole_field, sampled_frequencies
from data_gen.full_wave.convergence import agreement, convergence
from data_gen.full_wave.elements import cabin_model, digest, element_file, get_element, get_scale, snapshots_of, sources
from data_gen.full_wave.model import MEDIA, PML_CELLS, Model, Solution, fills
from data_gen.full_wave.solver_input import solver_input
from wbgs_jax._util.errors import UserError
from wbgs_jax.data import scene_dataset
from wbgs_jax.data.load import RELEASED
from wbgs_jax.data.scene_file import TEST, load_scene, save_scene
from wbgs_jax.propagation.materials import complex_permittivity, slab_coefficients
from wbgs_jax.radio.antenna import dipole_gain
from wbgs_jax.radio.array import SPEED_OF_LIGHT, snapshot_to_pas, steering_vector
from wbgs_jax.training.calibration.material_fit import ITU_MATERIALS

CELL, DURATION = 0.03, 5e-9


@pytest.fixture(scope="module")
def model() -> Model:
    return cabin_model(CELL, DURATION)


@pytest.fixture(scope="module")
def spec():
    return cabin.cabin_spec()


class FreeSpace:
    """A solver that knows the answer in free space, with a scale and a phase of its own, and counts what it is asked."""

    def __init__(self):
        self.calls = 0

    def __call__(self, model: Model, source) -> Solution:
        self.calls += 1
        frequency = np.asarray(model.frequencies_hz)
        field = dipole_field(model.points - np.asarray(source), frequency) * (3e-9 * np.exp(2j * frequency / 1e9))
        return Solution(field, -50.0, model.time_step, 0.0)


def results_of(solve, model, folder):
    scale = get_scale(solve, model, folder)
    return [get_element(solve, model, scale, place, element_file(folder, i)) for i, place in enumerate(sources())], scale


def test_everything_lies_on_nodes_of_all_cell_sizes(model):
    for cell in (0.01, 0.015, 0.03):
        same = cabin_model(cell, DURATION)
        corners = [c for block in same.blocks for c in (block.low, block.high)]
        assert same.off_nodes([*corners, same.low, same.high, *sources(), *map(tuple, same.points.tolist())]) < 1e-6


def test_bodies_of_the_mesh_are_filled_with_what_they_are_made_of(model, spec, rng):
    """Just inside of every face of a body there is its material, just outside there is none of it."""
    for part in spec.solids:
        points, face = sample_surface(part.mesh, 400, seed=int(rng.integers(2**31)))
        normal = part.mesh.face_normals[face]
        inside = fills(model.blocks, points - 0.004 * normal)
        assert set(inside) == {part.material}
        beyond = np.array(fills(model.blocks, points + 0.02 * normal))
        where = points + 0.02 * normal
        low, high = spec.bounds()
        free = ((where > low + 0.02) & (where < high - 0.02)).all(1) & ~spec.inside_objects(where)
        assert free.mean() > 0.4 and set(beyond[free]) == {cabin.AIR}


def test_walls_begin_at_the_mesh_and_are_as_thick_as_it_says(model, spec, rng):
    middle = np.array([0, 0, cabin.SIZE[2] / 2])
    for part in spec.parts:
        if part.kind != "shell":
            continue
        points, face = sample_surface(part.mesh, 100, seed=int(rng.integers(2**31)))
        normal = part.mesh.face_normals[face]
        outward = normal * np.sign(((points - middle) * normal).sum(1))[:, None]
        inner = np.clip(points, spec.bounds()[0] + 0.01, spec.bounds()[1] - 0.01)  # off the corners
        points = np.where(np.abs(normal) > 0.5, points, inner)
        for depth in (0.002, part.thickness - 0.002):
            assert set(fills(model.blocks, points + depth * outward)) == {part.material}
        assert set(fills(model.blocks, points + (part.thickness + 0.002) * outward)) == {cabin.AIR}


def test_hollow_bodies_have_air_behind_a_panel(model):
    for body in (b for b in cabin.BODIES if b.hollow):
        (low, high), *_ = body.boxes
        places = np.array([np.array(low) + 0.005, np.array(low) + cabin.PANEL + 0.005, (np.array(low) + high) / 2])
        assert fills(model.blocks, places) == [body.material, cabin.AIR, cabin.AIR]


def test_antennas_are_in_free_air(model, spec):
    tx = spec.tx_grid
    assert 250 <= len(tx) <= 350 and len(np.unique(tx, axis=0)) == len(tx)
    places = np.array(sources())
    assert set(fills(model.blocks, np.concatenate([tx, places]))) == {cabin.AIR}
    assert spec.in_room(tx).all() and spec.distance(tx).min() >= cabin.TX_CLEARANCE and spec.distance(places).min() > 0.2
    assert np.linalg.norm(tx[:, None] - places, axis=-1).min() >= cabin.ARRAY_CLEARANCE
    assert 0.1 < 1 - spec.line_of_sight(tx).mean() < 0.5


def test_solver_input(model):
    source = sources()[3]
    root = ElementTree.fromstring(solver_input(model, source))
    fdtd = root.find("FDTD")
    assert fdtd.get("NumberOfTimesteps") == str(model.steps)
    assert set(fdtd.find("BoundaryCond").attrib.values()) == {f"PML_{PML_CELLS}"}
    lines = [np.array(root.find(f".//{name}").text.split(","), float) for name in ("XLines", "YLines", "ZLines")]
    for axis, low, high in zip(lines, model.low, model.high, strict=True):
        np.testing.assert_allclose(np.diff(axis), model.cell, rtol=1e-6)
        assert axis[PML_CELLS] <= low + 1e-9 and axis[-1 - PML_CELLS] >= high - 1e-9
    boxes = root.findall(".//Material/Primitives/Box") + root.findall(".//Metal/Primitives/Box")
    assert len(boxes) == len(model.blocks) and len({box.get("Priority") for box in boxes}) == len(boxes)
    wood = next(m for m in root.findall(".//Material") if m.get("Name").startswith("wood"))
    assert float(wood.find("Property").get("Epsilon")) == MEDIA["wood"].permittivity
    assert float(wood.find("Property").get("Kappa")) == pytest.approx(MEDIA["wood"].conductivity())
    assert len(root.findall(".//Metal")) == 1
    ends = [[float(p.get(axis)) for axis in "XYZ"] for p in root.find(".//Properties/Excitation/Primitives/Box")]
    np.testing.assert_allclose(ends, [[*source[:2], source[2] + by] for by in (-model.cell, model.cell)])
    assert len(root.findall(".//ProbeBox")) == len(model.points)


def test_cells_that_do_not_fit_are_refused():
    with pytest.raises(UserError, match=r"off the nodes.*--cell"):
        solver_input(cabin_model(0.02, DURATION), sources()[0])


def test_media_are_those_of_the_recommendation():
    for name, medium in MEDIA.items():
        if name != cabin.AIR:
            assert tuple(medium) == pytest.approx(ITU_MATERIALS[name])


def test_waves_on_the_grid_are_sampled_a_little_lower():
    ratio = [sampled_frequencies(cabin_model(cell, DURATION)) / cabin.FREQUENCIES_HZ for cell in (0.01, 0.03)]
    assert (ratio[1] < ratio[0]).all() and (ratio[0] < 1).all() and (ratio[1] > 0.98).all()
    np.testing.assert_allclose((1 - ratio[1]) / (1 - ratio[0]), 9, rtol=0.05)  # of second order


def test_far_away_the_dipoles_are_those_of_the_project():
    """Amplitude lambda / (4 pi d) times both patterns, phase exp(-j k d)."""
    frequency = np.array([1e9, 1.5e9])
    offset = np.array([[300.0, 40.0, 120.0], [-10.0, 500.0, -200.0]])
    d = np.linalg.norm(offset, axis=1)[:, None]
    gain = np.asarray(dipole_gain(jnp.asarray(offset / d)))[:, None]
    wavelength = SPEED_OF_LIGHT / frequency
    expected = wavelength / (4 * np.pi * d) * gain**2 * np.exp(-2j * np.pi * d / wavelength)
    np.testing.assert_allclose(dipole_field(offset, frequency), expected, rtol=2e-3)


def test_near_field_solves_maxwells_equations():
    """The vertical field of a vertical dipole in air: (laplace + k^2) E = 0 away from it."""
    frequency, step = np.array([1.2e9]), 1e-3
    k = 2 * np.pi * frequency / SPEED_OF_LIGHT
    point = np.array([0.11, -0.07, 0.09])
    moves = np.concatenate([np.eye(3), -np.eye(3)]) * step
    around = dipole_field(point + moves, frequency).sum(0)
    middle = dipole_field(point[None], frequency)[0]
    np.testing.assert_allclose((around - 6 * middle) / step**2, -(k**2) * middle, rtol=2e-3)


def test_calibration_finds_the_scale_of_a_source():
    scale = calibrate(FreeSpace(), CELL, cabin.FREQUENCIES_HZ)
    frequency = np.array(cabin.FREQUENCIES_HZ)
    np.testing.assert_allclose(scale.factor, 1 / (3e-9 * np.exp(2j * frequency / 1e9)))
    assert scale.error.max() < 1e-12


def test_snapshots_of_free_space(model, tmp_path):
    """Far from the array they are plane waves of the project's steering vectors, and the direction of the peak is right."""
    results, _ = results_of(FreeSpace(), model, tmp_path)
    snapshots = snapshots_of(results)
    assert snapshots.shape == (len(model.points), 1, 6, 16)
    far = np.argsort(-np.linalg.norm(model.points - np.array(cabin.RX_POSITION), axis=1))[:20]
    for i in far:
        offset = model.points[i] - np.array(cabin.RX_POSITION)
        for j, frequency in enumerate(cabin.FREQUENCIES_HZ):
            positions = jnp.asarray(cabin.element_positions() * frequency / SPEED_OF_LIGHT)
            plane = np.asarray(steering_vector(positions, jnp.asarray(offset / np.linalg.norm(offset))))
            y = snapshots[i, 0, j]
            assert np.abs(np.vdot(plane, y)) > 0.9 * 4 * np.linalg.norm(y)  # the wave is a little round
            d = np.linalg.norm(model.points[i] - np.array(sources()), axis=1)
            assert np.abs(np.angle(y * np.exp(2j * np.pi * frequency * d / SPEED_OF_LIGHT))).max() < 0.2  # of the near field


def test_a_run_goes_on_where_it_stopped(model, tmp_path):
    solve = FreeSpace()
    first, _ = results_of(solve, model, tmp_path)
    assert solve.calls == 17  # the source in free space, 16 elements
    element_file(tmp_path, 5).unlink()
    second, _ = results_of(solve, model, tmp_path)
    assert solve.calls == 18
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.values, b.values)
    other = cabin_model(CELL, 2 * DURATION)
    assert len({digest(model, "1"), digest(model, "2"), digest(other, "1")}) == 3


@pytest.mark.heavy
def test_scene_file(model, tmp_path):
    model = dataclasses.replace(model, points=model.points[::20])
    results, scale = results_of(FreeSpace(), model, tmp_path)
    checks = {"convergence": convergence(FreeSpace(), model, results[0], tmp_path / "fine")}
    assert checks["convergence"]["by_frequency_ghz"]["1.2"]["correlation"] == 1.0
    save_scene(tmp_path / "cabin.npz", assemble(model, results, scale, "0.0.35", checks))
    scene = load_scene(tmp_path / "cabin.npz")
    assert scene.name == "cabin" and scene.element_unit == "metres" and scene.element_pattern == ""
    assert (scene.split == TEST).mean() == pytest.approx(0.2, abs=0.03)
    assert scene.meta["checks"]["decay_db"] == [-50.0] * 16
    assert {part["name"] for part in scene.meta["parts"]} >= {body.name for body in cabin.BODIES}
    dataset = scene_dataset(scene)
    assert dataset.pas(np.arange(2)).shape == (2, 90, 360) and dataset.materials is not None


def test_agreement_of_fields(rng):
    field = rng.normal(size=(40, 2)) + 1j * rng.normal(size=(40, 2))
    (same, other) = agreement(field, field * [2.0, -1j])
    assert same["correlation"] == other["correlation"] == 1.0
    assert same["median_level_db"] == pytest.approx(-6.02, abs=0.01) and other["median_level_db"] == 0


def test_without_the_binary_one_line_says_so(tmp_path):
    command = [sys.executable, "-m", "data_gen.full_wave", "--out", str(tmp_path / "a.npz"), "--work", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PATH": str(tmp_path)}, check=False)
    assert done.returncode == 2 and done.stderr.startswith("error: openEMS is not installed") and done.stderr.count("\n") == 1


def test_pulses_that_fade(rng):
    time = np.arange(1000)
    fading = np.exp(-time / 100) * rng.normal(size=(5, 1000)) + 1e-4 * time  # with a drift that means nothing
    assert openems.decay(fading) == pytest.approx(-20 * 9 * np.log10(np.e), abs=4)


@pytest.fixture(scope="module")
def installed() -> None:
    try:
        openems.find_openems()
    except UserError as error:
        pytest.skip(str(error))


def test_openems_in_free_space(installed):
    scale = calibrate(openems.run_openems, CELL, cabin.FREQUENCIES_HZ)
    assert (np.diff(scale.error) > 0).all() and scale.error[0] < 0.03 and scale.error[-1] < 0.09  # 7 cells a wavelength


def test_openems_above_metal(installed):
    """A metal floor is a mirror image of the source, of equal sign for vertical dipoles; a metal wall one of the other sign."""
    scale = calibrate(openems.run_openems, CELL, cabin.FREQUENCIES_HZ)
    frequency = np.array(cabin.FREQUENCIES_HZ)
    axes = ([-0.3, 0.3], [-0.36, -0.21, 0.3], [-0.12, 0.0, 0.3])
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    far = 3.0
    floor = (cabin.Block((-far, -far, -far), (far, far, -0.24), cabin.METAL), np.array([0, 0, -0.48]), 1)
    wall = (cabin.Block((0.51, -far, -far), (far, far, far), cabin.METAL), np.array([1.02, 0, 0]), -1)
    for block, image, sign in (floor, wall):
        model = Model((block,), (-0.6,) * 3, (0.6,) * 3, CELL, points, cabin.FREQUENCIES_HZ, 12e-9)
        heard = openems.run_openems(model, (0.0, 0.0, 0.0)).field * scale.factor
        truth = dipole_field(points, frequency) + sign * dipole_field(points - image, frequency)
        error = np.linalg.norm(heard - truth, axis=0) / np.linalg.norm(truth, axis=0)
        assert error[0] < 0.1 and error[-1] < 0.16  # at 15 mm a quarter of it


def test_openems_behind_a_wall(installed):
    """What passes is the direct wave times the slab's transmission, less the phase of the air that the slab replaces."""
    frequency, thickness = np.array(cabin.FREQUENCIES_HZ), 0.09
    scale = calibrate(openems.run_openems, CELL, cabin.FREQUENCIES_HZ)
    points = np.array([[0.75, y, z] for y in (-0.3, 0.0, 0.3) for z in (-0.12, 0.0, 0.12)])
    wall = cabin.Block((0.3, -3.0, -3.0), (0.3 + thickness, 3.0, 3.0), "plasterboard")
    model = Model((wall,), (-0.15, -0.45, -0.3), (0.84, 0.45, 0.3), CELL, points, cabin.FREQUENCIES_HZ, 10e-9)
    heard = openems.run_openems(model, (0.0, 0.0, 0.0)).field * scale.factor
    cosine = (points[:, 0] / np.linalg.norm(points, axis=1))[:, None]
    medium = MEDIA["plasterboard"]
    epsilon = complex_permittivity(*map(jnp.asarray, (medium.permittivity, medium.conductivity(), frequency)))
    slab = jnp.asarray(cosine), epsilon, jnp.asarray(thickness), jnp.asarray(frequency)
    nature, tracer = (np.asarray(slab_coefficients(*slab, air).transmit_te) for air in (1.0, 0.0))
    direct = dipole_field(points, frequency)
    errors = [np.linalg.norm(heard - direct * t) / np.linalg.norm(direct * t) for t in (nature, tracer)]
    assert errors[0] < 0.45 and errors[1] > 1.2  # at 15 mm 0.15 and 1.9 at most


def test_released_file_is_of_this_cabin(spec):
    scene = load_scene(RELEASED / "cabin.npz")
    assert scene.meta["mesh_sha256"] == spec.mesh_sha256()
    np.testing.assert_array_equal(scene.tx_positions, spec.tx_grid)
    np.testing.assert_allclose(scene.element_positions, cabin.element_positions()[None], atol=1e-12)
    np.testing.assert_array_equal(scene.frequencies_hz, cabin.FREQUENCIES_HZ)
    assert max(scene.meta["checks"]["decay_db"]) < -38
    found = scene.meta["checks"]["convergence"]["by_frequency_ghz"]
    assert min(row["correlation"] for row in found.values()) > 0.97


def test_released_spectra_peak_where_the_transmitter_is_in_sight(spec):
    """Of a strong line of sight, a sanity check of element order and phase sign in the whole chain."""
    scene = load_scene(RELEASED / "cabin.npz")
    offset = scene.tx_positions - scene.rx_position[0]
    near = spec.line_of_sight(scene.tx_positions) & (np.abs(offset[:, 0]) > 0.15) & (offset[:, 2] > 0)
    near &= np.linalg.norm(offset, axis=1) < 0.7
    positions = jnp.asarray(scene.element_positions[0] * 1.2e9 / SPEED_OF_LIGHT)
    pas = np.asarray(snapshot_to_pas(jnp.asarray(scene.snapshots[near, 0, 2]), positions))
    direction = offset[near] / np.linalg.norm(offset[near], axis=1, keepdims=True)
    row = np.round(np.degrees(np.arccos(direction[:, 2])) / 90 * 89).astype(int).clip(0, 89)
    column = np.round((np.degrees(np.arctan2(direction[:, 1], direction[:, 0])) + 180) / 360 * 359).astype(int)
    assert near.sum() > 10 and np.median(pas[np.arange(len(pas)), row, column]) > 0.8
