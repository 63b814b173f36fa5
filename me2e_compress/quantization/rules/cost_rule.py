"""The rule that keeps int8 where it pays."""

import dataclasses
from collections.abc import Collection, Mapping
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.quantization.rules.base import Rule, RuleFacts


@dataclasses.dataclass(frozen=True)
class CostGate(Rule):
    """Int8 that takes longer than float on the target stays float.

    Int8 saves arithmetic, which grows with a layer's multiply-accumulates, and costs
    time where it begins and ends, which grows with the tensors there. Both are
    estimated by the target; a target that estimates nothing keeps everything.
    """

    name: ClassVar[str] = "cost"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to nothing: what a node costs depends on its neighbours."""
        return None

    def objections(
        self, int8: Collection[ir.Node], facts: RuleFacts
    ) -> Mapping[ir.Node, str]:
        """Object to the layers that pay more at their borders than they save."""
        costs = None if facts.costs is None else facts.costs(facts.model, int8)
        if costs is None:
            return {}
        losses = costs.losses(int8)
        return {node: f"{loss} on {costs.machine}" for node, loss in losses.items()}
