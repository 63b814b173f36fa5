"""Facts about nodes and values: makers, readers, and the arrays of constants."""

import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir

# The two spellings of the domain of ONNX's own operators
STANDARD = ("", "ai.onnx")


# Operators that move nothing and equal a Reshape
VIEWS = frozenset({"Flatten", "Identity", "Reshape", "Squeeze", "Unsqueeze"})

# Operators that move elements and do nothing else to them
LAYOUT_OPERATORS = VIEWS | {"Transpose"}

# Element-wise operators of two operands, which broadcast
ELEMENTWISE = (
    "Add", "And", "Div", "Equal", "Greater", "GreaterOrEqual", "Less",
    "LessOrEqual", "Max", "Min", "Mul", "Or", "Pow", "Sub", "Xor",
)  # fmt: skip

_RANDOM = (
    "Bernoulli", "Multinomial", "RandomNormal", "RandomNormalLike", "RandomUniform",
    "RandomUniformLike",
)  # fmt: skip


def is_standard(node: ir.Node) -> bool:
    """Return whether a node is one of ONNX's own operators."""
    return node.domain in STANDARD


def is_plugin(node: ir.Node) -> bool:
    """Return whether a node is no operator of ONNX, but a plugin or function call."""
    # A plugin may stand in the default domain: so do those of
    # `OperatorExportTypes.ONNX_FALLTHROUGH` (`MultiScaleDeformableAttnTRT`) and of a
    # symbolic without a domain (`MSDAPlugin`)
    return not is_standard(node) or not _has_operator(node.op_type)


@functools.cache
def _has_operator(op_type: str) -> bool:
    return bool(onnx.defs.has(op_type, domain=""))


def opset_of(imports: ir.Model | ir.Graph | ir.Function) -> int:
    """Return the opset of ONNX's own operators that is imported; 0 if none is."""
    versions = imports.opset_imports
    return next((versions[domain] for domain in STANDARD if domain in versions), 0)


def bodies(model: ir.Model) -> Iterator[tuple[ir.Graph | ir.Function, int]]:
    """Yield the graph and the functions, with their opsets."""
    main = opset_of(model)
    yield model.graph, main
    for function in model.functions.values():
        yield function, opset_of(function) or main


def converted_opset(own: int, before: int, wanted: int) -> int:
    """Return a body's opset after the newest one of its model changed to ``wanted``."""
    return min(own, wanted) if wanted < before else max(own, wanted)


def nodes_of(model: ir.Model) -> Iterator[ir.Node]:
    """Walk the nodes of the graph, of its bodies and of its functions."""
    yield from nodes_in(model.graph)
    for function in model.functions.values():
        yield from nodes_in(function)


def nodes_in(graph: ir.Graph | ir.Function) -> Iterator[ir.Node]:
    """Walk the nodes of a graph; a node's bodies follow that node."""
    for node in graph:
        yield node
        yield from nodes_inside(node)


def nodes_inside(node: ir.Node) -> Iterator[ir.Node]:
    """Walk the nodes of a node's bodies, and of the bodies in them."""
    for body in bodies_of(node):
        yield from nodes_in(body)


def reads_of(node: ir.Node) -> Iterator[ir.Value]:
    """Yield the values of its own graph that a node, or a body of it, reads."""
    yield from filter(None, node.inputs)
    for inner in nodes_inside(node):
        reads = (value for value in inner.inputs if value is not None)
        yield from (value for value in reads if value.graph is node.graph)


# The operators of ONNX that have bodies: only these are searched, to save time.
_WITH_BODIES = frozenset({"If", "Loop", "Scan", "SequenceMap"})


def bodies_of(node: ir.Node) -> Sequence[ir.Graph]:
    """List the graphs that a node carries, not those inside them."""
    if node.op_type not in _WITH_BODIES and is_standard(node):
        return ()
    bodies: list[ir.Graph] = []
    for attribute in node.attributes.values():
        if attribute.type == ir.AttributeType.GRAPH:
            bodies.append(attribute.as_graph())
        elif attribute.type == ir.AttributeType.GRAPHS:
            bodies.extend(attribute.as_graphs())
    return bodies


def attribute_values(node: ir.Node) -> tuple[bytes, ...]:
    """Return a node's attributes, serialized: equal ones compare equal."""
    protos = (
        ir.serde.serialize_attribute(a) for _, a in sorted(node.attributes.items())
    )
    return tuple(proto.SerializeToString(deterministic=True) for proto in protos)


def makers_of(values: Iterable[ir.Value | None]) -> dict[ir.Node, None]:
    """Return all nodes that some values depend on, through bodies of nodes too."""
    makers: dict[ir.Node, None] = {}
    waiting = list(values)
    while waiting:
        node = producer_of(waiting.pop())
        if node is not None and node not in makers:
            makers[node] = None
            waiting.extend(reads_of(node))
    return makers


def input_at(node: ir.Node, index: int) -> ir.Value | None:
    """Return an input of a node; None if it is left out."""
    return node.inputs[index] if index < len(node.inputs) else None


def draws(node: ir.Node) -> bool:
    """Return whether a node draws random numbers, as a Dropout in training does."""
    training = input_at(node, 2) if node.op_type == "Dropout" else None
    known = array_of(training)
    trains = training is not None and (known is None or bool(known.any()))
    return is_standard(node) and (trains or node.op_type in _RANDOM)


