"""Lower a draft to a graph that onnxruntime runs in int8: pairs, then layers.

Let a strided convolution of an image read blocks of pixels as channels.

Given:   y = Conv<strides=[2,2]>(x, w)                  x [N, 3, H, W], w [O, 3, 7, 7]
Result:  y = Conv(SpaceToDepth<blocksize=2>(x), w')                   w' [O, 12, 4, 4]

Both add up the same products; w' has zeros where a block reaches beyond w. onnxruntime
reads the pixels of a QLinearConv in place only if four channels or a multiple of them
lie side by side. With three it copies every window first, and a ResNet's first layer
runs at a quarter of the processor's int8 rate; so at two thirds
(``benchmarks/measure/int8_shapes.py``). ONNX defines the order of the channels under
`SpaceToDepth <https://onnx.ai/onnx/operators/onnx__SpaceToDepth.html>`_.
"""

import dataclasses
from collections.abc import Collection, Mapping
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import FramesError
from me2e_compress.graph import provenance, rewrite
from me2e_compress.graph.shapes import open_shape, static_shape
from me2e_compress.targets.onnxruntime.layer_forms import write_layer
from me2e_compress.targets.onnxruntime.lint_rules import rounded_layers
from me2e_compress.targets.onnxruntime.region import (
    Grid,
    Region,
    find_region,
    has_average_kernel,
    is_average,
    is_move,
)
from me2e_compress.targets.quantized import BY, QUANTIZE, Writer, is_dequantized
from me2e_compress.targets.weights import QuantizedWeight

PACKED = 4  # channels that onnxruntime's kernel reads at once


