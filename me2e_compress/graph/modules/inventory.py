"""Count a graph's weights and costs by module."""

import dataclasses
from collections.abc import Callable

import onnx_ir as ir

from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.modules.paths import parameter_path
from me2e_compress.graph.summary import total_macs

_NOT_WEIGHTS = (
    *(ir.DataType.INT64, ir.DataType.INT32, ir.DataType.BOOL),
    ir.DataType.STRING,
)


@dataclasses.dataclass(frozen=True)
class Item:
    """The nodes, weights and cost of one module; None is what nobody counts.

    Attributes:
        nodes: those in subgraphs included.
        parameters: elements of weights: of its initializers of any type but
            int32, int64, bool and string, which hold shapes, indices and masks.
        weight_bytes: of all initializers.
        macs: multiply-accumulates, those known: a lower bound if
            others are unknown, and then None instead of 0.
        unknown_macs_nodes: number of its nodes that are not in ``macs``.
        activation_bytes: that its nodes write in a frame; bounded like ``macs``.
        unknown_activation_nodes: number of its nodes that are not in these.
        latency_share: share of a frame's time; 0 to 1, None if nobody measured.
    """

    module: str
    nodes: int
    parameters: int
    weight_bytes: int
    macs: int | None
    unknown_macs_nodes: int | None
    activation_bytes: int | None = None
    unknown_activation_nodes: int | None = None
    latency_share: float | None = None


def itemise(
    model: ir.Model,
    modules: ModuleMap,
    module_of: Callable[[ir.Node], str],
    macs: Callable[[ir.Node], int | None] | None = None,
) -> tuple[Item, ...]:
    """Count each module, in the order of the map; modules without nodes are zeros.

    An initializer counts once: for the module that its name says, else for the first
    node that reads it. One that nothing reads and no name places counts nowhere.
    """
    nodes: dict[str, list[ir.Node]] = {name: [] for name in modules.names()}
    for node in model.graph.all_nodes():
        nodes.setdefault(module_of(node), []).append(node)
    # weights by the module that owns them
    elements, size = dict.fromkeys(nodes, 0), dict.fromkeys(nodes, 0)
    for graph in (model.graph, *model.graph.subgraphs()):
        for value in graph.initializers.values():
            tensor, readers = value.const_value, value.consumers()
            owner = modules.match(parameter_path(value.name))
            if owner is None and readers:
                owner = module_of(readers[0])
            if owner is None or tensor is None:
                continue
            size[owner] = size.get(owner, 0) + tensor.nbytes
            if tensor.dtype not in _NOT_WEIGHTS:
                elements[owner] = elements.get(owner, 0) + tensor.size
    return tuple(
        Item(
            *(module, len(own), elements[module], size[module]),
            *((None, None) if macs is None else total_macs(map(macs, own))),
        )
        for module, own in nodes.items()
    )
