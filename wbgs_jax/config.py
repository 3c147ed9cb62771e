"""Settings of a training that every field shares; what belongs to one field stands in its own file under `fields/`.

A run's settings are those of its field, of the optimiser, of the host loop, and of the hooks that the field asks for. All
can be overridden on the command line (`wbgs-jax train --help`); a run writes its own to `config.json`. The paper's own
values are the wideband field's preset `paper`; docs/history.md says what was measured.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from wbgs_jax._util.errors import UserError

FEWEST_STEPS, STEPS_A_SPECTRUM = 600, 8
"""What `OptimConfig.min_steps` comes down to where spectra are few."""


def setting(default: Any, before: Any) -> Any:
    """Returns a setting of a dataclass that files from before it was one do not have: what it was then."""
    return dataclasses.field(default=default, metadata={"before": before})


@dataclass(frozen=True)
class OptimConfig:
    """Steps, batches and schedules; after a warm-up every learning rate decays by a cosine to `final_fraction` of itself."""

    steps: int = 6000
    """Upper bound; see `max_epochs`."""
    max_epochs: float = 16.0
    """Small data sets are not seen more often than this (they would be learned by heart) ..."""
    min_steps: int = 1000
    """... but get at least this many steps."""
    batch: int = 8
    """Links a step."""
    warmup: float = 0.0
    """Share of the steps over which every learning rate rises to its full value."""
    final_fraction: float = 0.01
    """What is left of every learning rate at the end."""
    curriculum: float = 0.0
    """Share of the steps over which the highest frequency of the batches rises from the lowest to the highest of the data. At
    low frequencies the phase behind a slab is no riddle."""
    virtual: float = setting(0.5, before=0.0)
    """Share of every batch that are links of transmitters nobody measured, with kriged spectra, where spectra are few and the
    field knows no paths (training/batches.py)."""


@dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control (paper, section 4.5; thresholds of the authors' code)."""

    every: int = 500
    """Steps between two controls; 0 switches it off."""
    start: int = 500
    """The first step at which there may be one."""
    stop_fraction: float = 0.5
    """No control after this fraction of the steps."""
    gradient_threshold: float = 8e-4
    """Clone or split above this mean norm of the positional gradient in normalised image coordinates, -1..1 (authors: 2e-4)."""
    split_scale: float = 0.3
    """Metres: Gaussians larger than this are split, smaller ones cloned."""
    prune_attenuation: float = 0.005
    """Gaussians whose delta_o lies below are removed."""
    reset_every: int = 0
    """Steps between two resets of delta_o to at most `reset_attenuation` (authors: 3000); 0: never."""
    reset_attenuation: float = 0.01
    """What delta_o is lowered to by a reset."""
    max_gaussians: int = 3000
    """The field never grows beyond this number."""


