"""What is written in front of a fused node has types and shapes at once."""

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.operators.call import FusedCall

# A Constant node of a file read by onnx_ir has neither type nor shape.
TEXT = """
<ir_version: 9, opset_import: ["" : 17]>
m (float[2,8] x) => (float[2,8] y) {
    axes = Constant<value = int64[1] {1}>()
    y = Relu(x)
}
"""


def test_what_reads_a_constant_node_is_typed() -> None:
    model = ir.from_onnx_text(TEXT)
    constant, relu = model.graph
    assert constant.outputs[0].type is None

    call = FusedCall(relu, opset=17, by="test")
    wide = call.add("Unsqueeze", [model.graph.inputs[0], constant.outputs[0]])
    flat = call.reshape(wide, (2, -1))

    assert flat.dtype == ir.DataType.FLOAT
    assert graph.static_shape(flat) == (2, 8)
