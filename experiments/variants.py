"""Named changes of a job's settings: those of the tables, and those that the series try one at a time."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from experiments.faults import Fault
from experiments.profiles import Changes


@dataclass(frozen=True)
class Variant:
    """Differences from the profile's settings."""

    changes: Changes = field(default_factory=dict)
    """Section of the settings, "field" for the field's own: what differs."""
    budget: float = 1
    """Number of spectra seen, as a multiple of the usual number."""
    steps: int | None = None
    """Steps, instead of the profile's."""
    rates: float = 1
    """Factor of all learning rates of the field."""
    room: bool = False
    """Whether a whole room is the test (`jobs.ROOMS`), and nothing of it trains."""
    fault: Fault = Fault()  # noqa: RUF009 (frozen)
    """Fault of the data."""


def _of_field(**values: object) -> Variant:
    return Variant({"field": values})


def _batch(size: int, steps: int) -> Variant:
    """Another batch: learning rates follow its square root, and the steps take as long as 1,050 of 8 spectra did
    (docs/performance.md). The query enters at layer 1, as it did by then."""
    return Variant({"optim": {"batch": size}, "field": {"fusion": 1}}, steps=steps, rates=(size / 8) ** 0.5)


PRECISIONS = ("precision_float32", "precision_tf32", "precision_bfloat16")
"""Precisions of the networks' matrix products."""
RATES = ("1e-3", "2e-3", "3e-3", "8e-3", "1.6e-2", "3.2e-2")
"""Learning rates of the networks; the presets' is 4e-3."""
HIGHER_RATE = 1.6e-2
TABLES = {
    "": Variant(),
    "long": Variant(budget=5),
    "longest": Variant(budget=10),
    "no_attenuation": _of_field(attenuation_frequency=False),
    "no_radiance": _of_field(radiance_frequency=False),
}
GAUSSIANS_AND_NETWORKS = {
    "paper_inputs": _of_field(relative=False),
    "no_frequency": _of_field(attenuation_frequency=False, radiance_frequency=False),
    "raw_gigahertz": _of_field(frequency_scale="ghz"),
    "sphere": _of_field(projection="sphere"),
    "area": _of_field(sampling="area"),
    "no_density_control": Variant({"density": {"every": 0, "reset_every": 0}}),
    "density_with_reset": Variant({"density": {"reset_every": 300}}),
    "octaves_10": _of_field(gaussian_octaves=10, tx_octaves=10, frequency_octaves=10),
    "frequency_octaves_0": _of_field(frequency_octaves=0),
    "frequency_octaves_1": _of_field(frequency_octaves=1),
    "frequency_octaves_4": _of_field(frequency_octaves=4),
    "octaves_3_2": _of_field(gaussian_octaves=3, tx_octaves=2),
    "gaussians_1000": _of_field(gaussians=1000),
    "gaussians_4000": _of_field(gaussians=4000),
    "width_128": _of_field(width=128, radiance_widths=(128, 64)),
    **{f"fusion_{layer}": _of_field(fusion=layer) for layer in range(4)},
    "batch_4": _batch(4, 1450),
    "batch_8": _batch(8, 1050),
    "batch_16": _batch(16, 600),
    **{f"lr_{rate}": _of_field(network_lr=float(rate)) for rate in RATES},
    "weight_decay_0.1": _of_field(network_weight_decay=0.1),
    "fixed_means": _of_field(means_lr=0.0),
}
_BLIND = {"attenuation_frequency": False, "radiance_frequency": False}
_Values = Mapping[str, object]


def _warm(network_lr: float, field: _Values | None = None) -> Variant:
    """A rate of the networks after a warm-up, and further changes."""
    return Variant({"field": {"network_lr": network_lr, **(field or {})}, "optim": {"warmup": 0.1}})


