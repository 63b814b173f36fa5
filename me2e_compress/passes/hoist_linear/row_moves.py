"""Operators that only rearrange or repeat rows and keep the last axis.

Row-wise operators may be computed before them: ``Tile(x) @ W`` is ``Tile(x @ W)``.
"""

import math
from collections.abc import Callable

import onnx_ir as ir

from me2e_compress.graph import is_standard, rank_of, static_shape
from me2e_compress.graph.nodes import VIEWS, integers_at, permutation_of

REPEATS = frozenset({"Concat", "Expand", "Tile"})
"""Those that may repeat axes of size 1."""


def moved_rows(node: ir.Node) -> tuple[ir.Value, ...] | None:
    """Return the inputs whose rows a node rearranges or repeats; None if none."""
    rule = _RULES.get(node.op_type)
    if rule is None or not is_standard(node) or not node.inputs:
        return None
    count = len(node.inputs) if node.op_type == "Concat" else 1
    sources = tuple(value for value in node.inputs[:count] if value is not None)
    result = static_shape(node.outputs[0])
    if not result or not rule(node, len(result)):
        return None
    for value in sources:
        shape = static_shape(value)
        if not shape or shape[-1] != result[-1] or math.prod(shape) == 0:
            return None
    return sources


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


def without_repeats(value: ir.Value | None) -> ir.Value | None:
    """Return the value before a repetition along axes of size 1, if there is one."""
    node = None if value is None else value.producer()
    return node.inputs[0] if node is not None and broadcasts(node) else None


def _always(node: ir.Node, rank: int) -> bool:
    return True


def _axis(default: int) -> Callable[[ir.Node, int], bool]:

    def check(node: ir.Node, rank: int) -> bool:
        axis = node.attributes.get_int("axis", default)
        inner = rank_of(node.inputs[0]) or 0
        return axis % inner != inner - 1 if inner else False

    return check


def _transpose(node: ir.Node, rank: int) -> bool:
    order = permutation_of(node)
    return order is not None and order[-1] == rank - 1


def _slice(node: ir.Node, rank: int) -> bool:
    axes = integers_at(node, "axes", 3)
    return axes is not None and all(axis % rank != rank - 1 for axis in axes)


def _gather_nd(node: ir.Node, rank: int) -> bool:
    index, inner = static_shape(node.inputs[1]), rank_of(node.inputs[0])
    batch = node.attributes.get_int("batch_dims", 0)
    return bool(index) and inner is not None and batch + index[-1] < inner  # type: ignore[index]


_RULES: dict[str, Callable[[ir.Node, int], bool]] = {
    **dict.fromkeys((*sorted(VIEWS), "Expand", "Tile"), _always),
    "Concat": _axis(0),
    "Gather": _axis(0),
    "GatherND": _gather_nd,
    "Slice": _slice,
    "Transpose": _transpose,
}
