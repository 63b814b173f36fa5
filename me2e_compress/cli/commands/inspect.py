"""``me2e-compress inspect``."""

import dataclasses
from pathlib import Path
from typing import Annotated

import onnx_ir as ir
import typer

from me2e_compress import graph, recipe
from me2e_compress.cli.console import (
    console,
    file_bytes,
    megabytes,
    number,
    print_json,
    table,
)
from me2e_compress.cli.job import run_on
from me2e_compress.cli.models import model_path
from me2e_compress.graph import Port, provenance
from me2e_compress.modules import Item, ModuleMap, assign, itemise, map_of

_SHAPES = "import-normalize,fold-constants{through_compute=false}"


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
    model: Annotated[str, typer.Argument(help="the ONNX file, or highway")],
    module_map: Annotated[
        str | None, typer.Option("--map", help="a preset or a TOML file")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Show what a graph holds: interface, and nodes, parameters, MACs by module."""
    found = look(model_path(model), module_map)
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
    modules = map_of(model, module_map)
    placed = assign(model, modules)
    inputs, outputs = graph.interface(model)
    items = itemise(model, modules, placed.module_of)
    costs = {item.module: item.macs for item in weigh(model, modules)}
    return Inspection(
        path.name,
        file_bytes(path),
        model.opset_imports.get(""),
        tuple(sorted(domain for domain in model.opset_imports if domain)),
        modules.name,
        inputs,
        outputs,
        tuple(dataclasses.replace(i, macs=costs.get(i.module)) for i in items),
        {str(rule): count for rule, count in placed.rules().items()},
    )


def weigh(model: ir.Model, modules: ModuleMap) -> tuple[Item, ...]:
    """Weigh the modules once the shape arithmetic is done, which MACs need to know."""
    if provenance.missing(model):
        model = run_on(model, recipe.parse(_SHAPES), modules)
    graph.infer_shapes(model)
    return itemise(model, modules, provenance.module_of, graph.macs)


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
