"""Inspect a graph: interface; nodes, parameters, MACs and time by module."""

import dataclasses
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.driving.adapter.outputs import adapted
from me2e_compress.errors import GraphError
from me2e_compress.graph import provenance
from me2e_compress.graph.modules import Item, ModuleMap, assign, itemise
from me2e_compress.graph.opset import lowered
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.graph.summary import why_uncounted
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context
from me2e_compress.passes.fix_shapes import FixShapes, open_dimensions
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.workflows.checks import lacking_shapes, load_map, model_path
from me2e_compress.workflows.inspect_result import InspectResult
from me2e_compress.workflows.module_costs import (
    trace_of,
    with_activations,
    with_latency,
)
from me2e_compress.workflows.weights_record import named_weights

_SHAPES = "import-normalize,fold-constants{through_compute=false}"


def inspect(
    model: str | Path,
    module_map: str | Path | None = None,
    dims: Mapping[str, int] | None = None,
    trace: str | Path | None = None,
    adapter: str | Path | None = None,
) -> InspectResult:
    """Read a graph, and weigh its modules.

    `dims` are sizes that open dimensions of the inputs are given first. The time by
    module comes from a trace that ``profile`` wrote. The adapter's TOML says which
    outputs are fed back.

    Raises:
        GraphError: The model does not exist.
        PreconditionError: No input has such a dimension.
        ModuleMapError: The map does not exist.
        EvaluationError: The trace is of another model, or not by module.
    """
    path = model_path(model)
    taken = None if trace is None else trace_of(trace, path)
    loaded = graph.load(path)
    adapted(loaded, adapter, module_map)
    modules = load_map(module_map, loaded)
    return inspected(path, loaded, modules, dims, taken)


def inspected(
    path: Path,
    loaded: ir.Model,
    modules: ModuleMap,
    dims: Mapping[str, int] | None = None,
    taken: LatencyTrace | None = None,
) -> InspectResult:
    """Weigh the modules of a graph; the arguments are those of :func:`inspect`."""
    if dims:
        loaded = FixShapes(dims).run(loaded, Context(modules)).model
    # count what stands in the file, module by module
    placed = assign(loaded, modules)
    inputs, outputs = graph.interface(loaded)
    items = itemise(loaded, modules, placed.module_of)
    # MACs and activations need shapes, and folded shape arithmetic
    folded = _folded(loaded, modules)
    costs = {item.module: item for item in _costs(folded, modules)}
    items = tuple(_with_cost(item, costs.get(item.module)) for item in items)
    items = with_activations(items, folded)
    if taken is not None:
        items = with_latency(items, taken)
    # say what is unknown, and why
    fed_back, wrong = _fed_back(loaded)
    total = sum(item.macs or 0 for item in costs.values())
    unknown = sum(item.unknown_macs_nodes or 0 for item in costs.values())
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
        _uncounted(folded),
        tuple(open_dimensions(loaded)),
        lowered(loaded),
        "; ".join(filter(None, (lacking_shapes(loaded), wrong))),
        fed_back,
        weights=named_weights(loaded.metadata_props),
        latency_of="" if taken is None else taken.headline,
    )


def _fed_back(model: ir.Model) -> tuple[dict[str, str], str]:
    """Pair inputs with the outputs that are fed back, or say why that fails."""
    try:
        return recurrent_inputs(model), ""
    except GraphError as error:
        return {}, str(error)


def _with_cost(item: Item, cost: Item | None) -> Item:
    """Return a module's item as it stands in the file, with its MACs."""
    if cost is None:
        return item
    return dataclasses.replace(
        item, macs=cost.macs, unknown_macs_nodes=cost.unknown_macs_nodes
    )


def weigh(model: ir.Model, modules: ModuleMap) -> tuple[Item, ...]:
    """Weigh the modules after shape arithmetic is folded, which MACs depend on."""
    return _costs(_folded(model, modules), modules)


def _folded(model: ir.Model, modules: ModuleMap) -> ir.Model:
    """Return a graph imported, its shape arithmetic folded, its shapes inferred."""
    if provenance.missing(model):
        manager = PassManager(recipe.parse(_SHAPES), verify_frames=0)
        model = manager.run(model, Context(modules)).model
    graph.infer_shapes(model)
    return model


def _costs(model: ir.Model, modules: ModuleMap) -> tuple[Item, ...]:
    return itemise(model, modules, provenance.module_of, graph.macs_counter(model))


def _uncounted(model: ir.Model) -> dict[str, int]:
    count = graph.macs_counter(model)
    unknown = [node for node in model.graph.all_nodes() if count(node) is None]
    return dict(Counter(map(why_uncounted, unknown)).most_common())
