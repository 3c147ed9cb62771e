"""What tests of the searches share: a run of the coherent field in a made-up room, before its first step."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from builders.rooms import box, mesh_of, room
from builders.synthetic import tiny_scene
from wbgs_jax.data import scene_dataset
from wbgs_jax.fields import coherent
from wbgs_jax.training.calibration.material_fit import ITU_MATERIALS
from wbgs_jax.training.loop import Run
from wbgs_jax.types import make_query

RX = (1.0, 1.0, 1.2)
PARTS = [*room(), box((3, 1, 0.5), (4, 2, 1.2))]
THICKNESS = 0.05
REFLECTIONS = {"specular_tried": 32, "specular_kept": 16, "diffracted_tried": 1, "diffracted_kept": 1, "mirror_areas": (0.0,)}
"""Settings of the field for few paths, without diffraction."""


def places(n_tx, margin=0.3):
    """Transmitters in the room, so far from its walls."""
    low = np.full(3, margin)
    return np.random.default_rng(3).uniform(low, np.array([6.0, 4.0, 3.0]) - margin, (n_tx, 3))


def run_in(parts, settings, folder, tx_positions, frequencies_hz, snapshots=None, receivers=(RX,)) -> Run:
    """The paths of all transmitters, and snapshots that mean nothing unless given (tx, rx, freq, 16)."""
    mesh, n_tx = mesh_of(*parts), len(tx_positions)
    nothing = np.ones((n_tx, len(receivers), len(frequencies_hz), 16), np.complex64)
    scene = dataclasses.replace(
        tiny_scene(n_tx, n_rx=len(receivers)),
        snapshots=nothing if snapshots is None else snapshots,
        tx_positions=tx_positions,
        frequencies_hz=frequencies_hz,
        rx_position=np.array(receivers),
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        face_part=np.asarray(mesh.part),
        meta={"parts": [{"name": f"{i}", "material": f"{i}", "thickness": THICKNESS} for i in range(len(parts))]},
    )
    return Run(scene_dataset(scene), "wave", settings, 0, folder)


def of_concrete(run):
    """The run's parameters with everything made of concrete."""
    permittivity, c, d = ITU_MATERIALS["concrete"]
    materials = run.state.params.materials
    values = {"log_susceptibility": np.log(permittivity - 1), "log_conductivity": np.log(c), "slope": d}
    leaves = {name: jnp.full_like(materials.slope, value) for name, value in values.items()}
    return dataclasses.replace(run.state.params, materials=dataclasses.replace(materials, **leaves))


def heard_in(run, params, tx_positions, frequencies_hz):
    """Snapshots of all places at all frequencies (tx, 1, freq, 16), paths and all."""
    n_tx, n = len(tx_positions), len(frequencies_hz)
    query = make_query(np.repeat(tx_positions, n, 0), np.tile(frequencies_hz, n_tx))
    heard = jax.jit(coherent.snapshots)(params, run.field.plan(params, run.dataset.receiver()), query)
    return np.asarray(heard).reshape(n_tx, 1, n, 16)


@jax.jit
def snapshots(params, plan, prepared, links):
    """What the coherent field says of links of one receiver whose paths are prepared."""
    return coherent.path_snapshots(params, plan, prepared.of(links), links)
