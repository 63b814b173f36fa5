"""What a rule finds, and what a rule is."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Literal, TypeAlias

import onnx_ir as ir

Severity = Literal["error", "warning"]


@dataclasses.dataclass(frozen=True)
class LintFinding:
    """One thing that is wrong with a graph for its target.

    Attributes:
        severity: ``error``: the target refuses the graph, or computes something else;
            ``warning``: it runs, but not as int8 or not as fast as it could.
        rule: id of the rule.
        node: name of the node; empty where the graph as a whole is meant.
        message: what was found and what there should be.
    """

    severity: Severity
    rule: str
    node: str
    message: str


LintRule: TypeAlias = Callable[[ir.Model], Iterator[LintFinding]]
"""Looks at a graph, with its shapes inferred, and yields what it finds."""


def error(rule: str, node: ir.Node | None, message: str) -> LintFinding:
    """Make a finding that the target refuses."""
    return LintFinding("error", rule, _name(node), message)


def warning(rule: str, node: ir.Node | None, message: str) -> LintFinding:
    """Make a finding that the target runs badly."""
    return LintFinding("warning", rule, _name(node), message)


def is_standard(node: ir.Node) -> bool:
    """Say whether a node's operator is ONNX's own."""
    return node.domain in ("", "ai.onnx")


def nodes_of(model: ir.Model) -> Iterator[ir.Node]:
    """Walk the nodes of the graph, of its bodies and of its functions."""
    yield from model.graph.all_nodes()
    for function in model.functions.values():
        yield from function.all_nodes()


def _name(node: ir.Node | None) -> str:
    return "" if node is None else node.name or str(node.outputs[0].name)
