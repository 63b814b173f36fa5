"""A value as a product: a constant times other values."""

import dataclasses

import onnx_ir as ir

from me2e_compress.graph.nodes import maker, scalar_of, sole_maker

_POWERS = (2.0, 3.0)
"""Powers that count as so many factors."""


@dataclasses.dataclass
class Factors:
    """``scale`` times the factors, each as often as it is listed.

    Attributes:
        scale: the product of the constant factors, all of one element.
        factors: the other factors, in order.
        nodes: the nodes that multiply, the last one first.
    """

    scale: float
    factors: list[ir.Value]
    nodes: list[ir.Node]


def factors_of(value: ir.Value) -> Factors | None:
    """Take Mul, Div by a constant and Pow by 2 or 3 apart, down to the leaves.

    Inner products are opened only where nothing else reads them. None if nothing
    multiplies.
    """
    node = maker(value, "Mul", "Div", "Pow")
    if node is None or not _opens(node):
        return None
    found = Factors(1.0, [], [])
    _open(node, found)
    return found


def _opens(node: ir.Node) -> bool:
    """Return whether a node multiplies its first input; a Mul both."""
    if node.op_type == "Mul":
        return True
    number = scalar_of(node.inputs[1])
    return bool(number) if node.op_type == "Div" else number in _POWERS


def _open(node: ir.Node, found: Factors) -> None:
    found.nodes.append(node)
    left, right = node.inputs[0], node.inputs[1]
    number = scalar_of(right) if node.op_type != "Mul" else None
    if number is None:
        _enter(left, found)
        _enter(right, found)
    elif node.op_type == "Div":
        found.scale /= number
        _enter(left, found)
    elif left is not None:
        found.factors.extend([left] * int(number))


def _enter(value: ir.Value | None, found: Factors) -> None:
    if value is None:
        return
    constant = scalar_of(value)
    inner = sole_maker(value, "Mul", "Div", "Pow") if constant is None else None
    if constant is not None:
        found.scale *= constant
    elif inner is not None and _opens(inner):
        _open(inner, found)
    else:
        found.factors.append(value)
