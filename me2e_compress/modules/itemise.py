"""What each module weighs."""

import dataclasses
from collections.abc import Callable

import onnx_ir as ir

from me2e_compress.modules.module_map import ModuleMap
from me2e_compress.modules.parameters import parameter_path

_NOT_WEIGHTS = (
    ir.DataType.INT64,
    ir.DataType.INT32,
    ir.DataType.BOOL,
    ir.DataType.STRING,
)


@dataclasses.dataclass(frozen=True)
class Item:
    """What one module weighs.

    Attributes:
        module: its name.
        nodes: its nodes, those in subgraphs included.
        parameters: elements of its initializers that hold weights: of any type but
            int32, int64, bool and string, which hold shapes, indices and masks.
        weight_bytes: bytes of all its initializers.
        macs: multiply-accumulates; None where one of its nodes' is not known, or
            nobody counts.
    """

    module: str
    nodes: int
    parameters: int
    weight_bytes: int
    macs: int | None


def itemise(
    model: ir.Model,
    modules: ModuleMap,
    module_of: Callable[[ir.Node], str],
    macs: Callable[[ir.Node], int | None] | None = None,
) -> tuple[Item, ...]:
    """Weigh each module, in the order of the map; modules without nodes are zeros.

    An initializer counts once: for the module that its name says, else for the first
    node that reads it. One that nothing reads and nothing names counts nowhere.

    Args:
        model: the graph.
        modules: its map.
        module_of: the module of a node: an assignment's, or what imported nodes say.
        macs: counts a node's multiply-accumulates, None where it cannot.
    """
    nodes = dict.fromkeys(modules.names(), 0)
    counts: dict[str, int | None] = dict.fromkeys(modules.names(), 0 if macs else None)
    for node in model.graph.all_nodes():
        module = module_of(node)
        nodes[module] = nodes.get(module, 0) + 1
        so_far = counts.setdefault(module, 0 if macs else None)
        count = None if macs is None else macs(node)
        counts[module] = None if so_far is None or count is None else so_far + count
    elements, size = dict.fromkeys(nodes, 0), dict.fromkeys(nodes, 0)
    for owner, tensor in _owned(model, modules, module_of):
        size[owner] = size.get(owner, 0) + tensor.nbytes
        if tensor.dtype not in _NOT_WEIGHTS:
            elements[owner] = elements.get(owner, 0) + tensor.size
    return tuple(
        Item(module, nodes[module], elements[module], size[module], counts[module])
        for module in nodes
    )


def owner_of(
    value: ir.Value, modules: ModuleMap, module_of: Callable[[ir.Node], str]
) -> str | None:
    """Name the module an initializer counts for; None if nothing tells."""
    named = modules.match(parameter_path(value.name))
    if named is not None:
        return named
    readers = value.consumers()
    return module_of(readers[0]) if readers else None


def _owned(
    model: ir.Model, modules: ModuleMap, module_of: Callable[[ir.Node], str]
) -> list[tuple[str, ir.TensorProtocol]]:
    return [
        (owner, value.const_value)
        for graph in (model.graph, *model.graph.subgraphs())
        for value in graph.initializers.values()
        if value.const_value is not None
        and (owner := owner_of(value, modules, module_of)) is not None
    ]
