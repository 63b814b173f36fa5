"""Products of few rows with matrices that axes of the batch share.

Given:   MatMul(x [1800, 8, 1, 32], keys [1, 8, 32, 101])

Result:  MatMul(x as [8, 1800, 32], keys as [8, 32, 101]) as [1800, 8, 1, 101]

These are 8 products of 1,800 rows, not 14,400 of one row, each of which would start a
kernel that reads the keys for a single row.
"""

import math

import onnx_ir as ir

from me2e_compress.graph import is_standard, static_shape
from me2e_compress.passes.hoist_linear.node_writer import NodeWriter
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter

FEW_ROWS = 8
"""Up to so many rows a product is joined with others. On onnxruntime (AMD Zen 5, one
thread, keys as above), joined over apart: 0.40 of the time at 1 row, 0.64 at 4, 0.84 at
8, 1.0 at 16 (``python -m benchmarks.bench_hoisting``)."""


def join_products(product: ir.Node, rewriter: Rewriter) -> bool:
    """Make the axes that share the right operand rows; False if they stay a batch."""
    if product.op_type != "MatMul" or not is_standard(product):
        return False
    left, right, out = *product.inputs, product.outputs[0]
    rows, columns, whole = map(static_shape, (left, right, out))
    if left is None or right is None or not rows or not columns or not whole:
        return False
    axes = _axes(rows, columns)
    if axes is None:
        return False
    # The sharing axes go next to the rows, where a view joins them
    kept, sharing = axes
    order = [*kept, *sharing, len(rows) - 2, len(rows) - 1]
    batch = tuple(rows[axis] for axis in kept if rows[axis] > 1)
    writer = NodeWriter(rewriter, (product,))
    joined = math.prod(rows[axis] for axis in sharing) * rows[-2]
    turned = writer.transpose(left, order)
    turned = writer.shape(turned, (*batch, joined, rows[-1]))
    matrices = writer.shape(right, (*batch, *columns[-2:]))
    # And back
    result = writer.multiply(turned, matrices)
    moved = tuple(whole[axis] for axis in order)
    result = writer.shape(result, moved)
    back = sorted(range(len(order)), key=order.__getitem__)
    rewriter.swap(out, writer.transpose(result, back))
    return True


def _axes(
    rows: tuple[int, ...], columns: tuple[int, ...]
) -> tuple[list[int], list[int]] | None:
    """Return the axes of the left batch that stay, and those that become rows."""
    if not 2 < len(columns) <= len(rows) or not 0 < rows[-2] <= FEW_ROWS:
        return None
    batch = rows[:-2]
    others = (*[1] * (len(rows) - len(columns)), *columns[:-2])
    if any(other not in (1, own) for own, other in zip(batch, others, strict=True)):
        return None
    sharing = [at for at, own in enumerate(batch) if own != others[at]]
    kept = [at for at, own in enumerate(batch) if own == others[at]]
    # A runtime joins all rows of a single matrix itself
    if not sharing or 0 in batch or math.prod(batch[at] for at in kept) == 1:
        return None
    return kept, sharing
