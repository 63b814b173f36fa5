"""QuantizeLinear and DequantizeLinear behind every uint8 tensor of a region."""

from collections.abc import Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress import rewrite
from me2e_compress.targets.onnxruntime.grid import Grid
from me2e_compress.targets.onnxruntime.region import Region
from me2e_compress.targets.onnxruntime.writer import Writer


def write_pairs(writer: Writer, region: Region, grids: Mapping[ir.Value, Grid]) -> None:
    """Let the kernels of a region read uint8.

    Whoever else reads such a tensor keeps the float one, unless there is none.

    Args:
        writer: of the graph.
        region: what becomes uint8.
        grids: of every uint8 tensor.
    """
    for value, grid in grids.items():
        born = value in region.born
        uses = [
            (use.node, use.idx)
            for use in value.uses()
            if born or region.reads(use.node, use.idx)
        ]
        producer = value.producer()
        source = producer if born and producer is not None else uses[0][0]
        quantize, dequantize = _pair(writer, value, grid, source)
        if producer is None:
            writer.graph.insert_before(writer.graph[0], [quantize, dequantize])
        else:
            writer.graph.insert_after(producer, [quantize, dequantize])
        for reader, index in uses:
            reader.replace_input_with(index, dequantize.outputs[0])
        if born and value.is_graph_output():
            _hand_over(value, dequantize.outputs[0], quantize)


def _pair(
    writer: Writer, value: ir.Value, grid: Grid, source: ir.Node
) -> tuple[ir.Node, ir.Node]:
    name = str(value.name)
    scale = writer.constant(np.array(grid.scale), f"{name}_scale")
    zero = writer.constant(np.array(grid.zero, np.uint8), f"uint8_{grid.zero}")
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
    """Make the dequantized tensor the output of the graph, under the old name."""
    rewrite.replace_value(value, heir)
    quantize.replace_input_with(0, value)
