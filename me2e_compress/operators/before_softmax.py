"""Recover the input of a softmax from its output."""

import math

import onnx_ir as ir

from me2e_compress.graph.nodes import maker, permutation_of
from me2e_compress.graph.shapes import static_shape
from me2e_compress.operators.call import FusedCall

_LAYOUT = ("Expand", "Identity", "Reshape", "Squeeze", "Transpose", "Unsqueeze")


def before_softmax(call: FusedCall, weights: ir.Value, axes: int) -> ir.Value | None:
    """Write the scores of a softmax in the layout of its weights, if there is one.

    The last ``axes`` axes of ``weights`` are one row of the softmax.
    """
    shape = static_shape(weights)
    if shape is None:
        return None
    # Walk back over layout operators that keep rows whole
    row, chain, source = math.prod(shape[-axes:]), list[ir.Node](), weights
    while node := maker(source, *_LAYOUT):
        read = node.inputs[0]
        if read is None or not _keeps_rows(node, row):
            return None
        chain.append(node)
        source = read
    # The softmax must be over the last axis
    softmax = maker(source, "Softmax")
    scores = None if softmax is None else softmax.inputs[0]
    made = static_shape(source)
    if softmax is None or scores is None or not made or made[-1] != row:
        return None
    if softmax.attributes.get_int("axis", -1) not in (-1, len(made) - 1):
        return None
    # Repeat the layout operators on its input
    for node in reversed(chain):
        attributes = {name: each.value for name, each in node.attributes.items()}
        scores = call.add(node.op_type, [scores, *node.inputs[1:]], attributes)
    return scores


def _keeps_rows(node: ir.Node, row: int) -> bool:
    read, made = static_shape(node.inputs[0]), static_shape(node.outputs[0])
    if read is None or made is None:
        return False
    if node.op_type not in ("Expand", "Transpose"):
        return True
    # A row consists of the last axes of the input
    kept = next(
        (at for at in range(len(read) + 1) if math.prod(read[len(read) - at :]) == row),
        None,
    )
    if kept is None:
        return False
    if node.op_type == "Expand":
        return read[len(read) - kept :] == made[len(made) - kept :]
    order = permutation_of(node) or []
    return order[len(read) - kept :] == list(range(len(read) - kept, len(read)))
