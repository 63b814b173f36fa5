"""The ways to multiply a value by a matrix, as data."""

import dataclasses
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress.passes.hoist_linear.linear_layers import LinearLayer


@dataclasses.dataclass(frozen=True)
class Direct:
    """Multiply a value as it is."""

    value: ir.Value


@dataclasses.dataclass(frozen=True)
class Precomputed:
    """Multiply a constant in advance."""

    value: ir.Value


@dataclasses.dataclass(frozen=True)
class Moved:
    """Multiply the inputs of a node that moves rows, then move the product."""

    node: ir.Node
    parts: tuple["Way", ...]


@dataclasses.dataclass(frozen=True)
class Composed:
    """Multiply the source of a linear layer by the product of both matrices."""

    layer: LinearLayer
    way: "Way"


@dataclasses.dataclass(frozen=True)
class Term:
    """One term of a sum of products; ``rows`` of the matrix are None for all."""

    way: "Way"
    shape: tuple[int, ...]
    rows: tuple[int, int] | None = None


@dataclasses.dataclass(frozen=True)
class Distributed:
    """Add (or subtract) the products of an Add, a Sub, or a Concat of columns."""

    node: ir.Node
    terms: tuple[Term, ...]


Way: TypeAlias = Direct | Precomputed | Moved | Composed | Distributed


def uses_weight(way: Way) -> bool:
    """Return whether some part of a way multiplies by the unchanged weight."""
    if isinstance(way, Moved):
        return any(map(uses_weight, way.parts))
    if isinstance(way, Distributed):
        return any(one.rows is None and uses_weight(one.way) for one in way.terms)
    return isinstance(way, Direct)
