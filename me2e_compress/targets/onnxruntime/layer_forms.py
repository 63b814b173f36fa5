"""Rewrite layers to the forms for which onnxruntime's CPU has int8 kernels.

A product between uint8 tensors becomes a convolution: on one core with VNNI,
onnxruntime 1.31 computes [10000, 256] x [256, 512] at 200 GMAC/s as a QGemm, and at 440
to 470 as a QLinearConv over pixels (``benchmarks/measure/int8_shapes.py``).
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.errors import PreconditionError
from me2e_compress.graph import rank_of, rewrite
from me2e_compress.graph.nodes import sole_reader
from me2e_compress.targets.onnxruntime.region import end_of, reads_one_pixel
from me2e_compress.targets.quantized import QUANTIZE
from me2e_compress.targets.weights import (
    Floats,
    QuantizedWeight,
    bias_by_channel,
    biased_end,
    least_scales,
    with_room,
)
from me2e_compress.targets.writer import Writer

# Insert nodes at one place of a graph: shapes changed and restored.


class Place:
    """Inserts new nodes at one place, with the provenance of the old ones."""

    def __init__(
        self, writer: Writer, before: ir.Node, sources: Sequence[ir.Node]
    ) -> None:
        self._writer = writer
        self._before = before
        self._sources = sources

    def node(
        self,
        op: str,
        inputs: Sequence[ir.Value],
        name: str,
        attributes: dict[str, int] | None = None,
    ) -> ir.Node:
        """Insert a node; its output has the type of its first input."""
        node = self._writer.node(op, inputs, name, self._sources, attributes)
        if (kind := inputs[0].dtype) is not None:
            node.outputs[0].dtype = kind
        self._writer.graph.insert_before(self._before, node)
        return node

    def reshaped(self, value: ir.Value, shape: Sequence[int], name: str) -> ir.Value:
        """Reshape a value to a constant shape, of which one number may be -1."""
        target = self._writer.constant(np.array(shape, np.int64), f"{name}_shape")
        return self.node("Reshape", [value, target], name).outputs[0]

    def turned(self, value: ir.Value, axes: Sequence[int], name: str) -> ir.Value:
        """Transpose a value."""
        node = self.node("Transpose", [value], name)
        node.attributes.add(ir.AttrInt64s("perm", axes))
        return node.outputs[0]

    def restored(
        self,
        rows: ir.Value,
        like: ir.Value,
        leading: Sequence[int | ir.SymbolicDim],
        columns: int,
        name: str,
    ) -> ir.Value:
        """Reshape [rows, columns] to the leading dimensions of another value."""
        # At most one open dimension: a constant shape suffices.
        known = [dim if isinstance(dim, int) else -1 for dim in leading]
        if known.count(-1) <= 1:
            return self.reshaped(rows, [*known, columns], f"{name}_ranked")
        # Several open dimensions must be read at run time.
        numbers = [
            self._writer.constant(np.array([number], np.int64), f"{name}_end")
            for number in (0, -1, columns)
        ]
        whole = self.node("Shape", [like], f"{name}_dims").outputs[0]
        front = self.node("Slice", [whole, *numbers[:2]], f"{name}_leading").outputs[0]
        target = self.node("Concat", [front, numbers[2]], f"{name}_target", {"axis": 0})
        for value in (whole, front, target.outputs[0]):
            value.dtype = ir.DataType.INT64
        inputs = [rows, target.outputs[0]]
        return self.node("Reshape", inputs, f"{name}_ranked").outputs[0]


CHANNELS_SECOND, CHANNELS_LAST = (0, 3, 1, 2), (0, 2, 3, 1)


def write_layer(
    writer: Writer, node: ir.Node, weight: QuantizedWeight, step: np.float32
) -> None:
    """Rewrite a layer to read its int8 weight and an int32 bias.

    ==================  ==============================================================
    Conv                remains: QLinearConv
    Conv of one pixel   becomes a Gemm, unless it is read as uint8 only
    read as uint8 only  becomes a Conv: QLinearConv
    Gemm                remains: QGemm
    MatMul, then Add    becomes a Gemm of two dimensions: QGemm. onnxruntime fuses the
                        two before it looks for int8, and then finds nothing
    MatMul              remains, of any rank: MatMulIntegerToFloat
    ==================  ==============================================================

    ``step`` is the scale of the uint8 tensor that the layer reads.
    """
    bias = bias_by_channel(node, len(weight.scales))
    integers = None
    if bias is not None:
        weight, integers = with_bias(weight, bias, step)
    # Does a QuantizeLinear alone read it, behind bias and ReLU?
    left = node.inputs[0]
    reader = sole_reader(end_of(_last_of(node)))
    known = left is not None and left.shape is not None
    quantize = reader if known and reader and reader.op_type == QUANTIZE else None
    # Choose the form.
    if node.op_type == "Conv":
        if quantize is None and reads_one_pixel(node):
            matrix = weight.integers.reshape(weight.integers.shape[:2])
            name = f"{weight.name}_matrix"
            weight = dataclasses.replace(weight, name=name, integers=matrix)
            node = _write_row(writer, node, weight.integers.shape)
    elif quantize is not None:
        columns_first = node.attributes.get_int("transB", 0)
        matrix = weight.integers if columns_first else weight.integers.T
        filters = np.ascontiguousarray(matrix)[:, :, None, None]
        axis = None if weight.axis is None else 0
        name = f"{weight.name}_filter"
        weight = QuantizedWeight(name, filters, weight.scales, axis)
        node = _write_convolution(writer, node, quantize, filters.shape)
    elif node.op_type == "MatMul" and bias is not None:
        node = _write_gemm(writer, node, weight.integers.shape)
    # Write the weight, and the bias in units of the product's steps.
    fresh = writer.dequantized(
        weight.name, weight.integers, weight.scales, weight.axis, node
    )
    node.replace_input_with(1, fresh)
    if integers is None:
        node.resize_inputs(2)
    else:
        units = (weight.scales * step).astype(np.float32)
        fresh = writer.dequantized(f"{weight.name}_bias", integers, units, 0, node)
        node.replace_input_with(2, fresh)


def with_bias(
    weight: QuantizedWeight, bias: Floats, step: np.float32
) -> tuple[QuantizedWeight, npt.NDArray[np.int32]]:
    """Round a bias to int32 in units of ``step * weight.scales``.

    If a channel's weights are so small that its bias does not fit, the channel gets a
    coarser scale: its products are then below the bias's own rounding.
    """
    roomy = with_room(weight, least_scales(bias, step))
    if roomy is not weight:
        weight = dataclasses.replace(roomy, name=f"{weight.name}_coarse")
    integers = np.rint(bias / (weight.scales.astype(np.float64) * step))
    return weight, integers.astype(np.int32)


def _write_gemm(writer: Writer, product: ir.Node, size: Sequence[int]) -> ir.Node:
    """Replace a MatMul and the Add after it by a Gemm of two dimensions.

    Given:   y = Add(MatMul(x, w), b)                           x [..., K], w [K, N]
    Result:  y = Reshape(Gemm(Reshape(x, [-1, K]), w, b), [..., N])

    ``size`` is (K, N). The weight and bias of the returned Gemm are still to be
    written.
    """
    addition = biased_end(product)
    left, right = product.inputs
    if addition is None or left is None or left.shape is None or right is None:
        raise PreconditionError(f"{product.name} is not a MatMul with a bias")
    old = addition.outputs[0]
    name = str(old.name)
    place = Place(writer, addition, [product, addition])
    # Flatten the leading dimensions, and restore them afterwards.
    leading = list(left.shape)[:-1]
    rows = left
    if len(leading) > 1:
        rows = place.reshaped(left, [-1, size[0]], f"{name}_rows")
    gemm = place.node("Gemm", [rows, right, right], f"{name}_gemm")
    answer = gemm.outputs[0]
    if len(leading) > 1:
        answer = place.restored(answer, left, leading, size[1], name)
    # The result replaces that of the Add.
    answer.shape, answer.type = old.shape, old.type
    rewrite.replace_value(old, answer)
    return gemm


def _write_row(writer: Writer, node: ir.Node, size: Sequence[int]) -> ir.Node:
    """Replace a convolution of one pixel by a Gemm.

    Given:   y = Conv(x, w, b)                      x [B, K, 1, 1], w [N, K, 1, 1]
    Result:  y = Reshape(Gemm<transB=1>(Reshape(x, [-1, K]), w', b), [-1, N, 1, 1])

    ``size`` is (N, K). The weight and bias of the returned Gemm are still to be
    written.
    """
    old, (image, weight) = node.outputs[0], node.inputs[:2]
    if image is None or weight is None:
        raise PreconditionError(f"{node.name} is not a convolution")
    name, ones = str(old.name), [1] * (rank_of(image) or 4)
    place = Place(writer, node, [node])
    row = place.reshaped(image, [-1, size[1]], f"{name}_row")
    inputs = [row, weight, weight]
    gemm = place.node("Gemm", inputs, f"{name}_gemm", {"transB": 1})
    shape = [-1, size[0], *ones[2:]]
    answer = place.reshaped(gemm.outputs[0], shape, f"{name}_pixel")
    answer.shape, answer.type = old.shape, old.type
    rewrite.replace_value(old, answer)
    return gemm


def _write_convolution(
    writer: Writer, product: ir.Node, quantize: ir.Node, size: Sequence[int]
) -> ir.Node:
    """Replace a product that only a QuantizeLinear reads by a convolution.

    Given:   q = QuantizeLinear(Relu(Add(MatMul(DequantizeLinear(x), w), b)))
    Result:  q = Reshape(Transpose(QuantizeLinear(Relu(Conv(DequantizeLinear(
                 Transpose(Reshape(x, [1, -1, 1, K]))), w, b)))), [..., N])

    x is uint8 [..., K], ``size`` (N, K, ...). onnxruntime computes with the channels
    last, and so removes both transposes. The filter and the bias of the returned Conv
    are still to be written.
    """
    last = _last_of(product)
    left, weight = product.inputs[:2]
    assert left is not None
    assert left.shape is not None
    assert weight is not None
    dequantize = left.producer()
    assert dequantize is not None
    integers, *grid = [each for each in dequantize.inputs if each is not None]
    old, leading = last.outputs[0], list(left.shape)[:-1]
    name, (columns, depth) = str(old.name), size[:2]
    # Every row becomes a pixel, while it is uint8.
    place = Place(writer, last, [product, last])
    pixels = place.reshaped(integers, [1, -1, 1, depth], f"{name}_pixels")
    image = place.turned(pixels, CHANNELS_SECOND, f"{name}_image")
    inputs = [image, *grid]
    numbers = place.node("DequantizeLinear", inputs, f"{name}_image_float").outputs[0]
    numbers.dtype = ir.DataType.FLOAT
    node = place.node("Conv", [numbers, weight, weight], f"{name}_conv")
    rewrite.replace_value(old, node.outputs[0])
    # All up to the QuantizeLinear has the shape of an image now.
    known = [dim for dim in leading if isinstance(dim, int)]
    rows = math.prod(known) if len(known) == len(leading) else None
    for value in (node.outputs[0], quantize.inputs[0], quantize.outputs[0]):
        assert value is not None
        value.shape = ir.Shape([1, columns, rows, 1])
    # The pixels become rows again behind it.
    answer, uses = quantize.outputs[0], list(quantize.outputs[0].uses())
    place = Place(writer, uses[0].node, [product, last])
    turned = place.turned(answer, CHANNELS_LAST, f"{name}_turned")
    restored = place.restored(turned, left, leading, columns, name)
    restored.shape = ir.Shape([*leading, columns])
    for use in uses:
        use.node.replace_input_with(use.idx, restored)
    return node


def _last_of(product: ir.Node) -> ir.Node:
    """Return the Add of a MatMul's bias, or the product itself."""
    end = biased_end(product) if product.op_type == "MatMul" else None
    return end or product
