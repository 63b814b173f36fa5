"""Seeded faults: each makes one node of a graph compute something else.

What exporters, simplifiers and plugins got wrong in public reports: a changed or lost
weight, operands or axes exchanged, another epsilon, a window or an index off by one, a
detour through float16, a lost activation, cameras in another order.
"""

import dataclasses
import random
from collections.abc import Callable, Mapping

import numpy as np
import onnx_ir as ir

from benchmarks import wrong_constants
from me2e_compress.graph import rewrite
from me2e_compress.graph.nodes import (
    array_of,
    constant_values,
    input_at,
    is_standard,
    permutation_of,
)
from me2e_compress.graph.shapes import static_shape

Kind = Callable[[ir.Node, random.Random], bool]
"""Makes a node wrong; returns whether it could."""

FLOAT = ir.DataType.FLOAT
CAMERAS = 6


@dataclasses.dataclass(frozen=True)
class Fault:
    """What was made wrong.

    Attributes:
        kind: one of :data:`KINDS`.
        nodes: names of the nodes of which one must be named: the wrong one, or those
            that were inserted.
        module: of the wrong node.
    """

    kind: str
    nodes: tuple[str, ...]
    module: str = ""


def seed_fault(model: ir.Model, seed: int) -> Fault:
    """Draw a kind, and a node that it fits; change the graph in place.

    Shapes must be inferred, and nodes have names.
    """
    rng = random.Random(seed)
    constant = constant_values(model)
    nodes = [
        node
        for node in model.graph
        if is_standard(node) and not all(each in constant for each in node.outputs)
    ]
    kinds = list(KINDS)
    rng.shuffle(kinds)
    for kind in kinds:
        for node in rng.sample(nodes, len(nodes)):
            before = {str(each.name) for each in model.graph}
            if KINDS[kind](node, rng):
                made = tuple(
                    str(each.name)
                    for each in model.graph
                    if str(each.name) not in before
                )
                module = node.metadata_props.get("me2e.module", "")
                return Fault(kind, made or (str(node.name),), module)
    raise ValueError("no fault fits this graph")


def _operands(node: ir.Node, rng: random.Random) -> bool:
    """Exchange the operands of what does not commute."""
    if node.op_type not in ("Sub", "Div", "Pow") or len(node.inputs) != 2:
        return False
    first, second = node.inputs
    if first is None or second is None or first.dtype != second.dtype:
        return False
    if static_shape(node.outputs[0]) is None or first is second:
        return False
    node.replace_input_with(0, second)
    node.replace_input_with(1, first)
    return True


def _axis(node: ir.Node, rng: random.Random) -> bool:
    """Take another axis where the shape stays."""
    shape = static_shape(node.outputs[0])
    if shape is None or len(shape) < 2:
        return False
    if node.op_type == "Softmax":
        axis = node.attributes.get_int("axis", -1) % len(shape)
        others = [
            each for each in range(len(shape)) if each != axis and shape[each] > 1
        ]
        if not others:
            return False
        node.attributes["axis"] = ir.AttrInt64("axis", rng.choice(others))
        return True
    if node.op_type == "Transpose":
        order = permutation_of(node)
        pairs = [
            (i, j)
            for i in range(len(shape))
            for j in range(i)
            if shape[i] == shape[j] > 1
        ]
        if order is None or not pairs:
            return False
        i, j = rng.choice(pairs)
        order[i], order[j] = order[j], order[i]
        node.attributes["perm"] = ir.AttrInt64s("perm", order)
        return True
    return False


def _order(node: ir.Node, rng: random.Random) -> bool:
    """Join parts in another order."""
    reads = list(node.inputs)
    if node.op_type != "Concat" or len(reads) < 2:
        return False
    if len({static_shape(each) for each in reads}) > 1 or len(set(reads)) < 2:
        return False
    if static_shape(reads[0]) is None:
        return False
    for index, value in enumerate(reversed(reads)):
        node.replace_input_with(index, value)
    return True


def _half(node: ir.Node, rng: random.Random) -> bool:
    """Send a value through float16."""
    value = node.outputs[0]
    if value.dtype != FLOAT or not value.uses() or value.is_graph_output():
        return False
    narrow = _behind(node, value, "Cast", {"to": ir.DataType.FLOAT16.value}, "half")
    wide = ir.node("Cast", [narrow.outputs[0]], {"to": FLOAT.value})
    return _finish(value, narrow, wide, "float")


