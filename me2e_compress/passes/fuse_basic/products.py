"""A value as a product: a constant times powers of other values."""

import dataclasses

import onnx_ir as ir

from me2e_compress.passes.fuse_basic.match import (
    constant_and_rest,
    scalar_of,
    sole_maker,
)


@dataclasses.dataclass
class Product:
    """``scale`` times the factors, each as often as it is listed.

    Attributes:
        scale: the product of the constant factors, all of one element.
        factors: the other factors, in order.
        nodes: the nodes that multiply, the last one first.
    """

    scale: float
    factors: list[ir.Value]
    nodes: list[ir.Node]


def product_of(node: ir.Node) -> Product:
    """Take Mul, Div by a constant and Pow by a whole number apart, down to the leaves.

    Inner products are opened only where nothing else reads them.
    """
    found = Product(1.0, [], [])
    _open(node, found)
    return found


def _open(node: ir.Node, found: Product) -> None:
    found.nodes.append(node)
    left, right = node.inputs[0], node.inputs[1]
    if node.op_type == "Mul":
        for value in (left, right):
            _factor(value, found)
    elif node.op_type == "Div":
        divisor = scalar_of(right)
        if divisor:
            found.scale /= divisor
            _factor(left, found)
        else:
            found.factors.append(node.outputs[0])
    else:
        power = scalar_of(right)
        times = int(power) if power in (2.0, 3.0) else 0
        if left is None or not times:
            found.factors.append(node.outputs[0])
        else:
            found.factors.extend([left] * times)


def _factor(value: ir.Value | None, found: Product) -> None:
    if value is None:
        return
    constant = scalar_of(value)
    inner = sole_maker(value, "Mul", "Div", "Pow")
    if constant is not None:
        found.scale *= constant
    elif inner is not None and _opens(inner):
        _open(inner, found)
    else:
        found.factors.append(value)


def _opens(node: ir.Node) -> bool:
    if node.op_type == "Div":
        return bool(scalar_of(node.inputs[1]))
    if node.op_type == "Pow":
        return scalar_of(node.inputs[1]) in (2.0, 3.0)
    return True


def scaled(value: ir.Value | None) -> tuple[float, ir.Value] | None:
    """Read a value as a constant times one other value."""
    node = sole_maker(value, "Mul", "Div")
    if node is None:
        return None
    if node.op_type == "Div":
        divisor, rest = scalar_of(node.inputs[1]), node.inputs[0]
        return (1 / divisor, rest) if divisor and rest is not None else None
    parts = constant_and_rest(node)
    if parts is None or parts[0].size != 1:
        return None
    return float(parts[0].item()), parts[1]
