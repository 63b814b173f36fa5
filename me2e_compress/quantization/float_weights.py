"""List weights that stay float although a graph is quantized, and why."""

import dataclasses

import onnx_ir as ir

from me2e_compress.quantization.plan import FLOAT, Decision, QuantPlan

LEAST_BYTES = 1024
"""Smaller constants are not worth a word."""

_FLOATS = (ir.DataType.FLOAT, ir.DataType.FLOAT16, ir.DataType.DOUBLE)


@dataclasses.dataclass(frozen=True)
class FloatWeight:
    """A weight that stays float, with the first node that reads it.

    ``rule`` keeps it float, e.g. ``gemv``; ``target`` if the runtime does. ``module``
    is empty if unknown.
    """

    name: str
    bytes: int
    node: str
    op: str
    module: str
    rule: str
    reason: str


def float_weights(model: ir.Model, plan: QuantPlan) -> tuple[FloatWeight, ...]:
    """List the weights that a plan leaves in float, the largest first.

    A weight that any node stores as int8 is not among them, nor are biases of int8
    layers and constants below a kilobyte. The plan must include what the target leaves
    in float.
    """
    # decisions by node, and those that the target does not follow
    decided = {each.output: each for each in plan.decisions}
    kept = {each.output: each.reason for each in plan.kept_float}
    found, stored = dict[str, FloatWeight](), set[str]()
    # float weights, and those that some other node stores as int8
    for node in model.graph:
        decision = decided.get(str(node.outputs[0].name)) if node.outputs else None
        if decision is None:
            continue
        is_int8 = decision.dtype != FLOAT and decision.output not in kept
        for at, value in enumerate(node.inputs):
            if value is None or not _is_weight(value):
                continue
            if not is_int8:
                made = _float_weight(value, decision, kept.get(decision.output))
                found.setdefault(made.name, made)
            elif at == decision.weight:
                stored.add(str(value.name))
    left = (each for name, each in found.items() if name not in stored)
    return tuple(sorted(left, key=lambda each: (-each.bytes, each.name)))


def _is_weight(value: ir.Value) -> bool:
    tensor = value.const_value
    return (
        tensor is not None and tensor.dtype in _FLOATS and tensor.nbytes >= LEAST_BYTES
    )


def _float_weight(value: ir.Value, decision: Decision, kept: str | None) -> FloatWeight:
    return FloatWeight(
        str(value.name),
        0 if value.const_value is None else value.const_value.nbytes,
        decision.node,
        decision.op,
        decision.module,
        decision.rule if kept is None else "target",
        decision.reason if kept is None else kept,
    )
