"""Series: a field, its changes, where and how often each is trained, and the table of their scores."""

import dataclasses
import statistics
from collections.abc import Callable
from dataclasses import dataclass

from experiments.jobs import Job
from experiments.markdown import markdown
from experiments.results import Results

NOT_RUN = "not run"


@dataclass(frozen=True)
class Series:
    """Changes that are compared with each other."""

    title: str
    field: str
    variants: tuple[str, ...]
    """Names in `variants.VARIANTS`; none: as the profile has it."""
    profile: str
    scenes: tuple[str, ...] = ("1",)
    combination: str = ""
    seeds: tuple[int, ...] = (0,)

    def jobs_of(self, scene: str, variant: str) -> list[Job]:
        """Returns one row of the table: a job a seed."""
        first = Job(scene, self.field, self.combination, variant=variant, profile=self.profile)
        return [dataclasses.replace(first, seed=seed) for seed in self.seeds]

    def jobs(self) -> list[Job]:
        """Returns all jobs."""
        return [job for scene in self.scenes for variant in self.variants for job in self.jobs_of(scene, variant)]

    def render(self, results: Results) -> str:
        """Returns the table: the median SSIM of every seed, their median, and the median of the mean SSIM."""
        rows = []
        for scene in self.scenes:
            for variant in self.variants:
                found = [results.get(job) for job in self.jobs_of(scene, variant)]
                known = [result.values for result in found if result]
                medians, means = ([values[name] for values in known] for name in ("median_ssim", "mean_ssim"))
                each = [f"{result.values['median_ssim']:.3f}" if result else NOT_RUN for result in found]
                summary = [f"**{statistics.median(medians):.3f}**", f"{statistics.median(means):.3f}"] if known else ["", ""]
                steps = f"{known[0]['steps']:,}" if known else ""
                rows.append([scene, variant or "(no change)", *each, *summary, steps])
        head = ["scene", "change", *(f"seed {seed}" for seed in self.seeds), "median", "mean SSIM", "steps"]
        where = f"profile `{self.profile}`" + (f", combination {self.combination}" if self.combination else "")
        return f"{self.title} ({self.field}, {where}):\n\n{markdown(head, rows)}"


@dataclass(frozen=True)
class Experiment:
    """Series that are shown together."""

    title: str
    series: tuple[Series, ...]
    more_jobs: tuple[Job, ...] = ()
    """Further jobs that its tables need."""
    tables: Callable[[Results], str] | None = None
    """Tables of its own form; by default one a series."""

    def jobs(self) -> list[Job]:
        """Returns a job a change, scene and seed."""
        return [job for one in self.series for job in one.jobs()] + [*self.more_jobs]

    def render(self, results: Results) -> str:
        """Returns its tables."""
        return self.tables(results) if self.tables else "\n\n".join(one.render(results) for one in self.series)
