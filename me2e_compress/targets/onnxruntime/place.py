"""Write a plan into a graph as onnxruntime's CPU kernels read it."""

import onnx_ir as ir

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.errors import PreconditionError
from me2e_compress.quantization.plan import Decision, KeptFloat, QuantPlan
from me2e_compress.targets.onnxruntime.draft import draft_of_plan, layers_of
from me2e_compress.targets.onnxruntime.kernels import objection
from me2e_compress.targets.onnxruntime.lower import lower
from me2e_compress.targets.onnxruntime.region import Region, find_region

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
    return _region(plan, model).ranged


def kept_float(plan: QuantPlan, model: ir.Model) -> tuple[KeptFloat, ...]:
    """List the plan's nodes that :func:`place` leaves in float, and why."""
    region = _region(plan, model)
    nodes = {str(node.outputs[0].name): node for node in model.graph}
    reasons = (
        (each, _objection(nodes[each.output], each, region)) for each in plan.chosen
    )
    return tuple(
        KeptFloat(each.node, each.output, reason) for each, reason in reasons if reason
    )


def _region(plan: QuantPlan, model: ir.Model) -> Region:
    chosen = {decision.output for decision in layers_of(plan)}
    return find_region(model.graph, chosen)


def _objection(node: ir.Node, decision: Decision, region: Region) -> str | None:
    if node in region.layers or node in region.readers:
        return None
    if decision.weight is not None:
        return objection(node)
    if node.op_type == "Add":
        return "a sum that no int8 kernel reads, or of which none gives a side"
    return "products of two activations are slower in int8"
