"""Training settings shared by all fields; the settings of a single field are in its own file under `fields/`.

The settings of a run are those of its field, of the optimiser, of the host loop, and of the hooks that the field requests. All
of them can be overridden on the command line (`wbgs-jax train --help`), and a run writes them to `config.json`. The paper's
values are the wideband field's preset `paper`; docs/history.md lists measurements.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from wbgs_jax._util.errors import UserError

RENAMED: Mapping[str, str] = {
    "search.sure": "calibration.n_sigma",
    "search.antenna_sure": "calibration.antenna_n_sigma",
    "search.absent_spectra": "calibration.spurious_spectra",
    "search.absent_glance": "calibration.spurious_glance",
    "search.ideal_spectra": "calibration.propagation_spectra",
    "search.tuning_spectra": "calibration.array_gain_spectra",
    "search.geometry_doubt": "calibration.geometry_position_std",
    "search.placement_spectra": "calibration.position_std_spectra",
    "search.clutter_spectra": "calibration.absorption_spectra",
    "search.clutter_steps": "calibration.absorption_steps",
    "search": "calibration",
}
"""Settings (SECTION.NAME) and sections of earlier versions with their present names, for stored runs and command lines."""


def present_name(name: str) -> str:
    """Returns the present name of a setting, SECTION.NAME, which may be that of an earlier version."""
    section, dot, rest = name.partition(".")
    return RENAMED.get(name) or RENAMED.get(section, section) + dot + rest


def present_option(argument: str) -> str:
    """Returns a word of a command line with the present name of the setting in it, such as --calibration.n-sigma=3 for
    --search.sure=3; other words are returned unchanged."""
    option, equals, value = argument.partition("=")
    if not option.startswith("--") or "." not in option:
        return argument
    return f"--{present_name(option[2:].replace('-', '_'))}".replace("_", "-") + equals + value


def setting(default: Any, before: Any) -> Any:
    """Returns a dataclass setting with its value in files written before the setting existed."""
    return dataclasses.field(default=default, metadata={"before": before})


@dataclass(frozen=True)
class OptimConfig:
    """Steps, batches and schedules. After a warm-up every learning rate decays by a cosine to `final_fraction` of itself."""

    steps: int = 6000
    """Maximum number of steps; see also `max_epochs`."""
    max_epochs: float = 16.0
    """Maximum number of passes over the training data, which limits the steps on small data sets (against overfitting) ..."""
    share_with_paths: float = setting(1.0, before=1.0)
    """... and the fraction of the steps that a field takes if it predicts paths, with which it converges sooner ..."""
    min_steps: int = 1000
    """... but at least this many steps are taken."""
    batch: int = 8
    """Links per step."""
    warmup: float = 0.0
    """Fraction of the steps over which every learning rate rises to its full value."""
    final_fraction: float = 0.01
    """Fraction of every learning rate that remains at the end."""
    curriculum: float = 0.0
    """Fraction of the steps over which the highest frequency of the batches rises from the lowest to the highest of the data.
    At low frequencies the phase of a transmitted wave is unambiguous."""
    virtual: float = setting(0.5, before=0.0)
    """Fraction of every batch that consists of virtual links, from unmeasured transmitters with kriged spectra; used if spectra
    are few and the field predicts no paths (training/batches.py)."""


@dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control (paper, section 4.5; thresholds of the authors' code)."""

    every: int = 500
    """Steps between two density controls; 0 disables them."""
    start: int = 500
    """First step at which density control may happen."""
    stop_fraction: float = 0.5
    """Fraction of the steps after which there is no density control."""
    gradient_threshold: float = 8e-4
    """Clone or split above this mean norm of the positional gradient in normalised image coordinates, -1..1 (authors: 2e-4)."""
    split_scale: float = 0.3
    """Metres: Gaussians larger than this are split, smaller ones cloned."""
    prune_attenuation: float = 0.005
    """Gaussians with delta_o below this are removed."""
    reset_every: int = 0
    """Steps between two resets of delta_o to at most `reset_attenuation` (authors: 3000); 0 for none."""
    reset_attenuation: float = 0.01
    """Upper bound of delta_o after a reset."""
    max_gaussians: int = 3000
    """Maximum number of Gaussians."""


