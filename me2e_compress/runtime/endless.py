"""Detect Loop nodes that never end: native code runs them and ignores signals."""

import math
from collections.abc import Iterable

import onnx_ir as ir

from me2e_compress.graph.nodes import array_of, bodies_of, input_at, is_standard, maker

MOST_ROUNDS = 1 << 24
"""Most iterations of a loop times those around it: one takes at least 5 us."""


def endless(model: ir.Model) -> str | None:
    """Describe a loop that would run for minutes or forever; None if none is known.

    Loops whose condition is computed at run time are not reported.
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
    """Return the iterations of a loop if constants alone decide them; else 1."""
    if node.op_type != "Loop" or not is_standard(node):
        return 1
    (body,) = bodies_of(node)
    if len(body.inputs) < 2 or not body.outputs:
        return 1
    # Both conditions must be constantly true, or passed through unchanged.
    goes_on = _origin(body.outputs[0])
    first = input_at(node, 1)
    if first is not None and not _is_true(first):
        return 1
    if goes_on is not body.inputs[1] and not _is_true(goes_on):
        return 1
    # Without a limit, the loop never ends.
    most = input_at(node, 0)
    if most is None:
        return math.inf
    count = array_of(most)
    return 1 if count is None or count.size != 1 else max(0, int(count.item()))


def _is_true(value: ir.Value) -> bool:
    array = array_of(_origin(value))
    return array is not None and array.size == 1 and bool(array.item())


def _origin(value: ir.Value) -> ir.Value:
    """Follow a value back through Identity nodes."""
    while (node := maker(value, "Identity")) is not None and node.inputs[0]:
        value = node.inputs[0]
    return value
