"""Find the axes of batch, heads, tokens and channels of a batched product's operand.

Attention cuts heads out of rows by views: [B, J, H D] is reshaped to [B, J, H, D] and
transposed to [B, H, J, D], or to [B, H, D, J] for a product from the left; other code
has [J, B, H D], or one axis for batch and heads together.
"""

import dataclasses

import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.graph.nodes import VIEWS, permutation_of
from me2e_compress.graph.rewrite import is_standard, scalar_of, sole_maker
from me2e_compress.passes.digits import Digit, Layout, flat, regrouped, whole

BATCH_OR_TOKENS = ("0", "1")
CHANNELS = "2"
"""The axes of the rows, by number."""


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
    layout: Layout | None = tuple(whole(str(at), size) for at, size in enumerate(shape))
    for node in reversed(nodes):
        layout = None if layout is None else _moved(layout, node)
    if layout is None:
        return None
    return _read(value, shape, layout, tuple(nodes), scale)


def _factor(node: ir.Node) -> float | None:
    if node.op_type not in ("Mul", "Div"):
        return 1.0
    left, right = map(scalar_of, node.inputs)
    if node.op_type == "Div":
        return 1.0 / right if right else None
    return right if left is None else left


def _moved(layout: Layout, node: ir.Node) -> Layout | None:
    """Return the layout after a view; after a scaling it is the same."""
    shape = static_shape(node.outputs[0])
    if node.op_type == "Transpose":
        order = permutation_of(node)
        return None if order is None else tuple(layout[axis] for axis in order)
    return None if shape is None else regrouped(layout, shape)


def _read(
    value: ir.Value,
    shape: tuple[int, ...],
    layout: Layout,
    nodes: tuple[ir.Node, ...],
    scale: float,
) -> HeadLayout | None:
    if len(layout) < 2 or len(layout[-1]) != 1 or len(layout[-2]) != 1:
        return None
    # The last two axes must be tokens and channels
    turned = layout[-2][0].axis == CHANNELS
    channels, tokens = layout[-2 if turned else -1][0], layout[-1 if turned else -2][0]
    if channels.axis != CHANNELS or tokens.axis not in BATCH_OR_TOKENS:
        return None
    heads, batch_axis = shape[2] // channels.size, 1 - int(tokens.axis)
    # The axes before them must be batch and heads
    lead = whole(str(batch_axis), shape[batch_axis])
    if heads > 1:
        lead = (*lead, Digit(CHANNELS, channels.size, heads))
    if (
        shape[batch_axis] == 1
        or channels.stride != 1
        or (tokens,) != whole(tokens.axis, shape[1 - batch_axis])
        or flat(layout[:-2]) != lead
    ):
        return None
    return HeadLayout(
        value, nodes, scale, batch_axis,
        shape[batch_axis], heads, tokens.size, channels.size, turned,
    )  # fmt: skip
