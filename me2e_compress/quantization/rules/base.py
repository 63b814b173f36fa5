"""What a rule is, and what it may know."""

import dataclasses
from collections.abc import Collection, Mapping
from typing import ClassVar, Protocol, Self

import onnx_ir as ir

from me2e_compress.quantization.coordinates import find_coordinates
from me2e_compress.quantization.find_attention import Attention, find_attention
from me2e_compress.runtime.constant_values import constant_values

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
        attention: the nodes that take part in an attention.
        coordinates: the products that positions come from, and which positions.
    """

    modules: frozenset[str]
    constants: Collection[ir.Value]
    attention: Mapping[ir.Node, Attention]
    coordinates: Mapping[ir.Node, str] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, model: ir.Model, modules: Collection[str]) -> Self:
        """Look at a graph: a few sweeps, each linear in its nodes."""
        constants = constant_values(model)
        return cls(
            frozenset(modules),
            constants,
            find_attention(model, constants),
            find_coordinates(model, constants),
        )


class Rule(Protocol):
    """Keeps some nodes in float.

    Class attributes:
        id: what plans and reports call it.
        firm: True where the node cannot be int8 at all, so that no override lifts it.
    """

    id: ClassVar[str]
    firm: ClassVar[bool]

    def objection(self, node: ir.Node, facts: Facts) -> str | None:
        """Say why this node stays in float; None to have no objection."""
        ...