@dataclass(frozen=True)
class CalibrationConfig:
    """Calibration of materials, antennas and geometry before the first step (training/calibration/pipeline.py)."""

    rounds: int = 3
    """Maximum number of passes over all materials; 0 disables the calibration of materials."""
    spectra: int = 384
    """Training spectra used."""
    glance: int = 24
    """The first of them, used to narrow down the list of materials."""
    thickness_spectra: int = 160
    """Training spectra up to a frequency, used for thicknesses that the scene does not specify ..."""
    thickness_glance: int = 48
    """... and the first of them, used to narrow down the candidate slabs."""
    thickness_n_sigma: float = setting(2.0, before=2.0)
    """Standard errors by which found thicknesses must fit better to be kept."""
    n_sigma: float = 2.0
    """Standard errors by which learned properties must fit better than every listed material to be kept."""
    antenna_rounds: int = 2
    """Maximum number of passes over the antennas of both ends; 0 disables the calibration of antennas."""
    antenna_spectra: int = 96
    """Training spectra used for antennas."""
    antenna_n_sigma: float = 3.0
    """Standard errors by which another antenna must fit better to replace the current one."""
    spurious_spectra: int = 768
    """Training spectra of low frequencies used to find spurious bodies of the mesh; 0 disables this ..."""
    spurious_glance: int = 96
    """... and the first of them, used to narrow down the candidate bodies."""
    spurious_n_sigma: float = setting(2.0, before=2.0)
    """Standard errors by which spectra must fit better without the bodies found in a pass for these to be removed."""
    propagation_spectra: int = 96
    """Training spectra used for the propagation options, such as effects that ray tracers leave out."""
    propagation_n_sigma: float = setting(3.0, before=3.0)
    """Standard errors by which a propagation option must fit better as in reality to be set so."""
    array_gain_spectra: int = 320
    """Training spectra used to calibrate the array gains; 0 disables this."""
    array_gain_n_sigma: float = setting(3.0, before=3.0)
    """Standard errors by which array gains must fit better to be used."""
    geometry: bool = True
    """Whether surfaces of an inaccurate mesh are displaced."""
    geometry_snapshots: int = 1500
    """Snapshots used in every step of this alignment ..."""
    geometry_steps: int = 240
    """... or, if only spectra are available, steps at every frequency."""
    geometry_position_std: float = 5e-4
    """Metres: surfaces are displaced if the spectra are explained best by a larger position_std than this."""
    geometry_tx: int = 640
    """Transmitters used at first for the alignment; all of them once surfaces are roughly in place."""
    geometry_width: float = 0.02
    """Prior standard deviation of the displacement of surfaces, metres."""
    geometry_spectra: int = 64
    """Training spectra used to name materials between alignment steps."""
    geometry_n_sigma: float = setting(2.0, before=2.0)
    """Standard errors by which an aligned mesh must fit better to be kept; low, since the mesh has already been found to be
    inaccurate."""
    position_std_spectra: int = 96
    """Training spectra used to estimate the remaining position_std."""
    absorption_spectra: int = 1024
    """Training spectra used to decide whether an absorption grid fitted to the others is kept; 0 disables the grid."""
    absorption_steps: int = 800
    """Steps of the fit of the absorption grid."""
    absorption_n_sigma: float = setting(1.0, before=1.0)
    """Standard errors by which an absorption grid must fit better to be kept. It is low, since a grid that is not needed makes
    other spectra fit worse, and does no harm otherwise."""


@dataclass(frozen=True)
class LoopConfig:
    """Settings of the host's training loop."""

    epoch_steps: int = 50
    """Steps of one jitted epoch; an interrupt takes effect after at most two of them."""
    evaluate_every: int = 1000
    """Steps between two evaluations on `evaluate_spectra` held-out spectra, used only for the curves."""
    evaluate_spectra: int = 60
    """Number of validation spectra used for the curves; none if there is no validation part."""
    checkpoint_every: int = 1000
    """Steps between two checkpoints."""
    keep_checkpoints: int = 2
    """Number of checkpoints kept; older ones are removed."""


