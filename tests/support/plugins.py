"""A small graph with TensorRT plugins, as exporters write them."""

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import rewrite

TEXT = """
<ir_version: 9, opset_import: ["" : 17, "custom_op" : 1, "trt.plugins" : 1]>
bev (float[1,16,8,8] image, float[1] angle, float[2] center, float[1,6,4,4] lidar)
    => (float y, float[1,6,4,4] camera)
    <int64[3] plain = {16, 8, 8}, int64[4] batch = {1, 16, 8, 8}>
{
    ["/reshape"] flat = Reshape(image, plain)
    ["/rotate"] turned = RotateTRT2<interpolation=0>(flat, angle, center)
    ["/batch"] again = Reshape(turned, batch)
    ["/conv"] y = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(again, again)
    ["/inverse"] camera_of = InverseTRT(lidar)
    ["/identity"] camera = Relu(camera_of)
}
"""

BARE = (
    TEXT.replace("= Reshape(image, plain)", "= Reshape(image, some)")
    .replace("= InverseTRT(lidar)", "= InverseTRT(cameras)")
    .replace(
        '    ["/reshape"]',
        """
    ["/three"] three = NonZero(three_ones)
    ["/four"] four = NonZero(four_ones)
    ["/row"] row = Reshape(three, flat_row)
    ["/column"] column = Reshape(four, flat_row)
    ["/some"] some = Gather(plain, row)
    ["/all"] all = Gather(square, column)
    ["/cameras"] cameras = Reshape(lidar, all)
    ["/reshape"]""",
    )
    .replace(
        "8, 8}>",
        """8, 8}, int64[4] square = {1, 6, 4, 4},
     int64[1] flat_row = {-1}, float[3] three_ones = {1, 1, 1},
     float[4] four_ones = {1, 1, 1, 1}>""",
    )
)
"""The same where nobody knows the rank of what the plugins read, nor of what they
give."""


def exported(*, shapes: bool, domain: str = "") -> ir.Model:
    """Build it; an output has no shape, as where an exporter knew none.

    Args:
        shapes: whether the file records what the plugins give, or nobody knows it.
        domain: of the plugins.
    """
    model = ir.from_onnx_text(TEXT if shapes else BARE)
    draws = np.random.default_rng(0).normal(size=(16, 16, 3, 3)).astype(np.float32)
    conv = next(node for node in model.graph if node.op_type == "Conv")
    conv.replace_input_with(1, rewrite.add_constant(model.graph, draws, "w"))
    model.graph.outputs[0].shape = None
    known = {"RotateTRT2": (16, 8, 8), "InverseTRT": (1, 6, 4, 4)}
    for node in model.graph:
        if node.op_type in known:
            node.domain = domain
            value = node.outputs[0]
            value.type = ir.TensorType(ir.DataType.FLOAT) if shapes else None
            value.shape = ir.Shape(known[node.op_type]) if shapes else None
    return model
