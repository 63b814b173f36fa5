"""Write a plan into a graph as onnxruntime's CPU kernels read it."""

import onnx_ir as ir

from me2e_compress.calibration.plan import QuantPlan
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.errors import PreconditionError
from me2e_compress.targets.onnxruntime.draft import draft_of_plan, layers_of
from me2e_compress.targets.onnxruntime.lower import lower
from me2e_compress.targets.onnxruntime.region import find_region

MIN_OPSET = 13
"""The first opset whose DequantizeLinear has an axis, i.e. one scale a channel."""


def place(model: ir.Model, plan: QuantPlan, ranges: Ranges) -> ir.Model:
    """Give a copy of a graph in which the plan's layers run in int8 on the CPU.

    Args:
        model: the float graph that was planned and calibrated; it stays as it is.
        plan: what becomes int8; the products of attention stay float here.
        ranges: of every tensor that :func:`tensors` names.

    Raises:
        PreconditionError: the graph is older than opset 13.
        FramesError: the range of a tensor is missing.
    """
    opset = model.opset_imports.get("", 0)
    if opset < MIN_OPSET:
        raise PreconditionError(
            f"the graph is of opset {opset}: int8 with one scale a channel needs"
            f" {MIN_OPSET} or later, export it so"
        )
    return lower(draft_of_plan(model, plan, ranges))


def tensors(plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
    """Name the activations whose range lowering needs: read by, or out of, a layer."""
    chosen = {decision.output for decision in layers_of(plan)}
    return find_region(model.graph, chosen).ranged
