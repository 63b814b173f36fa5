"""Find the convolutions that Winograd's algorithm runs faster than a direct one."""

import math

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import array_of, static_shape
from me2e_compress.graph.nodes import input_at, is_standard, sole_maker, sole_reader
from me2e_compress.operators import OWN_DOMAIN, FusedCall

# Nanoseconds per multiply-accumulate of onnxruntime's Conv. This and the numbers below
# are fitted to ResNet-50's and -34's layers, 64 to 512 channels, on one core of an AMD
# Zen 5.
_DIRECT = 1 / 130

# Nanoseconds per multiply-accumulate of the kernel, a quarter as many.
_PRODUCT = 1 / 115

# Nanoseconds per number read or written: for the transforms, and for onnxruntime to
# reorder it from and to the layout of the convolutions around.
_NUMBER = 0.9

# Nanoseconds per number of a shortcut, which onnxruntime adds in its own Conv.
_SUM = 0.7

# Nanoseconds per filter of one channel, for its transform.
_FILTER = 20.0

# What the kernel may take of the time of a Conv.
_WORTH = 0.95


def fuse_convolution(node: ir.Node, call: FusedCall) -> ir.Value | None:
    """Fuse a Conv, unless a Relu alone reads it, with which it is fused."""
    reader = sole_reader(node.outputs[0])
    if reader is not None and reader.op_type == "Relu" and is_standard(reader):
        return None
    return _fused(node, call, relu=0)


def fuse_rectified_convolution(node: ir.Node, call: FusedCall) -> ir.Value | None:
    """Fuse a Relu with the Conv in front that nothing else reads."""
    convolution = sole_maker(node.inputs[0], "Conv")
    return None if convolution is None else _fused(convolution, call, relu=1)


def _fused(node: ir.Node, call: FusedCall, *, relu: int) -> ir.Value | None:
    image, weight = node.inputs[0], node.inputs[1]
    # Only kernels of 3x3 float32 at stride 1, of one group
    pads = _pads(node)
    filters = array_of(weight)
    if image is None or weight is None or filters is None or pads is None:
        return None
    if filters.dtype != np.float32 or filters.shape[2:] != (3, 3):
        return None
    shape, made = static_shape(image), static_shape(node.outputs[0])
    if shape is None or made is None:
        raise PreconditionError("the size of its image is not known")
    if not _pays(shape, made, shortcut=_shortcut(node)):
        return None
    # Write the fused node; its kernel always adds a bias
    bias = input_at(node, 2)
    if bias is None:
        bias = call.constant(np.zeros(filters.shape[0], np.float32), "bias")
    inputs = [image, weight, bias]
    options: dict[str, int | list[int]] = {"pads": pads, "relu": relu}
    result = call.add("WinogradConvolution", inputs, options, domain=OWN_DOMAIN)
    result.shape, result.type = ir.Shape(made), ir.TensorType(ir.DataType.FLOAT)
    return result


def _pads(node: ir.Node) -> list[int] | None:
    """Return the pads of a Conv at stride 1, of one group; None for all others."""
    read = node.attributes
    steps = {*read.get_ints("strides", ()), *read.get_ints("dilations", ())}
    if steps - {1} or read.get_int("group", 1) != 1:
        return None
    if read.get_string("auto_pad", "NOTSET") != "NOTSET":
        return None
    return list(read.get_ints("pads", (0, 0, 0, 0)))


def _shortcut(node: ir.Node) -> bool:
    """Return whether only an Add reads a Conv, and adds no constant to it."""
    reader = sole_reader(node.outputs[0])
    if reader is None or reader.op_type != "Add" or not is_standard(reader):
        return False
    return all(array_of(value) is None for value in reader.inputs)


def _pays(image: tuple[int, ...], made: tuple[int, ...], *, shortcut: bool) -> bool:
    """Return whether the kernel is faster, by the measured times."""
    (batch, deep, *_), (_, out, high, wide) = image, made
    # Whole tiles of 4 x 4, all of them in whole blocks of 48
    tiles = batch * math.ceil(high / 4) * math.ceil(wide / 4)
    products = 36 * deep * out * 48 * math.ceil(tiles / 48)
    moved = _NUMBER * (math.prod(image) + math.prod(made))
    added = _SUM * math.prod(made) if shortcut else 0
    ours = _PRODUCT * products + moved + added + _FILTER * deep * out
    return ours < _WORTH * _DIRECT * 9 * deep * math.prod(made)
