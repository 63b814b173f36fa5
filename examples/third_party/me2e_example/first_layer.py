"""The layers that read the input stay in float."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.quantization.rules import RULE_SETS, Rule, RuleFacts, RuleSet


@dataclasses.dataclass(frozen=True)
class FirstLayer(Rule):
    """Keep layers in float that read an input of the graph."""

    name: ClassVar[str] = "first-layer"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to a node whose first operand is an input."""
        first = node.inputs[0] if node.inputs else None
        if first is None or not first.is_graph_input():
            return None
        return f"it reads the input {first.name}"


@dataclasses.dataclass(frozen=True)
class Cautious(RuleSet):
    """The paper's two stages, and first layers in float."""

    name: ClassVar[str] = "cautious"

    def own_rules(self) -> tuple[Rule, ...]:
        """Ask the paper's rules first."""
        return (*RULE_SETS.parse("paper").rules(), FirstLayer())
