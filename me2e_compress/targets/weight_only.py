"""Store the weights of float layers as int8."""

import onnx_ir as ir

from me2e_compress import rewrite
from me2e_compress.graph import provenance
from me2e_compress.quantization.plan import QuantPlan
from me2e_compress.targets.onnxruntime.writer import BY, Writer
from me2e_compress.targets.weights import QuantizedWeight, weights_of


def store_weights(model: ir.Model, plan: QuantPlan) -> None:
    """Replace weights by int8 and a DequantizeLinear where layers stay float.

    Given:   y = Gemm<transB = 1>(x, w, b)                      w [N, K]
    Result:  y = Gemm(x, DequantizeLinear<axis = 1>(w_int8), b)    w_int8 [K, N]

    The weight is stored as [K, N] with one scale a column: so onnxruntime (1.31) reads
    the integers directly, in one kernel (MatMulNBits); it would dequantize a transposed
    weight again for every frame. The graph, in which the plan's other nodes are placed,
    is changed in place.
    """
    chosen = plan.weight_only
    if not chosen:
        return
    weights = weights_of(model, chosen)
    nodes = {str(node.outputs[0].name): node for node in model.graph}
    writer = Writer(model.graph)
    for decision in chosen:
        _store(writer, nodes[decision.output], weights[decision.output])
    rewrite.sweep(model)


def _store(writer: Writer, node: ir.Node, weight: QuantizedWeight) -> None:
    integers = weight.integers
    transposed = node.attributes.get_int("transB", 0) == 1
    # Kernels read [K, N]: transpose the stored weight.
    if node.op_type == "Gemm" and transposed:
        integers = integers.T.copy()
        node.attributes["transB"] = ir.AttrInt64("transB", 0)
        provenance.inherit(node, [node], by=BY)
    fresh = writer.dequantized(weight.name, integers, weight.scales, 1, node)
    node.replace_input_with(1, fresh)
