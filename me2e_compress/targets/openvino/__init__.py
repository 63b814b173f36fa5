"""OpenVINO on the CPU: pairs with zero points 0 on what layers read.

Measured with OpenVINO 2026.4.1 on an AMD EPYC (Zen 4): in this form every planned layer
runs in int8. Of onnxruntime's, it runs the linear layers that are written as
convolutions in float, and refuses a Concat of pairs of which one has a zero point.
"""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.base.errors import GraphError
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph.shapes import CONVOLUTIONS, PRODUCTS
from me2e_compress.quantization.decision import QuantPlan
from me2e_compress.quantization.plan import tensors_of
from me2e_compress.runtime.openvino import OpenVinoProvider
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets import LintFinding, LintRule, Target, error
from me2e_compress.targets.onnxruntime.region import never_negative
from me2e_compress.targets.openvino.lint_rules import RULES, is_joined
from me2e_compress.targets.quantized import POSITIVE, SHIFTED, place_pairs


@dataclasses.dataclass(frozen=True)
class OpenVino(Target):
    """OpenVINO's CPU plugin, by its ONNX frontend and low-precision passes."""

    name: ClassVar[str] = "openvino"
    runs_in: ClassVar[str] = "openvino"

    def tensors(self, plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
        """List the inputs of weighted layers and residual branches."""
        return tensors_of(plan, model)

    def place(self, model: ir.Model, plan: QuantPlan, ranges: Ranges) -> ir.Model:
        """Return a copy of a graph in which the plan's nodes read int8.

        Tensors that are never negative are uint8, unless a Concat joins them with one
        that is: one scale for all keeps it int8. Behind a Concat a convolution reads
        uint8 with zero point 128.
        """
        self.check_types(plan, model)
        values = {str(e.name): e for node in model.graph for e in node.outputs}
        asked = [name for name in self.tensors(plan, model) if name in values]
        positive = {name for name in asked if never_negative(values[name])}
        for group in plan.groups:
            if not positive.issuperset(group.tensors):
                positive.difference_update(group.tensors)
        codes = {
            name: POSITIVE if name in positive else SHIFTED
            for name in asked
            if name in positive or _convolved(values[name])
        }
        return place_pairs(model, plan, ranges, codes)

    def fused_objection(self, node: ir.Node) -> str | None:
        """Return None: compiled kernels read int8 directly."""
        return None

    def lint_rules(self) -> tuple[LintRule, ...]:
        """Return the rules of its frontend and its int8."""
        return RULES

    def read_back(
        self, model: ir.Model, provider: Provider = CPU
    ) -> tuple[LintFinding, ...]:
        """Open a graph where OpenVINO is installed, and say why it is refused."""
        runner = (
            provider if isinstance(provider, OpenVinoProvider) else OpenVinoProvider()
        )
        if not runner.is_installed():
            return ()
        try:
            runner.open(model, 1, int8_kernels=True)
        except GraphError as refusal:
            return (error("refused", None, str(refusal)),)
        return ()


def _convolved(value: ir.Value) -> bool:
    """Return whether convolutions, and no products, read what a Concat made."""
    # There int8 is wrong by 11 dB; in front of a MatMul a zero point is refused
    readers = {reader.op_type for reader in value.consumers()}
    convolved = not readers.isdisjoint(CONVOLUTIONS) and readers.isdisjoint(PRODUCTS)
    return convolved and is_joined(value)
