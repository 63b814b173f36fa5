import onnx_ir as ir

from me2e_compress.graph import infer_shapes, macs, static_shape

# the second sampler's queries come from what the first gives; neither has a shape
CHAIN = """
<ir_version: 9, opset_import: ["" : 17]>
net (float[1,8,2,3] v, float[1,4,1,2] points, float[1,4,2,8] offsets,
     float[1,4,2,4] raw, float[6,16] l) => (float[1,4,6] y)
    <int32[2,2] sizes = {2, 3, 1, 2}, int64[3] rows = {1, 4, 6},
     int64[4] heads = {1, 4, 2, 8}> {
    a = MultiScaleDeformableAttnTRT(v, sizes, points, offsets, raw)
    b = Reshape(a, rows)
    c = MatMul(b, l)
    d = Reshape(c, heads)
    e = MultiScaleDeformableAttnTRT2(v, sizes, points, d, raw)
    y = Reshape(e, rows)
}
"""


def test_plugins_in_a_row_tell_what_they_give() -> None:
    model = ir.from_onnx_text(CHAIN)
    infer_shapes(model)
    shapes = [static_shape(node.outputs[0]) for node in model.graph]
    assert shapes[0] == shapes[4] == (1, 4, 2, 3)
    assert model.graph[4].outputs[0].dtype == ir.DataType.FLOAT
    assert macs(model.graph[0]) == 4 * (4 * 2 * 2 * 2) * 3
    text = CHAIN.replace("float[1,8,2,3] v", "float[n,s,2,d] v")
    assert macs(ir.from_onnx_text(text).graph[0]) is None
