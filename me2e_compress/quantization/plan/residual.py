"""Residual Adds: which branch is read as int8."""

import dataclasses
from collections.abc import Mapping

import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.quantization.plan.decision import FLOAT, INT8, RESIDUAL, Decision
from me2e_compress.quantization.plan.overrides import Pins
from me2e_compress.quantization.rules import CONVOLUTIONS, Facts


def residuals(
    graph: ir.Graph, decided: Mapping[ir.Node, Decision], facts: Facts, pins: Pins
) -> dict[ir.Node, Decision]:
    """Decide the Adds that end a residual block.

    An Add right behind an int8 convolution is computed in the convolution's own kernel,
    if its other branch is int8: that branch, and only that, gets a pair. Where both
    branches end in a convolution, the longer path is the one that is fused and the
    shorter the residual (a down-sampling projection), as NVIDIA's quantizer decides.

    Returns:
        New decisions for those Adds. The others stay what they are.
    """
    depth = _depths(graph)
    found: dict[ir.Node, Decision] = {}
    for node in graph:
        if node.op_type != "Add" or node.domain not in ("", "ai.onnx"):
            continue
        fused = [i for i in (0, 1) if _ends_convolution(node.inputs[i], decided)]
        if not fused or any(each in facts.constants for each in node.inputs):
            continue
        if static_shape(node.inputs[0]) != static_shape(node.inputs[1]):
            continue
        main = max(fused, key=lambda at: depth.get(node.inputs[at], 0))
        found[node] = _decision(decided[node], node, 1 - main, pins)
    return found


def _decision(old: Decision, node: ir.Node, residual: int, pins: Pins) -> Decision:
    pin = pins.of(node)
    if pin is not None and pin.dtype == FLOAT:
        return dataclasses.replace(old, rule="override", reason=pin.reason)
    main, branch = node.inputs[1 - residual], node.inputs[residual]
    return dataclasses.replace(
        old,
        dtype=INT8,
        rule=RESIDUAL,
        reason=f"computed with the convolution that gives {_name(main)}; its residual"
        f" branch {_name(branch)} is read as int8",
        activations=(residual,),
    )


def _ends_convolution(
    value: ir.Value | None, decided: Mapping[ir.Node, Decision]
) -> bool:
    """Say whether an int8 convolution gives a value, and nothing else reads it."""
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


def _depths(graph: ir.Graph) -> dict[ir.Value | None, int]:
    """Count the nodes on the longest path to every value."""
    depth: dict[ir.Value | None, int] = {}
    for node in graph:
        below = 1 + max((depth.get(each, 0) for each in node.inputs), default=0)
        depth.update(dict.fromkeys(node.outputs, below))
    return depth


def _name(value: ir.Value | None) -> str:
    return "" if value is None else str(value.name)
