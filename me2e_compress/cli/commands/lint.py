"""``me2e-compress lint``."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from me2e_compress import graph
from me2e_compress.cli.console import console, print_json, table
from me2e_compress.cli.models import model_path
from me2e_compress.errors import PreconditionError, RecipeError
from me2e_compress.targets.lint import LintFinding
from me2e_compress.targets.lint import lint as find
from me2e_compress.targets.tensorrt.rtx import BuildResult, check


def lint(
    model: Annotated[Path, typer.Argument(help="the ONNX file", parser=model_path)],
    target: Annotated[str, typer.Option(help="tensorrt or onnxruntime")] = "tensorrt",
    trt_check: Annotated[
        bool,
        typer.Option("--trt-check", help="also parse and build it by TensorRT-RTX"),
    ] = False,
    sm: Annotated[int, typer.Option(help="GPU generation that is built for")] = 86,
    shown: Annotated[int, typer.Option(min=0, help="nodes shown of each rule")] = 3,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Check a graph for the program that will run it; 1 if it would be refused."""
    if trt_check and target != "tensorrt":
        raise RecipeError(f"--trt-check is for tensorrt, not for {target}")
    loaded = graph.load(model)
    found = find(loaded, target)
    verdict = check(loaded, sm) if trt_check else None
    if as_json:
        print_json({"findings": found, "tensorrt_rtx": verdict})
    else:
        _show(found, shown)
        console.print(_counted(found, model.name, target))
        if verdict is not None:
            console.print(_said(verdict, sm))
    errors = [each for each in found if each.severity == "error"]
    if errors:
        first = errors[0]
        raise PreconditionError(
            f"{model}: {target} refuses it, {len(errors)} errors; {first.rule}"
            f" {first.node!r}: {first.message}"
        )
    if verdict is not None and not verdict.passed:
        raise PreconditionError(f"{model}: {_why(verdict)}")


def _said(verdict: BuildResult, sm: int) -> str:
    """Say what TensorRT-RTX made of a graph."""
    int8 = Counter(each.kind for each in verdict.kernels if each.is_int8)
    every = Counter(each.kind for each in verdict.kernels)
    kernels = ", ".join(f"{int8[kind]} of {every[kind]} {kind}s" for kind in every)
    lines = [
        f"TensorRT-RTX {verdict.version}, on this CPU:"
        f" {'parsed' if verdict.parsed else 'not parsed'}"
        + ("" if verdict.built is None else f", {_built(verdict)} for SM{sm}")
    ]
    if kernels:
        lines.append(f"kernels with int8 operands: {kernels}")
    if verdict.cut:
        lines.append(f"cut at {len(verdict.cut)} plugins: {', '.join(verdict.cut[:5])}")
    return escape("\n".join(lines))


def _built(verdict: BuildResult) -> str:
    return "built" if verdict.built else "not built"


def _why(verdict: BuildResult) -> str:
    if verdict.missing:
        return (
            f"{len(verdict.missing)} convolutions that the plan makes int8 have no int8"
            f" kernel, {verdict.missing[0]} first"
        )
    first = verdict.errors[0] if verdict.errors else "it does not say why"
    return f"TensorRT-RTX refuses it: {first}"


def _show(found: Sequence[LintFinding], shown: int) -> None:
    if not found:
        return
    listed = table("Findings", "", "rule", "node", "what", left=4)
    seen: Counter[tuple[str, str]] = Counter()
    for each in found:
        key = (each.severity, each.rule)
        seen[key] += 1
        if seen[key] <= shown:
            listed.add_row(
                each.severity, each.rule, escape(each.node), escape(each.message)
            )
    console.print(listed)
    for (severity, rule), count in seen.items():
        if count > shown:
            console.print(f"{severity} {rule}: {count - shown} more")


def _counted(found: Sequence[LintFinding], name: str, target: str) -> str:
    counts = Counter(each.severity for each in found)
    return (
        f"{name} for {target}: {counts['error']} errors, {counts['warning']} warnings"
        " (our own rules and operator tables)"
    )
