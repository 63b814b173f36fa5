"""``me2e-compress sensitivity`` and ``me2e-compress search``."""

import dataclasses
from pathlib import Path
from typing import Annotated

import onnx_ir as ir
import typer
from rich.markup import escape

from me2e_compress import graph, recipe
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.rules import rules_named
from me2e_compress.calibration.sample import draw
from me2e_compress.calibration.scheme import QuantScheme
from me2e_compress.cli.calibrate import prepare
from me2e_compress.cli.console import console, megabytes, print_json, progress, table
from me2e_compress.cli.models import model_path
from me2e_compress.errors import RecipeError
from me2e_compress.modules import map_of
from me2e_compress.runtime.race import race
from me2e_compress.runtime.session import Session
from me2e_compress.sensitivity import (
    Budget,
    Choice,
    Sensitivity,
    Trials,
    advise,
    analyse,
    write_recipe,
)
from me2e_compress.sensitivity import search as find
from me2e_compress.targets import target_named

Model = Annotated[Path, typer.Argument(help="the float ONNX file", parser=model_path)]
Recording = Annotated[Path, typer.Argument(help="the recorded FRAMES")]
Output = Annotated[Path, typer.Option("-o", "--output", help="the RECIPE.toml")]
Scheme = Annotated[str, typer.Option(help="modules that may be int8")]
Rules = Annotated[str, typer.Option(help="of the int8 plans: paper or tensorrt")]
Saved = Annotated[
    Path | None, typer.Option("--ranges", help="RANGES.json instead of calibrating")
]
Map = Annotated[
    str | None, typer.Option("--map", help="vad, uniad, tcp, or a TOML file")
]
Count = Annotated[int, typer.Option("-n", "--count", help="frames to judge on")]
Threads = Annotated[int, typer.Option(help="of onnxruntime; 0 takes all")]
Json = Annotated[bool, typer.Option("--json", help="for programs")]


@dataclasses.dataclass(frozen=True)
class Setting:
    """What both commands are told."""

    model: Path
    frames: Path
    scheme: str
    rules: str
    target: str
    ranges: Path | None
    module_map: str | None
    count: int
    threads: int

    def trials(self) -> tuple[Trials, tuple[str, ...]]:
        """Prepare the graph, calibrate once, and name the modules to try."""
        rules, target = rules_named(self.rules), target_named(self.target)
        recording = CalibrationSet(self.frames)
        loaded = graph.load(self.model)
        recording.check(loaded)
        modules = map_of(loaded, self.module_map)
        scheme = QuantScheme.named(self.scheme, modules)
        ready, tensors = prepare(self.model, self.module_map, recipe.load("exact"))
        if self.ranges is not None:
            ranges = Ranges.load(self.ranges)
            ranges.check(
                model=graph.digest(ready), tensors=tensors, method=ranges.method
            )
        else:
            with progress("calibrate") as advance:
                ranges = Calibrator(threads=self.threads).run(
                    ready, tensors, recording, lambda done, of: advance(done, of, "")
                )
        judged = draw(recording, self.count, 0)
        made = Trials(
            ready, modules, rules, target, ranges, judged, threads=self.threads
        )
        return made, scheme.modules

    def write(self, output: Path, choice: Choice) -> None:
        """Write the recipe, and say where it is."""
        before = tuple(each.name for each in recipe.load("exact"))
        overrides = write_recipe(output, choice, before, self.rules, self.target)
        listed = ", ".join(choice.modules) or "no module"
        more = f", {len(choice.floats)} of their nodes in float" if overrides else ""
        console.print(escape(f"{output}: int8 in {listed}{more}"), soft_wrap=True)


def sensitivity(
    model: Model,
    frames: Recording,
    output: Output,
    scheme: Scheme = "full",
    rules: Rules = "paper",
    target: Annotated[str, typer.Option(help="who runs the graph")] = "tensorrt",
    limit: Annotated[
        float,
        typer.Option(help="largest loss of the recipe: metres of the plan, see below"),
    ] = 0.1,
    node_trials: Annotated[
        int, typer.Option(help="most trials on the nodes of a module; 0: none")
    ] = 24,
    ranges: Saved = None,
    module_map: Map = None,
    count: Count = 4,
    threads: Threads = 0,
    as_json: Json = False,
) -> None:
    """Measure what int8 costs per module and node, and write a recipe within a limit.

    The loss is how far the plan moves, metres, mean over the frames; of a model whose
    plan is not known, the noise of its worst output relative to the signal.
    """
    setting = Setting(
        model, frames, scheme, rules, target, ranges, module_map, count, threads
    )
    trials, modules = setting.trials()
    with progress("modules") as advance:
        found = analyse(trials, modules, node_trials=node_trials, progress=advance)
    choice = advise(trials, found, limit)
    if as_json:
        print_json(found)
        setting.write(output, choice)
        return
    _show(found)
    setting.write(output, choice)
    if choice.modules:
        score = trials.score(choice)
        console.print(f"its loss: {score.loss:.4g} {score.unit}, limit {limit:g}")


