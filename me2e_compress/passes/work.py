"""The cost of a node per frame, and its equivalent in bytes of the file."""

import math

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import macs
from me2e_compress.graph.nodes import VIEWS
from me2e_compress.graph.summary import value_bytes

BYTES_PER_NODE = 2048
"""File bytes that a removed node may cost: at 2 us a node, 1 MB for 1 ms."""
MACS_PER_NODE = 200_000
"""Multiply-accumulates that take as long as starting a node does."""
MOVED_BYTES_PER_NODE = 40_000
"""Bytes read and written that take as long as starting a node does.

Both at 2 us a node, which is what a GPU takes to launch a kernel and onnxruntime to
start an operator that allocates; at 100 GMAC/s of float32 products and 20 GB/s through
element-wise operators on two cores of an AMD Zen 5 (``python -m
benchmarks.measure.folding --price`` measures a machine).
"""

SMALL_PRODUCTS_PER_NODE = 25
"""Products of a batch of matrices that take as long to start as a node does.

At 85 ns each: a matrix [4, 4] times each of 240,000 vectors takes onnxruntime's CPU
20.4 ms (``python -m benchmarks.measure.hoisting``).
"""


def small_products(left: tuple[int, ...], right: tuple[int, ...]) -> int:
    """Return how many products of matrices onnxruntime starts for operands' shapes.

    It is one where the right operand is a single matrix: its rows are one batch then.
    """
    if math.prod(right[:-2]) == 1:
        return 1
    return math.prod(np.broadcast_shapes(left[:-2], right[:-2]))


def item_bytes(value: ir.Value) -> float:
    """Return the bytes of an element; those of float32 where the type is unknown."""
    return 4.0 if value.dtype is None else value.dtype.itemsize


def work(node: ir.Node) -> float:
    """Return the cost of a node per frame in node starts: 1 plus its work.

    Unknown sizes count as 0.
    """
    if node.op_type in VIEWS or node.op_type in ("Shape", "Size"):  # move no data
        return 1.0
    values = [*node.inputs, *node.outputs]
    moved = sum(value_bytes(value) or 0 for value in values if value is not None)
    products = macs(node) or 0
    return 1.0 + products / MACS_PER_NODE + moved / MOVED_BYTES_PER_NODE
