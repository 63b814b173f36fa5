"""Bytes that nodes write in a frame."""

from me2e_compress import graph
from me2e_compress.graph.summary import activation_bytes
from tests.nets import parsed

NET = """
net (float[1,4] x, float[n,4] open) => (float[4,1] y, float[n,4] z)
<float scale = {0.1}, int8 zero = {0}, int64[2] tall = {4, 1}> {
    a = Relu(x)
    q = QuantizeLinear(a, scale, zero)
    d = DequantizeLinear(q, scale, zero)
    b = Exp(d)
    p = QuantizeLinear(b, scale, zero)
    s = Sin(b)
    y = Reshape(s, tall)
    z = Relu(open)
}
"""


def test_int8_is_written_where_nothing_else_is_read() -> None:
    model = parsed(NET)
    graph.infer_shapes(model)

    found = {node.outputs[0].name: activation_bytes(node) for node in model.graph}

    assert found == {
        "a": 4,  # Relu and QuantizeLinear at once
        "q": 0,
        "d": 0,
        "b": 16,
        "p": 4,  # and the floats stay, for Sin
        "s": 16,
        "y": 0,
        "z": None,
    }
