"""Settings of the coherent field, and its presets."""

import dataclasses
from dataclasses import dataclass

from wbgs_jax._util.errors import UserError
from wbgs_jax.config import PRESETS as COMMON
from wbgs_jax.config import SearchConfig, Settings

MAX_FACETS = 100_000
"""As many as anybody has tried; each is a mirror, and shades all others."""


@dataclass(frozen=True)
class WaveConfig:
    """Settings of the coherent field."""

    max_facets: int = 20_000
    """Planar pieces of the mesh, at most: of more than 3,000 the largest that make up 98 % of it. Where a tenth of it would be
    left out, the mesh is simplified to 3,000."""
    mirror_areas: tuple[float, ...] = (0.0, 0.05, 1.0)
    """Square metres: the smallest facet in a chain of 1, 2 and 3 reflections."""
    mirror_area_after_edge: float = 0.5
    """Square metres: the smallest mirror behind a diffracting edge ..."""
    mirror_area_before_edge: float = 3.0
    """... and in front of it."""
    specular_tried: int = 512
    """Candidates without diffraction that are cut with all facets, at most ..."""
    specular_kept: int = 128
    """... and how many of them are kept."""
    diffracted_tried: int = 1024
    """Candidates with a diffraction that are cut with all facets, at most ..."""
    diffracted_kept: int = 256
    """... and how many of them are kept."""
    permittivity: float = 4.0
    """What all materials start with: relative permittivity ..."""
    conductivity: float = 0.02
    """... conductivity at 1 GHz, S/m ..."""
    slope: float = 1.0
    """... its exponent over frequency ..."""
    thickness: float = 0.1
    """... and metres, where the scene does not say."""
    excess_amplitude: float = 0.7
    """Amplitude that diffracted waves keep at every further interaction, beyond its slab, at the start."""
    placement: float = 1e-6
    """Metres: how far surfaces and transmitters may stand from where they are said to be, before the search for that."""
    clutter_cells: int = 32_768
    """Cells of the grid of what stands in the way and is not in the mesh, at most (`search.clutter_spectra`)."""
    clutter_cell: float = 0.25
    """Metres: the side of a cell, at least."""
    coherent: bool = True
    """False: the powers of the paths are added instead of their amplitudes, as phase-blind models do (an ablation)."""
    ssim_weight: float = 0.2
    """lambda of the paper's equation 5."""
    correlation_weight: float = 0.5
    """Weight of one minus the squared correlation of snapshots, where the data have them ..."""
    power_weight: float = 0.01
    """... and of the squared error of their log amplitude."""
    correction_weight: float = 0.1
    """Weight of the facets' mean squared corrections."""
    materials_lr: float = 1e-2
    """Learning rate of the logarithms of permittivity and conductivity."""
    thickness_lr: float = 1e-3
    """Learning rate of the logarithm of metres: at 100 GHz a thousandth of a wall turns the phase by a tenth of a radian."""
    corrections_lr: float = 5e-3
    """Learning rate of facet corrections, excess losses and the gain."""
    antennas_lr: float = 3e-4
    """Learning rate of the antennas' orientations and exponents."""
    clutter_weight: float = 0.02
    """Weight of the mean density of clutter (nepers per metre)."""
    clutter_lr: float = 0.2
    """Learning rate of the logarithm (where it is small) of that density."""
    placement_lr: float = 2e-2
    """Learning rate of the logarithm of `placement`."""

    def check(self, name: str) -> None:
        """Raises a `UserError` for settings that cannot work, of the field of this name."""
        if self.max_facets > MAX_FACETS:
            raise UserError(f"--{name}.max-facets is {self.max_facets}; the most is {MAX_FACETS}")
        if self.clutter_cells < 1 or self.clutter_cell <= 0:
            raise UserError(f"--{name}.clutter-cells and -cell must be positive; --search.clutter-spectra 0 does without")


STEPS = {"smoke": 100, "cpu": 2000, "gpu": 4000}
"""There are a few numbers a material to learn, no networks."""
SEARCH = {
    "smoke": SearchConfig(
        rounds=1, spectra=32, antenna_rounds=0, absent_spectra=0, tuning_spectra=0, geometry=False, clutter_spectra=0
    ),
    "cpu": SearchConfig(),
    "gpu": SearchConfig(),
}


CONFIGS = {
    # Few candidates, of large facets alone.
    "smoke": WaveConfig(mirror_areas=(0.05, 1.0), specular_tried=96, specular_kept=24, diffracted_tried=32, diffracted_kept=8),
    "cpu": WaveConfig(),
    "gpu": WaveConfig(),
}


def _preset(name: str) -> Settings:
    common, steps = COMMON[name], STEPS[name]
    optim = dataclasses.replace(common.optim, steps=steps, min_steps=steps // 2, batch=8)
    loop = dataclasses.replace(common.loop, evaluate_every=min(common.loop.evaluate_every, steps // 2))
    return Settings(CONFIGS[name], optim, loop, search=SEARCH[name])


PRESETS = {name: _preset(name) for name in COMMON}
