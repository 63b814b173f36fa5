"""Lower a draft to a graph that onnxruntime runs in int8: pairs, then layers."""

import dataclasses
from collections.abc import Collection, Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import FramesError
from me2e_compress.graph import rewrite
from me2e_compress.targets.onnxruntime.image_blocks import (
    blocks_of,
    filter_of_blocks,
    read_blocks,
)
from me2e_compress.targets.onnxruntime.int8_rewrites import rounded_layers
from me2e_compress.targets.onnxruntime.kernels import has_average_kernel, is_average
from me2e_compress.targets.onnxruntime.layer_forms import write_layer
from me2e_compress.targets.onnxruntime.region import Grid, Region, find_region
from me2e_compress.targets.quantized import QUANTIZE, is_dequantized
from me2e_compress.targets.weights import QuantizedWeight
from me2e_compress.targets.writer import Writer


@dataclasses.dataclass(frozen=True)
class Draft:
    """A float graph, and what of it becomes int8; lowering changes the graph in place.

    ``weights`` and ``sampled`` name layers and sampling operators by their first
    output; ``reach`` is max(|low|, |high|) of the activations whose range is known.
    """

    model: ir.Model
    weights: Mapping[str, QuantizedWeight]
    reach: Mapping[str, float]
    sampled: Collection[str] = ()


def lower(draft: Draft) -> ir.Model:
    """Write the int8 part of a draft into its graph."""
    draft = _with_image_blocks(draft)
    main = draft.model.graph
    region = find_region(main, {*draft.weights, *draft.sampled})
    if missing := [name for name in region.ranged if name not in draft.reach]:
        raise FramesError(
            f"{len(missing)} tensors have no range, the first is {missing[0]}:"
            " onnxruntime's convolutions write uint8, so their outputs are calibrated"
            " too"
        )
    # Choose the grids before the graph changes.
    grids = {
        value: Grid.of(origin, draft.reach[str(origin.name)])
        for value, origin in region.grids.items()
    }
    jobs = [
        (layer, draft.weights[str(layer.outputs[0].name)], grids[value].scale)
        for layer, value in region.layers.items()
    ]
    # Write pairs, then layers; then keep what is float from fusing.
    writer = Writer(main)
    _write_pairs(writer, region, grids)
    for layer, weight, step in jobs:
        write_layer(writer, layer, weight, step)
    _screen_products(writer)
    _screen_averages(writer)
    _screen_float_weights(writer, draft.model)
    rewrite.sweep(draft.model)
    return draft.model


def _with_image_blocks(draft: Draft) -> Draft:
    """Let strided convolutions of images read blocks of pixels as channels."""
    main = draft.model.graph
    weights, reach = dict(draft.weights), dict(draft.reach)
    region = find_region(main, weights)
    writer = Writer(main)
    for layer, image in region.layers.items():
        cut = None if image in region.written else blocks_of(layer)
        if cut is not None:
            name = str(layer.outputs[0].name)
            weights[name] = filter_of_blocks(weights[name], cut)
            blocks = read_blocks(writer, layer, cut)
            # Blocks have the range of their pixels.
            if str(image.name) in reach:
                reach[str(blocks.name)] = reach[str(image.name)]
    return dataclasses.replace(draft, weights=weights, reach=reach)


def _write_pairs(
    writer: Writer, region: Region, grids: Mapping[ir.Value, Grid]
) -> None:
    """Insert a pair after every uint8 tensor, for the kernels of a region to read.

    Other readers of such a tensor keep the float one, if it exists.
    """
    for value, grid in grids.items():
        written = value in region.written
        # A tensor that a kernel writes as uint8 has no float version.
        uses = [
            (use.node, use.idx)
            for use in value.uses()
            if written or region.reads(use.node, use.idx)
        ]
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
    products = [
        node
        for node in writer.graph
        if node.op_type in ("Gemm", "MatMul")
        and all(map(is_dequantized, node.inputs[:2]))
    ]
    for node in products:
        if _would_run_in_float(node):
            _screen(writer, node)


def _screen_averages(writer: Writer) -> None:
    """Insert a Max of one tensor after averages that int8 would compute otherwise.

    Given:   y = QuantizeLinear(AveragePool(DequantizeLinear(x)))
    Result:  y = QuantizeLinear(Max(AveragePool(DequantizeLinear(x))))

    onnxruntime (1.31) fuses the three whatever the pool's attributes are, and moves a
    QuantizeLinear through Reshape, Identity and Clip for it.
    """
    averages = [
        node
        for node in writer.graph
        if is_average(node)
        and is_dequantized(node.inputs[0])
        and not has_average_kernel(node)
    ]
    for node in averages:
        value = node.outputs[0]
        screen = writer.node("Max", [value], f"{value.name}_screened", [node])
        writer.graph.insert_after(node, screen)
        screen.outputs[0].shape, screen.outputs[0].type = value.shape, value.type
        rewrite.replace_value(value, screen.outputs[0])
        screen.replace_input_with(0, value)


def _screen_float_weights(writer: Writer, model: ir.Model) -> None:
    """Insert a Sum of one operand behind layers that stay float between pairs.

    Given:   q = QuantizeLinear(Relu(ConvTranspose(DequantizeLinear(x), w)))
    Result:  q = QuantizeLinear(Sum(Relu(ConvTranspose(DequantizeLinear(x), w))))

    Without it onnxruntime (1.31) rounds the float weight to int8, with one scale in
    all, though it may have no int8 kernel for the layer.
    """
    for layer, quantizer in list(rounded_layers(model)):
        value = quantizer.inputs[0]
        assert value is not None
        node = writer.node("Sum", [value], f"{value.name}_alone", [layer])
        writer.graph.insert_before(quantizer, node)
        node.outputs[0].shape, node.outputs[0].type = value.shape, value.type
        quantizer.replace_input_with(0, node.outputs[0])


def _would_run_in_float(product: ir.Node) -> bool:
    value = product.outputs[0]
    readers = list(value.consumers())
    if any(each.op_type == QUANTIZE for each in readers):
        return len(value.uses()) > 1 or value.is_graph_output()
    if len(readers) != 1:
        return False
    if product.op_type == "MatMul" and readers[0].op_type == "Add":
        return True
    # A Relu or Clip hides the layer, unless only pairs follow.
    clipped = readers[0].outputs[0]
    return readers[0].op_type in ("Relu", "Clip") and (
        clipped.is_graph_output()
        or any(each.op_type != QUANTIZE for each in clipped.consumers())
    )


def _screen(writer: Writer, product: ir.Node) -> None:
    """Insert a Reshape to its own shape between a product and its readers."""
    value = product.outputs[0]
    rank = max(graph.rank_of(each) or 2 for each in product.inputs[:2])
    same = writer.constant(np.zeros(rank, np.int64), f"same_{rank}")
    node = writer.node("Reshape", [value, same], f"{value.name}_screened", [product])
    writer.graph.insert_after(product, node)
    node.outputs[0].shape, node.outputs[0].type = value.shape, value.type
    rewrite.replace_value(value, node.outputs[0])
    node.replace_input_with(0, value)
