"""TensorRT: int8 as explicit, symmetric QDQ pairs.

The rules (TensorRT 10 developer guide, "Explicit quantization", and its ONNX parser):
zero points are 0; activations have one scale a tensor, weights one a channel, batches
of matrices one; weights are stored as int8 before a DequantizeLinear; biases and
outputs have no pair, and of an Add only the residual branch has one; all int8 readers
of a tensor share one pair, all float readers read the tensor itself.
"""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.calibration.observers import scale_of
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import input_at, is_standard, nodes_of, rewrite, static_shape
from me2e_compress.operators import find, int8_inputs
from me2e_compress.quantization.decision import Decision, QuantPlan
from me2e_compress.quantization.plan import share_scales, tensors_of
from me2e_compress.targets import LintFinding, LintRule, Target
from me2e_compress.targets.quantized import Writer, is_in_a_pair
from me2e_compress.targets.tensorrt.lint.support import rules, version_of
from me2e_compress.targets.weights import (
    QuantizedWeight,
    bias_by_channel,
    least_scales,
    requantized,
    scales_in,
    weights_of,
    with_room,
)


@dataclasses.dataclass(frozen=True)
class TensorRT(Target):
    """NVIDIA's engine builder, by its ONNX parser and explicit quantization.

    Attributes:
        version: of TensorRT, such as ``10.13``, whose tables :meth:`lint` asks; empty
            warns of what 10.1 did not take.
    """

    name: ClassVar[str] = "tensorrt"
    half_since: ClassVar[int | None] = 19
    version: str = ""

    def __post_init__(self) -> None:
        if self.version:
            version_of(self.version)

    def tensors(self, plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
        """List the inputs of weighted layers and residual branches."""
        return tensors_of(plan, model)

    def place(self, model: ir.Model, plan: QuantPlan, ranges: Ranges) -> ir.Model:
        """Return a copy of a graph in which the plan's nodes read int8.

        Every activation that the plan reads gets a QuantizeLinear and a
        DequantizeLinear (int8, zero point 0, scale = max(|low|, |high|) / 127); weights
        become int8 initializers before a DequantizeLinear.
        """
        self.check_types(plan, model)
        weights = weights_of(model, plan.chosen, balanced=plan.balanced)
        copy, shared = model.clone(), share_scales(plan, ranges)
        nodes = {str(node.outputs[0].name): node for node in copy.graph}
        weights = _with_room(weights, nodes, shared)
        pairs = _Pairs(copy.graph, shared)
        for decision in plan.chosen:
            pairs.apply(nodes[decision.output], decision, weights.get(decision.output))
        rewrite.sweep(copy)
        return copy

    def fused_objection(self, node: ir.Node) -> str | None:
        """Explain why a plugin gets no int8: most support float only."""
        # A pair before those would run as separate kernels. In explicit quantization a
        # plugin gets the int8 directly, and its scale as an input (SparseDriveV2);
        # BEVFormer_tensorrt's plugins expect it by implicit quantization.
        plugin = find(node)
        if plugin is None or ir.DataType.INT8 not in plugin[1].operands[0].types:
            return f"the plugin {node.op_type} takes float32 or float16 alone"
        # The scale must be an input that is not set yet.
        scale, shape = plugin[1].int8_scale, static_shape(node.inputs[0])
        if scale is None:
            return f"the plugin {node.op_type} gets the scale of int8 not by QDQ"
        if shape is None or input_at(node, scale) is not None:
            return "its features are int8 already, or of open size"
        return None

    def lint_rules(self) -> tuple[LintRule, ...]:
        """Return the rules of its parser and of explicit quantization."""
        return rules(version_of(self.version) if self.version else None)

    def lint(self, model: ir.Model) -> tuple[LintFinding, ...]:
        """List all findings, as if no Clip stood between the nodes of a pair."""
        # brevitas writes one there. TensorRT-RTX 1.7 builds int8 kernels of it, for
        # weights in float, activations and narrow ranges (measured).
        copy = model.clone()
        copy.meta.update(model.meta)
        for node in list(nodes_of(copy)):
            if node.op_type == "Clip" and is_standard(node) and is_in_a_pair(node):
                for reader, index in tuple(node.outputs[0].uses()):
                    reader.replace_input_with(index, node.inputs[0])
                assert node.graph is not None
                node.graph.remove(node)
        return super().lint(copy)


def _with_room(
    weights: Mapping[str, QuantizedWeight], nodes: Mapping[str, ir.Node], ranges: Ranges
) -> dict[str, QuantizedWeight]:
    """Leave room for the biases: TensorRT keeps them in float, onnxruntime does not."""
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

    def __init__(self, where: ir.Graph, ranges: Ranges) -> None:
        self._write = Writer(where, share=False)
        self._ranges = ranges
        self._activations: dict[str, ir.Value] = {}
        self._weights: dict[tuple[str, int | None], ir.Value] = {}
        self._zero: ir.Value | None = None

    def apply(
        self, node: ir.Node, decision: Decision, weight: QuantizedWeight | None
    ) -> None:
        """Rewrite one node to read int8."""
        # Fused operators get integers; layers get pairs and weights.
        if reads := int8_inputs(node):
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
            step = scales_in(exact, _numpy(value))
            scale = self._write.constant(step, f"{name}_scale")
            if self._zero is None:
                self._zero = self._write.constant(np.array(0, np.int8), "int8_zero")
            names = f"{name}_QuantizeLinear", f"{name}_DequantizeLinear"
            _, dequantize = self._write.pair(value, [scale, self._zero], names, reader)
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
