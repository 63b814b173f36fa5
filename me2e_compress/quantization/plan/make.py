"""Decide for every node of a graph."""

import functools
from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress.graph import provenance, static_shape
from me2e_compress.quantization.extents import is_one_matrix
from me2e_compress.quantization.plan.decision import (
    FLOAT,
    INT8,
    Decision,
    QuantPlan,
)
from me2e_compress.quantization.plan.groups import find_groups
from me2e_compress.quantization.plan.overrides import NONE, Overrides, Pins
from me2e_compress.quantization.plan.residual import residuals
from me2e_compress.quantization.rules import RULE_SETS, Facts, Rule, RuleSet
from me2e_compress.quantization.scheme import QuantScheme


def make_plan(
    model: ir.Model,
    scheme: QuantScheme,
    rules: RuleSet | None = None,
    overrides: Overrides = NONE,
) -> QuantPlan:
    """Decide for every node; one look at each, so linear in the graph.

    First every node is asked by itself, then what must be decided together: residual
    branches of Adds behind int8 convolutions, and scales that are shared.

    Args:
        model: the float graph: modules stamped on its nodes, shapes inferred.
        scheme: which modules are to be int8.
        rules: asked in order; None for the set ``paper``.
        overrides: what the user has decided; it beats every rule that is not firm.

    Raises:
        RecipeError: an override matches no node, or wants int8 where it cannot be.
    """
    asked = RULE_SETS.parse("paper") if rules is None else rules
    in_order = asked.rules()
    facts = Facts.of(model, scheme.modules)
    pins = overrides.bind(model)
    main = model.graph
    decided = {
        node: _decide(node, facts, in_order, pins, main) for node in main.all_nodes()
    }
    decided.update(residuals(main, decided, facts, pins))
    pins.check(decided)
    decisions = tuple(decided.values())
    groups = find_groups(main, decided, pins, concat=asked.share_concat)
    return QuantPlan(scheme, decisions, RULE_SETS.text(asked), groups)


def tensors_of(plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
    """Name the activations that the plan reads in int8, in graph order."""
    nodes = {node.outputs[0].name: node for node in model.graph}
    names: dict[str, None] = {}
    for decision in plan.chosen:
        for index in decision.activations:
            value = nodes[decision.output].inputs[index]
            if value is not None:
                names[str(value.name)] = None
    return tuple(names)


def _decide(
    node: ir.Node, facts: Facts, rules: Sequence[Rule], pins: Pins, main: ir.Graph
) -> Decision:
    decision = functools.partial(
        Decision,
        node=node.name or "",
        output=str(node.outputs[0].name),
        op=node.op_type,
        module=provenance.module_of(node),
        shapes=tuple(static_shape(v) for v in (*node.inputs[:2], *node.outputs[:1])),
        dtype=FLOAT,
    )
    if node.graph is not main:
        return decision(rule="body", reason="in the body of an If, Loop or Scan")
    close = _borderline(node, facts, rules)
    pin = pins.of(node)
    for rule in rules:
        objection = rule.objection(node, facts)
        if objection is None or (pin is not None and not rule.firm):
            continue
        return decision(rule=rule.name, reason=objection, borderline=close)
    if pin is not None and pin.dtype == FLOAT:
        return decision(rule="override", reason=pin.reason, borderline=close)
    rule_id, reason, layout = _int8(node, facts)
    if pin is not None:
        rule_id, reason = "override", pin.reason
    activations, weight = layout
    return decision(
        dtype=INT8,
        rule=rule_id,
        reason=reason,
        activations=activations,
        weight=weight,
        axis=None if weight is None else _scale_axis(node),
        borderline=close,
    )


def _int8(
    node: ir.Node, facts: Facts
) -> tuple[str, str, tuple[tuple[int, ...], int | None]]:
    """Give rule, reason, and which inputs become activations and weight."""
    constant = node.inputs[1] in facts.constants
    layout = ((0,), 1) if constant else ((0, 1), None)
    if node in facts.attention:
        size = facts.attention[node]
        reason = f"attention of {size.queries} queries and {size.keys} keys"
        return "attention", reason, layout
    return "layer", f"{node.op_type} with a constant weight", layout


def _borderline(node: ir.Node, facts: Facts, rules: Sequence[Rule]) -> str:
    remarks = (rule.borderline(node, facts) for rule in rules)
    return next((remark for remark in remarks if remark), "")


def channel_axis(node: ir.Node) -> int:
    """Give the axis of a weight that its output channels run along.

    Conv [M, C/g, ...]: 0. ConvTranspose [C, M/g, ...]: 1. MatMul [..., K, N]: the last.
    Gemm [K, N]: 1, or 0 where it is transposed.
    """
    if node.op_type == "Conv":
        return 0
    if node.op_type == "ConvTranspose":
        return 1
    if node.op_type == "Gemm":
        return 0 if node.attributes.get_int("transB", 0) else 1
    weight = node.inputs[1]
    rank = 2 if weight is None or weight.shape is None else len(weight.shape)
    return rank - 1


def _scale_axis(node: ir.Node) -> int | None:
    """Give the axis of a weight's scales; None where it has one scale in all.

    Kernels apply the scales of output channels to the result of one product: that of a
    MatMul by a batch of matrices, or by a vector, has no such channels.
    """
    if node.op_type == "MatMul" and not is_one_matrix(node):
        return None
    return channel_axis(node)
