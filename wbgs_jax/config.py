"""All settings on one page: frozen dataclasses, and the presets `smoke`, `cpu` and `gpu` at the end.

Every setting can be overridden on the command line (`python -m wbgs_jax.train --help`); a run writes its own to
`config.json`. Where the paper or the authors' code give a value it is the default of the `gpu` preset; docs/decisions.md
says what was measured.
"""

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

from wbgs_jax.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.encoding import FrequencyScale
from wbgs_jax.errors import UserError
from wbgs_jax.geometry import Projection


@dataclass(frozen=True)
class WidebandConfig:
    """The paper's field (fields/wideband.py)."""

    gaussians: int = 2000
    """How many Gaussians start on the scene's surface; 0: one for every vertex of the mesh."""
    sampling: Literal["solid_angle", "area"] = "solid_angle"
    """Spread them evenly over the receiver's directions, or over the area of the surface."""
    width: int = 64
    """Units of the attenuation network's layers (authors: 128)."""
    depth: int = 4
    """Layers of the attenuation network (authors: 8)."""
    skip: int = 2
    """The layer at which the inputs enter again (authors: 4)."""
    fusion: int = 1
    """The layer of the attenuation network at which transmitter and frequency enter; those before it are evaluated once for
    all queries. 0: the paper's form."""
    radiance_widths: tuple[int, ...] = (64, 32)
    """Units of the radiance network's layers (authors: 128, 64)."""
    gaussian_octaves: int = 6
    """Octaves of P(G) (authors: 10)."""
    tx_octaves: int = 4
    """Octaves of P(TX) (authors: 10)."""
    frequency_octaves: int = 0
    """Octaves of the frequency encoding, beyond the scaled frequency itself (authors: 10; more than none fail between the
    frequencies that were trained)."""
    frequency_scale: FrequencyScale = "log"
    """"log" maps 1..100 GHz to -1..1; "ghz" feeds raw gigahertz, as the authors do."""
    relative: bool = True
    """Also encode TX and Gaussian relative to each other and to the receiver array; False: the paper's inputs alone."""
    attenuation_frequency: bool = True
    """Frequency embedding of the attenuation network (paper, Table 3)."""
    radiance_frequency: bool = True
    """Frequency embedding of the radiance network (paper, Table 3)."""
    projection: Projection = "hemisphere"
    """Zenith range on the image rows: "hemisphere" 0..90 degrees (paper), "sphere" 0..180 (authors' code)."""


@dataclass(frozen=True)
class Nerf2Config:
    """The NeRF2-style volume (fields/nerf2.py)."""

    samples: int = 24
    """Samples of a ray between the receiver and the end of the scene's box."""
    directions: int = 192
    """Directions (pixels) of every spectrum that a training step looks at."""
    width: int = 64
    """Units of the attenuation network's layers (authors: 256)."""
    depth: int = 4
    """Layers of the attenuation network (authors: 8); the frequency enters the last one."""
    skip: int = 2
    """The layer at which the place enters again (authors: 4)."""
    radiance_widths: tuple[int, ...] = (64, 32)
    """Units of the radiance network's layers."""
    point_octaves: int = 6
    """Octaves of P(x) (authors: 10)."""
    direction_octaves: int = 2
    tx_octaves: int = 4
    """Octaves of P(TX) (authors: 10)."""
    frequency_octaves: int = 0
    """Octaves of the frequency encoding, beyond its logarithm itself."""
    relative: bool = True
    """Also encode the TX relative to the place, the direction and the receiver array, as the wideband field does."""


@dataclass(frozen=True)
class WaveConfig:
    """The coherent field (fields/wave.py)."""

    max_facets: int = 3000
    """The largest planar pieces of the mesh; the rest is left out."""
    mirror_areas: tuple[float, ...] = (0.0, 0.05, 1.0)
    """Square metres: the smallest facet in a chain of 1, 2 and 3 reflections."""
    mirror_area_after_edge: float = 0.5
    """Square metres: the smallest mirror behind a diffracting edge ..."""
    mirror_area_before_edge: float = 3.0
    """... and in front of it."""
    plain_tried: int = 512
    """Candidates without diffraction that are cut with all facets, and how many of them are kept."""
    plain_kept: int = 128
    diffracted_tried: int = 1024
    diffracted_kept: int = 256
    permittivity: float = 4.0
    """What all materials start with: relative permittivity ..."""
    conductivity: float = 0.02
    """... conductivity at 1 GHz, S/m ..."""
    slope: float = 1.0
    """... its exponent over frequency ..."""
    thickness: float = 0.1
    """... and metres, where the scene does not say."""
    survival: float = 0.7
    """Amplitude that diffracted waves keep at every further meeting, at the start."""
    coherent: bool = True
    """False: the powers of the paths are added instead of their amplitudes, as phase-blind models do (an ablation)."""
    residual_weight: float = 0.1
    """Weight of the facets' mean squared residuals."""