@dataclass(frozen=True)
class Settings:
    """All settings of a run except the data and the seed."""

    field: Any = None
    """Settings of the field, of the type declared by the field."""
    optim: OptimConfig = dataclasses.field(default_factory=OptimConfig)
    loop: LoopConfig = dataclasses.field(default_factory=LoopConfig)
    density: DensityConfig | None = None
    """Settings of density control, for fields that use it."""
    calibration: CalibrationConfig | None = None
    """Settings of the calibration, for fields that use it."""


PRESETS: Mapping[str, Settings] = {
    # Two minutes on two cores: shows that everything runs, not that the result is good.
    "smoke": Settings(
        optim=OptimConfig(steps=200, batch=4),
        loop=LoopConfig(epoch_steps=20, evaluate_every=100, evaluate_spectra=20, checkpoint_every=100),
    ),
    # Default without a GPU.
    "cpu": Settings(),
    # For a GPU: larger networks, and one Gaussian per vertex.
    "gpu": Settings(optim=OptimConfig(steps=20_000, batch=8), loop=LoopConfig(epoch_steps=100, checkpoint_every=2000)),
}
"""Settings common to the presets of all fields."""


def sections(settings: Settings, field_name: str) -> dict[str, Any]:
    """Returns the sections of settings by their names in command lines and files. The field's section has the name of the
    field; for a composite field, its components' sections have theirs."""
    values = {f.name: getattr(settings, f.name) for f in dataclasses.fields(settings) if f.name != "field"}
    own = _parts(settings.field) or {field_name: settings.field}
    return own | {name: value for name, value in values.items() if value is not None}


def _parts(config: Any) -> dict[str, Any]:
    """Returns the component settings of a composite field's settings; empty for other fields."""
    if not dataclasses.is_dataclass(config):
        return {}
    values = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    return values if all(map(dataclasses.is_dataclass, values.values())) else {}


def from_sections(values: Mapping[str, Any], like: Settings, field_name: str) -> Settings:
    """Returns settings from named sections, the inverse of `sections`; `like` provides the types."""
    parts = _parts(like.field)
    field = dataclasses.replace(like.field, **{name: values[name] for name in parts}) if parts else values[field_name]
    others = {name: value for name, value in values.items() if name not in (parts or {field_name})}
    return Settings(field=field, **others)


def to_dict(settings: Settings, field_name: str) -> dict[str, Any]:
    """Returns settings as plain values for JSON, by section."""
    return {name: dataclasses.asdict(section) for name, section in sections(settings, field_name).items()}


def from_dict(values: Any, default: Settings, field_name: str) -> Settings:
    """Returns settings from the values of `to_dict`, also of an earlier version (`RENAMED`); `default` provides the types of
    all sections.

    Raises:
        UserError: names are unknown or missing, as in settings of another version.
    """

    def build(cls: Any, values: Any) -> Any:
        values = {f.name: f.metadata["before"] for f in dataclasses.fields(cls) if "before" in f.metadata} | values
        if missing := {f.name for f in dataclasses.fields(cls)} - set(values):
            raise KeyError(f"{cls.__name__}.{min(missing)}")
        return cls(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})

    types = {name: type(section) for name, section in sections(default, field_name).items()}
    try:
        present: dict[str, dict[str, Any]] = {RENAMED.get(section, section): {} for section in values}
        for section, content in values.items():
            for name, value in content.items():
                section_now, _, name_now = present_name(f"{section}.{name}").partition(".")
                present[section_now][name_now] = value
        built = {name: build(types[name], value) for name, value in present.items()}
        return from_sections({name: built[name] for name in types}, default, field_name)
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"these settings belong to another version of wbgs-jax ({error}); start a new run") from error


