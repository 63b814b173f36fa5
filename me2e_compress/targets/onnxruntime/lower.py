"""Lower a draft to a graph that onnxruntime runs in int8: pairs, then layers."""

import dataclasses
from collections.abc import Collection, Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress import rewrite
from me2e_compress.errors import FramesError
from me2e_compress.targets.onnxruntime.layer_forms import write_layer
from me2e_compress.targets.onnxruntime.region import Grid, Region, find_region
from me2e_compress.targets.onnxruntime.screens import screen_products
from me2e_compress.targets.onnxruntime.writer import Writer
from me2e_compress.targets.weights import QuantizedWeight


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
    # Write pairs, then layers; then keep products from fusing.
    writer = Writer(main)
    _write_pairs(writer, region, grids)
    for layer, weight, step in jobs:
        write_layer(writer, layer, weight, step)
    screen_products(writer)
    rewrite.sweep(draft.model)
    return draft.model


def _write_pairs(
    writer: Writer, region: Region, grids: Mapping[ir.Value, Grid]
) -> None:
    """Insert a pair after every uint8 tensor, for the kernels of a region to read.

    Other readers of such a tensor keep the float one, if it exists.
    """
    for value, grid in grids.items():
        born = value in region.born
        # A tensor that a kernel writes as uint8 has no float version.
        uses = [
            (use.node, use.idx)
            for use in value.uses()
            if born or region.reads(use.node, use.idx)
        ]
        producer = value.producer()
        source = producer if born and producer is not None else uses[0][0]
        # Insert the pair, and reconnect the readers.
        quantize, dequantize = _pair(writer, value, grid, source)
        if producer is None:
            writer.graph.insert_before(writer.graph[0], [quantize, dequantize])
        else:
            writer.graph.insert_after(producer, [quantize, dequantize])
        for reader, index in uses:
            reader.replace_input_with(index, dequantize.outputs[0])
        # A graph output keeps its name.
        if born and value.is_graph_output():
            _hand_over(value, dequantize.outputs[0], quantize)


def _pair(
    writer: Writer, value: ir.Value, grid: Grid, source: ir.Node
) -> tuple[ir.Node, ir.Node]:
    name = str(value.name)
    scale = writer.constant(np.array(grid.scale), f"{name}_scale")
    zero = writer.constant(np.array(grid.zero, np.uint8), f"uint8_{grid.zero}")
    # Both nodes share scale and zero point.
    quantize = writer.node(
        "QuantizeLinear", [value, scale, zero], f"{name}_uint8", [source]
    )
    dequantize = writer.node(
        "DequantizeLinear",
        [quantize.outputs[0], scale, zero],
        f"{name}_float",
        [source],
    )
    quantize.outputs[0].dtype = ir.DataType.UINT8
    dequantize.outputs[0].dtype = ir.DataType.FLOAT
    quantize.outputs[0].shape = dequantize.outputs[0].shape = value.shape
    return quantize, dequantize


def _hand_over(value: ir.Value, heir: ir.Value, quantize: ir.Node) -> None:
    """Make the dequantized tensor the graph output, under the old name."""
    rewrite.replace_value(value, heir)
    quantize.replace_input_with(0, value)
