"""Options of a search on the road."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from me2e_compress.errors import RecipeError
from me2e_compress.quantization.rules import DEFAULT_RULES
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.study.on_road.limits import Limits
from me2e_compress.workflows.checks import MOST_THREADS, check_count


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
    target: str | None = None
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
        if timed and self.runs_on != "onnxruntime":
            raise RecipeError(
                f"latency is measured here, where int8 for {self.runs_on} is slow: use"
                " --target onnxruntime"
            )

    @property
    def runs_on(self) -> str:
        """The runtime of the int8 graphs."""
        return self.target or "onnxruntime"
