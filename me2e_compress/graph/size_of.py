"""What a graph weighs and costs."""

import dataclasses
import math

import onnx_ir as ir

from me2e_compress.graph.shapes import static_shape


@dataclasses.dataclass(frozen=True)
class Size:
    """What a graph weighs.

    Attributes:
        nodes: nodes, those in subgraphs and in every call of a function included.
        weight_bytes: bytes of all initializers.
        macs: multiply-accumulates of convolutions and matrix products; None where
            the shape of one of them is not known.
    """

    nodes: int
    weight_bytes: int
    macs: int | None


def size(model: ir.Model) -> Size:
    """Weigh a graph."""
    each = [macs(node) for node in model.graph.all_nodes()]
    known = [count for count in each if count is not None]
    return Size(
        nodes=node_count(model),
        weight_bytes=sum(
            value.const_value.nbytes
            for graph in model.graphs()
            for value in graph.initializers.values()
            if value.const_value is not None
        ),
        macs=sum(known) if len(known) == len(each) else None,
    )


def node_count(model: ir.Model) -> int:
    """Count nodes as a runtime sees them: a function counts at every call."""
    bodies: dict[ir.OperatorIdentifier, int] = {}

    def count(node: ir.Node) -> int:
        key = node.op_identifier()
        function = model.functions.get(key)
        if function is None:
            return 1
        if key not in bodies:
            bodies[key] = sum(count(inner) for inner in function.all_nodes())
        return bodies[key]

    return sum(count(node) for node in model.graph.all_nodes())


def macs(node: ir.Node) -> int | None:
    """Count a node's multiply-accumulates: 0 for what multiplies no matrices.

    Conv and ConvTranspose: output (input) elements x kernel volume x channels per
    group. Gemm and MatMul: rows x columns x inner dimension x batch. None where a
    shape is unknown.
    """
    if node.domain not in ("", "ai.onnx"):
        return 0
    rule = _RULES.get(node.op_type)
    return 0 if rule is None else rule(node)


def _conv(node: ir.Node) -> int | None:
    kernel, out = static_shape(node.inputs[1]), static_shape(node.outputs[0])
    return None if kernel is None or out is None else math.prod(out + kernel[1:])


def _conv_transpose(node: ir.Node) -> int | None:
    kernel, source = static_shape(node.inputs[1]), static_shape(node.inputs[0])
    if kernel is None or source is None:
        return None
    return math.prod(source + kernel[1:])


def _matmul(node: ir.Node) -> int | None:
    left, out = static_shape(node.inputs[0]), static_shape(node.outputs[0])
    if left is None or out is None:
        return None
    return math.prod(out) * (left[-1] if left else 1)


def _gemm(node: ir.Node) -> int | None:
    left, out = static_shape(node.inputs[0]), static_shape(node.outputs[0])
    if left is None or out is None:
        return None
    transposed = node.attributes.get_int("transA", 0)
    return math.prod(out) * left[0 if transposed else 1]


_RULES = {
    "Conv": _conv,
    "ConvTranspose": _conv_transpose,
    "Gemm": _gemm,
    "MatMul": _matmul,
}
