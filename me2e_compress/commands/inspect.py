"""Inspect a graph: interface; nodes, parameters and MACs by module."""

import dataclasses
from collections import Counter
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import (
    format_gmacs,
    format_mb,
    format_number,
    plural,
    table,
)
from me2e_compress.base.errors import GraphError
from me2e_compress.commands.checks import load_graph, load_map, model_path, shortcomings
from me2e_compress.commands.options import InspectOptions
from me2e_compress.commands.result import Result, View
from me2e_compress.driving.adapter.outputs import write_port_metadata
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.assign import Item, assign, itemise
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.opset import read_as
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.graph.summary import Port, macs_counter
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context
from me2e_compress.passes.fix_shapes import FixShapes, open_dimensions
from me2e_compress.passes.freeze_inputs import advice

# Metadata key of what an exporter says of the checkpoint that it took
WEIGHTS = "me2e.weights"
_SHOWN = 8  # number of reasons for unknown MACs that are named


@dataclasses.dataclass(frozen=True, repr=False)
class InspectResult(Result):
    """What a file holds.

    Attributes:
        file_bytes: size with the external weights.
        opset: opset of the default domain; `domains` names the others.
        map: the module map that was used.
        rules: nodes placed, by rule of the map.
        macs: multiply-accumulates, those known; None if none is.
        uncounted: nodes that ``macs`` leaves out, by operator.
        open_dimensions: of the inputs; MACs depend on them.
        lowered: what was changed for onnxruntime; empty if nothing.
        hint: what the graph lacks; empty if nothing.
        recurrent: outputs that are fed back, by input.
        weights: what its metadata says of its checkpoint; or empty.
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
    macs: int | None
    unknown_macs_nodes: int
    uncounted: dict[str, int]
    open_dimensions: tuple[str, ...]
    lowered: str = ""
    hint: str = ""
    recurrent: dict[str, str] = dataclasses.field(default_factory=dict)
    weights: str = ""

    def view(self) -> View:
        """Return the interface, the modules, what is lacking and the checkpoint."""
        more = f" and {', '.join(self.domains)}" if self.domains else ""
        read = f" ({self.lowered})" if self.lowered else ""
        size = f"{format_mb(self.file_bytes)} MB"
        headline = f"{self.file}: {size}, opset {self.opset}{more}{read}"
        ports = [
            (kind, port.name, port.type, port.shape)
            for kind, side in (("in", self.inputs), ("out", self.outputs))
            for port in side
        ]
        rows = [
            (
                item.module,
                format_number(item.nodes),
                format_number(item.parameters),
                format_mb(item.weight_bytes),
                format_gmacs(item.macs, item.unknown_macs_nodes, ".3f"),
            )
            for item in self.modules
        ]
        # All MACs, or why some are unknown
        total = format_gmacs(self.macs, 0, ".3f")
        if self.unknown_macs_nodes:
            at_least = "" if self.macs is None else f"at least {total}, "
            types = [f"{count} {op_type}" for op_type, count in self.uncounted.items()]
            why = ", ".join(types[:_SHOWN]) + (", ..." if len(types) > _SHOWN else "")
            if self.open_dimensions:
                why += f"; --set-dim NAME=SIZE for {', '.join(self.open_dimensions)}"
            nodes = plural(self.unknown_macs_nodes, "node")
            total = f"{at_least}{nodes} not counted: {why}"
        # Notes below the tables: placement and recurrence
        rules = ", ".join(f"{count} by {rule}" for rule, count in self.rules.items())
        note = f"nodes placed: {rules}\nGMACs in all: {total}"
        pairs = [f"{to} as {name}" for name, to in self.recurrent.items()]
        back = f"fed back: {', '.join(pairs)}" if pairs else ""
        weights = self.weights and f"weights: {self.weights}"
        columns = ("module", "nodes", "parameters", "MB", "GMACs")
        return View(
            headline,
            (
                table("Interface", ("", "name", "type", "shape"), ports, back, words=4),
                table(f"Modules (map {self.map})", columns, rows, note),
            ),
            filter(None, (self.hint, headline, weights)),
        )


_SHAPES = "import-normalize,fold-constants{through_compute=false}"


def inspect(model: str | Path, options: InspectOptions | None = None) -> InspectResult:
    """Read a graph, and weigh its modules.

    Raises:
        GraphError: The model does not exist.
        PreconditionError: No input has such a dimension.
        ModuleMapError: The map does not exist.
    """
    # Read the graph as its adapter, map and dimensions have it
    options, path = options or InspectOptions(), model_path(model)
    loaded = load_graph(path)
    write_port_metadata(loaded, options.adapter, options.module_map)
    modules = load_map(options.module_map, loaded)
    if options.dims:
        loaded = FixShapes(options.dims).run(loaded, Context(modules)).model
    # count what stands in the file, module by module
    placed = assign(loaded, modules)
    inputs, outputs = graph.interface(loaded)
    items = itemise(loaded, modules, placed.module_of)
    # MACs need shapes, and folded shape arithmetic
    folded = _fold_shapes(loaded, modules)
    weighed = itemise(folded, modules, provenance.module_of, macs_counter(folded))
    costs = {item.module: item for item in weighed}
    items = tuple(
        dataclasses.replace(
            item, macs=cost.macs, unknown_macs_nodes=cost.unknown_macs_nodes
        )
        for item in items
        for cost in [costs.get(item.module, item)]
    )
    # say what is unknown, and why
    count, fed_back, wrong = macs_counter(folded), dict[str, str](), ""
    nodes = folded.graph.all_nodes()
    uncounted = Counter(node.op_type for node in nodes if count(node) is None)
    try:
        fed_back = recurrent_inputs(loaded)
    except GraphError as error:
        wrong = str(error)
    total = sum(item.macs or 0 for item in costs.values())
    unknown = sum(item.unknown_macs_nodes or 0 for item in costs.values())
    hints = wrong, shortcomings(loaded), "" if wrong else advice(loaded)
    return InspectResult(
        path.name,
        graph.file_bytes(path),
        loaded.opset_imports.get(""),
        tuple(sorted(domain for domain in loaded.opset_imports if domain)),
        modules.name,
        inputs,
        outputs,
        items,
        {str(rule): count for rule, count in placed.rules().items()},
        total if total or not unknown else None,
        unknown,
        dict(uncounted.most_common()),
        tuple(open_dimensions(loaded)),
        read_as(loaded),
        "; ".join(filter(None, hints)),
        fed_back,
        weights=loaded.metadata_props.get(WEIGHTS, ""),
    )


def weigh(model: ir.Model, modules: ModuleMap) -> tuple[Item, ...]:
    """Return nodes, bytes and MACs by module, after shape arithmetic is folded."""
    folded = _fold_shapes(model, modules)
    return itemise(folded, modules, provenance.module_of, macs_counter(folded))


def _fold_shapes(model: ir.Model, modules: ModuleMap) -> ir.Model:
    """Return a graph imported, its shape arithmetic folded, its shapes inferred."""
    if provenance.missing(model):
        manager = PassManager(recipe.parse(_SHAPES), verify_frames=0)
        model = manager.run(model, Context(modules)).model
    graph.infer_shapes(model)
    return model
