"""The rule set of the paper: operators, modules and the two stages."""

import dataclasses
from typing import ClassVar

import onnx_ir as ir

from me2e_compress.graph import WEIGHTED, is_standard, provenance
from me2e_compress.graph.shapes import PRODUCTS, extent
from me2e_compress.operators import int8_inputs
from me2e_compress.quantization.find_attention import is_fused
from me2e_compress.quantization.rules.base import Rule, RuleFacts, RuleSet


@dataclasses.dataclass(frozen=True)
class WeightedOperator(Rule):
    """Convolutions and matrix products may be int8, and features that are sampled."""

    name: ClassVar[str] = "operator"
    firm: ClassVar[bool] = True

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to every other operator, and to what the target cannot read."""
        if is_standard(node) and node.op_type in WEIGHTED:
            return None
        if int8_inputs(node):
            return None if facts.fused is None else facts.fused(node)
        if node not in facts.attention:
            return f"{node.op_type} is not a weighted layer"
        if not is_fused(node):
            return f"{node.op_type} in an attention has no int8 kernel"
        size = facts.attention[node]
        return (
            f"{node.op_type} is a whole attention of {size.queries} queries and"
            f" {size.keys} keys, its products cannot be reached"
        )


@dataclasses.dataclass(frozen=True)
class FusedOperator(Rule):
    """Fused operators stay as they are, the features too that they sample."""

    name: ClassVar[str] = "fused-operator"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to every fused operator."""
        if not int8_inputs(node):
            return None
        return f"{node.op_type} is fused: only convolutions and products become int8"


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
    """The right operand is a weight in float32 or float16, or of an attention."""

    name: ClassVar[str] = "weight"
    firm: ClassVar[bool] = True

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object to computed weights, constants on the left, other element types."""
        left, right = node.inputs[0], node.inputs[1]
        if int8_inputs(node):
            return _no_features(left, facts)
        # operands of floats, and not all constant
        types = {each.dtype for each in (left, right) if each is not None}
        if not types <= {ir.DataType.FLOAT, ir.DataType.FLOAT16, None}:
            return "neither float32 nor float16"
        if left in facts.constants and right in facts.constants:
            return "both operands are constant: computed once, when the graph is loaded"
        if left in facts.constants and node in facts.attention:
            return "the queries are constant"
        if left in facts.constants:
            return "the left operand is constant: coordinate arithmetic, not a layer"
        # a weight, or the product of an attention
        if right in facts.constants:
            return None
        if node.op_type != "MatMul":
            return "the weight is computed"
        if node in facts.attention:
            return None
        return "both operands are computed, and no softmax follows: not a layer"


def _no_features(value: ir.Value | None, facts: RuleFacts) -> str | None:
    """Say why what a fused operator samples cannot become int8; None if it can."""
    if value is None or value in facts.constants:
        return "what it samples is constant"
    if value.dtype not in (ir.DataType.FLOAT, None):
        return "what it samples is not float32"
    return None


@dataclasses.dataclass(frozen=True)
class AttentionLength(Rule):
    """Stage 1: long attention stays float.

    TensorRT fuses int8 attention up to 512 queries and 512 keys, and errors of the
    product of queries and keys grow with the length in the softmax.

    Attributes:
        limit: longest attention that becomes int8, in tokens.
    """

    limit: int = 512
    name: ClassVar[str] = "attention-length"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object if queries or keys are more than the limit, or unknown in number."""
        attention = facts.attention.get(node)
        if attention is None:
            return None
        if attention.length is None:
            return f"attention of unknown length, limit {self.limit}"
        if attention.length <= self.limit:
            return None
        return (
            f"attention of {attention.queries} queries and {attention.keys} keys,"
            f" more than {self.limit}"
        )

    def borderline(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Return what is close about a node: a reader may want to decide it otherwise.

        Close is within an eighth of the limit; or only one of queries and keys beyond
        it, so that tools which look at one of the two decide otherwise.
        """
        attention = facts.attention.get(node)
        if attention is None or attention.queries is None or attention.keys is None:
            return None
        sizes = f"{attention.queries} queries, {attention.keys} keys"
        longest = max(attention.queries, attention.keys)
        if abs(longest - self.limit) <= self.limit // 8:
            return f"{sizes}: close to the limit of {self.limit}"
        if min(attention.queries, attention.keys) <= self.limit < longest:
            return f"{sizes}: one within the limit of {self.limit}, one beyond"
        return None


@dataclasses.dataclass(frozen=True)
class MatrixVector(Rule):
    """Stage 2: a product that degenerates to GEMV gains nothing."""

    name: ClassVar[str] = "gemv"

    def objection(self, node: ir.Node, facts: RuleFacts) -> str | None:
        """Object if one side of the product is a single row or column."""
        if node.op_type not in PRODUCTS:
            return None
        size = extent(node, weight=node.inputs[1] in facts.constants)
        if not size.is_vector:
            return None
        return f"{size.rows} rows by {size.columns} columns: a matrix-vector product"


@dataclasses.dataclass(frozen=True)
class PaperRules(RuleSet):
    """The two stages of the paper alone, and what is no layer at all.

    Attributes:
        attention_limit: longest attention that becomes int8, in tokens.
        without: names of rules that are switched off, e.g. ``gemv``.
        extra: more rules, asked last.
    """

    name: ClassVar[str] = "paper"
    method: ClassVar[str] = "max-min"  # section III-C, equation 3
    attention_limit: int = 512

    def own_rules(self) -> tuple[Rule, ...]:
        """Return six rules, the stages last."""
        return (
            WeightedOperator(),
            FusedOperator(),
            ModuleScope(),
            WeightOperand(),
            AttentionLength(self.attention_limit),
            MatrixVector(),
        )
