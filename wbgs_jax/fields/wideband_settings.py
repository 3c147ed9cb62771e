"""Settings and presets of the paper's field."""

from dataclasses import dataclass

from wbgs_jax._util.errors import UserError
from wbgs_jax.config import (
    PRESETS,
    DensityConfig,
    LoopConfig,
    OptimConfig,
    Settings,
    check_positive,
    check_rates,
    check_share,
    setting,
)
from wbgs_jax.fields.base import Optimizer
from wbgs_jax.fields.networks import FrequencyScale, Precision, check_octaves
from wbgs_jax.radio.geometry import Projection
from wbgs_jax.types import SurfaceSampling


@dataclass(frozen=True)
class WidebandConfig:
    """Settings of the paper's field."""

    gaussians: int = 2000
    """Initial number of Gaussians on the scene's surface, limited to 16 per training spectrum (but not below 500); 0 for one
    per vertex of the mesh."""
    sampling: SurfaceSampling = "solid_angle"
    """Distribute them evenly over the receiver's directions, or over the area of the surface."""
    features: int = 16
    """Trained features of every Gaussian that enter the networks in addition to its position (authors: 0)."""
    width: int = 64
    """Units per layer of the attenuation network (authors: 128)."""
    depth: int = 4
    """Number of layers of the attenuation network (authors: 8)."""
    skip: int = 2
    """Layer at which the inputs enter again (authors: 4)."""
    fusion: int = 1
    """Layer of the attenuation network at which transmitter and frequency enter; the layers before it are evaluated once for
    all queries. 0 is the paper's form."""
    radiance_widths: tuple[int, ...] = (32,)
    """Units of each layer of the radiance network (authors: 128, 64)."""
    gaussian_octaves: int = 6
    """Octaves of P(G) (authors: 10)."""
    tx_octaves: int = 4
    """Octaves of P(TX) (authors: 10)."""
    frequency_octaves: int = 0
    """Octaves of the frequency encoding, in addition to the scaled frequency itself (authors: 10; any number above 0 fails
    between the trained frequencies)."""
    frequency_scale: FrequencyScale = "log"
    """"log" maps 1..100 GHz to -1..1; "ghz" uses raw gigahertz, as the authors do."""
    frequency_degree: int = 1
    """Highest degree of the Legendre polynomials of the scaled frequency that enter the networks; 1 for the frequency alone."""
    frequency_heads: int = 0
    """Degree of delta_f and of the logit of Sig as polynomials in the scaled frequency, whose coefficients are the outputs of
    the networks; 0 for dependence through the inputs only."""
    relative: bool = True
    """Also encode TX and Gaussian relative to each other and to the receiver array; False for the paper's inputs only."""
    attenuation_frequency: bool = True
    """Frequency embedding of the attenuation network (paper, Table 3)."""
    radiance_frequency: bool = True
    """Frequency embedding of the radiance network (paper, Table 3)."""
    projection: Projection = "hemisphere"
    """Zenith range on the image rows: "hemisphere" 0..90 degrees (paper), "sphere" 0..180 (authors' code)."""
    ssim_weight: float = 0.2
    """lambda of the paper's equation 5."""
    ssim_stride: int = 2
    """Stride of the SSIM windows in the loss, along both axes (paper: 1)."""
    power_weight: float = 0.01
    """Weight of the mean absolute error (dB) of the received power, if the data contain it. It has no gradient with respect to
    the parameters of the spectra. Not in the paper."""
    precision: Precision = setting("device", before="device")
    """Precision of products in the networks: "device" (TF32 on GPUs that support it, else float32), "float32", "tf32" or
    "bfloat16"."""
    features_lr: float = 1e-2
    """Learning rate of the Gaussians' features."""
    network_optimizer: Optimizer = "muon"
    """Optimiser of the networks' matrices (`base.Group`; authors: Adam)."""
    network_lr: float = 1e-2
    """Learning rate of the networks (authors: 8e-4)."""
    network_weight_decay: float = 0.0
    """Decoupled weight decay of the networks."""
    means_lr: float = 1e-3
    """Learning rate of the centres, about metres per step (authors: effectively 0, after multiplication by their spatial
    scale)."""
    log_scales_lr: float = 5e-3
    """Learning rate of the logarithms of the standard deviations."""
    quats_lr: float = 1e-3
    """Learning rate of the rotations."""
    opacity_lr: float = 2.5e-2
    """Learning rate of delta_o."""

    def check(self, name: str) -> None:
        """Raises a `UserError` for invalid settings; the message names the option with the field's `name`."""
        widths = min(self.radiance_widths, default=0)
        sizes = {"width": self.width, "depth": self.depth, "radiance-widths": widths, "ssim-stride": self.ssim_stride}
        check_positive({f"{name}.{option}": size for option, size in sizes.items()})
        check_share(f"{name}.ssim-weight", self.ssim_weight)
        if 0 < self.gaussians < 4 or self.gaussians < 0:
            raise UserError(f"--{name}.gaussians is {self.gaussians}; give at least 4, or 0 for the size of the mesh")
        if not 0 <= self.fusion < self.depth:
            raise UserError(f"--{name}.fusion is {self.fusion}; it is the number of a layer, 0 to {self.depth - 1}")
        check_rates(name, self)
        check_octaves(name, self, ("gaussian", "tx", "frequency"))
        if self.frequency_degree < 1 or self.frequency_heads < 0:
            raise UserError(f"--{name}.frequency-degree must be at least 1, --{name}.frequency-heads at least 0")

    @property
    def sees_frequency(self) -> bool:
        """Whether anything other than the array's response depends on the frequency."""
        return self.attenuation_frequency or self.radiance_frequency or self.frequency_heads > 0