FREQUENCY = {
    "f_off": _warm(HIGHER_RATE, _BLIND),
    "f_input": _warm(HIGHER_RATE),
    "f_degree_4": _warm(HIGHER_RATE, {"frequency_degree": 4}),
    "f_heads_2": _warm(HIGHER_RATE, _BLIND | {"frequency_heads": 2}),
    "f_heads_4": _warm(HIGHER_RATE, _BLIND | {"frequency_heads": 4}),
    "f_both": _warm(HIGHER_RATE, {"frequency_heads": 3, "frequency_degree": 3}),
}
"""Ways in which the frequency enters the networks."""
SCHEDULES = {
    "warm_8e-3": _warm(8e-3),
    "warm_1.6e-2": _warm(1.6e-2),
    "warm_2.4e-2": _warm(2.4e-2),
    "steps_6000": Variant(steps=6000),
}
"""Learning rates with warm-up, and numbers of steps."""
OPTIMIZERS = {
    "adam_4e-3": _of_field(network_optimizer="adam", network_lr=4e-3),
    "adam_1.6e-2": _of_field(network_optimizer="adam", network_lr=1.6e-2),
    "muon_5e-3": _of_field(network_optimizer="muon", network_lr=5e-3),
    "muon_1e-2": _of_field(network_optimizer="muon", network_lr=1e-2),
    "muon_2e-2": _of_field(network_optimizer="muon", network_lr=2e-2),
}
"""Optimisers of the networks."""
ROOMS = {"room": Variant(room=True), "room_pooled": Variant({"field": _BLIND}, room=True)}
"""A room held out."""
POOLED = {
    "pooled": Variant({"field": _BLIND}),
    "pooled_long": Variant({"field": _BLIND}, budget=5),
    "pooled_longest": Variant({"field": _BLIND}, budget=10),
}
"""WRF-GS as one model for all frequencies: the wideband field, blind to them."""
VOLUME = {
    "l2": _of_field(pixel_loss="l2"),
    "directions_384": _of_field(directions=384),
}
_NO_EDGES: dict[str, object] = {"diffracted_tried": 1, "diffracted_kept": 1}
_NO_MATERIALS = {"materials_lr": 0.0, "thickness_lr": 0.0}
_UNTRAINED = _NO_MATERIALS | {"corrections_lr": 0.0}
_NO_SEARCH: Changes = {"calibration": {"rounds": 0}}
AS_IT_IS: Changes = {"calibration": {"geometry": False, "spurious_spectra": 0, "absorption_spectra": 0}}
"""The mesh is exact: nothing in it is moved, left out or missed."""
COHERENT = {
    "phase_blind": Variant({"field": {"coherent": False}, **_NO_SEARCH}),  # phases would name the materials
    "order_0": _of_field(mirror_areas=(), **_NO_EDGES),
    "order_1": _of_field(mirror_areas=(0.0,), **_NO_EDGES),
    "order_2": _of_field(mirror_areas=(0.0, 0.05), **_NO_EDGES),
    "order_3": _of_field(**_NO_EDGES),
    "no_search": Variant(_NO_SEARCH),
    "no_search_low_frequencies_first": Variant({"optim": {"curriculum": 0.5}, **_NO_SEARCH}),
    "materials_lr_5e-3": _of_field(materials_lr=5e-3),
    "materials_lr_2e-2": _of_field(materials_lr=2e-2),
    "search_alone": _of_field(**_UNTRAINED),
    "no_corrections": _of_field(corrections_lr=0.0),
    "free_reflectivity": Variant({"field": _NO_MATERIALS, **_NO_SEARCH}),
    "untrained": Variant({"field": _UNTRAINED, **_NO_SEARCH}),
    "no_snapshot_loss": _of_field(correlation_weight=0.0, power_weight=0.0),
    "more_candidates": _of_field(diffracted_tried=4096, diffracted_kept=512, mirror_areas=(0.0, 0.02, 0.3)),
    "mesh_moved_3mm": Variant(AS_IT_IS, fault=Fault(displaced_m=0.003)),
    "mesh_moved_3cm": Variant(AS_IT_IS, fault=Fault(displaced_m=0.03)),
    "mesh_moved_1m": Variant(AS_IT_IS, fault=Fault(displaced_m=1.0)),
}
FAULTS = {
    name: Variant(fault=fault)
    for name, fault in {
        "mesh_1mm": Fault(displaced_m=0.001),
        "mesh_3mm": Fault(displaced_m=0.003),
        "mesh_1cm": Fault(displaced_m=0.01),
        "mesh_3cm": Fault(displaced_m=0.03),
        "tilted": Fault(tilted_deg=0.2),
        "missing_10": Fault(missing=0.1),
        "missing_30": Fault(missing=0.3),
        "added_10": Fault(added=0.1),
        "added_30": Fault(added=0.3),
        "thickness_unknown": Fault(thickness_unknown=True),
        "one_material": Fault(one_material=True),
        "wrong_materials": Fault(wrong_materials=0.3),
        "receiver_off": Fault(receiver_m=0.02, receiver_deg=1.0),
        "array_off": Fault(array_deg=5.0),
        "pattern_unknown": Fault(pattern_unknown=True),
        "snr_30": Fault(snr_db=30.0),
        "snr_20": Fault(snr_db=20.0),
        "snr_10": Fault(snr_db=10.0),
        "tx_20": Fault(tx=20),
        "tx_100": Fault(tx=100),
        "images": Fault(images_only=True),
        "all_together": Fault(displaced_m=0.01, missing=0.1, thickness_unknown=True, snr_db=20.0),
    }.items()
}
"""Faults of the data, one at a time, and the medium ones together."""


