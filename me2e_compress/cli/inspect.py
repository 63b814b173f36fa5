"""``me2e-compress inspect``."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from me2e_compress import graph
from me2e_compress.cli.compress import modules_of
from me2e_compress.cli.console import (
    console,
    file_bytes,
    megabytes,
    number,
    print_json,
    table,
)
from me2e_compress.graph import Port
from me2e_compress.modules import Assignment, Item, assign, itemise


@dataclasses.dataclass(frozen=True)
class Inspection:
    """What a file holds.

    Attributes:
        file: its name.
        file_bytes: with the weights beside it.
        opset: of the default domain.
        domains: further operator domains.
        map: the module map that was used.
        inputs: what it takes.
        outputs: what it gives.
        modules: module by module.
        rules: how many nodes each rule of the map placed.
    """

    file: str
    file_bytes: int
    opset: int | None
    domains: tuple[str, ...]
    map: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    modules: tuple[Item, ...]
    rules: dict[str, int]


def inspect(
    model: Annotated[Path, typer.Argument(help="the ONNX file")],
    module_map: Annotated[
        str | None, typer.Option("--map", help="vad, uniad, tcp, or a TOML file")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Show what a graph holds: interface, and nodes, parameters, MACs by module."""
    found = look(model, module_map)
    if as_json:
        print_json(found)
        return
    console.print(
        f"{found.file}: {megabytes(found.file_bytes)} MB, opset {found.opset}"
        + (f" and {', '.join(found.domains)}" if found.domains else "")
    )
    ports = table("Interface", "", "name", "type", "shape", left=4)
    for kind, side in (("in", found.inputs), ("out", found.outputs)):
        for port in side:
            ports.add_row(kind, port.name, port.type, port.shape)
    console.print(ports)
    console.print(_modules(found))


def look(path: Path, module_map: str | None) -> Inspection:
    """Read a file and weigh its modules."""
    model = graph.load(path)
    graph.infer_shapes(model)
    modules = modules_of(model, module_map)
    placed: Assignment = assign(model, modules)
    inputs, outputs = graph.interface(model)
    return Inspection(
        path.name,
        file_bytes(path),
        model.opset_imports.get(""),
        tuple(sorted(domain for domain in model.opset_imports if domain)),
        modules.name,
        inputs,
        outputs,
        itemise(model, modules, placed.module_of, graph.macs),
        {str(rule): count for rule, count in placed.rules().items()},
    )


def _modules(found: Inspection) -> object:
    shown = table(
        f"Modules (map {found.map})", "module", "nodes", "parameters", "MB", "GMACs"
    )
    for item in found.modules:
        giga = None if item.macs is None else item.macs / 1e9
        shown.add_row(
            item.module,
            number(item.nodes),
            number(item.parameters),
            megabytes(item.weight_bytes),
            number(giga, ".3f"),
        )
    rules = ", ".join(f"{count} by {rule}" for rule, count in found.rules.items())
    shown.caption = f"nodes placed: {rules}"
    shown.caption_justify = "left"
    return shown
