"""What is written in front of a fused node has types and shapes at once."""

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import GraphError
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


@pytest.mark.parametrize("of_node", [True, False])
def test_no_value_of_another_node_loses_its_name_to_an_output(of_node: bool) -> None:
    text = TEXT.replace("y = Relu(x)", "a = Exp(x) y = Relu(a)")
    model = ir.from_onnx_text(text)
    exp, relu = model.graph[1], model.graph[2]
    call = FusedCall(relu, opset=17, by="test")
    call.put(exp.outputs[0] if of_node else call.constant(np.zeros(8, np.float32)))
    output = model.graph.outputs[0]
    assert output.name == "y"
    assert exp.outputs[0].name == "a"
    assert model.graph[-1].op_type == "Identity"


def test_a_bare_number_is_refused_and_how_to_write_it_is_said() -> None:
    relu = ir.from_onnx_text(TEXT).graph[1]
    call = FusedCall(relu, opset=17, by="test")
    with pytest.raises(GraphError, match=r"^Mul: input 1 is 2\.0, .* call\.numbers"):
        call.add("Mul", [relu.inputs[0], 2.0])  # type: ignore[list-item]
