"""Store weights as int8 whose layers run in float."""

import onnx_ir as ir

from me2e_compress import rewrite
from me2e_compress.graph import provenance
from me2e_compress.quantization.plan import QuantPlan
from me2e_compress.targets.onnxruntime.writer import BY, Writer
from me2e_compress.targets.weights import QuantizedWeight, weights_of


def store_weights(model: ir.Model, plan: QuantPlan) -> None:
    """Put int8 and a DequantizeLinear in the place of weights that alone become int8.

    Given:   y = Gemm<transB = 1>(x, w, b)                      w [N, K]
    Result:  y = Gemm(x, DequantizeLinear<axis = 1>(w_int8), b)    w_int8 [K, N]

    The weight is stored as [K, N] with one scale a column: so onnxruntime (1.31) reads
    the integers themselves, in one kernel (MatMulNBits); a transposed weight it would
    dequantize again for every frame.

    Args:
        model: the graph in which the plan's other nodes are placed; written in place.
        plan: what was decided of it.

    Raises:
        PreconditionError: the graph is older than opset 13.
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
    if node.op_type == "Gemm" and transposed:
        integers = integers.T.copy()
        node.attributes["transB"] = ir.AttrInt64("transB", 0)
        provenance.inherit(node, [node], by=BY)
    fresh = writer.dequantized(weight.name, integers, weight.scales, 1, node)
    node.replace_input_with(1, fresh)
