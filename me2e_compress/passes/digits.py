"""Mixed-radix indices: what Reshape and Transpose do to the dimensions of a tensor.

A dimension of 16 that holds 2 images of 8 heads has the digits image and head. Reshape
regroups digits and Transpose reorders dimensions; neither moves anything else. So the
digits of every dimension determine the layout of a tensor.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import TypeAlias

import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, permutation_of


@dataclasses.dataclass(frozen=True)
class Digit:
    """One digit ``index // stride % size`` of the index named ``axis``."""

    axis: str
    stride: int
    size: int

    @property
    def end(self) -> int:
        """The stride of the next digit."""
        return self.stride * self.size


Digits: TypeAlias = tuple[Digit, ...]
Layout: TypeAlias = tuple[Digits, ...]
"""The digits of every dimension, most significant first; none where its size is 1."""


def whole(axis: str, size: int) -> Digits:
    """Return an index as its only digit; nothing where its size is 1."""
    return (Digit(axis, 1, size),) if size > 1 else ()


def flat(layout: Layout) -> Digits:
    """Return the digits of all dimensions in sequence."""
    return tuple(digit for digits in layout for digit in digits)


def sizes(layout: Layout) -> tuple[int, ...]:
    """Return the shape of a tensor of this layout."""
    return tuple(math.prod(digit.size for digit in digits) for digits in layout)


def regrouped(layout: Layout, shape: Sequence[int]) -> Layout | None:
    """Return the layout after a Reshape; None if it breaks digits up.

    ``[16] -> [2, 8]`` splits a digit in two; ``[4, 3] -> [6, 2]`` has no digits.
    """
    # The most significant digit is the last of the list
    rest = list(reversed(flat(layout)))
    groups: list[Digits] = []
    for size in shape:
        group: list[Digit] = []
        # Take digits from the front, and split the last if it divides
        while size > 1:
            if not rest:
                return None
            digit = rest.pop()
            if digit.size > size:
                if digit.size % size:
                    return None
                low = digit.size // size
                rest.append(Digit(digit.axis, digit.stride, low))
                digit = Digit(digit.axis, digit.stride * low, size)
            elif size % digit.size:
                return None
            group.append(digit)
            size //= digit.size
        groups.append(tuple(group))
    return None if rest else tuple(groups)


def before(node: ir.Node, layout: Layout) -> Layout | None:
    """Return the layout of a node's input from that of its output.

    None if it is no layout operator, a shape is unknown, or a Reshape breaks digits up.
    """
    shape, order = static_shape(node.inputs[0]), permutation_of(node)
    if shape is None or node.op_type not in LAYOUT_OPERATORS:
        return None
    if node.op_type != "Transpose" or order is None:
        return regrouped(layout, shape)
    return tuple(layout[order.index(axis)] for axis in range(len(order)))


def merged(digits: Iterable[Digit]) -> Digits:
    """Return digits with consecutive digits of the same index merged."""
    result: list[Digit] = []
    for digit in digits:
        last = result[-1] if result else None
        if last is not None and last.axis == digit.axis and last.stride == digit.end:
            result[-1] = Digit(digit.axis, digit.stride, last.size * digit.size)
        else:
            result.append(digit)
    return tuple(result)


def split_like(digits: Digits, others: Iterable[Digit]) -> Digits:
    """Return digits split wherever those of others begin or end."""
    # Where the digits of others begin and end, by index: a digit of stride 2 and size 4
    # at 2 and 8
    edges: dict[str, set[int]] = {}
    for other in others:
        edges.setdefault(other.axis, set()).update((other.stride, other.end))
    # Cut a digit of stride 1 and size 16 there: 1..2, 2..8 and 8..16 are digits of
    # sizes 2, 4 and 2, of which the last is the most significant
    pieces_of: list[Digit] = []
    for digit in digits:
        known = sorted(edges.get(digit.axis, ()))
        inner = (edge for edge in known if digit.stride < edge < digit.end)
        bounds = itertools.pairwise([digit.stride, *inner, digit.end])
        pieces = [Digit(digit.axis, low, high // low) for low, high in bounds]
        pieces_of.extend(reversed(pieces))
    return tuple(pieces_of)


def runs(source: Digits, wanted: Digits) -> tuple[list[Digits], list[int]]:
    """Split digits into runs that stay together in the wanted order.

    Returns the runs in the order of the source, and the wanted order as positions.
    """
    # A run begins wherever the next wanted digit is not the next of the source
    places = [source.index(digit) for digit in wanted]
    pairs = itertools.pairwise([-2, *places])
    starts = [place for before, place in pairs if place != before + 1]
    # The same runs in the order of the source, each up to where the next begins
    cuts = sorted(starts)
    bounds = itertools.pairwise([*cuts, len(source)])
    pieces = [source[low:high] for low, high in bounds]
    return pieces, [cuts.index(start) for start in starts]
