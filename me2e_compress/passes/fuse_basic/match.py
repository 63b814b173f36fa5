"""What every pattern here is made of: guards first, refusals counted with reasons."""

import dataclasses
from collections import Counter

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import array_of
from me2e_compress.rewrite import FLOATS, is_standard, sole_reader

Numbers = npt.NDArray[np.float64]

CLOSE = 1e-4
"""How near a constant must be to the textbook's, relative: 0.7071 is 1/sqrt 2."""


@dataclasses.dataclass
class Site:
    """The graph that is being fused, and why some patterns were left alone."""

    graph: ir.Graph
    opset: int
    by: str
    swish: bool
    refused: Counter[str]

    def refuse(self, reason: str) -> bool:
        """Count a pattern that matched but may not be fused."""
        self.refused[reason] += 1
        return False


def maker(value: ir.Value | None, *op_types: str) -> ir.Node | None:
    """Give the node that makes a value, if it is one of these standard operators."""
    node = None if value is None else value.producer()
    if node is None or not is_standard(node) or node.op_type not in op_types:
        return None
    return node


def sole_maker(value: ir.Value | None, *op_types: str) -> ir.Node | None:
    """Give the maker of a value that one node reads, of the same graph."""
    node = maker(value, *op_types)
    if node is None or value is None or sole_reader(value) is None:
        return None
    return node if value is node.outputs[0] else None


def numbers_of(value: ir.Value | None) -> Numbers | None:
    """Give a constant floating-point array, widened to float64."""
    if value is None or value.dtype not in FLOATS:
        return None
    array = array_of(value)
    return None if array is None else array.astype(np.float64)


def scalar_of(value: ir.Value | None) -> float | None:
    """Give a constant of one element; None if it is an array or computed."""
    numbers = numbers_of(value)
    return float(numbers.item()) if numbers is not None and numbers.size == 1 else None


def is_close(value: float | None, expected: float) -> bool:
    """Say whether a constant is the one of the textbook."""
    return value is not None and abs(value - expected) <= CLOSE * abs(expected)


def constant_and_rest(node: ir.Node) -> tuple[Numbers, ir.Value] | None:
    """Tell the constant operand of a commutative operator from the computed one."""
    for constant, rest in ((0, 1), (1, 0)):
        numbers, value = numbers_of(node.inputs[constant]), node.inputs[rest]
        if numbers is not None and value is not None and array_of(value) is None:
            return numbers, value
    return None


def plus_scalar(value: ir.Value | None, expected: float) -> ir.Value | None:
    """Give x where a value is ``x + expected`` and nothing else reads the sum."""
    node = sole_maker(value, "Add")
    parts = constant_and_rest(node) if node is not None else None
    if parts is None or parts[0].size != 1:
        return None
    return parts[1] if is_close(float(parts[0].item()), expected) else None
