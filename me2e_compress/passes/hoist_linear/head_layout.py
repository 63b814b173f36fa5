"""Find the axes of batch, heads, tokens and channels of a batched product's operand.

Attention cuts heads out of rows by views: [B, J, H D] is reshaped to [B, J, H, D] and
transposed to [B, H, J, D], or to [B, H, D, J] for a product from the left; other code
has [J, B, H D], or one axis for batch and heads together.
"""

import dataclasses

import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.passes.hoist_linear.row_moves import VIEWS
from me2e_compress.rewrite import is_standard, scalar_of, sole_maker

Atom = tuple[int, int, int]
"""A piece of an axis of the rows: axis, number of steps, length of a step."""


@dataclasses.dataclass(frozen=True)
class HeadLayout:
    """How an operand is cut out of rows ``value``: [B, J, H D], or [J, B, H D].

    ``nodes`` are the views and scalings in between, the last one first; ``scale`` is
    the product of the scalings. A ``turned`` operand is [.., D, J] (keys), not [.., J,
    D] (values); D are the channels of one head, J the tokens.
    """

    value: ir.Value
    nodes: tuple[ir.Node, ...]
    scale: float
    batch_axis: int
    batch: int
    heads: int
    tokens: int
    channels: int
    turned: bool

    def is_shared(self, shape: tuple[int, ...] | None) -> bool:
        """Return whether rows of this shape are the same for every batch."""
        return shape is not None and shape == self._rows(1, self.heads * self.channels)

    def is_whole(self, shape: tuple[int, ...] | None) -> bool:
        """Return whether every batch has such rows, of fewer columns."""
        if not shape or shape[-1] >= self.channels:
            return False
        return shape == self._rows(self.batch, shape[-1])

    def _rows(self, batch: int, columns: int) -> tuple[int, ...]:
        pair = (self.tokens, batch) if self.batch_axis else (batch, self.tokens)
        return (*pair, columns)


def layout_of(operand: ir.Value) -> HeadLayout | None:
    """Return how an operand is cut out of rows by nodes that nothing else reads."""
    # Walk back over views and scalings
    value, scale = operand, 1.0
    nodes: list[ir.Node] = []
    while (node := sole_maker(value, "Transpose", "Mul", "Div", *VIEWS)) is not None:
        factor = _factor(node)
        first = node.op_type == "Mul" and scalar_of(node.inputs[0]) is not None
        source = node.inputs[1 if first else 0]
        if factor is None or source is None or not is_standard(node):
            break
        scale, value = scale * factor, source
        nodes.append(node)
    shape = static_shape(value)
    if not nodes or shape is None or len(shape) != 3:
        return None
    # Then apply the views to the axes of the rows
    axes = [[(axis, size, 1)] if size > 1 else [] for axis, size in enumerate(shape)]
    for node in reversed(nodes):
        moved = _view(axes, node)
        if moved is None:
            return None
        axes = moved
    return _read(value, shape, axes, tuple(nodes), scale)


def _factor(node: ir.Node) -> float | None:
    if node.op_type not in ("Mul", "Div"):
        return 1.0
    left, right = map(scalar_of, node.inputs)
    if node.op_type == "Div":
        return 1.0 / right if right else None
    return right if left is None else left


def _view(axes: list[list[Atom]], node: ir.Node) -> list[list[Atom]] | None:
    shape = static_shape(node.outputs[0])
    if node.op_type == "Transpose":
        order = node.attributes.get("perm")
        return None if order is None else [axes[axis] for axis in order.as_ints()]
    return None if shape is None else _regroup(axes, shape)


def _regroup(axes: list[list[Atom]], shape: tuple[int, ...]) -> list[list[Atom]] | None:
    atoms = [atom for axis in axes for atom in axis][::-1]
    found: list[list[Atom]] = []
    for size in shape:
        axis: list[Atom] = []
        # Take atoms from the front, and split the last if it divides
        while size > 1:
            if not atoms:
                return None
            of, count, step = atoms.pop()
            if size % count == 0:
                axis.append((of, count, step))
                size //= count
            elif count % size == 0:
                inner = count // size
                axis.append((of, size, step * inner))
                atoms.append((of, inner, step))
                size = 1
            else:
                return None
        found.append(axis)
    return None if atoms else found


def _read(
    value: ir.Value,
    shape: tuple[int, ...],
    axes: list[list[Atom]],
    nodes: tuple[ir.Node, ...],
    scale: float,
) -> HeadLayout | None:
    if len(axes) < 2 or len(axes[-1]) != 1 or len(axes[-2]) != 1:
        return None
    # The last two axes must be tokens and channels
    turned = axes[-2][0][0] == 2
    channels, tokens = axes[-2 if turned else -1][0], axes[-1 if turned else -2][0]
    heads = shape[2] // channels[1]
    batch_axis = 1 - tokens[0]
    # The axes before them must be batch and heads
    lead = [(batch_axis, shape[batch_axis], 1)]
    if heads > 1:
        lead.append((2, heads, channels[1]))
    if (
        batch_axis not in (0, 1)
        or channels != (2, channels[1], 1)
        or tokens != (tokens[0], shape[tokens[0]], 1)
        or [atom for axis in axes[:-2] for atom in axis] != lead
    ):
        return None
    return HeadLayout(
        value, nodes, scale, batch_axis,
        shape[batch_axis], heads, tokens[1], channels[1], turned,
    )  # fmt: skip
