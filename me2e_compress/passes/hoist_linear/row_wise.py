"""Operators that compute every element, or every row of the last axis, by itself."""

from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress.graph import is_standard, rank_of
from me2e_compress.graph.nodes import integers_at
from me2e_compress.graph.rewrite import is_read
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter

UNARY = frozenset(
    {
        *("Abs", "Celu", "Clip", "Cos", "Elu", "Erf", "Exp", "Gelu", "HardSigmoid"),
        *("HardSwish", "Identity", "LeakyRelu", "Log", "Mish", "Neg", "Reciprocal"),
        *("Relu", "Selu", "Sigmoid", "Sin", "Softplus", "Softsign", "Sqrt", "Tanh"),
    }
)
"""Operators that map every element by itself."""

BINARY = frozenset({"Add", "Div", "Max", "Min", "Mul", "Pow", "Sub"})
"""Element-wise operators of two operands, which broadcast."""

REDUCTIONS = frozenset(
    {"ReduceL2", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum"}
)
"""Operators that reduce every row to one number where their axis is the last."""

ALONG_AXIS = frozenset({"LayerNormalization", "LogSoftmax", "Softmax"})
"""Operators that map every row by itself where their axis is the last."""

SOFTMAX_OPSET = 13
"""Before, the axis of a softmax was the second by default."""


def is_row_wise(node: ir.Node, opset: int) -> bool:
    """Return whether a node maps every element, or every row of the last axis."""
    if not is_standard(node) or any(map(is_read, node.outputs[1:])):
        return False
    if any((rank_of(value) or 0) > 1 for value in node.inputs[2:]):
        return False
    if node.op_type in UNARY or node.op_type in BINARY:
        return True
    # Reductions and normalizations must work along the last axis
    rank = rank_of(node.outputs[0]) or 0
    if node.op_type in REDUCTIONS:
        axes = integers_at(node, "axes", 1)
        return bool(node.attributes.get_int("keepdims", 1)) and axes in (
            [-1],
            [rank - 1],
        )
    if node.op_type not in ALONG_AXIS:
        return False
    softmax = node.op_type != "LayerNormalization"
    if not softmax and rank_of(node.inputs[1]) != 1:
        return False
    default = 1 if softmax and opset < SOFTMAX_OPSET else -1
    return node.attributes.get_int("axis", default) in (-1, rank - 1)


def along_last(
    node: ir.Node,
    inputs: Sequence[ir.Value | None],
    rank: int,
    rewriter: Rewriter,
) -> tuple[list[ir.Value | None], list[ir.Attr]]:
    """Return a moved node's inputs and attributes, its axis being the last."""
    given, attributes = list(inputs), dict(node.attributes)
    if node.op_type in ALONG_AXIS:
        attributes["axis"] = ir.AttrInt64("axis", rank - 1)
    elif "axes" in attributes:
        attributes["axes"] = ir.AttrInt64s("axes", [rank - 1])
    elif node.op_type in REDUCTIONS:
        given[1] = rewriter.target((rank - 1,), f"{node.outputs[0].name}_axes")
    return given, list(attributes.values())
