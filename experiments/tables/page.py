"""The two pages of results: tables and figures of the paper from the results that exist, and where they come from.

The first page holds what a reader needs, the second one the long tables by frequency. No figure is typed in; what has not been
run is marked.
"""

from collections import Counter
from pathlib import Path

from experiments.catalogue import unique_jobs
from experiments.profiles import PROFILES, Profile
from experiments.results import Results
from experiments.tables import (
    baselines,
    default_field,
    few,
    figure4,
    figure6,
    figure7,
    figure8,
    headline,
    power,
    table1,
    table2,
    table3,
)

PAGES = (headline, default_field, table3, figure4, figure6)
"""Sections of the first page."""
LONG = (few, power, table1, table2, figure7, figure8, baselines)
"""Sections of the second page: tables by scene and frequency."""


def page(results: Results, images: Path) -> str:
    """The first page."""
    parts = ["# Results", introduction(results.profile), provenance(results)]
    return joined(parts, PAGES, results, images)


def long_page(results: Results, images: Path) -> str:
    """The second page."""
    return joined(["# Results by scene and frequency", LONG_INTRODUCTION], LONG, results, images)


def joined(parts: list[str], modules: tuple, results: Results, images: Path) -> str:
    """Text and sections as one document."""
    for module in modules:
        parts += [f"## {module.TITLE}", module.render(results, images)]
    return "\n\n".join(parts) + "\n"


INTRODUCTION = """This page shows how well the fields predict spectra at transmitter positions, or frequencies, that were not
used in training. It repeats the tables and figures of [*Wideband RF Radiance Field Modeling Using Frequency-embedded 3D
Gaussian Splatting*](https://arxiv.org/abs/2505.20714) on [this repository's data](dataset.md); [a second
page](results_tables{suffix}.md) has the tables by scene and frequency. Scores are median SSIM (scikit-image, 7 x 7 window).
**In parentheses: the paper's value.** The paper's scenes are not published: compare orders and ratios, not single values.

| name | what it is |
| --- | --- |
| wideband (ours) | the paper's field with this project's inputs and projection, which gain more than anything else \
([decisions](decisions.md)); one model for all frequencies of a scene |
| WRF-GS | the paper's comparison, a splatting field without frequency, one model for every frequency, all of which together \
see as many spectra as ours; rebuilt here with the same inputs, not its authors' code ([baselines](baselines.md)) |
| WRF-GS, pooled | our field without its frequency inputs, one model for all frequencies |
| 5x samples | trained on five times the usual number of spectra |
| coherent (ours) | the [coherent field](wave.md), one model for all frequencies. It has more information than the others: \
complex snapshots, the exact mesh and the walls' thickness, a list that contains the true materials, and the physics that made \
the data. Its rows in tables 1 and 2 and figures 7 and 8 predate its learned uncertainty of surface positions |
| NeRF2-style | a volume marched along rays, with the frequency as an input; rebuilt here too |
| untrained predictors, phase-blind ceiling | [dataset card](dataset.md#ceilings); the ceiling was measured on 50 transmitters \
of each scene |
| truth against itself | 40 transmitters of each scene, traced again with three times the rays; scores above this level cannot \
be distinguished |

* **Effort** (profile `{name}`): {effort}. [How the experiments are run](experiments.md).
* **Intervals** (95 %) are bootstrapped over transmitters and seeds. Intervals and p-values treat neighbouring transmitters as
  independent, which they are not quite. The value of several seeds is their median.
* **Split**: unless a table names an exception, all models of a scene have the same training and test transmitters.
* **Choices**: optimisers, rates, layers and loss were chosen on a validation part of the training transmitters; inputs and
  octaves are older, chosen on held-out transmitters of scenes 1 and 4."""

LONG_INTRODUCTION = """Reference tables of the [results](results.md), where models, scores and intervals are defined."""


def introduction(name: str) -> str:
    """Returns the introduction: what is compared, and with which effort."""
    suffix = "" if name == "quick" else f"_{name}"
    return INTRODUCTION.format(name=name, suffix=suffix, effort=profile_text(PROFILES[name]))


def profile_text(profile: Profile) -> str:
    """The size of a profile in words."""
    gaussians = profile.fields.get("wideband", {}).get("gaussians")
    size = f"the `{profile.preset}` preset" + (f" with {gaussians:,} Gaussians at the start" if gaussians else "")
    return f"{size}, {profile.steps:,} steps (the coherent field {profile.wave_steps:,})"


def provenance(results: Results) -> str:
    """Returns how much has been run, where, with which code."""
    jobs = unique_jobs()
    found = results.all(jobs)
    if not found:
        return f"**None of the {len(jobs)} jobs has been run yet.**"
    seconds = sum(r.seconds for r in found)
    where = Counter((r.values["environment"]["device"], r.values["environment"]["jax"]) for r in found)
    devices = "; ".join(f"{count} on {device} (JAX {jax})" for (device, jax), count in where.most_common())
    commits = sorted({str(r.values["environment"]["commit"]) for r in found})
    return (
        f"{len(found)} of {len(jobs)} jobs have been run ({devices}; {seconds / 3600:.1f} hours of training and evaluation;"
        f" code {', '.join(f'`{c}`' for c in commits)}). Each is a line of `experiments/results/{results.profile}.jsonl`, with"
        " its settings; results of other settings count as not run."
    )
