"""onnxruntime on the CPU: int8 where it has kernels for it, and in their form."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.quantization.plan import KeptFloat, QuantPlan
from me2e_compress.targets.base import LintRule, Target
from me2e_compress.targets.onnxruntime.convert import (
    convert,
    int8_layers,
    unranged,
)
from me2e_compress.targets.onnxruntime.lint import RULES
from me2e_compress.targets.onnxruntime.place import kept_float, place, tensors

__all__ = [
    "OnnxRuntime",
    "convert",
    "int8_layers",
    "kept_float",
    "place",
    "tensors",
    "unranged",
]


@dataclasses.dataclass(frozen=True)
class OnnxRuntime(Target):
    """onnxruntime's CPU kernels: uint8 activations, quantized answers, 2-D products."""

    name: ClassVar[str] = "onnxruntime"

    def tensors(self, plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
        """Name what its int8 kernels read, and what those of convolutions answer."""
        return tensors(plan, model)

    def place(self, model: ir.Model, plan: QuantPlan, ranges: Ranges) -> ir.Model:
        """Lower the plan to the forms that its kernels take."""
        return place(model, plan, ranges)

    def kept_float(self, plan: QuantPlan, model: ir.Model) -> tuple[KeptFloat, ...]:
        """List what it has no int8 kernel for."""
        return kept_float(plan, model)

    def lint_rules(self) -> tuple[LintRule, ...]:
        """Return the rules of its kernels."""
        return RULES
