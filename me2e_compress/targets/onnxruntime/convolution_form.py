"""Write a product between uint8 tensors as a convolution, for its faster kernel.

On one core with VNNI, onnxruntime 1.31 computes [10000, 256] x [256, 512] at 210 GMAC/s
as a QGemm that writes uint8, at 290 as one that writes float32, and at 470 as a
QLinearConv over pixels (``benchmarks/bench_levers.py``).
"""

import math

import numpy as np
import onnx_ir as ir

from me2e_compress.graph.rewrite import replace_value, sole_reader
from me2e_compress.targets.onnxruntime.insertion import Place
from me2e_compress.targets.onnxruntime.kernels import biased_end, end_of
from me2e_compress.targets.quantized import QUANTIZE
from me2e_compress.targets.weights import QuantizedWeight
from me2e_compress.targets.writer import Writer

CHANNELS_SECOND, CHANNELS_LAST = (0, 3, 1, 2), (0, 2, 3, 1)


def quantize_of(product: ir.Node) -> ir.Node | None:
    """Return the QuantizeLinear that alone reads a product, behind bias and ReLU."""
    if product.op_type == "Conv" or product.inputs[0] is None:
        return None
    reader = sole_reader(end_of(_last_of(product)))
    known = product.inputs[0].shape is not None
    return reader if known and reader and reader.op_type == QUANTIZE else None


def filter_of(product: ir.Node, weight: QuantizedWeight) -> QuantizedWeight:
    """Return the weight of a product as a filter [N, K, 1, 1]."""
    columns_first = product.attributes.get_int("transB", 0)
    matrix = weight.integers if columns_first else weight.integers.T
    integers = np.ascontiguousarray(matrix)[:, :, None, None]
    axis = None if weight.axis is None else 0
    return QuantizedWeight(f"{weight.name}_filter", integers, weight.scales, axis)


def write_convolution(
    writer: Writer, product: ir.Node, quantize: ir.Node, size: tuple[int, int]
) -> ir.Node:
    """Replace a product that only a QuantizeLinear reads by a convolution.

    Given:   q = QuantizeLinear(Relu(Add(MatMul(DequantizeLinear(x), w), b)))
    Result:  q = Reshape(Transpose(QuantizeLinear(Relu(Conv(DequantizeLinear(
                 Transpose(Reshape(x, [1, -1, 1, K]))), w, b)))), [..., N])

    x is uint8 [..., K], ``size`` (N, K). onnxruntime computes with the channels last,
    and so removes both transposes. The filter and the bias of the returned Conv are
    still to be written.
    """
    last = _last_of(product)
    left, weight = product.inputs[:2]
    assert left is not None
    assert left.shape is not None
    assert weight is not None
    integers, *grid = _operands(left.producer())
    old, leading = last.outputs[0], list(left.shape)[:-1]
    name, (columns, depth) = str(old.name), size
    # Every row becomes a pixel, while it is uint8.
    place = Place(writer, last, [product, last])
    pixels = place.reshaped(integers, [1, -1, 1, depth], f"{name}_pixels")
    image = place.turned(pixels, CHANNELS_SECOND, f"{name}_image")
    inputs = [image, *grid]
    numbers = place.node("DequantizeLinear", inputs, f"{name}_image_float").outputs[0]
    numbers.dtype = ir.DataType.FLOAT
    node = place.node("Conv", [numbers, weight, weight], f"{name}_conv")
    replace_value(old, node.outputs[0])
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
    found = biased_end(product) if product.op_type == "MatMul" else None
    return found or product


def _operands(dequantize: ir.Node | None) -> list[ir.Value]:
    """Return the integers, the scale and the zero point of a DequantizeLinear."""
    assert dequantize is not None
    return [each for each in dequantize.inputs if each is not None]
