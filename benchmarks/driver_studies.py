"""The studies of the driver that ships: which variants, under which conditions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from me2e_compress.manager import recipe
from me2e_compress.simulator.routes import Route
from me2e_compress.study import Condition, Study, Timing, Variant
from me2e_compress.workflows.compress import CompressOptions

MODULES = ("track", "map", "motion", "occ")
SCHEMES = ("exact", "feature-ext", "prediction", "full")
FPS = (20, 10, 5, 2, 1)
FLOAT_MEDIAN_S = 0.43
"""Median latency of the float driver on the device imagined."""
MEDIANS_S = (0.25, 0.35, FLOAT_MEDIAN_S, 0.5)
"""The same on devices of other speeds, some on each side of a multiple of 50 ms."""
LATENCY_SAMPLES = 300
IDEAL = Condition("ideal", "none")
DEVICE = Condition("device", "trace")
SLOWER = tuple(Condition(f"fps-{fps}", f"fps:{fps}") for fps in FPS)


@dataclass(frozen=True)
class Bench:
    """What all studies share."""

    out: Path
    model: str
    routes: tuple[Route, ...]
    set_size: int
    frames: Path
    held_out: Path
    target: str | None = None
    rules: str | None = None

    @property
    def float(self) -> Variant:
        return Variant("float", self.model)

    def without(self, *modules: str) -> Variant:
        """Drop modules; what read them reads the means over the calibration frames."""
        text = (
            "import-normalize,fold-constants,"
            f"ablate-modules{{drop=[{', '.join(modules)}], fill=means, "
            "drop_outputs=true},eliminate-redundant,hoist-linear,fuse-basic"
        )
        return Variant(f"minus-{'-'.join(modules)}", self.model, recipe.parse(text))

    def compressed(self, name: str) -> Variant:
        """Apply a recipe; its int8 is for the target and by the rules, if chosen."""
        passes = recipe.load(name)
        if any(each.quantizes for each in passes):
            options = CompressOptions(target=self.target, rules=self.rules)
            passes = options.passes(passes)
        return Variant(name, self.model, passes)

    def study(
        self,
        title: str,
        variants: tuple[Variant, ...],
        conditions: tuple[Condition, ...] = (IDEAL,),
    ) -> Study:
        return Study(
            title,
            variants,
            conditions,
            self.float.name,
            self.routes,
            self.set_size,
            self.frames,
            self.held_out,
            Timing(LATENCY_SAMPLES, baseline_median_s=FLOAT_MEDIAN_S),
        )

    def untimed(self, study: Study) -> Study:
        """Drive only: neither a clock nor a plan on held-out frames is wanted."""
        return replace(study, held_out=None, timing=Timing(LATENCY_SAMPLES))


def baselines(bench: Bench) -> Study:
    drivers = (Variant("expert", "expert"), Variant("blind", "blind"))
    return bench.study("Baselines", (*drivers, bench.float))


def ablation(bench: Bench) -> Study:
    single = [bench.without(name) for name in MODULES]
    return bench.study("Ablation", (bench.float, *single))


def pairs(bench: Bench) -> Study:
    double = [bench.without(*pair) for pair in combinations(MODULES, 2)]
    return bench.study("Ablation of pairs", (bench.float, *double))


def schemes(bench: Bench) -> Study:
    made = [bench.compressed(name) for name in SCHEMES]
    return bench.study("Schemes", (bench.float, *made), (IDEAL, DEVICE))


def scales(bench: Bench) -> Study:
    """Drive on faster and slower devices: each model's own latencies, stretched."""
    devices = tuple(
        DEVICE if median == FLOAT_MEDIAN_S else _stretched(median)
        for median in MEDIANS_S
    )
    return bench.study("Scales", (bench.float, bench.compressed("full")), devices)


def _stretched(median_s: float) -> Condition:
    """Return the device on which the float driver's median latency is this."""
    scale = f"trace{{scale={median_s / FLOAT_MEDIAN_S:.6g}}}"
    return Condition(f"median-{1000 * median_s:.0f}ms", scale)


def latency(bench: Bench) -> Study:
    return bench.untimed(bench.study("Latency", (bench.float,), (IDEAL, *SLOWER)))


def determinism(bench: Bench) -> Study:
    again = Variant("float-again", bench.model)
    return bench.untimed(bench.study("Determinism", (bench.float, again)))


STUDIES: Mapping[str, Callable[[Bench], Study]] = {
    "baselines": baselines,
    "ablation": ablation,
    "pairs": pairs,
    "schemes": schemes,
    "scales": scales,
    "latency": latency,
    "determinism": determinism,
}
