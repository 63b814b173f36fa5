"""The plan: for every node, int8 or float, by which rule, and why."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress.calibration.attention import find_attention
from me2e_compress.calibration.rules import WEIGHTED, Facts, Rule, paper_rules
from me2e_compress.calibration.scheme import QuantScheme
from me2e_compress.graph import provenance, static_shape
from me2e_compress.runtime.evaluate import constant_values

INT8 = "int8"
FLOAT = "float"
Shape = tuple[int, ...] | None


@dataclasses.dataclass(frozen=True)
class Decision:
    """What becomes of one node.

    Attributes:
        node: its name, which need not be unique.
        output: name of its first output, which is.
        op: its operator.
        module: its ME2E module; empty if unknown.
        dtype: ``int8`` or ``float``.
        rule: id of the rule that decided; ``layer`` or ``attention`` for int8.
        reason: the same in words.
        shapes: of the first two inputs and the first output; None where open.
        activations: which inputs get an activation scale.
        weight: which input is stored as int8; None where none is.
        axis: of the weight's per-channel scales.
    """

    node: str
    output: str
    op: str
    module: str
    dtype: str
    rule: str
    reason: str
    shapes: tuple[Shape, ...]
    activations: tuple[int, ...] = ()
    weight: int | None = None
    axis: int | None = None


@dataclasses.dataclass(frozen=True)
class QuantPlan:
    """Decisions for every node of a graph, in graph order.

    Attributes:
        scheme: what was asked for.
        decisions: one a node.
    """

    scheme: QuantScheme
    decisions: tuple[Decision, ...]

    @property
    def chosen(self) -> tuple[Decision, ...]:
        """The nodes that become int8."""
        return tuple(each for each in self.decisions if each.dtype == INT8)

    def counts(self) -> dict[str, int]:
        """Count the decisions by rule, over the nodes that could be int8 at all."""
        rules = Counter(each.rule for each in self.decisions if each.op in WEIGHTED)
        return dict(sorted(rules.items()))


def make_plan(
    model: ir.Model, scheme: QuantScheme, rules: Sequence[Rule] | None = None
) -> QuantPlan:
    """Decide for every node; one look at each, so linear in the graph.

    Args:
        model: the float graph: modules stamped on its nodes, shapes inferred.
        scheme: which modules are to be int8.
        rules: asked in order; None for :func:`paper_rules`.
    """
    constants = constant_values(model)
    attention = find_attention(model, constants)
    facts = Facts(frozenset(scheme.modules), constants, attention)
    asked = paper_rules() if rules is None else tuple(rules)
    main = model.graph
    return QuantPlan(
        scheme,
        tuple(_decide(node, facts, asked, main) for node in main.all_nodes()),
    )


def tensors_of(plan: QuantPlan, model: ir.Model) -> tuple[str, ...]:
    """Name the activations that the plan needs a range of, in graph order."""
    nodes = {node.outputs[0].name: node for node in model.graph}
    names: dict[str, None] = {}
    for decision in plan.chosen:
        for index in decision.activations:
            value = nodes[decision.output].inputs[index]
            if value is not None:
                names[str(value.name)] = None
    return tuple(names)


def _decide(
    node: ir.Node, facts: Facts, rules: Sequence[Rule], main: ir.Graph
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
    for rule in rules:
        if objection := rule.objection(node, facts):
            return decision(rule=rule.id, reason=objection)
    if node in facts.attention:
        size = facts.attention[node]
        return decision(
            dtype=INT8,
            rule="attention",
            reason=f"attention of {size.queries} queries and {size.keys} keys",
            activations=(0, 1),
        )
    return decision(
        dtype=INT8,
        rule="layer",
        reason=f"{node.op_type} with a constant weight",
        activations=(0,),
        weight=1,
        axis=channel_axis(node),
    )


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
