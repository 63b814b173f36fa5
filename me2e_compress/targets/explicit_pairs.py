"""Int8 as explicit QDQ pairs with zero points 0, on what layers read.

Activations have one scale a tensor, weights one a channel, batches of matrices one;
weights are stored as int8 before a DequantizeLinear; biases and outputs have no pair,
and of an Add only the residual branch has one; all int8 readers of a tensor share one
pair, all float readers read the tensor itself.
"""

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.calibration.observers import scale_of
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import rewrite, static_shape
from me2e_compress.operators import find, int8_inputs
from me2e_compress.quantization.decision import Decision, QuantPlan
from me2e_compress.quantization.plan import share_scales
from me2e_compress.targets.quantized import Writer
from me2e_compress.targets.weights import (
    QuantizedWeight,
    bias_by_channel,
    least_scales,
    requantized,
    scales_in,
    weights_of,
    with_room,
)

# What multiplies the scale of the symmetric int8 grid, and the zero point
Codes: TypeAlias = tuple[float, np.int8 | np.uint8]
SIGNED: Codes = 1.0, np.int8(0)
POSITIVE: Codes = 127 / 255, np.uint8(0)
"""For tensors without negative numbers: twice the steps."""
SHIFTED: Codes = 1.0, np.uint8(128)
"""The grid of `SIGNED`, as uint8."""


def place_pairs(
    model: ir.Model,
    plan: QuantPlan,
    ranges: Ranges,
    codes: Mapping[str, Codes] | None = None,
) -> ir.Model:
    """Return a copy of a graph in which the plan's nodes read int8.

    Every activation that the plan reads gets a QuantizeLinear and a DequantizeLinear
    (int8, zero point 0, scale = max(|low|, |high|) / 127), or those of its ``codes``.
    Without any, fused operators read integers, as a plugin does.
    """
    weights = weights_of(model, plan.chosen, balanced=plan.balanced)
    copy, shared = model.clone(), share_scales(plan, ranges)
    nodes = {str(node.outputs[0].name): node for node in copy.graph}
    weights = _with_room(weights, nodes, shared)
    pairs = _Pairs(copy.graph, shared, codes)
    for decision in plan.chosen:
        pairs.apply(nodes[decision.output], decision, weights.get(decision.output))
    rewrite.sweep(copy)
    return copy


def _with_room(
    weights: Mapping[str, QuantizedWeight], nodes: Mapping[str, ir.Node], ranges: Ranges
) -> dict[str, QuantizedWeight]:
    """Leave room for the biases: onnxruntime makes int32 of them, others do not."""
    # Layers that share a weight share its scales, so the largest of their least ones
    least: dict[tuple[str, int | None], npt.NDArray[np.float64]] = {}
    for output, weight in weights.items():
        value = nodes[output].inputs[0]
        known = None if value is None else ranges.tensors.get(str(value.name))
        channels = None if weight.axis is None else weight.scales.size
        bias = bias_by_channel(nodes[output], channels)
        if bias is None or known is None:
            continue
        key = weight.name, weight.axis
        wanted = least_scales(bias, scale_of(*known))
        least[key] = np.maximum(wanted, least.get(key, 0.0))
    raised = dict(weights)
    for output, weight in weights.items():
        if (scales := least.get((weight.name, weight.axis))) is not None:
            raised[output] = with_room(weight, scales)
    return raised


class _Pairs:
    """Writes pairs into one graph, once for each tensor and each weight."""

    def __init__(
        self, where: ir.Graph, ranges: Ranges, codes: Mapping[str, Codes] | None
    ) -> None:
        self._write = Writer(where, share=False)
        self._ranges, self._codes = ranges, codes
        self._activations: dict[str, ir.Value] = {}
        self._weights: dict[tuple[str, int | None], ir.Value] = {}
        self._zeros: dict[str, ir.Value] = {}

    def apply(
        self, node: ir.Node, decision: Decision, weight: QuantizedWeight | None
    ) -> None:
        """Rewrite one node to read int8."""
        # A plugin gets integers; layers, and our kernels, get pairs and weights.
        if self._codes is None and (reads := int8_inputs(node)):
            self._connect_integers(node, reads[0])
            return
        for index in decision.activations:
            value = node.inputs[index]
            if value is not None:
                node.replace_input_with(index, self._activation(value, node))
        at = decision.weight
        like = None if at is None else node.inputs[at]
        if weight is not None and at is not None and like is not None:
            node.replace_input_with(at, self._weight(weight, like, node))

    def _connect_integers(self, plugin: ir.Node, index: int) -> None:
        """Let a plugin read integers, with their scale for every channel."""
        value, known = plugin.inputs[index], find(plugin)
        at = None if known is None else known[1].int8_scale
        channels = (static_shape(value) or ())[-1:]
        if value is None or at is None or not channels:
            return
        dequantize = self._activation(value, plugin).producer()
        if dequantize is None:
            return
        # The plugin reads the integers before the DequantizeLinear.
        plugin.replace_input_with(index, dequantize.inputs[0])
        step = scale_of(*self._ranges.tensors[str(value.name)])
        scales = self._write.constant(np.full(channels, step), f"{value.name}_scales")
        plugin.resize_inputs(at + 1)
        plugin.replace_input_with(at, scales)

    def _activation(self, value: ir.Value, reader: ir.Node) -> ir.Value:
        """Return the dequantized tensor that all int8 readers of a value share."""
        name = str(value.name)
        if name not in self._activations:
            exact = np.array(scale_of(*self._ranges.tensors[name]))
            factor, code = (self._codes or {}).get(name, SIGNED)
            step = scales_in(exact * np.float32(factor), _numpy(value))
            scale = self._write.constant(step, f"{name}_scale")
            stored = f"{code.dtype}_{code}" if code else f"{code.dtype}_zero"
            if stored not in self._zeros:
                self._zeros[stored] = self._write.constant(np.array(code), stored)
            names = f"{name}_QuantizeLinear", f"{name}_DequantizeLinear"
            grid = [scale, self._zeros[stored]]
            _, dequantize = self._write.pair(value, grid, names, reader)
            self._activations[name] = dequantize.outputs[0]
        return self._activations[name]

    def _weight(
        self, weight: QuantizedWeight, like: ir.Value, reader: ir.Node
    ) -> ir.Value:
        """Return the dequantized weight that all its readers share."""
        key = weight.name, weight.axis
        if key not in self._weights:
            scales = scales_in(weight.scales, _numpy(like))
            self._weights[key] = self._write.dequantized(
                weight.name,
                requantized(weight.integers, weight.scales, scales, weight.axis),
                scales,
                weight.axis,
                reader,
                f"{weight.name}_DequantizeLinear",
            )
        return self._weights[key]


def _numpy(value: ir.Value) -> np.dtype[np.generic]:
    """Return the type of a tensor's scale: its own, float32 if unknown."""
    return np.dtype(np.float32) if value.dtype is None else value.dtype.numpy()
