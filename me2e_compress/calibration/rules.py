"""Why a node stays in float: small rules, asked in order, the first answer counts.

Whatever stage 1 and stage 2 of the paper leave in, and whatever is no layer at all, is
named here. A rule set is a tuple of rules: leave one out to switch it off.
"""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Protocol

import onnx_ir as ir

from me2e_compress.calibration.attention import FUSED, Attention
from me2e_compress.calibration.products import extent
from me2e_compress.graph import provenance

CONVOLUTIONS = ("Conv", "ConvTranspose")
WEIGHTED = (*CONVOLUTIONS, "Gemm", "MatMul")
"""Operators that have an int8 kernel worth feeding (TensorRT, "weighted layers")."""


@dataclasses.dataclass(frozen=True)
class Facts:
    """What rules may know besides the node.

    Attributes:
        modules: which are to be int8.
        constants: the values that no input changes: weights, and what is computed
            from weights alone.
        attention: the products that take part in an attention.
    """

    modules: frozenset[str]
    constants: Collection[ir.Value]
    attention: Mapping[ir.Node, Attention]


class Rule(Protocol):
    """Keeps some nodes in float."""

    @property
    def id(self) -> str:
        """What reports call it."""
        ...

    def objection(self, node: ir.Node, facts: Facts) -> str | None:
        """Say why this node stays in float; None to have no objection."""
        ...


@dataclasses.dataclass(frozen=True)
class Operator:
    """Only convolutions and matrix products are int8."""

    id: str = "operator"

    def objection(self, node: ir.Node, facts: Facts) -> str | None:
        """Object to every other operator."""
        if node.domain in ("", "ai.onnx") and node.op_type in WEIGHTED:
            return None
        if node.op_type in FUSED:
            return (
                f"{node.op_type} is a whole attention, its products cannot be reached"
            )
        if node in facts.attention:
            return f"{node.op_type} in an attention has no int8 kernel"
        return f"{node.op_type} is no weighted layer"


@dataclasses.dataclass(frozen=True)
class ModuleScope:
    """Modules outside the scheme stay as they are."""

    id: str = "module"

    def objection(self, node: ir.Node, facts: Facts) -> str | None:
        """Object to a node of another module, or of none."""
        module = provenance.module_of(node)
        if module in facts.modules:
            return None
        return f"module {module or '(none)'} is not in the scheme"


@dataclasses.dataclass(frozen=True)
class Weight:
    """The right operand is a float32 weight, or the product is an attention's."""

    id: str = "weight"

    def objection(self, node: ir.Node, facts: Facts) -> str | None:
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


@dataclasses.dataclass(frozen=True)
class AttentionLength:
    """Stage 1 of the paper: long attention stays float.

    TensorRT validates fused int8 attention up to 512 tokens, and errors of the product
    of queries and keys grow with the length in the softmax.
    """

    limit: int = 512
    id: str = "attention-length"

    def objection(self, node: ir.Node, facts: Facts) -> str | None:
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


@dataclasses.dataclass(frozen=True)
class MatrixVector:
    """Stage 2 of the paper: a product that degenerates to GEMV gains nothing."""

    id: str = "gemv"

    def objection(self, node: ir.Node, facts: Facts) -> str | None:
        """Object if one side of the product is a single row or column."""
        if node.op_type in CONVOLUTIONS:
            return None
        size = extent(node, weight=node.inputs[1] in facts.constants)
        if not size.is_vector:
            return None
        return f"{size.rows} rows by {size.columns} columns: a matrix-vector product"


def paper_rules(attention_limit: int = 512) -> tuple[Rule, ...]:
    """Give the rule set of the paper: its two stages, and what is no layer at all."""
    return (
        Operator(),
        ModuleScope(),
        Weight(),
        AttentionLength(attention_limit),
        MatrixVector(),
    )
