"""Rewrite int8 that was placed for TensorRT so that onnxruntime runs it fast."""

import dataclasses
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import plural
from me2e_compress.calibration.observers import DEFAULT_METHOD
from me2e_compress.graph import provenance
from me2e_compress.passes.base import Context, PassResult
from me2e_compress.passes.quantize_int8 import Quantizer
from me2e_compress.quantization.decision import plan_of, stamp_plan
from me2e_compress.targets.onnxruntime.convert import convert, int8_layers, unranged


@dataclasses.dataclass(frozen=True)
class LowerInt8(Quantizer):
    """Rewrite a graph quantized for TensorRT so that a CPU runs it fast.

    Given:   y = Conv(DequantizeLinear(QuantizeLinear(x)), DequantizeLinear(w_int8), b)

    Result:  y = DequantizeLinear(QuantizeLinear(Conv(DequantizeLinear(
             QuantizeLinear(x)), DequantizeLinear(w_int8), DequantizeLinear(b_int32))))

    The graph may come from ModelOpt or from ``quantize-int8``. Layers, weights and
    ranges stay, on uint8 instead of int8. Outputs of convolutions are quantized too;
    their ranges are measured on the context's frames or read from a file. Activations
    that TensorRT reads in int8 but onnxruntime has no fast kernel for (the products of
    attention) become float again.

    Attributes:
        method: how ranges are read from the frames: ``mse``, ``max-min``, ...
        ranges: file of saved ranges instead of frames.
    """

    name = "lower-int8"
    exact = False
    method: str = DEFAULT_METHOD
    ranges: Path | None = None

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Read the quantizers, calibrate the missing ranges, and write the new graph.

        Raises:
            PreconditionError: the graph is not quantized, or not in symmetric int8.
        """
        # Ranges of tensors that TensorRT leaves in float
        missing, ranges = self.ranged_tensors(model, context), None
        if missing:
            ranges = self.read_ranges(model, missing, context, self.ranges)
        lowered = convert(model, ranges)
        provenance.sign(model, lowered, self.name)
        if plan := plan_of(model):
            stamp_plan(lowered, dataclasses.replace(plan, target="onnxruntime"))
        layers = int8_layers(lowered)
        changes = len(layers) or int(graph.digest(lowered) != graph.digest(model))
        notes = (
            f"{plural(len(layers), 'layer')} in int8 for onnxruntime",
            f"{plural(len(missing), 'tensor')} calibrated besides the graph's",
        )
        return PassResult(lowered, changes, notes)

    @property
    def method_of_ranges(self) -> str:
        """The method that was asked for."""
        return self.method

    def ranged_tensors(self, model: ir.Model, context: Context) -> tuple[str, ...]:
        """Return the names of the tensors whose range is not in the graph."""
        return unranged(model)