def grid_of(node: ir.Node) -> ir.Value | None:
    """Return the grid of a GridSample or a plugin of it; None of other nodes."""
    samples = node.op_type.startswith(("GridSample", "grid_sampler"))
    return input_at(node, 1) if samples else None


def producer_of(value: ir.Value | None) -> ir.Node | None:
    """Return the node that computes a value; None for inputs and initializers."""
    return None if value is None else value.producer()


def has_subgraph(node: ir.Node) -> bool:
    """Return whether a node carries a graph of its own (If, Loop, Scan, ...)."""
    return bool(bodies_of(node))


def graphs_of(graph: ir.Graph) -> Iterator[ir.Graph]:
    """Walk a graph and all the graphs inside its nodes, outermost first."""
    yield graph
    for node in graph:
        for body in bodies_of(node):
            yield from graphs_of(body)


def array_of(value: ir.Value | None) -> npt.NDArray[np.generic] | None:
    """Return the array of an initializer or Constant; None if the value is computed."""
    if value is None or value.is_graph_input():
        return None
    if value.const_value is not None and value.is_initializer():
        return value.const_value.numpy()
    if value.producer() is None:
        return None
    tensor = ir.convenience.get_const_tensor(value)
    return None if tensor is None else tensor.numpy()


Array: TypeAlias = npt.NDArray[np.generic]
Numbers: TypeAlias = npt.NDArray[np.float64]

# The floating-point types that numpy itself computes with
FLOATS = frozenset({ir.DataType.DOUBLE, ir.DataType.FLOAT, ir.DataType.FLOAT16})

# All element types that numpy itself computes with
NATIVE = FLOATS | {
    ir.DataType.BOOL, ir.DataType.INT8, ir.DataType.INT16, ir.DataType.INT32,
    ir.DataType.INT64, ir.DataType.UINT8, ir.DataType.UINT16, ir.DataType.UINT32,
    ir.DataType.UINT64,
}  # fmt: skip


def maker(value: ir.Value | None, *op_types: str) -> ir.Node | None:
    """Return the node that makes a value, if it is one of these standard operators."""
    node = producer_of(value)
    fits = node is not None and is_standard(node) and node.op_type in op_types
    return node if fits else None


def unrenamed(value: ir.Value) -> ir.Value:
    """Follow a value back through Identity nodes."""
    while (node := maker(value, "Identity")) is not None and node.inputs[0]:
        value = node.inputs[0]
    return value


def sole_maker(value: ir.Value | None, *op_types: str) -> ir.Node | None:
    """Return :func:`maker` of a first output that only one node of its graph reads."""
    node = maker(value, *op_types)
    if node is None or value is None or sole_reader(value) is None:
        return None
    return node if value is node.outputs[0] else None


def sole_reader(value: ir.Value) -> ir.Node | None:
    """Return the one node that reads a value, once; None if it is an output too."""
    uses = value.uses()
    if len(uses) != 1 or value.is_graph_output():
        return None
    # A reader in the body of an If or Loop may run never, or often
    node, made = next(iter(uses)).node, value.producer()
    return node if made is None or made.graph is node.graph else None


def is_read(value: ir.Value) -> bool:
    """Return whether a node reads a value, or it is a graph output."""
    return bool(value.uses()) or value.is_graph_output()


def holds_numbers(value: ir.Value | None) -> bool:
    """Return whether a value is a constant of a floating-point type."""
    return value is not None and value.dtype in FLOATS and array_of(value) is not None


def numbers_of(value: ir.Value | None) -> Numbers | None:
    """Return a constant floating-point array, widened to float64."""
    array = array_of(value) if holds_numbers(value) else None
    return None if array is None else array.astype(np.float64)


def scalar_of(value: ir.Value | None) -> float | None:
    """Return a constant of one element; None if it is an array or computed."""
    array = array_of(value) if holds_numbers(value) else None
    return float(array.item()) if array is not None and array.size == 1 else None


def integers_of(value: ir.Value | None) -> list[int] | None:
    """Return the elements of a constant array of integers, in order."""
    array = array_of(value)
    if array is None or array.dtype.kind not in "iu":
        return None
    return [int(number) for number in array.reshape(-1)]


def integers_at(node: ir.Node, name: str, index: int) -> list[int] | None:
    """Return integers of an attribute, or of the input that replaced it later."""
    written = node.attributes.get_ints(name)
    return integers_of(input_at(node, index)) if written is None else list(written)


def permutation_of(node: ir.Node) -> list[int] | None:
    """Return the order of a Transpose; None if it has none and its rank is unknown."""
    written, data = node.attributes.get_ints("perm"), node.inputs[0]
    if written is not None:
        return list(written)
    rank = None if data is None or data.shape is None else len(data.shape)
    return None if rank is None else list(reversed(range(rank)))


def overflow(numbers: Numbers, stored: Array) -> bool:
    """Return whether numbers are too large for the type of a stored array."""
    return not np.all(np.abs(numbers) <= np.finfo(stored.dtype.name).max)


def constant_values(model: ir.Model) -> frozenset[ir.Value]:
    """Return the initializers and all values computed only from them."""
    weights = model.graph.initializers.values()
    constants = {value for value in weights if not value.is_graph_input()}
    # Bodies, calls of functions and operators of other domains count as not constant
    for node in model.graph:
        plain = is_standard(node) and not draws(node) and not has_subgraph(node)
        if plain and constants.issuperset(filter(None, node.inputs)):
            constants.update(node.outputs)
    return frozenset(constants)
