"""``me2e-compress search``."""

from collections.abc import Mapping
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show, tell
from me2e_compress.errors import RecipeError
from me2e_compress.extras import need_extra
from me2e_compress.runtime.providers import provider_named
from me2e_compress.targets import DEFAULT_TARGET
from me2e_compress.workflows import search as workflow
from me2e_compress.workflows.budgets import check_budgets
from me2e_compress.workflows.checks import sizes

MAX_JOULES = "most joules a frame: measured by a counter, else modelled"
ROAD = "with --on-road"
ROUTES = f"{given.ROUTES}; {ROAD}"
MaxMb = Annotated[float | None, typer.Option(help="most MB of weights")]
MaxMs = Annotated[
    float | None, typer.Option(help="most milliseconds a frame, on this CPU")
]
MaxJoules = Annotated[float | None, typer.Option(help=MAX_JOULES)]
OnRoad = Annotated[
    bool, typer.Option("--on-road", help="judge by driving; float, int8 or no module")
]
Modules = Annotated[
    str | None, typer.Option(help=f"groups that are int8 or float: A+B,C; {ROAD}")
]
Ablate = Annotated[str | None, typer.Option(help=f"modules that may go: A,B; {ROAD}")]
MostAblated = Annotated[
    int | None, typer.Option(min=0, help=f"most modules gone at once: 1; {ROAD}")
]
Routes = Annotated[str | None, typer.Option(help=ROUTES)]
Latency = Annotated[
    str | None, typer.Option(help=f"none, fps:F, or trace: its own; {ROAD}")
]
BaselineMedian = Annotated[
    float | None, typer.Option(help=f"seconds of float on the device; {ROAD}")
]
Seed = Annotated[
    int | None, typer.Option(min=0, help=f"seed of everything random: 0; {ROAD}")
]
Workers = Annotated[
    int | None, typer.Option(min=1, help=f"processes at a time; {ROAD}")
]


def search(
    model: given.FloatModel,
    frames: given.Recording,
    output: given.RecipeOutput,
    max_mb: MaxMb = None,
    max_ms: MaxMs = None,
    max_joules: MaxJoules = None,
    on_road: OnRoad = False,
    modules: Modules = None,
    ablate: Ablate = None,
    most_ablated: MostAblated = None,
    routes: Routes = None,
    latency: Latency = None,
    baseline_median_s: BaselineMedian = None,
    seed: Seed = None,
    adapter: given.Adapter = None,
    workers: Workers = None,
    scheme: given.TrialScheme = "full",
    rules: given.TrialRules = "safe",
    target: given.TrialTarget = DEFAULT_TARGET,
    ranges: given.SavedRanges = None,
    module_map: given.ModuleMap = None,
    set_dim: given.SetDim = None,
    count: given.JudgedFrames = 4,
    threads: given.Threads = 0,
    provider: given.Provider = "cpu",
    plugins: given.Plugins = None,
    force: given.Force = False,
) -> None:
    """Find the scheme within the budgets that costs the plan, or the road, least."""
    check_budgets(max_mb, max_ms, max_joules)
    dims, runs_on = sizes(set_dim or ()), provider_named(provider, plugins or ())
    # without --on-road nothing drives: the loss is judged by the plan
    if not on_road:
        _refuse_the_road({
            "modules": modules, "ablate": ablate, "most-ablated": most_ablated,
            "routes": routes, "latency": latency,
            "baseline-median-s": baseline_median_s, "seed": seed, "workers": workers,
        })  # fmt: skip
        options = workflow.SearchOptions(
            max_mb=max_mb, max_ms=max_ms, max_joules=max_joules, scheme=scheme,
            rules=rules, target=target, ranges=ranges, module_map=module_map,
            count=count, threads=threads, dims=dims, force=force, provider=runs_on,
            adapter=adapter,
        )  # fmt: skip
        with listening() as listener:
            found = workflow.search(model, frames, output, options, listener)
        show(found)
        return
    need_extra("highway", "search --on-road")
    if ranges is not None or scheme != "full":
        raise RecipeError("--ranges and --scheme do not go with --on-road: --modules")
    # takes highway-env and matplotlib two seconds to import
    from me2e_compress.evaluators.highway.engine import LocalEngine
    from me2e_compress.study.on_road import Limits, RoadSearchOptions, search_on_road

    road = RoadSearchOptions(
        drives=output.with_name(f"{output.stem}.drives"),
        limits=Limits(max_mb, max_ms, max_joules), modules=modules, ablate=ablate,
        most_ablated=1 if most_ablated is None else most_ablated,
        routes=routes or "all", latency=latency or "trace",
        baseline_median_s=baseline_median_s, rules=rules, target=target,
        module_map=module_map, adapter=adapter, dims=dims,
        threads=threads or 1, seed=seed or 0, provider=runs_on, force=force,
    )  # fmt: skip
    engine = LocalEngine(workers or 1)
    with listening() as listener:
        driven = search_on_road(model, frames, output, road, engine, listener, tell)
    show(driven)


def _refuse_the_road(options: Mapping[str, object]) -> None:
    for name, value in options.items():
        if value is not None:
            raise RecipeError(f"--{name} says how to drive: add --on-road")
