"""TensorRT: int8 as explicit, symmetric QDQ, and what its parser would say of it."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.quantization.plan import QuantPlan
from me2e_compress.targets.base import LintRule, Target
from me2e_compress.targets.tensorrt.lint import RULES
from me2e_compress.targets.tensorrt.place import place, tensors

__all__ = ["TensorRT", "place", "tensors"]


@dataclasses.dataclass(frozen=True)
class TensorRT(Target):
    """NVIDIA's engine builder, by its ONNX parser and explicit quantization."""

    name: ClassVar[str] = "tensorrt"

    def tensors(self, plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
        """Name what weighted layers and residual branches read."""
        return tensors(plan, model)

    def place(self, model: ir.Model, plan: QuantPlan, ranges: Ranges) -> ir.Model:
        """Put a pair of QuantizeLinear and DequantizeLinear before what reads int8."""
        return place(model, plan, ranges)

    def lint_rules(self) -> tuple[LintRule, ...]:
        """Return the rules of its parser and of explicit quantization."""
        return RULES