CONFIGS = {
    "smoke": WidebandConfig(gaussians=500, width=32, depth=3, radiance_widths=(32,)),
    "cpu": WidebandConfig(),
    # A Gaussian per vertex of the mesh and the authors' networks, with the inputs, schedule and batches of the other presets.
    "gpu": WidebandConfig(gaussians=0, width=128, depth=8, skip=4, fusion=0, radiance_widths=(128, 64)),
}
DENSITY = {
    "smoke": DensityConfig(every=100, start=50, max_gaussians=600),
    "cpu": DensityConfig(every=200, start=200),
    "gpu": DensityConfig(max_gaussians=100_000, reset_every=3000),
}
OPTIM = {
    "smoke": PRESETS["smoke"].optim,
    "cpu": OptimConfig(steps=2400),
    "gpu": PRESETS["gpu"].optim,
}
PAPER = Settings(
    field=WidebandConfig(
        gaussians=0,
        features=0,
        width=128,
        depth=8,
        skip=4,
        fusion=0,
        radiance_widths=(128, 64),
        gaussian_octaves=10,
        tx_octaves=10,
        frequency_octaves=10,
        frequency_scale="ghz",
        relative=False,
        ssim_stride=1,
        power_weight=0.0,
        network_optimizer="adam",
        network_lr=8e-4,
        network_weight_decay=5e-5,
        means_lr=0.0,
    ),
    optim=OptimConfig(steps=200_000, max_epochs=1e6, batch=1, final_fraction=1.25e-3, virtual=0.0),
    density=DensityConfig(
        every=100,
        start=500,
        stop_fraction=0.075,
        gradient_threshold=2e-4,
        split_scale=0.02,
        reset_every=3000,
        max_gaussians=100_000,
    ),
    loop=LoopConfig(epoch_steps=100, evaluate_every=10_000, checkpoint_every=10_000),
)
"""The paper's own form, without the changes of this project. Inputs of the networks, hemisphere and loss are those of the
paper's text; sizes, octaves, raw gigahertz, rates, thresholds, batch and steps, which the text does not give, are those of the
authors' code. docs/baselines.md describes where the two differ and which parts of the code are left out."""
