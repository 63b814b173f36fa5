"""Options of a search on the road: budgets, grid and drives."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from me2e_compress.display import significant
from me2e_compress.errors import RecipeError
from me2e_compress.fidelity.sensitivity.search import nothing_fits
from me2e_compress.quantization.rules import DEFAULT_RULES
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets import DEFAULT_TARGET
from me2e_compress.workflows.budgets import Joules, check_budgets
from me2e_compress.workflows.checks import MOST_THREADS, check_count


@dataclass(frozen=True)
class Weighed:
    """Costs of one scheme: MB of weights, median decision in ms, joules per frame."""

    mb: float
    ms: float
    joules: float


@dataclass(frozen=True)
class Limits:
    """Budgets, all of which must be met.

    Args:
        max_mb: MB of weights.
        max_ms: Milliseconds, the median of a decision on the device.
        max_joules: Joules per frame.

    Raises:
        RecipeError: There is none, or one is not a finite number above 0.
    """

    max_mb: float | None = None
    max_ms: float | None = None
    max_joules: float | None = None

    def __post_init__(self) -> None:
        check_budgets(self.max_mb, self.max_ms, self.max_joules)

    def spent(self, weighed: Weighed) -> float:
        """Return the largest used share of a budget; 1 is all of it."""
        return max(cost / limit for cost, limit in self._pairs(weighed))

    def words(self, weighed: Weighed, kind: Joules) -> str:
        """Say how much of each budget is used."""
        pairs = zip(self._pairs(weighed), self.units(kind), strict=True)
        return ", ".join(
            f"{significant(cost)} of {significant(most)} {unit}"
            for (cost, most), unit in pairs
        )

    def refusal(self, whole: Weighed, found: Sequence[Weighed], kind: Joules) -> str:
        """Say that nothing fits, and what the least cost was."""
        costs = [[cost for cost, _ in self._pairs(each)] for each in (whole, *found)]
        limits = [limit for _, limit in self._pairs(whole)]
        pairs = tuple(zip(limits, self.units(kind), strict=True))
        return nothing_fits(pairs, costs[0], costs[1:] or costs)

    def units(self, kind: Joules) -> tuple[str, ...]:
        """Return the unit of each budget."""
        asked = ((self.max_mb, "MB"), (self.max_ms, "ms"), (self.max_joules, kind))
        return tuple(unit for limit, unit in asked if limit is not None)

    def _pairs(self, weighed: Weighed) -> Iterator[tuple[float, float]]:
        for cost, limit in (
            (weighed.mb, self.max_mb),
            (weighed.ms, self.max_ms),
            (weighed.joules, self.max_joules),
        ):
            if limit is not None:
                yield cost, limit


@dataclass(frozen=True, kw_only=True)
class RoadSearchOptions:
    """Budgets, grid and drives of a search on the road.

    Args:
        drives: Folder of models, traces and drives; run again, the search resumes.
        limits: Budgets.
        modules: ``A+B,C``: groups that are float or int8; None: feature extraction and
            prediction.
        ablate: ``A,B``: modules that may be removed; ``none``; None: all that may.
        most_ablated: At most so many of them at once.
        routes: ``all``, a number, ids, or a file of routes.
        latency: Latency of decisions: ``trace`` (each model's own), ``fps:F``,
            ``none``.
        baseline_median_s: Median latency of the float model on the target device; None
            takes this machine as it is.
        first_rung: Routes that every scheme drives.
        rules: Rules of the int8 plans.
        target: Runtime of the int8 graphs.
        module_map: Preset or TOML file; None finds the preset.
        adapter: TOML file that adapts the model to the policy contract.
        dims: Sizes of open dimensions.
        samples: Timed inferences per model.
        threads: Threads of onnxruntime while they are timed.
        seed: Seed of the order of routes, of draws from traces and of bootstraps.
        provider: What runs the models.
        force: Also replace a recipe that we did not write.

    Raises:
        RecipeError: A number is too small, or int8 for another target is timed here.
    """

    drives: Path
    limits: Limits
    modules: str | None = None
    ablate: str | None = None
    most_ablated: int = 1
    routes: str = "all"
    latency: str = "trace"
    baseline_median_s: float | None = None
    first_rung: int = 22
    rules: str = DEFAULT_RULES
    target: str = DEFAULT_TARGET
    module_map: str | None = None
    adapter: Path | None = None
    dims: Mapping[str, int] = field(default_factory=dict)
    samples: int = 200
    threads: int = 1
    seed: int = 0
    provider: Provider = CPU
    force: bool = False

    def __post_init__(self) -> None:
        check_count("--most-ablated", self.most_ablated)
        check_count("--first-rung", self.first_rung, least=1)
        check_count("--threads", self.threads, least=1, most=MOST_THREADS)
        timed = self.limits.max_ms is not None or self.latency == "trace"
        if timed and self.target != DEFAULT_TARGET:
            raise RecipeError(
                f"latency is measured here, where int8 for {self.target} is slow: use"
                f" --target {DEFAULT_TARGET}"
            )
