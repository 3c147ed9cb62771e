"""Assembles a scene file from the elements' results: snapshots, mesh and metadata."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from data_gen.ceilings import NAMES
from data_gen.full_wave.cabin import AIR, ARRAY_CLEARANCE, METAL, TX_CLEARANCE, cabin_spec, candidates, element_positions
from data_gen.full_wave.calibration import Scale, sampled_frequencies
from data_gen.full_wave.elements import ElementResult, snapshots_of
from data_gen.full_wave.model import MARGIN, MEDIA, PML_CELLS, Model, coarsest
from data_gen.generate import SPLIT_SEED, TEST_FRACTION, draw_split
from data_gen.statistics import DIGITS, ceiling_table
from wbgs_jax.data.scene_file import SceneFile


def assemble(model: Model, results: Sequence[ElementResult], scale: Scale, solver: str, checks: dict[str, Any]) -> SceneFile:
    """Returns the scene file's content.

    Args:
        model: the cabin as computed.
        results: of all elements, in the array's order.
        scale: of the source.
        solver: version of openEMS.
        checks: further entries of `meta["checks"]`, such as the convergence; may be empty.
    """
    spec = cabin_spec()
    mesh = spec.mesh_arrays()
    scene = SceneFile(
        name=spec.name, snapshots=snapshots_of(results), tx_positions=model.points,
        frequencies_hz=np.array(model.frequencies_hz), rx_position=np.array([spec.rx_position]),
        rx_orientation=np.array([spec.rx_orientation]), element_positions=element_positions()[None], element_unit="metres",
        element_pattern="", split=draw_split(len(model.points)),
        vertices=mesh["vertices"], faces=mesh["faces"], face_part=mesh["face_part"],
        meta=_provenance(model, solver) | {"checks": _checks(model, results, scale) | checks},
    )  # fmt: skip
    unknown = {
        "ceilings": np.full((len(scene.tx_positions), len(model.frequencies_hz), len(NAMES)), np.nan)
    }  # not available without paths
    scene.meta.update(ceilings=ceiling_table(scene, unknown), channel=_channel(scene, spec.line_of_sight(model.points)))
    return scene


def _provenance(model: Model, solver: str) -> dict[str, Any]:
    spec = cabin_spec()
    return {
        "generator": {"name": "data_gen.full_wave", "simulator": "openEMS", "versions": {"openEMS": solver}},
        "description": spec.description,
        "parts": spec.part_table(),
        "mesh_sha256": spec.mesh_sha256(),
        "solver": {
            "method": "FDTD", "cell_m": model.cell, "cells": model.cells, "time_step_s": model.time_step, "steps": model.steps,
            "duration_s": model.duration, "absorbing_layer_cells": PML_CELLS, "margin_m": MARGIN,
            "cells_in_shortest_wavelength": round(coarsest(model), 2),
            "sampled_frequencies_hz": sampled_frequencies(model).tolist(),
        },
        "media": _media() | {METAL: "perfect conductor"},
        "reciprocity": "one run an element; the transmitters are where the field is recorded",
        "antennas": "short vertical dipoles; in free space |y| is lambda / (4 pi d) times sqrt(1.5) sin(zenith) of either end",
        "tx_polarization": "V", "split_seed": SPLIT_SEED, "test_fraction": TEST_FRACTION,
        "tx_candidates": len(candidates()), "tx_accessible": len(model.points),
        "tx_clearance_m": TX_CLEARANCE, "array_clearance_m": ARRAY_CLEARANCE,
    }  # fmt: skip


def _channel(scene: SceneFile, in_sight: Bool[np.ndarray, " tx"]) -> list[dict[str, float]]:
    """Returns, by frequency, the fraction of transmitters with line of sight and the gain to an element (5th, 50th, 95th
    percentile, dB)."""
    gain_db = 10 * np.log10(np.mean(np.abs(scene.observations["snapshots"][:, 0].astype(np.complex128)) ** 2, -1))
    names = ("line_of_sight_share", "gain_db_p05", "gain_db_p50", "gain_db_p95")
    columns = [np.full(len(scene.frequencies_hz), in_sight.mean()), *np.percentile(gain_db, (5, 50, 95), axis=0)]
    return [
        {
            "frequency_ghz": float(frequency / 1e9),
            **{name: round(float(value), DIGITS) for name, value in zip(names, row, strict=True)},
        }
        for frequency, row in zip(scene.frequencies_hz, zip(*columns, strict=True), strict=True)
    ]


def _media() -> dict[str, Any]:
    solid = sorted(set(MEDIA) - {AIR})
    return {name: {"permittivity": MEDIA[name].permittivity, "conductivity": MEDIA[name].conductivity()} for name in solid}


def _checks(model: Model, results: Sequence[ElementResult], scale: Scale) -> dict[str, Any]:
    return {
        "decay_db": [round(result.decay_db, 1) for result in results],
        "free_space_error": dict(zip(_names(model), np.round(scale.error, 4).tolist(), strict=True)),
    }


def _names(model: Model) -> list[str]:
    return [f"{frequency / 1e9:g}" for frequency in model.frequencies_hz]
