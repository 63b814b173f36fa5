"""Determine which layers onnxruntime's CPU computes on uint8 and int8."""

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import bias_of, is_standard, rank_of
from me2e_compress.graph.nodes import scalar_of
from me2e_compress.graph.rewrite import sole_reader
from me2e_compress.graph.shapes import (
    extent,
    is_one_matrix,
    open_shape,
    static_shape,
)
from me2e_compress.targets.weights import is_bias

MOVES = frozenset(
    {
        "Flatten", "MaxPool", "Reshape", "Resize", "Slice", "SpaceToDepth", "Squeeze",
        "Transpose", "Unsqueeze",
    }
)  # fmt: skip
"""Operators that pick or move elements: before quantization or behind it, on one grid,
they give the same integers. A grid of their own would gain nothing."""

AVERAGES = frozenset({"AveragePool", "GlobalAveragePool"})
"""Operators whose output may be a small part of the input's range: it has a grid of
its own."""

LAYERS = ("Conv", "Gemm", "MatMul")
"""Operators with a weight that have an int8 kernel."""

JOINS = frozenset({"Add", "Concat"})
"""Operators that read several activations, each on its own grid."""


def has_kernel(node: ir.Node) -> bool:
    """Return whether a layer has an int8 kernel, given a constant weight."""
    return objection(node) is None


def objection(node: ir.Node) -> str | None:
    """Explain why a layer has no int8 kernel; None if it has one.

    There is QLinearConv, but none for ConvTranspose; QGemm has neither beta nor a
    transposed left operand; MatMul must have one weight for the whole batch.
    """
    if not is_standard(node) or node.op_type not in LAYERS:
        return f"there is no int8 kernel for {node.op_type}"
    # Each operator has its own conditions.
    if node.op_type == "Conv":
        stored = bias_of(node) is None or graph.array_of(bias_of(node)) is not None
        return None if stored else "the bias is computed"
    if node.op_type == "Gemm":
        plain = _is_plain_gemm(node)
        return None if plain else "QGemm takes no factors, and one bias for all rows"
    if (rank_of(node.inputs[0]) or 0) < 2:
        return "the left operand is a vector, or of unknown rank"
    return None if is_one_matrix(node) else "the weight is a batch of matrices"


def _is_plain_gemm(node: ir.Node) -> bool:
    bias = bias_of(node)
    return (
        node.attributes.get_float("alpha", 1.0) == 1
        and node.attributes.get_float("beta", 1.0) == 1
        and not node.attributes.get_int("transA", 0)
        and (bias is None or is_bias(bias, 2, extent(node, weight=True).columns))
    )


def reads_one_pixel(node: ir.Node) -> bool:
    """Return whether a convolution is a Gemm: kernels of 1 over images of one pixel.

    So it is behind a global average. A Gemm may write float; a QLinearConv may not.
    """
    image, weight = open_shape(node.inputs[0]), static_shape(node.inputs[1])
    return (
        node.op_type == "Conv"
        and image is not None
        and weight is not None
        and set(image[2:]) == set(weight[2:]) == {1}
        and node.attributes.get_int("group", 1) == 1
        and not any(node.attributes.get_ints("pads", []))
    )


def is_move(node: ir.Node) -> bool:
    """Return whether a node only moves or picks elements of its first input."""
    if not is_standard(node) or node.op_type not in MOVES:
        return False
    if node.op_type == "Resize":
        mode = node.attributes.get_string("mode", "nearest")
        places = node.attributes.get_string("coordinate_transformation_mode")
        # Outside the crop there is a value of the attributes, not of the input.
        return mode == "nearest" and places != "tf_crop_and_resize"
    return len(node.outputs) == 1


def is_average(node: ir.Node) -> bool:
    """Return whether a node averages its input over windows, or over all places."""
    return is_standard(node) and node.op_type in AVERAGES


def has_average_kernel(node: ir.Node) -> bool:
    """Return whether the int8 kernel of an average computes what ONNX defines.

    onnxruntime 1.31 refuses a QLinearAveragePool with dilations, of 1 too. With
    ``count_include_pad`` and ``ceil_mode``, windows that reach beyond the padding are
    divided by all their places; ONNX leaves those out that are beyond.
    """
    options = node.attributes
    dilated = "dilations" in options
    beyond = all(options.get_int(n, 0) for n in ("ceil_mode", "count_include_pad"))
    return is_average(node) and not dilated and not beyond


def end_of(node: ir.Node) -> ir.Value:
    """Return the output of a layer's kernel: that of the ReLU after it, if any.

    A ReLU costs nothing where its uint8 grid begins at zero: quantization clips.
    """
    reader = sole_reader(node.outputs[0])
    if reader is not None and is_clip_at_zero(reader):
        return reader.outputs[0]
    return node.outputs[0]


def is_clip_at_zero(node: ir.Node) -> bool:
    """Return whether a node is a ReLU, or a Clip that begins at zero."""
    if node.op_type == "Clip":
        return is_standard(node) and scalar_of(graph.input_at(node, 1)) == 0.0
    return is_standard(node) and node.op_type == "Relu"
