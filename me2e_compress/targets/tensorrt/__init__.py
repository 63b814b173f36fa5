"""TensorRT: int8 as explicit, symmetric QDQ pairs.

The rules (TensorRT 10 developer guide, "Explicit quantization", and its ONNX parser):
zero points are 0; activations have one scale a tensor, weights one a channel, batches
of matrices one; weights are stored as int8 before a DequantizeLinear; biases and
outputs have no pair, and of an Add only the residual branch has one; all int8 readers
of a tensor share one pair, all float readers read the tensor itself.
"""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import input_at, is_standard, nodes_of, static_shape
from me2e_compress.operators import find
from me2e_compress.quantization.decision import QuantPlan
from me2e_compress.quantization.plan import tensors_of
from me2e_compress.targets import LintFinding, LintRule, Target
from me2e_compress.targets.quantized import is_in_a_pair, place_pairs
from me2e_compress.targets.tensorrt.lint.support import rules, version_of


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
        return place_pairs(model, plan, ranges)

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
