"""``me2e-compress plan``."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import onnx_ir as ir
import typer
from rich.markup import escape
from rich.table import Table

from me2e_compress import graph, recipe
from me2e_compress.cli.console import console, print_json, table
from me2e_compress.cli.job import run_on
from me2e_compress.cli.models import model_path
from me2e_compress.cli.output import check_output
from me2e_compress.errors import PreconditionError, RecipeError
from me2e_compress.graph import WEIGHTED
from me2e_compress.modules import map_of
from me2e_compress.passes import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.plan import (
    INT8,
    QuantPlan,
    differences,
    load_plan,
    plan_of,
    save_plan,
)
from me2e_compress.quantization.plan.decision import record
from me2e_compress.targets.quantized import describe_quantized


def plan(
    model: Annotated[
        Path,
        typer.Argument(help="an ONNX file, float or with a plan", parser=model_path),
    ],
    scheme: Annotated[
        str | None, typer.Option(help="feature-ext, prediction; default full")
    ] = None,
    rules: Annotated[
        str | None, typer.Option(help="paper or tensorrt; default paper")
    ] = None,
    overrides: Annotated[
        Path | None, typer.Option(help="TOML file of exceptions")
    ] = None,
    module_map: Annotated[
        str | None, typer.Option("--map", help="vad, uniad, tcp, or a TOML file")
    ] = None,
    against: Annotated[
        Path | None, typer.Option(help="a plan or model: compare; float: no overrides")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="save it as JSON")
    ] = None,
    every: Annotated[
        bool, typer.Option("--all", help="every node, not only what could be int8")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Show which nodes become int8, which stay float, by which rule, and why."""
    check_output([output], (model, overrides, module_map, against))
    files = (model,) if against is None else (model, against)
    read = [read_plan(path) for path in files]
    given = {"scheme": scheme, "rules": rules, "overrides": overrides}
    _check_options([name for name, value in given.items() if value], files, read)
    plain = QuantizeInt8(scheme=scheme or "full", rules=rules or "paper")
    found = _made(read[0], dataclasses.replace(plain, overrides=overrides), module_map)
    if output is not None:
        save_plan(found, output)
    if against is not None:
        _compare(_made(read[1], plain, module_map), found, as_json)
    elif as_json:
        print_json(record(found))
    else:
        _show(found, every=every)


def read_plan(path: Path) -> QuantPlan | ir.Model:
    """Give the plan that a file is or carries, else the graph to make one of."""
    if path.suffix == ".json":
        return load_plan(path)
    model = graph.load(path)
    return plan_of(model) or model


def _check_options(
    given: Sequence[str],
    files: Sequence[Path],
    read: Sequence[QuantPlan | ir.Model],
) -> None:
    """Refuse options of a plan that would change none, for all are made.

    Raises:
        RecipeError: names the first option and the file.
    """
    only = read[:1] if "overrides" in given else read
    if given and all(isinstance(each, QuantPlan) for each in only):
        option = "overrides" if "overrides" in given else given[0]
        raise RecipeError(
            f"--{option} is for a plan that is yet to be made, and {files[0]} has its"
            " own: give the float model"
        )


def _made(
    read: QuantPlan | ir.Model, options: QuantizeInt8, module_map: str | None
) -> QuantPlan:
    return read if isinstance(read, QuantPlan) else make(read, options, module_map)


def make(model: ir.Model, options: QuantizeInt8, module_map: str | None) -> QuantPlan:
    """Plan a float graph as ``compress --scheme`` does, the exact passes done."""
    if quantized := describe_quantized(model):
        raise PreconditionError(
            f"the graph is quantized already and carries no plan: {quantized}"
        )
    modules = map_of(model, module_map)
    ready = run_on(model, recipe.load("exact"), modules)
    graph.infer_shapes(ready)
    return options.plan(ready, Context(modules))


def _show(found: QuantPlan, *, every: bool) -> None:
    shown = table("Decisions", "module", "node", "op", "", "rule", "why", left=6)
    for each in found.decisions:
        if every or each.op in WEIGHTED or each.dtype == INT8:
            close = (
                f" [bold]({escape(each.borderline)})[/bold]" if each.borderline else ""
            )
            shown.add_row(
                each.module,
                escape(each.node),
                each.op,
                each.dtype,
                each.rule,
                escape(each.reason) + close,
            )
    console.print(shown)
    if every and found.groups:
        console.print(_groups(found))
    counts = ", ".join(f"{rule} {count}" for rule, count in found.counts().items())
    kept = len(found.kept_float)
    console.print(
        f"scheme {found.scheme.name}, rules {found.rules}: {len(found.chosen)} of"
        f" {len(found.decisions)} nodes int8; {counts}"
        + (f"; {kept} of them stay float on their target" if kept else "")
    )


def _groups(found: QuantPlan) -> Table:
    shown = table("Decided together", "kind", "name", "tensors", "read by", left=4)
    for group in found.groups:
        tensors, nodes = ", ".join(group.tensors), ", ".join(group.nodes)
        shown.add_row(group.kind, escape(group.name), escape(tensors), escape(nodes))
    return shown


def _compare(old: QuantPlan, new: QuantPlan, as_json: bool) -> None:
    found = tuple(differences(old, new))
    if as_json:
        print_json(found)
        return
    for each in found:
        console.print(escape(str(each)), soft_wrap=True)
    console.print(f"{len(found)} differences")
