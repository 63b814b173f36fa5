"""Scores from weights: what a softmax read, laid out as what it gives is read."""

import math

import onnx_ir as ir

from me2e_compress.graph.nodes import maker
from me2e_compress.graph.shapes import static_shape
from me2e_compress.operators.call import FusedCall

_LAYOUT = ("Expand", "Identity", "Reshape", "Squeeze", "Transpose", "Unsqueeze")


def before_softmax(call: FusedCall, weights: ir.Value, axes: int) -> ir.Value | None:
    """Write the layout of weights again, in front of their softmax.

    Args:
        call: where to write.
        weights: each row of their last axes adds up to 1, if they are of a softmax.
        axes: how many axes are a row.

    Returns:
        The scores, of the shape of the weights; None if they are of no softmax over
        whole rows, or a shape on the way to it is not known.
    """
    shape = static_shape(weights)
    if shape is None:
        return None
    row, chain, source = math.prod(shape[-axes:]), list[ir.Node](), weights
    while node := maker(source, *_LAYOUT):
        read = node.inputs[0]
        if read is None or not _keeps_rows(node, row):
            return None
        chain.append(node)
        source = read
    softmax = maker(source, "Softmax")
    scores = None if softmax is None else softmax.inputs[0]
    made = static_shape(source)
    if softmax is None or scores is None or not made or made[-1] != row:
        return None
    if softmax.attributes.get_int("axis", -1) not in (-1, len(made) - 1):
        return None
    for node in reversed(chain):
        attributes = {name: each.value for name, each in node.attributes.items()}
        scores = call.add(node.op_type, [scores, *node.inputs[1:]], attributes)
    return scores


def _keeps_rows(node: ir.Node, row: int) -> bool:
    """Return whether a change of layout leaves every run of numbers of a row whole."""
    read, made = static_shape(node.inputs[0]), static_shape(node.outputs[0])
    if read is None or made is None:
        return False
    if node.op_type not in ("Expand", "Transpose"):
        return True
    kept = next(
        (at for at in range(len(read) + 1) if math.prod(read[len(read) - at :]) == row),
        None,
    )
    if kept is None:
        return False
    if node.op_type == "Expand":
        return read[len(read) - kept :] == made[len(made) - kept :]
    order = node.attributes.get_ints("perm", tuple(reversed(range(len(read)))))
    return list(order[len(read) - kept :]) == list(range(len(read) - kept, len(read)))