@dataclasses.dataclass(frozen=True)
class Blocks:
    """How a convolution reads blocks of pixels, along height and width."""

    size: int  # pixels along a side of a block
    zeros: tuple[int, int]  # rows and columns of the new filter before the old one
    covered: tuple[int, int]  # blocks that the new filter covers
    pads: tuple[int, int, int, int]  # blocks around the image, in the order of ONNX


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
    # Along each axis: zeros, and in blocks what is covered and padded. The filter
    # begins `zeros` pixels into a block, so that before + zeros are whole blocks
    sides = []
    axes = zip(lengths, weight[2:], pads[:2], pads[2:], strict=True)
    for length, kernel, before, behind in axes:
        first = -(-before // size)
        zeros = first * size - before
        covered = -(-(zeros + kernel) // size)
        steps = (length + before + behind - kernel) // size + 1
        last = steps - 1 + covered - first - length // size
        sides.append((zeros, covered, first, last))
    (top, left), covers, firsts, lasts = zip(*sides, strict=True)
    return Blocks(size, (top, left), covers, (*firsts, *lasts))


def filter_of_blocks(weight: QuantizedWeight, cut: Blocks) -> QuantizedWeight:
    """Return a filter [O, C, k, k] as one over blocks, [O, size * size * C, k', k']."""
    outputs, channels, high, wide = weight.integers.shape
    size, covered = cut.size, cut.covered
    whole = np.zeros((outputs, channels, covered[0] * size, covered[1] * size), np.int8)
    top, left = cut.zeros
    whole[:, :, top : top + high, left : left + wide] = weight.integers
    # A block's pixels come first among the channels, the image's channels last
    split = whole.reshape(outputs, channels, covered[0], size, covered[1], size)
    blocks = split.transpose(0, 3, 5, 1, 2, 4).reshape(outputs, -1, *covered)
    integers, name = np.ascontiguousarray(blocks), f"{weight.name}_blocks"
    return dataclasses.replace(weight, name=name, integers=integers)


def read_blocks(writer: Writer, node: ir.Node, cut: Blocks) -> ir.Value:
    """Let a convolution read blocks, and return them; its filter is still the old."""
    image, size = node.inputs[0], cut.size
    assert image is not None
    assert image.shape is not None
    name = f"{image.name}_blocks"
    made = writer.node("SpaceToDepth", [image], name, [node], {"blocksize": size})
    blocks = made.outputs[0]
    batch, *dims = image.shape
    channels, high, wide = (int(str(dim)) for dim in dims)
    blocks.shape = ir.Shape([batch, channels * size**2, high // size, wide // size])
    blocks.type = image.type
    writer.graph.insert_before(node, made)
    # The stride is in the blocks now
    node.replace_input_with(0, blocks)
    node.attributes.pop("strides", None)
    node.attributes.add(ir.AttrInt64s("kernel_shape", cut.covered))
    node.attributes.add(ir.AttrInt64s("pads", cut.pads))
    provenance.inherit(node, [node], by=BY)
    return blocks


# The low and the high bound of tensors by name
Bounds: TypeAlias = Mapping[str, tuple[float, float]]


@dataclasses.dataclass(frozen=True)
class Draft:
    """A float graph, and what of it becomes int8; lowering changes the graph in place.

    ``weights`` and ``sampled`` name layers and sampling operators by their first
    output; ``ranges`` has low and high of the activations whose range is known.
    """

    model: ir.Model
    weights: Mapping[str, QuantizedWeight]
    ranges: Bounds
    sampled: Collection[str] = ()


def symmetric(ranges: Bounds) -> Bounds:
    """Widen ranges to plus and minus their largest magnitude."""
    reach = {name: max(-low, high) for name, (low, high) in ranges.items()}
    return {name: (-largest, largest) for name, largest in reach.items()}


def lower(draft: Draft) -> ir.Model:
    """Write the int8 part of a draft into its graph."""
    draft = _with_image_blocks(draft)
    main = draft.model.graph
    region = find_region(main, {*draft.weights, *draft.sampled})
    if missing := [name for name in region.ranged if name not in draft.ranges]:
        raise FramesError(
            f"{len(missing)} tensors have no range, the first is {missing[0]}:"
            " onnxruntime's convolutions write uint8, so their outputs are calibrated"
            " too"
        )
    # Choose the grids before the graph changes.
    grids = {
        value: Grid.of(origin, *draft.ranges[str(origin.name)])
        for value, origin in region.grids.items()
    }
    # Write pairs, then layers; then keep what is float from fusing
    writer = Writer(main)
    layers = {layer: str(layer.outputs[0].name) for layer in region.layers}
    _write_pairs(writer, region, grids)
    for layer, name in layers.items():
        step = grids[region.layers[layer]].scale
        write_layer(writer, layer, draft.weights[name], step)
    _screen_products(writer)
    _screen_others(writer, draft.model)
    rewrite.sweep(draft.model)
    return draft.model


def _with_image_blocks(draft: Draft) -> Draft:
    """Let strided convolutions of images read blocks of pixels as channels."""
    main = draft.model.graph
    weights, ranges = dict(draft.weights), dict(draft.ranges)
    region = find_region(main, weights)
    writer = Writer(main)
    for layer, image in region.layers.items():
        cut = None if image in region.written else blocks_of(layer)
        if cut is not None:
            name = str(layer.outputs[0].name)
            weights[name] = filter_of_blocks(weights[name], cut)
            blocks = read_blocks(writer, layer, cut)
            # Blocks have the range of their pixels.
            if str(image.name) in ranges:
                ranges[str(blocks.name)] = ranges[str(image.name)]
    return dataclasses.replace(draft, weights=weights, ranges=ranges)


def _write_pairs(
    writer: Writer, region: Region, grids: Mapping[ir.Value, Grid]
) -> None:
    """Insert a pair after every uint8 tensor, for the kernels of a region to read."""
    # Other readers of such a tensor keep the float one, if it exists
    for value, grid in grids.items():
        written = value in region.written
        # A tensor that a kernel writes as uint8 has no float version.
        pairs = [(use.node, use.idx) for use in value.uses()]
        uses = [pair for pair in pairs if written or region.reads(*pair)]
        producer = value.producer()
        source = producer if written and producer is not None else uses[0][0]
        # Insert the pair, and reconnect the readers.
        name = str(value.name)
        constants = (
            writer.constant(np.array(grid.scale), f"{name}_scale"),
            writer.constant(np.array(grid.zero, np.uint8), f"uint8_{grid.zero}"),
        )
        names = f"{name}_uint8", f"{name}_float"
        quantize, dequantize = writer.pair(value, constants, names, source)
        for reader, index in uses:
            reader.replace_input_with(index, dequantize.outputs[0])
        # A graph output keeps its name.
        if written and value.is_graph_output():
            rewrite.replace_value(value, dequantize.outputs[0])
            quantize.replace_input_with(0, value)


def _screen_products(writer: Writer) -> None:
    """Insert a Reshape without effect after products that would run in float.

    Given:   y = Relu(Gemm(DequantizeLinear(x), DequantizeLinear(w)))
    Result:  y = Relu(Reshape(Gemm(DequantizeLinear(x), DequantizeLinear(w)), [0, 0]))

    onnxruntime (1.31) silently finds no int8 kernel for a Gemm or MatMul,

    * whose only reader is a Relu or Clip that something else than a QuantizeLinear
      reads: it looks for the QuantizeLinear after that one, or fuses the two;
    * that both a QuantizeLinear and something else read;
    * that is a MatMul whose only reader is an Add: the two become a float Gemm first.

    Convolutions are not affected: their output is read only through its pair.
    """
    for node in list(writer.graph):
        if node.op_type not in ("Gemm", "MatMul"):
            continue
        if not all(map(is_dequantized, node.inputs[:2])):
            continue
        # Does onnxruntime overlook the layer?
        value = node.outputs[0]
        readers = list(value.consumers())
        if any(reader.op_type == QUANTIZE for reader in readers):
            hidden = len(value.uses()) > 1 or value.is_graph_output()
        elif len(readers) != 1:
            hidden = False
        elif node.op_type == "MatMul" and readers[0].op_type == "Add":
            hidden = True
        else:
            # A Relu or Clip hides the layer, unless only pairs follow.
            clipped = readers[0].outputs[0]
            hidden = readers[0].op_type in ("Relu", "Clip") and (
                clipped.is_graph_output()
                or any(other.op_type != QUANTIZE for other in clipped.consumers())
            )
        if hidden:
            rank = max(graph.rank_of(operand) or 2 for operand in node.inputs[:2])
            same = writer.constant(np.zeros(rank, np.int64), f"same_{rank}")
            _screen(writer, "Reshape", node, same)


def _screen_others(writer: Writer, model: ir.Model) -> None:
    """Keep pools and float weights between pairs from what int8 would make of them.

    Given:   y = QuantizeLinear(AveragePool(DequantizeLinear(x)))
    Result:  y = QuantizeLinear(Max(AveragePool(DequantizeLinear(x))))

    onnxruntime (1.31) fuses the three whatever the pool's attributes are, and moves a
    QuantizeLinear through Reshape, Identity and Clip for it. It moves one in front of a
    MaxPool, too, which then takes ten times as long if no QLinearConv wrote its uint8.

    Given:   q = QuantizeLinear(Relu(ConvTranspose(DequantizeLinear(x), w)))
    Result:  q = QuantizeLinear(Sum(Relu(ConvTranspose(DequantizeLinear(x), w))))

    Without it onnxruntime (1.31) rounds the float weight to int8, with one scale in
    all, though it may have no int8 kernel for the layer.
    """
    # Averages whose kernel computes something else, and MaxPools of float
    for node in list(writer.graph):
        if is_dequantized(graph.input_at(node, 0)):
            hidden = is_average(node) and not has_average_kernel(node)
        else:
            hidden = node.op_type == "MaxPool" and _is_quantized(node.outputs[0])
        if hidden:
            _screen(writer, "Max", node)
    # Float weights between pairs
    for layer, quantizer in list(rounded_layers(model)):
        value = quantizer.inputs[0]
        assert value is not None
        node = writer.node("Sum", [value], f"{value.name}_alone", [layer])
        writer.graph.insert_before(quantizer, node)
        node.outputs[0].shape, node.outputs[0].type = value.shape, value.type
        quantizer.replace_input_with(0, node.outputs[0])


def _is_quantized(value: ir.Value) -> bool:
    """Return whether a QuantizeLinear reads a value, itself or moved."""
    readers = list(value.consumers())
    return any(node.op_type == QUANTIZE for node in readers) or any(
        _is_quantized(node.outputs[0]) for node in readers if is_move(node)
    )


def _screen(writer: Writer, op: str, layer: ir.Node, *more: ir.Value) -> None:
    """Insert a node without effect between a layer and its readers."""
    value = layer.outputs[0]
    node = writer.node(op, [value, *more], f"{value.name}_screened", [layer])
    writer.graph.insert_after(layer, node)
    node.outputs[0].shape, node.outputs[0].type = value.shape, value.type
    rewrite.replace_value(value, node.outputs[0])
    node.replace_input_with(0, value)
