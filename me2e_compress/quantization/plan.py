"""The plan: for every node, int8 or float, by which rule, and why."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import (
    CONVOLUTIONS,
    channel_axis,
    is_standard,
    provenance,
    static_shape,
)
from me2e_compress.graph.nodes import maker
from me2e_compress.graph.shapes import is_one_matrix
from me2e_compress.operators import int8_inputs
from me2e_compress.quantization.costs import CostsOf
from me2e_compress.quantization.decision import (
    FLOAT,
    INT8,
    NONE,
    RESIDUAL,
    Decision,
    Override,
    Overrides,
    QuantPlan,
    QuantScheme,
    ScaleGroup,
    check_followed,
)
from me2e_compress.quantization.rules import (
    DEFAULT_RULES,
    RULE_SETS,
    Objection,
    Rule,
    RuleFacts,
    RuleSet,
)

# Find tensors whose scales are decided together.


def find_groups(
    graph: ir.Graph, decided: Mapping[ir.Node, Decision]
) -> tuple[ScaleGroup, ...]:
    """List the tensors that Concats join, with their readers.

    A Concat whose result is read as int8 is put on one scale with those of its inputs
    that are read as int8 elsewhere: it then moves int8 as it is. Concats of Concats are
    one group.
    """
    # int8 readers of every tensor
    readers: dict[ir.Value, list[str]] = {}
    for node, decision in decided.items():
        for index in decision.activations if decision.dtype == INT8 else ():
            value = node.inputs[index]
            if value is not None:
                readers.setdefault(value, []).append(decision.node or decision.output)
    head_of: dict[ir.Value, ir.Node] = {}
    members: dict[ir.Node, list[ir.Value]] = {}
    # from the last Concat back, so that Concats of Concats join its group
    for node in reversed(graph):
        result = node.outputs[0]
        if node.op_type != "Concat" or not (result in readers or result in head_of):
            continue
        head = head_of.get(result, node)
        for value in filter(None, (result, *node.inputs)):
            other = head_of.get(value)
            if other is not head:
                moved = [value] if other is None else members.pop(other)
                members.setdefault(head, []).extend(moved)
                head_of.update(dict.fromkeys(moved, head))
    # of each group what is read as int8, and by whom
    groups = list[ScaleGroup]()
    for head, values in members.items():
        read = [value for value in values if value in readers]
        nodes = dict.fromkeys(name for value in read for name in readers[value])
        tensors = tuple(str(value.name) for value in read)
        if len(tensors) > 1:
            groups.append(ScaleGroup(head.name or tensors[0], tensors, tuple(nodes)))
    return tuple(groups)


# Ranges that differ more share no scale: it would cost the smaller 2 of its 8 bits.
APART = 4.0


def share_scales(plan: QuantPlan, ranges: Ranges) -> Ranges:
    """Widen ranges so that the tensors of a concat group have one.

    Scores beside pixels keep their own: what is `APART` times smaller than the largest.
    """
    widened = dict(ranges.tensors)
    for group in plan.groups:
        if all(name in widened for name in group.tensors):
            reach = {name: max(map(abs, widened[name])) for name in group.tensors}
            near = max(reach.values()) / APART
            names = [name for name, size in reach.items() if size >= near or not size]
            bounds = [widened[name] for name in names]
            whole = min(low for low, _ in bounds), max(high for _, high in bounds)
            widened.update(dict.fromkeys(names, whole))
    return dataclasses.replace(ranges, tensors=widened)


# What the user decides of which nodes.
Pins: TypeAlias = Mapping[ir.Node, Override]


def make_plan(
    model: ir.Model,
    scheme: QuantScheme,
    rules: RuleSet | None = None,
    overrides: Overrides = NONE,
    costs: CostsOf | None = None,
    fused: Objection | None = None,
) -> QuantPlan:
    """Decide for every node, in linear time.

    First every node by itself, then what must be decided together: int8 that does not
    pay, residual branches of Adds behind int8 convolutions, and scales that are shared.

    Args:
        model: the float graph: modules stamped on its nodes, shapes inferred.
        scheme: which modules are to be int8.
        rules: asked in order; None for the set ``safe``.
        overrides: the user's decisions; they beat every rule that is not firm.
        costs: estimates what int8 saves and costs on the target, for rules that ask.
        fused: says why a fused operator reads no int8 on the target.

    Raises:
        RecipeError: an override matches no node, or wants int8 where it cannot be.
    """
    # what the rules may know, and what the user has decided
    asked = RULE_SETS.parse(DEFAULT_RULES) if rules is None else rules
    in_order = asked.rules()
    facts = RuleFacts(model, scheme.modules, costs, fused)
    pins = overrides.bind(model)
    main = model.graph
    # every node by itself
    decided = {
        node: _decide(node, facts, in_order, pins, main) for node in main.all_nodes()
    }
    # what depends on other decisions
    for rule in in_order:
        int8 = {n: None for n, choice in decided.items() if choice.dtype == INT8}
        for node, reason in rule.objections(int8, facts).items():
            if node in int8 and (rule.firm or pins.get(node) is None):
                decided[node] = dataclasses.replace(
                    decided[node],
                    dtype=FLOAT,
                    rule=rule.name,
                    reason=reason,
                    activations=(),
                    weight=None,
                    axis=None,
                )
    decided.update(_residuals(main, decided, facts, pins))
    check_followed(pins, decided)
    decisions = tuple(decided.values())
    groups = find_groups(main, decided) if asked.share_concat else ()
    text = RULE_SETS.text(asked)
    return QuantPlan(scheme, decisions, text, groups, balanced=asked.balance)


def tensors_of(plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
    """Return the names of the activations that are read in int8, in graph order."""
    nodes = {node.outputs[0].name: node for node in model.graph}
    names: dict[str, None] = {}
    for decision in plan.chosen:
        for index in decision.activations:
            value = nodes[decision.output].inputs[index]
            if value is not None:
                names[str(value.name)] = None
    return tuple(names)


def _decide(
    node: ir.Node, facts: RuleFacts, rules: Sequence[Rule], pins: Pins, main: ir.Graph
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
    # the first rule that objects decides, unless the user has and it is not firm
    pin = pins.get(node)
    for rule in rules:
        objection = rule.objection(node, facts)
        if objection is None or (pin is not None and not rule.firm):
            continue
        return decision(rule=rule.name, reason=objection)
    # the user's float, else int8
    if pin is not None and pin.dtype == FLOAT:
        return decision(rule="override", reason=pin.why)
    rule_id, reason, layout = _int8(node, facts)
    if pin is not None:
        rule_id, reason = "override", pin.why
    # Kernels apply the scales of output channels to the result of one product: that of
    # a MatMul by a batch of matrices, or by a vector, has one scale in all.
    activations, weight = layout
    one_scale = node.op_type == "MatMul" and not is_one_matrix(node)
    axis = None if weight is None or one_scale else channel_axis(node)
    return decision(
        dtype=INT8,
        rule=rule_id,
        reason=reason,
        activations=activations,
        weight=weight,
        axis=axis,
    )


def _int8(
    node: ir.Node, facts: RuleFacts
) -> tuple[str, str, tuple[tuple[int, ...], int | None]]:
    """Return rule, reason, and which inputs become activations and weight."""
    if reads := int8_inputs(node):
        reason = f"{node.op_type} samples int8; positions and weights stay float"
        return "sampled", reason, (reads, None)
    constant = node.inputs[1] in facts.constants
    layout = ((0,), 1) if constant else ((0, 1), None)
    if node in facts.attention:
        size = facts.attention[node]
        reason = f"attention of {size.queries} queries and {size.keys} keys"
        return "attention", reason, layout
    return "layer", f"{node.op_type} with a constant weight", layout


def _residuals(
    graph: ir.Graph, decided: Mapping[ir.Node, Decision], facts: RuleFacts, pins: Pins
) -> dict[ir.Node, Decision]:
    """Decide the Adds that end a residual block: which branch is read as int8.

    An Add right behind an int8 convolution is computed in the convolution's own kernel,
    if its other branch is int8: that branch, and only that, gets a pair. Where both
    branches end in a convolution, the longer path is the one that is fused and the
    shorter the residual (a down-sampling projection), as NVIDIA's quantizer decides.
    Returns new decisions for those Adds alone.
    """
    # the longest path to every value, in nodes
    depth: dict[ir.Value | None, int] = {}
    for node in graph:
        below = 1 + max((depth.get(value, 0) for value in node.inputs), default=0)
        depth.update(dict.fromkeys(node.outputs, below))
    decisions: dict[ir.Node, Decision] = {}
    for node in graph:
        if node.op_type != "Add" or not is_standard(node):
            continue
        # branches that end in an int8 convolution
        fused = [i for i in (0, 1) if _ends_convolution(node.inputs[i], decided)]
        if not fused or any(value in facts.constants for value in node.inputs):
            continue
        if any(maker(value, "DequantizeLinear") for value in node.inputs):
            continue  # a branch is read as int8 already
        if static_shape(node.inputs[0]) != static_shape(node.inputs[1]):
            continue
        # the longer path is fused, the other is the residual
        main = max(fused, key=lambda at: depth.get(node.inputs[at], 0))
        pin = pins.get(node)
        if pin is not None and pin.dtype == FLOAT:
            decisions[node] = dataclasses.replace(
                decided[node], rule="override", reason=pin.why
            )
            continue
        names = ["" if value is None else value.name for value in node.inputs]
        decisions[node] = dataclasses.replace(
            decided[node],
            dtype=INT8,
            rule=RESIDUAL,
            reason=f"computed with the convolution that gives {names[main]}; its"
            f" residual branch {names[1 - main]} is read as int8",
            activations=(1 - main,),
        )
    return decisions


def _ends_convolution(
    value: ir.Value | None, decided: Mapping[ir.Node, Decision]
) -> bool:
    """Return whether a value comes from an int8 convolution and has one reader."""
    if value is None or value.is_graph_output() or len(value.uses()) != 1:
        return False
    node = value.producer()
    if node is not None and node.op_type == "BatchNormalization":
        return _ends_convolution(node.inputs[0], decided)
    return (
        node is not None
        and node.op_type in CONVOLUTIONS
        and decided[node].dtype == INT8
    )
