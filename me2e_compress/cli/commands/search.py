"""``me2e-compress search``."""

from collections.abc import Sequence
from typing import Annotated

import onnx_ir as ir
import typer
from rich.markup import escape

from me2e_compress import graph
from me2e_compress.cli.console import console, print_json, progress, table
from me2e_compress.cli.limits import check_number
from me2e_compress.cli.trials import (
    Count,
    Json,
    Map,
    Model,
    Output,
    Recording,
    Rules,
    Saved,
    Scheme,
    Setting,
    Threads,
)
from me2e_compress.errors import RecipeError
from me2e_compress.runtime.interleaved import race
from me2e_compress.runtime.session import Session
from me2e_compress.sensitivity import Budget, Candidate, Int8Choice, Trials
from me2e_compress.sensitivity import search as find


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
    check_number("--max-mb", max_mb)
    check_number("--max-ms", max_ms)
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
    setting.check_output(output)
    trials, modules = setting.trials()
    budget = (
        Budget(max_mb * 1e6, "bytes of weights", lambda g: graph.size(g).weight_bytes)
        if max_mb is not None
        else Budget((max_ms or 0) / 1e3, "s", _Stopwatch(trials, threads).seconds)
    )
    with progress("modules") as advance:
        tried = find(trials, modules, budget, progress=advance)
    written = setting.write(output, Int8Choice(tried[-1].modules))
    if as_json:
        print_json(tried)
    else:
        _show(tried, budget.unit)
        console.print(escape(written), soft_wrap=True)


def _show(tried: Sequence[Candidate], unit: str) -> None:
    shown = table("Tried, best first", "int8", "loss", "predicted", unit)
    for each in tried:
        loss = "-" if each.score is None else f"{each.score.loss:.4g}"
        cost = "-" if each.measured_cost is None else f"{each.measured_cost:.4g}"
        names = ", ".join(each.modules) or "none"
        shown.add_row(names, loss, f"{each.loss:.4g}", cost)
    console.print(shown)


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
