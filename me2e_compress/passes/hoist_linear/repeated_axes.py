"""The axes along which a value repeats, found behind whatever regroups them.

``Reshape(Tile(x, [1, 6, 1, 1]), [6, cells, heads, 32])`` repeats along its first axis,
and so does every layer's output that is made of it row by row. What counts are the
digits of the indices (:mod:`me2e_compress.passes.digits`): those that a Tile, Expand or
Concat adds make no difference to what the value holds.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress.graph import is_standard, static_shape
from me2e_compress.passes.digits import (
    Digit,
    Digits,
    Layout,
    before,
    flat,
    merged,
    regrouped,
    split_like,
    whole,
)

REPEATS = frozenset({"Concat", "Expand", "Tile"})
"""Operators that may repeat axes."""
LONGEST = 16
"""Largest number of nodes between the source and the repeated value."""


@dataclasses.dataclass(frozen=True)
class RepeatedAxes:
    """A value that is ``Expand(Reshape(source, small), large)``, reshaped.

    Attributes:
        source: the value that holds every element once.
        small: the sizes of ``large``, and 1 where the value repeats.
        large: the shape of the value; axes that repeat in part are split.
        nodes: the nodes between both, the last one first.
    """

    source: ir.Value
    small: tuple[int, ...]
    large: tuple[int, ...]
    nodes: tuple[ir.Node, ...]


def repeated_axes(value: ir.Value) -> RepeatedAxes | None:
    """Return the smallest source of a value that repeats; None if it does not.

    Of several sources of one size it is the last.
    """
    shape = static_shape(value)
    if not shape or 0 in shape:
        return None
    layout: Layout = tuple(whole(str(axis), size) for axis, size in enumerate(shape))
    best, least = None, math.prod(shape)
    nodes: list[ir.Node] = []
    while len(nodes) < LONGEST:
        node = value.producer()
        if node is None or node.graph is not value.graph:
            break
        source = node.inputs[0] if node.inputs else None
        earlier = _before_repeats(node, layout)
        if earlier is None or source is None:
            break
        value, layout = source, earlier
        nodes.append(node)
        size = math.prod(static_shape(value) or ())
        sizes = _sizes(shape, merged(flat(layout))) if size < least else None
        if sizes is not None:
            best, least = RepeatedAxes(value, *sizes, tuple(nodes)), size
    return best


def broadcasts(node: ir.Node) -> bool:
    """Return whether a node repeats only axes of size 1, as an Add does by itself.

    A Concat of the same value does so too: ``torch.stack([x] * 6)``.
    """
    if not is_standard(node) or node.op_type not in REPEATS:
        return False
    if node.op_type == "Concat" and len(set(node.inputs)) != 1:
        return False
    small, large = static_shape(node.inputs[0]), static_shape(node.outputs[0])
    if small is None or large is None:
        return False
    ends = large[len(large) - len(small) :]
    return all(one in (1, many) for one, many in zip(small, ends, strict=True))


def _before_repeats(node: ir.Node, layout: Layout) -> Layout | None:
    """Return the layout of what a node moves or repeats; None if it does neither."""
    if not is_standard(node) or not node.inputs:
        return None
    given = static_shape(node.inputs[0])
    if given is None or node.op_type not in REPEATS:
        return before(node, layout)
    if node.op_type == "Concat" and len(set(node.inputs)) != 1:
        return None
    found = [
        _once(digits, size)
        for digits, size in zip(layout[len(layout) - len(given) :], given, strict=True)
    ]
    known = tuple(digits for digits in found if digits is not None)
    return known if len(known) == len(found) else None


def _once(digits: Digits, size: int) -> Digits | None:
    """Return the digits of an axis before it was repeated, its last ones."""
    times = math.prod(digit.size for digit in digits) // size
    split = regrouped((digits,), (times, size))
    return None if split is None else split[1]


def _sizes(
    shape: Sequence[int], kept: Digits
) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Return the small and the large sizes; None if the source has another order."""
    small: list[int] = []
    large: list[int] = []
    mine: list[Digit] = []
    for axis, size in enumerate(shape):
        pieces = split_like(whole(str(axis), size), kept)
        if not pieces:
            small.append(1)
            large.append(1)
        for stays, group in itertools.groupby(pieces, lambda one: _is_in(one, kept)):
            found = list(group)
            large.append(math.prod(digit.size for digit in found))
            small.append(large[-1] if stays else 1)
            mine.extend(found if stays else ())
    return (tuple(small), tuple(large)) if merged(mine) == kept else None


def _is_in(digit: Digit, kept: Digits) -> bool:
    return any(
        one.axis == digit.axis and one.stride <= digit.stride and digit.end <= one.end
        for one in kept
    )
