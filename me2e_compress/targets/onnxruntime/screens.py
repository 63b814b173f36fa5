"""Keep products in int8 that onnxruntime would run in float due to their readers."""

import numpy as np
import onnx_ir as ir

from me2e_compress import graph, rewrite
from me2e_compress.targets.onnxruntime.writer import Writer
from me2e_compress.targets.quantized import QUANTIZE, is_dequantized

_CLIPS = ("Relu", "Clip")


def screen_products(writer: Writer) -> None:
    """Insert a Reshape without effect after products that would run in float.

    Given:   y = Relu(Gemm(DequantizeLinear(x), DequantizeLinear(w)))
    Result:  y = Relu(Reshape(Gemm(DequantizeLinear(x), DequantizeLinear(w)), [0, 0]))

    onnxruntime (1.31) silently finds no int8 kernel for a Gemm or MatMul,

    * whose only reader is a Relu or Clip that something else than a QuantizeLinear
      reads: it looks for the QuantizeLinear after that one, or fuses the two;
    * that both a QuantizeLinear and something else read;
    * that is a MatMul whose only reader is an Add: the two become a float Gemm first.

    Convolutions are not affected: their output is read only through its pair.
    """
    products = [
        node
        for node in writer.graph
        if node.op_type in ("Gemm", "MatMul") and _reads_integers(node)
    ]
    for node in products:
        if _would_run_in_float(node):
            _screen(writer, node)


def _reads_integers(node: ir.Node) -> bool:
    return all(map(is_dequantized, node.inputs[:2]))


def _would_run_in_float(product: ir.Node) -> bool:
    value = product.outputs[0]
    readers = list(value.consumers())
    if any(each.op_type == QUANTIZE for each in readers):
        return len(value.uses()) > 1 or value.is_graph_output()
    if len(readers) != 1:
        return False
    if product.op_type == "MatMul" and readers[0].op_type == "Add":
        return True
    # A Relu or Clip hides the layer, unless only pairs follow.
    clipped = readers[0].outputs[0]
    return readers[0].op_type in _CLIPS and (
        clipped.is_graph_output()
        or any(each.op_type != QUANTIZE for each in clipped.consumers())
    )


def _screen(writer: Writer, product: ir.Node) -> None:
    """Insert a Reshape to its own shape between a product and its readers."""
    value = product.outputs[0]
    rank = max(graph.rank_of(each) or 2 for each in product.inputs[:2])
    same = writer.constant(np.zeros(rank, np.int64), f"same_{rank}")
    node = writer.node("Reshape", [value, same], f"{value.name}_screened", [product])
    writer.graph.insert_after(product, node)
    node.outputs[0].shape, node.outputs[0].type = value.shape, value.type
    rewrite.replace_value(value, node.outputs[0])
    node.replace_input_with(0, value)
