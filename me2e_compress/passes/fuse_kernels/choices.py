"""A choice between whole tensors as an If: only what is chosen is read and copied.

Given:   Concat(Where(first_frame, query, last_view), query)

Result:  If(first_frame) { Concat(query, query) } else { Concat(last_view, query) }

onnxruntime's CPU (1.31) computes Where of one condition in three passes over its
operands: two stacked choices of 10 MB take 4.1 ms, and 1.0 in branches.
"""

import math
from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress.errors import PreconditionError
from me2e_compress.graph import array_of, provenance, static_shape
from me2e_compress.graph.rewrite import fresh_name, maker
from me2e_compress.operators import FusedCall

LEAST = 1 << 16
"""Elements that are worth a branch: 30 us of Where, 10 of starting one."""


def fuse(node: ir.Node, call: FusedCall) -> ir.Value | None:
    """Write a Concat of choices, or a choice that no Concat reads, as an If."""
    choice = node if node.op_type == "Where" else _first_choice(node)
    if choice is None or not _is_choice(choice):
        return None
    result, condition = node.outputs[0], choice.inputs[0]
    if math.prod(static_shape(result) or ()) < LEAST:
        return None
    if node is choice and any(_joins(use.node, condition) for use in result.uses()):
        return None  # the Concat chooses by itself
    if any(maker(value, "DequantizeLinear") for value in _operands(node, condition)):
        raise PreconditionError("what it chooses from is int8")
    # One branch for each side
    branches = {
        name: _branch(node, _side(node, condition, index), call)
        for name, index in (("then_branch", 1), ("else_branch", 2))
    }
    name = fresh_name(f"{node.name}/If", call.names)
    made = ir.node("If", [condition], branches, name=name)
    made.outputs[0].name = fresh_name(f"{name}_0", call.names)
    made.outputs[0].type, made.outputs[0].shape = result.type, result.shape
    choices = (maker(value, "Where") for value in node.inputs)
    sources = [node, *(each for each in choices if each is not None)]
    provenance.inherit(made, sources, by=call.by)
    assert node.graph is not None
    node.graph.insert_before(node, made)
    return made.outputs[0]


def _first_choice(node: ir.Node) -> ir.Node | None:
    """Return a choice that a Concat of the same graph reads: none in a branch of it."""
    found = (maker(value, "Where") for value in node.inputs)
    here = (each for each in found if each is not None and each.graph is node.graph)
    return next(filter(_is_choice, here), None)


def _joins(node: ir.Node, condition: ir.Value | None) -> bool:
    choice = _first_choice(node) if node.op_type == "Concat" else None
    return choice is not None and choice.inputs[0] is condition


def _is_choice(node: ir.Node) -> bool:
    """Return whether one computed condition chooses one of two values as it is."""
    condition, one, other = node.inputs
    number, shape = static_shape(condition), static_shape(node.outputs[0])
    if number is None or math.prod(number) != 1 or array_of(condition) is not None:
        return False
    return shape is not None and shape == static_shape(one) == static_shape(other)


def _side(
    node: ir.Node, condition: ir.Value | None, index: int
) -> list[ir.Value | None]:
    """Return what a branch reads: 1 where the condition holds, 2 where it does not."""
    if node.op_type == "Where":
        return [node.inputs[index]]
    found = []
    for value in node.inputs:
        choice = maker(value, "Where")
        chooses = choice is not None and choice.inputs[0] is condition
        chosen = choice is not None and chooses and _is_choice(choice)
        found.append(choice.inputs[index] if choice and chosen else value)
    return found


def _operands(node: ir.Node, condition: ir.Value | None) -> list[ir.Value | None]:
    return [*_side(node, condition, 1), *_side(node, condition, 2)]


def _branch(
    node: ir.Node, values: Sequence[ir.Value | None], call: FusedCall
) -> ir.Graph:
    joins = node.op_type == "Concat"
    options = {key: attr.value for key, attr in node.attributes.items()}
    name = fresh_name(f"{node.name}/branch", call.names)
    made = ir.node("Concat" if joins else "Identity", values, options, name=name)
    result, old = made.outputs[0], node.outputs[0]
    result.name = fresh_name(f"{name}_0", call.names)
    result.type, result.shape = old.type, old.shape
    provenance.inherit(made, [node], by=call.by)
    return ir.Graph([], [result], nodes=[made], name=name)