def _cameras(node: ir.Node, rng: random.Random) -> bool:
    """Exchange two of what there are six of."""
    value = node.outputs[0]
    shape = static_shape(value)
    if shape is None or CAMERAS not in shape[:3] or value.is_graph_output():
        return False
    if value.dtype != FLOAT or not value.uses():
        return False
    order = list(range(CAMERAS))
    i, j = rng.sample(order, 2)
    order[i], order[j] = j, i
    graph = node.graph
    assert isinstance(graph, ir.Graph)
    name = f"{value.name}_order"
    indices = rewrite.add_constant(graph, np.array(order, np.int64), name)
    taken = ir.node(
        "Gather", [value, indices], {"axis": shape.index(CAMERAS)}, name=f"{name}_node"
    )
    taken.outputs[0].name = f"{name}ed"
    readers = [use for use in value.uses() if use.node is not taken]
    graph.insert_after(node, taken)
    for use in readers:
        use.node.replace_input_with(use.idx, taken.outputs[0])
    return True


def _activation(node: ir.Node, rng: random.Random) -> bool:
    """Lose an activation, or take another."""
    others = {
        "Relu": "Identity", "Sigmoid": "HardSigmoid", "Sin": "Cos", "Cos": "Sin",
        "Max": "Min", "Min": "Max", "ReduceMax": "ReduceMin", "Floor": "Ceil",
        "Exp": "Identity", "Tanh": "Identity", "Sqrt": "Identity", "Erf": "Tanh",
        "Greater": "Less", "Less": "Greater", "And": "Or", "Not": "Identity",
    }  # fmt: skip
    if node.op_type not in others:
        return False
    node.op_type = others[node.op_type]
    return True


def _padding(node: ir.Node, rng: random.Random) -> bool:
    """Pad on one side, align corners otherwise, or sample the nearest."""
    if node.op_type == "GridSample":
        align = node.attributes.get_int("align_corners", 0)
        node.attributes["align_corners"] = ir.AttrInt64("align_corners", 1 - align)
        return True
    pads = node.attributes.get_ints("pads")
    if node.op_type != "Conv" or not pads or not any(pads):
        return False
    half = len(pads) // 2
    moved = [0] * half + [a + b for a, b in zip(pads[:half], pads[half:], strict=True)]
    node.attributes["pads"] = ir.AttrInt64s("pads", moved)
    return moved != list(pads)


def _wiring(node: ir.Node, rng: random.Random) -> bool:
    """Read an older value of the same shape."""
    graph = node.graph
    assert isinstance(graph, ir.Graph)
    index = rng.randrange(len(node.inputs)) if node.inputs else 0
    value = input_at(node, index)
    shape = static_shape(value)
    if value is None or shape is None or value.producer() is None:
        return False
    if value.dtype != FLOAT or array_of(value) is not None:
        return False
    older = []
    for each in graph:
        if each is node:
            break
        older += [
            out
            for out in each.outputs
            if out is not value and out.dtype == FLOAT and static_shape(out) == shape
        ]
    if not older:
        return False
    node.replace_input_with(index, rng.choice(older))
    return True


KINDS: Mapping[str, Kind] = {
    "weight": wrong_constants.weight,
    "lost bias": wrong_constants.bias,
    "operands": _operands,
    "axis": _axis,
    "order of parts": _order,
    "epsilon": wrong_constants.epsilon,
    "window": wrong_constants.window,
    "index": wrong_constants.index,
    "float16": _half,
    "cameras": _cameras,
    "activation": _activation,
    "padding": _padding,
    "wiring": _wiring,
}


def _behind(
    node: ir.Node, value: ir.Value, op: str, attributes: Mapping[str, int], word: str
) -> ir.Node:
    made = ir.node(op, [value], attributes, name=f"{value.name}_{word}_node")
    made.outputs[0].name = f"{value.name}_{word}"
    return made


def _finish(value: ir.Value, first: ir.Node, last: ir.Node, word: str) -> bool:
    """Put two new nodes between a value and all that read it."""
    producer = value.producer()
    assert producer is not None
    graph = producer.graph
    assert isinstance(graph, ir.Graph)
    last.name = f"{value.name}_{word}_node"
    last.outputs[0].name = f"{value.name}_{word}"
    readers = [use for use in value.uses() if use.node is not first]
    graph.insert_after(producer, [first, last])
    for use in readers:
        use.node.replace_input_with(use.idx, last.outputs[0])
    return True
