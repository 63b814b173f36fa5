"""``me2e-compress lint``."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from me2e_compress import graph
from me2e_compress.cli.console import console, print_json, table
from me2e_compress.errors import PreconditionError
from me2e_compress.targets.lint import Finding
from me2e_compress.targets.lint import lint as find


def lint(
    model: Annotated[Path, typer.Argument(help="the ONNX file")],
    target: Annotated[str, typer.Option(help="tensorrt or onnxruntime")] = "tensorrt",
    shown: Annotated[int, typer.Option(help="nodes shown of each rule")] = 3,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Check a graph for the program that will run it; 1 if it would be refused."""
    found = find(graph.load(model), target)
    if as_json:
        print_json(found)
    else:
        _show(found, shown)
        console.print(_verdict(found, model.name, target))
    errors = [each for each in found if each.severity == "error"]
    if errors:
        first = errors[0]
        raise PreconditionError(
            f"{model}: {target} refuses it, {len(errors)} errors; {first.rule}"
            f" {first.node!r}: {first.message}"
        )


def _show(found: Sequence[Finding], shown: int) -> None:
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


def _verdict(found: Sequence[Finding], name: str, target: str) -> str:
    counts = Counter(each.severity for each in found)
    return (
        f"{name} for {target}: {counts['error']} errors, {counts['warning']} warnings"
        " (our own rules and operator tables)"
    )