def uncorrected(fault: str) -> str:
    """Returns the variant with a fault (or none) in which neither mesh nor arrays are corrected."""
    return f"uncorrected_{fault}".rstrip("_")


_UNCORRECTED: Changes = {"calibration": {**AS_IT_IS["calibration"], "array_gain_spectra": 0}}
UNCORRECTED = {
    uncorrected(name): dataclasses.replace(variant, changes=_UNCORRECTED) for name, variant in {"": Variant(), **FAULTS}.items()
}
_STEPS_TO_OURS: dict[str, Changes] = {
    "batch_of_8": {"optim": {"batch": 8}, "field": {"network_lr": 4e-3}},
    "small_networks": {"field": {"width": 64, "depth": 4, "skip": 2, "fusion": 1, "radiance_widths": (32,)}},
    "relative_inputs": {"field": {"relative": True, "gaussian_octaves": 6, "tx_octaves": 4}},
    "log_frequency": {"field": {"frequency_scale": "log", "frequency_octaves": 0}},
    "own_features": {"field": {"features": 16}},
    "moving_gaussians": {
        "field": {"means_lr": 1e-3},
        "density": {
            "every": 100, "start": 100, "stop_fraction": 0.5, "gradient_threshold": 8e-4, "split_scale": 0.3, "reset_every": 0,
        },
    },
    "muon": {
        "field": {"network_optimizer": "muon", "network_lr": 1e-2, "network_weight_decay": 0.0},
        "optim": {"final_fraction": 0.01},
    },
    "our_loss": {"field": {"ssim_stride": 2, "power_weight": 0.01}},
}  # fmt: skip
"""From the paper's form to ours: what is changed, one after the other."""


def _together(all_changes: Sequence[Changes]) -> Changes:
    sections = dict.fromkeys(section for changes in all_changes for section in changes)
    return {name: {k: v for changes in all_changes for k, v in changes.get(name, {}).items()} for name in sections}


TO_OURS = {
    f"to_{name}": Variant(_together(list(_STEPS_TO_OURS.values())[: i + 1]), steps=500) for i, name in enumerate(_STEPS_TO_OURS)
}
"""Each with all changes before it, and as many spectra as the paper's form saw one at a time."""
VARIANTS: dict[str, Variant] = {
    **{name: _of_field(precision=name.removeprefix("precision_")) for name in PRECISIONS},
    **TABLES,
    **GAUSSIANS_AND_NETWORKS,
    **SCHEDULES,
    **FREQUENCY,
    **OPTIMIZERS,
    **ROOMS,
    **POOLED,
    **VOLUME,
    **COHERENT,
    **FAULTS,
    **UNCORRECTED,
    **TO_OURS,
}
