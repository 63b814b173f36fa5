"""One layer of each kind that has int8."""

import onnx_ir as ir

from tests.support.nets import drawn

LAYERS = """
<ir_version: 9, opset_import: ["" : %d]>
layers (float[2,3,5,5] x, float[2,4] t, float[6,3,3,3] conv, float[6] bias,
        float[6,2,2,2] up, float[4,7] right, float[7,4] turned)
    => (float[2,6,3,3] a, float[2,4,6,6] b, float[2,7] c, float[2,7] d) {
    z = Conv<kernel_shape=[3,3]>(x, conv, bias)
    a = Relu(z)
    b = ConvTranspose<kernel_shape=[2,2], strides=[2,2], group=2>(a, up)
    c = MatMul(t, right)
    d = Gemm<transB=1>(t, turned)
}
"""
SHAPES = {
    "conv": (6, 3, 3, 3), "bias": (6,), "up": (6, 2, 2, 2), "right": (4, 7),
    "turned": (7, 4),
}  # fmt: skip


def layers(seed: int = 0, opset: int = 17) -> ir.Model:
    return drawn(LAYERS % opset, SHAPES, seed)