def changed(settings: Settings, changes: Mapping[str, Mapping[str, Any]]) -> Settings:
    """Returns settings with changed values in some sections, such as {"optim": {"steps": 100}, "field": {...}}."""
    replaced = {name: dataclasses.replace(getattr(settings, name), **values) for name, values in changes.items()}
    return dataclasses.replace(settings, **replaced)


def limit_steps(settings: Settings, n_train: int, no_paths: bool = False) -> Settings:
    """Returns settings with `optim.steps` limited for a data set of `n_train` spectra, a multiple of the epoch block. A field
    that predicts no paths (`no_paths`) needs all steps for many spectra, but overfits to few, and gets fewer steps for them."""
    optim, block = settings.optim, settings.loop.epoch_steps
    # Lower bounds on `OptimConfig.min_steps` when spectra are few: in total, and per spectrum.
    fewest_steps, steps_a_spectrum = 600, 8
    fewest = min(optim.min_steps, max(fewest_steps, steps_a_spectrum * n_train)) if no_paths else optim.min_steps
    most = optim.steps if no_paths else optim.share_with_paths * optim.steps
    wanted = max(fewest, min(optim.max_epochs * n_train / optim.batch, most))
    steps = min(optim.steps, round(wanted / block) * block)
    return dataclasses.replace(settings, optim=dataclasses.replace(optim, steps=max(steps, block)))


def check(settings: Settings) -> None:
    """Raises a `UserError` for invalid settings before any work is done. Fields check their own settings."""
    optim, loop = settings.optim, settings.loop
    positive = {
        "optim.steps": optim.steps,
        "optim.batch": optim.batch,
        "loop.epoch-steps": loop.epoch_steps,
        "loop.evaluate-every": loop.evaluate_every,
        "loop.checkpoint-every": loop.checkpoint_every,
        "loop.keep-checkpoints": loop.keep_checkpoints,
    }
    check_positive(positive | ({"calibration.spectra": settings.calibration.spectra} if settings.calibration else {}))
    for name in ("share_with_paths", "warmup", "final_fraction", "curriculum", "virtual"):
        check_share(f"optim.{name.replace('_', '-')}", getattr(optim, name))
    if optim.max_epochs < 0:
        raise UserError(f"--optim.max-epochs is {optim.max_epochs}; it must be at least 0")
    if optim.steps % loop.epoch_steps:
        raise UserError(
            f"--optim.steps {optim.steps} is not a multiple of --loop.epoch-steps {loop.epoch_steps}; change one of them"
        )
    if density := settings.density:
        check_positive({"density.max-gaussians": density.max_gaussians})
        check_share("density.prune-attenuation", density.prune_attenuation)
        if not 0 < density.reset_attenuation < 1:  # its logit is computed
            raise UserError(f"--density.reset-attenuation is {density.reset_attenuation}; it must lie strictly between 0 and 1")
    if density and density.every < density.stop_fraction * optim.steps:
        for name, every in (("every", density.every), ("reset-every", density.reset_every)):
            if every % loop.epoch_steps:  # it would never be due at the end of an epoch
                raise UserError(
                    f"--density.{name} {every} is not a multiple of --loop.epoch-steps {loop.epoch_steps}; change one of them"
                )


def check_positive(values: Mapping[str, int]) -> None:
    """Raises a `UserError` with the name of the first option whose value is less than 1."""
    for name, value in values.items():
        if value < 1:
            raise UserError(f"--{name} is {value}; it must be at least 1")


def check_share(name: str, value: float) -> None:
    """Raises a `UserError` unless an option's value lies between 0 and 1."""
    if not 0 <= value <= 1:
        raise UserError(f"--{name} is {value}; it must lie between 0 and 1")


def check_rates(name: str, config: Any) -> None:
    """Raises a `UserError` for the first negative learning rate, `<group>_lr`, of the settings of the field of this name."""
    for f in dataclasses.fields(config):
        if f.name.endswith("_lr") and getattr(config, f.name) < 0:
            raise UserError(f"--{name}.{f.name.replace('_', '-')} is {getattr(config, f.name)}; it must be at least 0")
