"""Find tensors whose scales are decided together."""

import dataclasses
import math
from collections.abc import Mapping

import onnx_ir as ir

from me2e_compress.calibration.observers import scale_of
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.quantization.plan.decision import (
    INT8,
    Decision,
    QuantPlan,
    ScaleGroup,
)
from me2e_compress.quantization.plan.overrides import Pins

SHARED, CONCAT = "shared-input", "concat"


def find_groups(
    graph: ir.Graph, decided: Mapping[ir.Node, Decision], pins: Pins, *, concat: bool
) -> tuple[ScaleGroup, ...]:
    """List the tensors and readers that are decided together.

    A tensor that several int8 nodes read has one pair: keeping one of its readers in
    float saves nothing unless the others go too. With ``concat``, a Concat whose result
    is read as int8 is put on one scale with those of its inputs that are read as int8
    elsewhere: it then moves int8 as it is. Concats of Concats are one group.
    """
    # int8 readers of every tensor
    readers: dict[ir.Value, list[str]] = {}
    for node, decision in decided.items():
        for index in decision.activations if decision.dtype == INT8 else ():
            value = node.inputs[index]
            if value is not None:
                readers.setdefault(value, []).append(decision.node or decision.output)
    found = [
        ScaleGroup(SHARED, str(value.name), (str(value.name),), tuple(nodes))
        for value, nodes in readers.items()
        if len(nodes) > 1
    ]
    # scales that a Concat joins
    if concat:
        found += _concats(graph, readers, pins)
    return tuple(found)


def _concats(
    graph: ir.Graph, readers: Mapping[ir.Value, list[str]], pins: Pins
) -> list[ScaleGroup]:
    head_of: dict[ir.Value, ir.Node] = {}
    members: dict[ir.Node, list[ir.Value]] = {}

    def join(head: ir.Node, value: ir.Value) -> None:
        other = head_of.get(value)
        if other is head:
            return
        moved = [value] if other is None else members.pop(other)
        members.setdefault(head, []).extend(moved)
        head_of.update(dict.fromkeys(moved, head))

    # from the last Concat back, so that Concats of Concats join its group
    for node in reversed(graph):
        if node.op_type != "Concat" or node in pins.apart:
            continue
        result = node.outputs[0]
        if result in readers or result in head_of:
            head = head_of.get(result, node)
            for value in (result, *node.inputs):
                if value is not None:
                    join(head, value)
    found = (_concat(head, values, readers) for head, values in members.items())
    return [group for group in found if len(group.tensors) > 1]


def _concat(
    head: ir.Node, values: list[ir.Value], readers: Mapping[ir.Value, list[str]]
) -> ScaleGroup:
    read = [value for value in values if value in readers]
    nodes = dict.fromkeys(name for value in read for name in readers[value])
    tensors = tuple(str(value.name) for value in read)
    return ScaleGroup(CONCAT, head.name or tensors[0], tensors, tuple(nodes))


def share_scales(plan: QuantPlan, ranges: Ranges) -> Ranges:
    """Widen ranges so that the tensors of a concat group have one."""
    widened = dict(ranges.tensors)
    for group in _shared(plan, ranges):
        bounds = [widened[name] for name in group.tensors]
        low, high = min(low for low, _ in bounds), max(high for _, high in bounds)
        widened.update(dict.fromkeys(group.tensors, (low, high)))
    return dataclasses.replace(ranges, tensors=widened)


@dataclasses.dataclass(frozen=True)
class SharingCost:
    """The cost of one scale for a group.

    ``tensor`` loses most; ``loss_db`` is how much its rounding noise rises, 0 if it had
    the widest range.
    """

    group: ScaleGroup
    tensor: str
    loss_db: float


def sharing_costs(plan: QuantPlan, ranges: Ranges) -> tuple[SharingCost, ...]:
    """Return what each concat group costs: ``20 log10(shared step / own step)``."""
    wide = share_scales(plan, ranges).tensors
    costs = []
    for group in _shared(plan, ranges):
        losses = {
            name: _decibels(wide[name], ranges.tensors[name]) for name in group.tensors
        }
        worst = max(losses, key=lambda name: losses[name])
        costs.append(SharingCost(group, worst, losses[worst]))
    return tuple(costs)


def _shared(plan: QuantPlan, ranges: Ranges) -> list[ScaleGroup]:
    return [
        group
        for group in plan.groups
        if group.kind == CONCAT
        and all(name in ranges.tensors for name in group.tensors)
    ]


def _decibels(wide: tuple[float, float], own: tuple[float, float]) -> float:
    if own == (0.0, 0.0):  # it has no step of its own, and loses nothing
        return 0.0
    return 20 * math.log10(float(scale_of(*wide)) / float(scale_of(*own)))
