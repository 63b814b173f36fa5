"""What is a layer at all, and of which module."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph import WEIGHTED, is_standard, provenance
from me2e_compress.quantization.find_attention import FUSED
from me2e_compress.quantization.rules.base import Rule, RuleFacts


@dataclasses.dataclass(frozen=True)
class WeightedOperator(Rule):
    """Only convolutions and matrix products are int8."""

    name: ClassVar[str] = "operator"
    firm: ClassVar[bool] = True

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to every other operator."""
        if is_standard(node) and node.op_type in WEIGHTED:
            return None
        if node not in facts.attention:
            return f"{node.op_type} is no weighted layer"
        if node.op_type not in FUSED:
            return f"{node.op_type} in an attention has no int8 kernel"
        size = facts.attention[node]
        return (
            f"{node.op_type} is a whole attention of {size.queries} queries and"
            f" {size.keys} keys, its products cannot be reached"
        )


@dataclasses.dataclass(frozen=True)
class ModuleScope(Rule):
    """Modules outside the scheme stay as they are."""

    name: ClassVar[str] = "module"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to a node of another module, or of none."""
        module = provenance.module_of(node)
        if module in facts.modules:
            return None
        return f"module {module or '(none)'} is not in the scheme"


@dataclasses.dataclass(frozen=True)
class WeightOperand(Rule):
    """The right operand is a float32 weight, or the product is an attention's."""

    name: ClassVar[str] = "weight"
    firm: ClassVar[bool] = True

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to computed weights, constants on the left, other element types."""
        left, right = node.inputs[0], node.inputs[1]
        types = {each.dtype for each in (left, right) if each is not None}
        if not types <= {ir.DataType.FLOAT, None}:
            return "not float32"
        if left in facts.constants and right in facts.constants:
            return "both operands are constant: computed once, when the graph is loaded"
        if left in facts.constants and node in facts.attention:
            return "the queries are constant"
        if left in facts.constants:
            return "the left operand is constant: coordinate arithmetic, not a layer"
        if right in facts.constants:
            return None
        if node.op_type != "MatMul":
            return "the weight is computed"
        if node in facts.attention:
            return None
        return "both operands are computed, and no softmax follows: not a layer"