@dataclass(frozen=True)
class SearchConfig:
    """Search for known materials and antennas before the first step (training/calibration/pipeline.py)."""

    rounds: int = 3
    """Times all materials are gone through, at most; 0: no search for materials."""
    spectra: int = 384
    """Training spectra that are looked at."""
    glance: int = 24
    """The first of them, by which the materials of the list are narrowed down to a few."""
    thickness_spectra: int = 160
    """Training spectra up to a frequency that are looked at for thicknesses which the scene does not say ..."""
    thickness_glance: int = 48
    """... and the first of them, by which slabs are narrowed down to a few."""
    sure: float = 2.0
    """Standard errors by which what has been learned must fit better than every known material to be kept."""
    antenna_rounds: int = 2
    """Times the antennas of both ends are gone through, at most; 0: no search for antennas."""
    antenna_spectra: int = 96
    """Training spectra that are looked at for them."""
    antenna_sure: float = 3.0
    """Standard errors by which another antenna must fit better than the one that is there."""
    absent_spectra: int = 768
    """Training spectra of low frequencies that are looked at for bodies of the mesh that are not there; 0: all are there ..."""
    absent_glance: int = 96
    """... and the first of them, by which bodies are narrowed down to a few."""
    ideal_spectra: int = 96
    """Training spectra that are looked at for what ray tracers leave out."""
    tuning_spectra: int = 320
    """Training spectra that are looked at for how far the elements of arrays are out of tune; 0: they are in tune."""
    geometry: bool = True
    """Whether surfaces of a doubtful mesh are moved."""
    geometry_snapshots: int = 1500
    """Snapshots that every step of that looks at ..."""
    geometry_steps: int = 240
    """... or, where only spectra are known, steps at every frequency."""
    geometry_doubt: float = 5e-4
    """Metres: surfaces are moved where spectra are explained best if they may stand further off than this."""
    geometry_tx: int = 640
    """Transmitters that are looked at for that at first; once surfaces are roughly in place, all of them."""
    geometry_width: float = 0.02
    """Metres: how far surfaces may stand from where the mesh has them (standard deviation)."""
    geometry_spectra: int = 64
    """Training spectra that are looked at to name materials on the way."""
    placement_spectra: int = 96
    """Training spectra that are looked at for how far they may still be off."""
    clutter_spectra: int = 1024
    """Training spectra that say whether clutter which the others show is there; 0: no clutter is looked for."""
    clutter_steps: int = 800
    """Steps in which it is fitted to the others."""


@dataclass(frozen=True)
class LoopConfig:
    """How the host drives training."""

    epoch_steps: int = 50
    """Steps in one jitted epoch; an interrupt waits for two of them at most."""
    evaluate_every: int = 1000
    """Steps between two evaluations on `evaluate_spectra` held-out spectra, for the curves only."""
    evaluate_spectra: int = 60
    """How many spectra are looked at for the curves: of the validation part; none where there is none."""
    checkpoint_every: int = 1000
    """Steps between two checkpoints."""
    keep_checkpoints: int = 2
    """Older checkpoints are removed."""


@dataclass(frozen=True)
class Settings:
    """Everything that makes a run, but the data and the seed."""

    field: Any = None
    """Settings of the field, of the type that it declares."""
    optim: OptimConfig = dataclasses.field(default_factory=OptimConfig)
    loop: LoopConfig = dataclasses.field(default_factory=LoopConfig)
    density: DensityConfig | None = None
    """Of a field that asks for density control."""
    search: SearchConfig | None = None
    """Of a field that asks for a search for materials."""


PRESETS: Mapping[str, Settings] = {
    # Under a minute on two cores: proves that everything works, not that it is good.
    "smoke": Settings(
        optim=OptimConfig(steps=200, batch=4),
        loop=LoopConfig(epoch_steps=20, evaluate_every=100, evaluate_spectra=20, checkpoint_every=100),
    ),
    # The default without a GPU.
    "cpu": Settings(),
    # For a GPU: larger networks, and a Gaussian for every vertex.
    "gpu": Settings(optim=OptimConfig(steps=20_000, batch=8), loop=LoopConfig(epoch_steps=100, checkpoint_every=2000)),
}
"""What the presets of all fields have in common."""


def sections(settings: Settings, field_name: str) -> dict[str, Any]:
    """Returns the parts of settings by the names that command lines and files give them: the field's part has its name. Those
    of a field that is made of fields have the names of these."""
    values = {f.name: getattr(settings, f.name) for f in dataclasses.fields(settings) if f.name != "field"}
    own = _parts(settings.field) or {field_name: settings.field}
    return own | {name: value for name, value in values.items() if value is not None}


def _parts(config: Any) -> dict[str, Any]:
    """Returns the settings that a field's settings are made of; nothing where they are settings themselves."""
    if not dataclasses.is_dataclass(config):
        return {}
    values = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    return values if all(map(dataclasses.is_dataclass, values.values())) else {}


