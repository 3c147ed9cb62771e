"""Settings of the coherent field, and its presets."""

import dataclasses
from dataclasses import dataclass

from wbgs_jax._util.errors import UserError
from wbgs_jax.config import PRESETS as COMMON
from wbgs_jax.config import CalibrationConfig, Settings, check_positive, check_rates


@dataclass(frozen=True)
class WaveConfig:
    """Settings of the coherent field."""

    max_facets: int = 20_000
    """Maximum number of planar facets of the mesh. Of more than 3,000 only the largest are used that make up 98 % of the area;
    if a tenth of the area would be left out, the mesh is simplified to 3,000."""
    mirror_areas: tuple[float, ...] = (0.0, 0.05, 1.0)
    """Smallest area of a facet in a sequence of 1, 2 and 3 reflections, square metres."""
    mirror_area_after_edge: float = 0.5
    """Smallest area of a reflecting facet after a diffracting edge, square metres."""
    mirror_area_before_edge: float = 3.0
    """Smallest area of a reflecting facet before a diffracting edge, square metres."""
    specular_tried: int = 512
    """Maximum number of candidates without diffraction that are tested for occlusion."""
    specular_kept: int = 128
    """Maximum number of paths without diffraction that are kept."""
    diffracted_tried: int = 1024
    """Maximum number of candidates with a diffraction that are tested for occlusion."""
    diffracted_kept: int = 256
    """Maximum number of paths with a diffraction that are kept."""
    permittivity: float = 4.0
    """Initial relative permittivity of all materials."""
    conductivity: float = 0.02
    """Initial conductivity of all materials at 1 GHz, S/m."""
    slope: float = 1.0
    """Initial exponent of the conductivity over frequency."""
    thickness: float = 0.1
    """Initial thickness of materials whose thickness the scene does not define, metres."""
    excess_amplitude: float = 0.7
    """Initial amplitude factor of diffracted waves at every further interaction, in addition to that of its slab."""
    placement: float = 1e-6
    """Initial standard deviation of the positions of surfaces and transmitters, before calibration, metres."""
    clutter_cells: int = 32_768
    """Maximum number of cells of the absorption grid, for objects that the mesh lacks (`calibration.absorption_spectra`)."""
    clutter_cell: float = 0.25
    """Smallest edge length of a cell of the absorption grid, metres."""
    coherent: bool = True
    """Add the amplitudes of paths; False adds their powers, as phase-blind models do (an ablation)."""
    ssim_weight: float = 0.2
    """lambda of the paper's equation 5."""
    ssim_stride: int = 2
    """Stride of the SSIM windows in the loss, along both axes (paper: 1)."""
    correlation_weight: float = 0.5
    """Weight of one minus the squared correlation of snapshots, if the data contain them."""
    power_weight: float = 0.01
    """Weight of the squared error of the log amplitude of snapshots, if the data contain them."""
    correction_weight: float = 0.1
    """Weight of the mean squared facet corrections."""
    materials_lr: float = 1e-2
    """Learning rate of the logarithms of permittivity and conductivity."""
    thickness_lr: float = 1e-3
    """Learning rate of the logarithm of thickness: at 100 GHz a thousandth of a wall's thickness changes the phase by a tenth
    of a radian."""
    corrections_lr: float = 5e-3
    """Learning rate of facet corrections, additional losses and the overall gain."""
    antennas_lr: float = 3e-4
    """Learning rate of the orientations and exponents of the antennas."""
    clutter_weight: float = 0.02
    """Weight of the mean density of the absorption grid (nepers per metre)."""
    clutter_lr: float = 0.2
    """Learning rate of the density of the absorption grid, which is stored as a logarithm where it is small."""
    placement_lr: float = 2e-2
    """Learning rate of the logarithms of the standard deviations of positions."""

    def check(self, name: str) -> None:
        """Raises a `UserError` for invalid settings; the message names the option with the field's `name`."""
        # Largest number of facets that has been tested; each may reflect waves and obstruct all other paths.
        max_facets = 100_000
        if self.max_facets > max_facets:
            raise UserError(f"--{name}.max-facets is {self.max_facets}; the most is {max_facets}")
        check_rates(name, self)
        check_positive({f"{name}.ssim-stride": self.ssim_stride})
        if self.clutter_cells < 1 or self.clutter_cell <= 0:
            raise UserError(
                f"--{name}.clutter-cells and -cell must be positive; --calibration.absorption-spectra 0 disables the grid"
            )


STEPS = {"smoke": 100, "cpu": 2000, "gpu": 4000}
"""Training steps by preset: few, since only a few numbers per material are learned, and no networks."""
CALIBRATION = {
    "smoke": CalibrationConfig(
        rounds=1, spectra=32, antenna_rounds=0, spurious_spectra=0, array_gain_spectra=0, geometry=False, absorption_spectra=0
    ),
    "cpu": CalibrationConfig(),
    "gpu": CalibrationConfig(),
}


CONFIGS = {
    # Few candidates, from large facets only.
    "smoke": WaveConfig(mirror_areas=(0.05, 1.0), specular_tried=96, specular_kept=24, diffracted_tried=32, diffracted_kept=8),
    "cpu": WaveConfig(),
    "gpu": WaveConfig(),
}


def _preset(name: str) -> Settings:
    common, steps = COMMON[name], STEPS[name]
    optim = dataclasses.replace(common.optim, steps=steps, min_steps=steps // 2, batch=8)
    loop = dataclasses.replace(common.loop, evaluate_every=min(common.loop.evaluate_every, steps // 2))
    return Settings(CONFIGS[name], optim, loop, calibration=CALIBRATION[name])


PRESETS = {name: _preset(name) for name in COMMON}
