"""Let a strided convolution of an image read blocks of pixels as channels.

Given:   y = Conv<strides=[2,2]>(x, w)                  x [N, 3, H, W], w [O, 3, 7, 7]
Result:  y = Conv(SpaceToDepth<blocksize=2>(x), w')                   w' [O, 12, 4, 4]

Both add up the same products; w' has zeros where a block reaches beyond w. onnxruntime
reads the pixels of a QLinearConv in place only if four channels or a multiple of them
lie side by side. With three it copies every window first, and a ResNet's first layer
runs at a quarter of the processor's int8 rate; so at two thirds
(``benchmarks/bench_int8_shapes.py``). ONNX defines the order of the channels under
`SpaceToDepth <https://onnx.ai/onnx/operators/onnx__SpaceToDepth.html>`_.
"""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.graph.shapes import open_shape, static_shape
from me2e_compress.targets.weights import QuantizedWeight
from me2e_compress.targets.writer import BY, Writer

PACKED = 4
"""Channels that onnxruntime's kernel reads at once."""


@dataclasses.dataclass(frozen=True)
class Blocks:
    """How a convolution reads blocks of pixels, along height and width.

    Attributes:
        size: pixels along a side of a block.
        zeros: rows and columns of the new filter before the old one.
        covered: blocks that the new filter covers.
        pads: blocks of padding before and behind the image, in the order of ONNX:
            before height and width, then behind.
    """

    size: int
    zeros: tuple[int, int]
    covered: tuple[int, int]
    pads: tuple[int, int, int, int]


def blocks_of(node: ir.Node) -> Blocks | None:
    """Return the blocks that a convolution can read; None if it should not.

    It must step over fewer than four channels by one stride along both axes, skip no
    pixel, have one group and no dilation, and whole blocks must fill the image.
    """
    if node.op_type != "Conv":
        return None
    image, weight = open_shape(node.inputs[0]), static_shape(node.inputs[1])
    if image is None or weight is None or len(image) != 4 or None in image[1:]:
        return None
    _, channels, *lengths = (dim or 0 for dim in image)
    options = node.attributes
    size, *others = options.get_ints("strides", [1, 1])
    pads = options.get_ints("pads", [0] * 4)
    if (
        channels >= PACKED
        or size < 2
        or others != [size]
        or min(weight[2:]) < size
        or any(length % size for length in lengths)
        or options.get_int("group", 1) != 1
        or set(options.get_ints("dilations", [1])) != {1}
        or options.get_string("auto_pad", "NOTSET") != "NOTSET"
    ):
        return None
    axes = zip(lengths, weight[2:], pads[:2], pads[2:], strict=True)
    sides = [_side(size, *axis) for axis in axes]
    zeros, covered, before, behind = zip(*sides, strict=True)
    return Blocks(size, zeros, covered, (*before, *behind))


def _side(
    size: int, length: int, kernel: int, before: int, behind: int
) -> tuple[int, int, int, int]:
    """Return zeros, and in blocks what is covered and padded, along one axis."""
    first = -(-before // size)
    zeros = first * size - before
    covered = -(-(zeros + kernel) // size)
    steps = (length + before + behind - kernel) // size + 1
    return zeros, covered, first, steps - 1 + covered - first - length // size


def filter_of_blocks(weight: QuantizedWeight, cut: Blocks) -> QuantizedWeight:
    """Return a filter [O, C, k, k] as one over blocks, [O, size * size * C, k', k']."""
    outputs, channels, high, wide = weight.integers.shape
    size, covered = cut.size, cut.covered
    whole = np.zeros((outputs, channels, covered[0] * size, covered[1] * size), np.int8)
    top, left = cut.zeros
    whole[:, :, top : top + high, left : left + wide] = weight.integers
    # A block's pixels come first among the channels, the image's channels last.
    split = whole.reshape(outputs, channels, covered[0], size, covered[1], size)
    integers = split.transpose(0, 3, 5, 1, 2, 4).reshape(outputs, -1, *covered)
    name = f"{weight.name}_blocks"
    return dataclasses.replace(
        weight, name=name, integers=np.ascontiguousarray(integers)
    )


def read_blocks(writer: Writer, node: ir.Node, cut: Blocks) -> ir.Value:
    """Let a convolution read blocks, and return them; its filter is still the old."""
    image = node.inputs[0]
    assert image is not None
    assert image.shape is not None
    name, size = f"{image.name}_blocks", cut.size
    made = writer.node("SpaceToDepth", [image], name, [node], {"blocksize": size})
    blocks = made.outputs[0]
    batch, channels, high, wide = image.shape
    known = [int(str(each)) for each in (channels, high, wide)]
    blocks.shape = ir.Shape(
        [batch, known[0] * size**2, known[1] // size, known[2] // size]
    )
    blocks.type = image.type
    writer.graph.insert_before(node, made)
    # The stride is in the blocks now.
    node.replace_input_with(0, blocks)
    node.attributes.pop("strides", None)
    node.attributes.add(ir.AttrInt64s("kernel_shape", cut.covered))
    node.attributes.add(ir.AttrInt64s("pads", cut.pads))
    provenance.inherit(node, [node], by=BY)
    return blocks