@dataclass(frozen=True)
class OptimConfig:
    """Loss, optimiser groups and schedules; every learning rate decays by a cosine to `final_fraction` of itself."""

    steps: int = 6000
    """Upper bound; see `max_epochs`."""
    max_epochs: float = 16.0
    """Small data sets are not seen more often than this (they would be learned by heart) ..."""
    min_steps: int = 1000
    """... but get at least this many steps."""
    batch: int = 8
    """Queries a step."""
    ssim_weight: float = 0.2
    """lambda of the paper's equation 5."""
    pixel_loss: Literal["l1", "l2"] = "l1"
    """Of a field that trains on some directions only, where there is no SSIM."""
    network_lr: float = 4e-3
    """Authors: 8e-4."""
    network_weight_decay: float = 0.0
    means_lr: float = 1e-3
    """Metres a step, about. (Authors: 0 in effect; their spatial scale multiplies it away.)"""
    log_scales_lr: float = 5e-3
    quats_lr: float = 1e-3
    opacity_lr: float = 2.5e-2
    materials_lr: float = 1e-2
    """Logarithms of permittivity and conductivity, of the wave field."""
    thickness_lr: float = 1e-3
    """Logarithm of metres: at 100 GHz a thousandth of a wall turns the phase by a tenth of a radian."""
    residual_lr: float = 5e-3
    """Facets' residuals, survival and gain."""
    snapshot_weight: float = 0.5
    """Weight of 1 - correlation of snapshots, where field and data have them ..."""
    power_weight: float = 0.01
    """... and of the squared error of their log amplitude."""
    final_fraction: float = 0.01
    curriculum: float = 0.0
    """Share of the steps over which the highest frequency of the batches rises from the lowest to the highest of the data. At
    low frequencies the phase behind a slab is no riddle."""


@dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control (paper, section 4.5; thresholds of the authors' code)."""

    every: int = 500
    """Steps between two controls; 0 switches it off."""
    start: int = 500
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
    max_gaussians: int = 3000


@dataclass(frozen=True)
class SearchConfig:
    """Search for known materials before the first step of the wave field (material_search.py)."""

    rounds: int = 3
    """Times all materials are gone through, at most; 0: no search."""
    spectra: int = 384
    """Training spectra that are looked at."""
    sure: float = 2.0
    """Standard errors by which what has been learned must fit better than every known material to be kept."""


@dataclass(frozen=True)
class LoopConfig:
    """How the host drives training."""

    epoch_steps: int = 50
    """Steps in one jitted epoch: what an interrupt waits for at most."""
    evaluate_every: int = 1000
    """Steps between two evaluations on `evaluate_spectra` held-out spectra, for the curves only."""
    evaluate_spectra: int = 60
    checkpoint_every: int = 1000
    keep_checkpoints: int = 2


def without_frequency(config: WidebandConfig) -> WidebandConfig:
    """The same field with both frequency embeddings switched off."""
    return dataclasses.replace(config, attenuation_frequency=False, radiance_frequency=False)


@dataclass(frozen=True)
class Settings:
    """Everything that makes a run, but the data and the seed."""

    wideband: WidebandConfig = field(default_factory=WidebandConfig)
    wrfgs: WidebandConfig = field(default_factory=lambda: without_frequency(WidebandConfig()))
    """The wideband field without any frequency input, one model a frequency (fields/wrfgs.py)."""
    nerf2: Nerf2Config = field(default_factory=Nerf2Config)
    wave: WaveConfig = field(default_factory=WaveConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)


PRESETS: dict[str, Settings] = {
    # Under a minute on two cores: proves that everything works, not that it is good.
    "smoke": Settings(
        wideband=WidebandConfig(gaussians=500, width=32, depth=3, radiance_widths=(32,)),
        nerf2=Nerf2Config(samples=8, directions=64, width=32, depth=3, radiance_widths=(32,)),
        optim=OptimConfig(steps=200, batch=4),
        density=DensityConfig(every=100, start=50, max_gaussians=640),
        search=SearchConfig(rounds=1, spectra=96),
        loop=LoopConfig(epoch_steps=20, evaluate_every=100, evaluate_spectra=20, checkpoint_every=100),
    ),
    # The default without a GPU.
    "cpu": Settings(),
    # The paper's size: a Gaussian for every vertex of the mesh, 8x128 and 128-64 networks.
    "gpu": Settings(
        wideband=WidebandConfig(gaussians=0, width=128, depth=8, skip=4, fusion=0, radiance_widths=(128, 64)),
        nerf2=Nerf2Config(samples=64, directions=1024, width=256, depth=8, skip=4, radiance_widths=(256, 128)),
        optim=OptimConfig(steps=20_000, batch=8, network_lr=8e-4),
        density=DensityConfig(max_gaussians=100_000, reset_every=3000),
        loop=LoopConfig(epoch_steps=100, checkpoint_every=2000),
    ),
}


WAVE_STEPS = {"smoke": 100, "cpu": 2000, "gpu": 4000}
"""The wave field has a few numbers a material to learn, not networks."""


def preset_settings(preset: str, field: str) -> Settings:
    """A preset as it suits a field."""
    settings = PRESETS[preset]
    if field == "wrfgs":
        return dataclasses.replace(settings, wrfgs=without_frequency(settings.wideband))
    if field != "wave":
        return settings
    steps = WAVE_STEPS[preset]
    optim = dataclasses.replace(settings.optim, steps=steps, min_steps=steps // 2, batch=8)
    loop = dataclasses.replace(settings.loop, evaluate_every=min(settings.loop.evaluate_every, steps // 2))
    return dataclasses.replace(settings, optim=optim, loop=loop)


def to_dict(settings: Settings) -> dict[str, Any]:
    """Settings as plain values for JSON."""
    return dataclasses.asdict(settings)


def from_dict(values: Any) -> Settings:
    """Settings from `to_dict`'s values; unknown or missing names are a `UserError` (today's default was not set then)."""

    def build(cls: Any, values: Any) -> Any:
        if missing := {f.name for f in dataclasses.fields(cls)} - set(values):
            raise KeyError(f"{cls.__name__}.{min(missing)}")
        return cls(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})

    sections = {name: type(section) for name, section in vars(Settings()).items()}
    try:
        built = {name: build(sections[name], value) for name, value in values.items()}
        return Settings(**built | {name: built[name] for name in sections})
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"these settings belong to another version of wbgs-jax ({error}); start a new run") from error


def limit_steps(settings: Settings, n_train: int) -> Settings:
    """Settings whose `optim.steps` are what a data set of `n_train` spectra gets: a multiple of the epoch block."""
    optim, block = settings.optim, settings.loop.epoch_steps
    wanted = max(optim.min_steps, optim.max_epochs * n_train / optim.batch)
    steps = min(optim.steps, round(wanted / block) * block)
    return dataclasses.replace(settings, optim=dataclasses.replace(optim, steps=max(steps, block)))


def check(settings: Settings) -> None:
    """Settings that cannot work are a `UserError` before any work is done."""
    positive = {
        "optim.steps": settings.optim.steps,
        "optim.batch": settings.optim.batch,
        "loop.epoch-steps": settings.loop.epoch_steps,
        "loop.evaluate-every": settings.loop.evaluate_every,
        "loop.checkpoint-every": settings.loop.checkpoint_every,
        "loop.keep-checkpoints": settings.loop.keep_checkpoints,
        "search.spectra": settings.search.spectra,
    }
    _check_positive(positive)
    steps, block = settings.optim.steps, settings.loop.epoch_steps
    if steps % block:
        raise UserError(f"--optim.steps {steps} is not a multiple of --loop.epoch-steps {block}; change one of them")
    if not 0 <= settings.optim.ssim_weight <= 1:
        raise UserError(f"--optim.ssim-weight is {settings.optim.ssim_weight}; it must lie between 0 and 1")
    _check_splatting("wideband", settings.wideband)
    _check_splatting("wrfgs", settings.wrfgs)
    _check_volume(settings.nerf2)
    if settings.wrfgs != without_frequency(settings.wrfgs):
        raise UserError("WRF-GS has no frequency input to switch on; train --field wideband")


def _check_positive(values: dict[str, int]) -> None:
    for name, value in values.items():
        if value < 1:
            raise UserError(f"--{name} is {value}; it must be at least 1")


def _check_splatting(name: str, config: WidebandConfig) -> None:
    widths = min(config.radiance_widths, default=0)
    _check_positive({f"{name}.width": config.width, f"{name}.depth": config.depth, f"{name}.radiance-widths": widths})
    if 0 < config.gaussians < 4 or config.gaussians < 0:
        raise UserError(f"--{name}.gaussians is {config.gaussians}; give at least 4, or 0 for the size of the mesh")
    if not 0 <= config.fusion < config.depth:
        raise UserError(f"--{name}.fusion is {config.fusion}; it is the number of a layer, 0 to {config.depth - 1}")
    for part in ("gaussian", "tx", "frequency"):
        _check_octaves(name, config, part)


def _check_volume(config: Nerf2Config) -> None:
    counts = {name: getattr(config, name) for name in ("samples", "directions", "width", "depth")}
    _check_positive({f"nerf2.{name}": n for name, n in counts.items()})
    _check_positive({"nerf2.radiance-widths": min(config.radiance_widths, default=0)})
    if config.directions > (pixels := PAS_HEIGHT * PAS_WIDTH):
        raise UserError(f"--nerf2.directions is {config.directions}; a spectrum has {pixels} pixels")
    for part in ("point", "direction", "tx", "frequency"):
        _check_octaves("nerf2", config, part)


def _check_octaves(name: str, config: Any, part: str) -> None:
    if getattr(config, f"{part}_octaves") < 0:
        raise UserError(f"--{name}.{part}-octaves is negative; give 0 or more")
