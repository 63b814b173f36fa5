"""Loops that constants alone keep going: native code runs them, and hears no signal."""

import math
from collections.abc import Iterable

import onnx_ir as ir

from me2e_compress.graph.nodes import array_of, bodies_of, input_at, is_standard, maker

MOST_ROUNDS = 1 << 24
"""Of a loop and those around it: a round takes 5 us at least."""


def endless(model: ir.Model) -> str | None:
    """Say which loop of a graph would not end, or after minutes; None if none is known.

    A loop that may end by what it computes is none of them.
    """
    for nodes in (model.graph, *model.functions.values()):
        if (node := _endless(nodes, 1)) is not None:
            name = node.name or node.outputs[0].name
            return f"Loop node {name!r} goes on for more than {MOST_ROUNDS:,} rounds"
    return None


def _endless(nodes: Iterable[ir.Node], rounds: float) -> ir.Node | None:
    for node in nodes:
        if not (bodies := bodies_of(node)):
            continue
        inside = rounds * _rounds(node)
        if inside > MOST_ROUNDS:
            return node
        for body in bodies:
            if (found := _endless(body, inside)) is not None:
                return found
    return None


def _rounds(node: ir.Node) -> float:
    """Return how often the body of a loop runs, if constants alone say so; else 1."""
    if node.op_type != "Loop" or not is_standard(node):
        return 1
    (body,) = bodies_of(node)
    if len(body.inputs) < 2 or not body.outputs:
        return 1
    goes_on = _origin(body.outputs[0])
    first = input_at(node, 1)
    if first is not None and not _is_true(first):
        return 1
    if goes_on is not body.inputs[1] and not _is_true(goes_on):
        return 1
    most = input_at(node, 0)
    if most is None:
        return math.inf
    count = array_of(most)
    return 1 if count is None or count.size != 1 else max(0, int(count.item()))


def _is_true(value: ir.Value) -> bool:
    array = array_of(_origin(value))
    return array is not None and array.size == 1 and bool(array.item())


def _origin(value: ir.Value) -> ir.Value:
    """Look through Identity nodes."""
    while (node := maker(value, "Identity")) is not None and node.inputs[0]:
        value = node.inputs[0]
    return value