def from_sections(values: Mapping[str, Any], like: Settings, field_name: str) -> Settings:
    """Returns the settings of named parts, the inverse of `sections`; `like` has the types."""
    parts = _parts(like.field)
    field = dataclasses.replace(like.field, **{name: values[name] for name in parts}) if parts else values[field_name]
    others = {name: value for name, value in values.items() if name not in (parts or {field_name})}
    return Settings(field=field, **others)


def to_dict(settings: Settings, field_name: str) -> dict[str, Any]:
    """Returns settings as plain values for JSON, by section."""
    return {name: dataclasses.asdict(section) for name, section in sections(settings, field_name).items()}


def from_dict(values: Any, default: Settings, field_name: str) -> Settings:
    """Returns settings from `to_dict`'s values; `default` has the types of all sections.

    Raises:
        UserError: unknown or missing names, because today's default was not set then.
    """

    def build(cls: Any, values: Any) -> Any:
        values = {f.name: f.metadata["before"] for f in dataclasses.fields(cls) if "before" in f.metadata} | values
        if missing := {f.name for f in dataclasses.fields(cls)} - set(values):
            raise KeyError(f"{cls.__name__}.{min(missing)}")
        return cls(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})

    known = {name: type(section) for name, section in sections(default, field_name).items()}
    try:
        built = {name: build(known[name], value) for name, value in values.items()}
        return from_sections({name: built[name] for name in known}, default, field_name)
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"these settings belong to another version of wbgs-jax ({error}); start a new run") from error


def changed(settings: Settings, changes: Mapping[str, Mapping[str, Any]]) -> Settings:
    """Returns settings with other values in some sections, such as {"optim": {"steps": 100}, "field": {...}}."""
    replaced = {name: dataclasses.replace(getattr(settings, name), **values) for name, values in changes.items()}
    return dataclasses.replace(settings, **replaced)


def limit_steps(settings: Settings, n_train: int, no_paths: bool = False) -> Settings:
    """Returns settings whose `optim.steps` are what a data set of `n_train` spectra gets: a multiple of the epoch block. A
    field that knows no paths learns a few spectra by heart, and gets fewer steps for them."""
    optim, block = settings.optim, settings.loop.epoch_steps
    fewest = min(optim.min_steps, max(FEWEST_STEPS, STEPS_A_SPECTRUM * n_train)) if no_paths else optim.min_steps
    wanted = max(fewest, optim.max_epochs * n_train / optim.batch)
    steps = min(optim.steps, round(wanted / block) * block)
    return dataclasses.replace(settings, optim=dataclasses.replace(optim, steps=max(steps, block)))


def check(settings: Settings) -> None:
    """Raises a `UserError` for settings that cannot work, before any work is done. A field checks its own."""
    optim, loop = settings.optim, settings.loop
    positive = {
        "optim.steps": optim.steps,
        "optim.batch": optim.batch,
        "loop.epoch-steps": loop.epoch_steps,
        "loop.evaluate-every": loop.evaluate_every,
        "loop.checkpoint-every": loop.checkpoint_every,
        "loop.keep-checkpoints": loop.keep_checkpoints,
    }
    check_positive(positive | ({"search.spectra": settings.search.spectra} if settings.search else {}))
    if optim.steps % loop.epoch_steps:
        raise UserError(
            f"--optim.steps {optim.steps} is not a multiple of --loop.epoch-steps {loop.epoch_steps}; change one of them"
        )


def check_positive(values: Mapping[str, int]) -> None:
    """Raises a `UserError` that names the first option whose value is less than 1."""
    for name, value in values.items():
        if value < 1:
            raise UserError(f"--{name} is {value}; it must be at least 1")


def check_share(name: str, value: float) -> None:
    """Raises a `UserError` unless an option's value lies between 0 and 1."""
    if not 0 <= value <= 1:
        raise UserError(f"--{name} is {value}; it must lie between 0 and 1")