def search(
    model: Model,
    frames: Recording,
    output: Output,
    max_mb: Annotated[float | None, typer.Option(help="most MB of weights")] = None,
    max_ms: Annotated[
        float | None, typer.Option(help="most milliseconds a frame, on this CPU")
    ] = None,
    scheme: Scheme = "full",
    rules: Rules = "paper",
    target: Annotated[
        str | None, typer.Option(help="tensorrt; onnxruntime for --max-ms")
    ] = None,
    ranges: Saved = None,
    module_map: Map = None,
    count: Count = 4,
    threads: Threads = 0,
    as_json: Json = False,
) -> None:
    """Find the modules whose int8 meets a budget and costs the plan least."""
    if (max_mb is None) == (max_ms is None):
        raise RecipeError("give a budget: --max-mb or --max-ms, one of the two")
    runs_on = target or ("tensorrt" if max_ms is None else "onnxruntime")
    if max_ms is not None and runs_on != "onnxruntime":
        raise RecipeError(
            f"--max-ms is measured on this CPU, where int8 for {runs_on} is slow:"
            " use --target onnxruntime"
        )
    setting = Setting(
        model, frames, scheme, rules, runs_on, ranges, module_map, count, threads
    )
    trials, modules = setting.trials()
    budget = (
        Budget(max_mb * 1e6, "bytes of weights", lambda g: graph.size(g).weight_bytes)
        if max_mb is not None
        else Budget((max_ms or 0) / 1e3, "s", _Stopwatch(trials, threads).seconds)
    )
    with progress("modules") as advance:
        tried = find(trials, modules, budget, progress=advance)
    if as_json:
        print_json([dataclasses.asdict(each) for each in tried])
    else:
        shown = table("Tried, best first", "int8", "loss", "predicted", budget.unit)
        for each in tried:
            loss = "-" if each.score is None else f"{each.score.loss:.4g}"
            cost = "-" if each.measured_cost is None else f"{each.measured_cost:.4g}"
            names = ", ".join(each.modules) or "none"
            shown.add_row(names, loss, f"{each.loss:.4g}", cost)
        console.print(shown)
    setting.write(output, Choice(tried[-1].modules))


class _Stopwatch:
    """Times graphs against the float model, in turn on one frame."""

    def __init__(self, trials: Trials, threads: int) -> None:
        self._trials = trials
        self._threads = threads

    def seconds(self, made: ir.Model) -> float:
        """Give the least wall time of a frame, of 5."""
        session = Session(made, threads=self._threads, release=True)
        first = next(iter(self._trials.reference.frames))
        return race({"int8": session}, [first], 5)["int8"].best_wall_s


def _show(found: Sensitivity) -> None:
    unit = found.together.unit
    shown = table(
        "Int8 module by module", "module", "nodes", f"loss {unit}", "worst dB"
    )
    for each in found.findings:
        worst = min(item.sqnr_db for item in each.score.fidelity.outputs)
        shown.add_row(
            each.module, str(each.nodes), f"{each.score.loss:.4g}", f"{worst:.1f}"
        )
    worst = min(item.sqnr_db for item in found.together.fidelity.outputs)
    shown.add_row("together", "", f"{found.together.loss:.4g}", f"{worst:.1f}")
    size = megabytes(found.together.weight_bytes)
    shown.caption = f"{found.trials} variants run; together {size} MB of weights"
    console.print(shown)
    for each in found.findings:
        for group, loss in each.blamed:
            first, *rest = group
            more = f" and {len(rest)} more" if rest else ""
            line = f"{each.module}: {first}{more}: {loss:.4g} {unit} alone"
            console.print(escape(line), soft_wrap=True)
