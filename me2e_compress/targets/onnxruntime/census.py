"""Count what is int8 in a graph."""

import onnx_ir as ir

LAYERS = frozenset({"Conv", "ConvTranspose", "Gemm", "MatMul"})


def int8_layers(model: ir.Model) -> tuple[ir.Node, ...]:
    """List the layers whose two operands both come through a DequantizeLinear.

    Whether a program computes them in integers is its own affair: on onnxruntime's CPU
    those of a graph placed for TensorRT run in float.
    """
    return tuple(
        node
        for node in model.graph
        if node.op_type in LAYERS and all(map(_dequantized, node.inputs[:2]))
    )


def _dequantized(value: ir.Value | None) -> bool:
    """Look for a DequantizeLinear before a value, through changes of layout."""
    node = None if value is None else value.producer()
    while node is not None and node.op_type in ("Reshape", "Transpose"):
        value = node.inputs[0]
        node = None if value is None else value.producer()
    return node is not None and node.op_type == "DequantizeLinear"
