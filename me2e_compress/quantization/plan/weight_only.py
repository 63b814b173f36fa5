"""Matrix-vector products whose weight alone becomes int8."""

import dataclasses
from collections.abc import Collection, Iterator

import onnx_ir as ir

from me2e_compress.graph import channel_axis, size
from me2e_compress.graph.activations import value_bytes
from me2e_compress.graph.nodes import constant_values
from me2e_compress.graph.shapes import is_one_matrix
from me2e_compress.quantization.plan.decision import (
    FLOAT,
    WEIGHT_ONLY,
    Decision,
    QuantPlan,
)

LEAST_BYTES = 16384
"""A smaller float32 weight is not worth a node: 64 by 64."""

WORTH = 0.02
"""Part of a graph's weights that is worth a hint."""


def with_weight_only(plan: QuantPlan, model: ir.Model) -> QuantPlan:
    """Decide that the weights of matrix-vector products become int8, and only they.

    Such a product reads every weight once, so its time and file size are those of the
    weight; quantizing its one row would gain nothing. Products that other rules keep in
    float, weights that float layers read too and small ones stay as they are. ``model``
    is the float graph that was planned.
    """
    found = {each.output: each for each, _ in _candidates(plan, model)}
    return dataclasses.replace(
        plan,
        decisions=tuple(found.get(each.output, each) for each in plan.decisions),
    )


def savable_bytes(plan: QuantPlan, model: ir.Model) -> tuple[int, int]:
    """Count the weights that could become int8 alone, and the bytes that this saves.

    Both are zero if that is less than a fiftieth of all weights.
    """
    weights = {weight: None for _, weight in _candidates(plan, model)}
    saved = sum((value_bytes(weight) or 0) * 3 // 4 for weight in weights)
    worth = saved >= WORTH * size(model).weight_bytes
    return (len(weights), saved) if worth and saved else (0, 0)


def _candidates(
    plan: QuantPlan, model: ir.Model
) -> Iterator[tuple[Decision, ir.Value]]:
    """Yield the possible decisions, each with its weight."""
    nodes = {str(node.outputs[0].name): node for node in model.graph}
    constants = constant_values(model)
    # matrix-vector products that no other rule keeps in float
    vectors = {
        nodes[each.output]: each
        for each in plan.decisions
        if each.dtype == FLOAT and each.rule == "gemv" and each.output in nodes
    }
    for node, decision in vectors.items():
        weight = node.inputs[1]
        if weight is None or weight not in constants:
            continue
        if (value_bytes(weight) or 0) < LEAST_BYTES:
            continue
        plain = node.op_type == "Gemm" or is_one_matrix(node)
        if plain and weight.dtype == ir.DataType.FLOAT and _read_by(weight, vectors):
            made = dataclasses.replace(
                decision,
                dtype=WEIGHT_ONLY,
                reason=f"{decision.reason}; its weight alone is int8",
                weight=1,
                axis=channel_axis(node),
            )
            yield made, weight


def _read_by(weight: ir.Value, nodes: Collection[ir.Node]) -> bool:
    """Return whether a weight is read by these nodes only, as their right operand."""
    return all(use.node in nodes and use.idx == 1 for use in weight.uses())
