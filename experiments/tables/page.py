"""The page of results: every table and figure of the paper from the results that there are, and where they come from.

Nothing in it is typed in: what has not been run says so.
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
    table1,
    table2,
    table3,
)

PAGES = (headline, default_field, few, table1, table2, table3, figure4, figure6, figure7, figure8, baselines)
"""In the order of the paper, for readers."""


def page(results: Results, images: Path) -> str:
    """The whole document."""
    parts = ["# Results", introduction(results.profile), provenance(results)]
    for module in PAGES:
        parts += [f"## {module.TITLE}", module.render(results, images)]
    return "\n\n".join(parts) + "\n"


INTRODUCTION = """The tables and figures of [*Wideband RF Radiance Field Modeling Using Frequency-embedded 3D Gaussian
Splatting*](https://arxiv.org/abs/2505.20714), run again on [this repository's data](dataset.md). A model is trained on spectra
of one scene and asked for spectra at transmitter positions, or frequencies, that it has not seen. Scores are median SSIM
(scikit-image, 7 x 7 window). **In parentheses stands the paper's value**, where it gives one. The paper's scenes are not
published and the data here are others: compare orders and ratios, not single values.

* **wideband (ours)**: the paper's field with this project's inputs and projection, which gain more than anything else
  ([decisions](decisions.md)); one model for all frequencies of a scene.
* **WRF-GS**: what the paper compares with, a splatting field without frequency; *one model for every frequency*, all of which
  together see as many spectra as ours does. Rebuilt here with the same inputs as ours; not its authors' code
  ([baselines](baselines.md)).
* **WRF-GS, pooled**: one model for all frequencies that is not told which one it is asked for: our field without its frequency
  inputs.
* **5x samples**: trained on five times the usual number of spectra.
* **coherent (ours)**: the [coherent field](wave.md); one model for all frequencies. It is told more than the others: complex
  snapshots in training, the exact mesh and the walls' thickness, the list that the materials come from, and the physics that
  made the data. Its rows in tables 1 and 2 and figures 7 and 8 predate its learning of how far surfaces
  may be off.
* **NeRF2-style**: a volume marched along rays, with the frequency as an input; rebuilt here too.
* **Predictors that learn nothing**, and the **phase-blind ceiling**: the mean spectrum over random phases of all true paths,
  about the best that can be said without phases; measured on 50 transmitters of each scene ([dataset card](dataset.md)).
* **Truth against itself**: 40 transmitters of each scene, traced again with three times the rays. Scores above this level
  cannot be told apart.

Effort (profile `{name}`): {effort}.
Intervals (95 %) are bootstrapped over transmitters, because spectra of one transmitter are no independent samples, and over
seeds. They, and the p-values, take neighbouring transmitters for independent, which they are not quite. Where several seeds
were run a value is their median. Except where a table says otherwise, all models of a scene train on the same transmitters and
are tested on the same others. Optimisers, rates, layers and loss were chosen on a validation part of the training transmitters;
inputs and octaves are older, chosen on held-out transmitters of scenes 1 and 4.

```
make experiments PROFILE={name}    # runs what is missing, goes on where it was cut; MINUTES=60 sets a limit
make tables PROFILE={name}         # writes this page
python -m experiments.runner --profile {name} --only table1 --scenes 1 4 --dry-run
```"""


def introduction(name: str) -> str:
    """What is compared, with which effort, and how to run it again."""
    return INTRODUCTION.format(name=name, effort=profile_text(PROFILES[name]))


def profile_text(profile: Profile) -> str:
    """The size of a profile in words."""
    gaussians = profile.fields.get("wideband", {}).get("gaussians")
    size = f"the `{profile.preset}` preset" + (f" with {gaussians:,} Gaussians at the start" if gaussians else "")
    return f"{size}, {profile.steps:,} steps (the coherent field {profile.wave_steps:,})"


def provenance(results: Results) -> str:
    """How much has been run, where, with which code."""
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
