"""A plugin that scales and shifts every channel."""

import dataclasses
from typing import ClassVar

import numpy as np
import onnx_ir as ir

from me2e_compress.operators import Attribute, Dialect, FusedCall, Operand, Operator
from me2e_compress.operators.call import Attributes
from me2e_compress.operators.dialect import Arrays, NdArray, Values, present

OPERANDS = (Operand("x", "N C H W"), Operand("scale", "C"), Operand("shift", "C"))
RELU = (Attribute("relu", 0, choices=(0, 1)),)


@dataclasses.dataclass(frozen=True)
class ScaleShift(Operator):
    """Scale and shift every channel of x [N, C, H, W]; relu=1 cuts off below zero."""

    name: ClassVar[str] = "scale-shift"
    output: ClassVar[str] = "N C H W"
    work: ClassVar[str] = "N C H W"
    own: ClassVar[Dialect] = Dialect("me2e", "ScaleShift", "me2e", OPERANDS, "", RELU)
    dialects: ClassVar[tuple[Dialect, ...]] = (
        Dialect("acme", "ScaleShiftPlugin", "acme.plugins", OPERANDS, "ACME", RELU),
    )

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Write Mul, Add and Relu."""
        x, scale, shift = present(inputs)
        scaled = call.add("Mul", [x, call.unsqueeze(scale, (1, 2))])
        shifted = call.add("Add", [scaled, call.unsqueeze(shift, (1, 2))])
        return call.add("Relu", [shifted]) if attributes["relu"] else shifted

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [N, C, H, W] float64."""
        x, scale, shift = (np.asarray(each, np.float64) for each in inputs)
        shifted = x * scale[:, None, None] + shift[:, None, None]
        return np.maximum(shifted, 0) if attributes["relu"] else shifted
