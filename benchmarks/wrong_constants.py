"""Seeded faults in what a node holds: weights, epsilons, bounds and indices.

Each makes one node wrong, and returns whether it could.
"""

import random

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import rewrite
from me2e_compress.graph.nodes import array_of, input_at, integers_of
from me2e_compress.graph.shapes import static_shape


def weight(node: ir.Node, rng: random.Random) -> bool:
    """Change one element, or all by one percent."""
    at = _float_constants(node)
    if node.op_type not in ("MatMul", "Gemm", "Conv", "Mul", "Add") or not at:
        return False
    index = rng.choice(at)
    array = _array(node, index).copy()
    if rng.random() < 0.5:
        array *= np.float32(1.01)
    else:
        array.reshape(-1)[rng.randrange(array.size)] += max(float(array.std()), 0.1)
    return _write(node, index, array)


def bias(node: ir.Node, rng: random.Random) -> bool:
    """Lose a bias."""
    if node.op_type in ("Conv", "Gemm") and len(node.inputs) > 2:
        index = 2
    elif node.op_type == "Add" and _float_constants(node):
        index = _float_constants(node)[0]
    else:
        return False
    value = node.inputs[index]
    array = None if value is None else array_of(value)
    if array is None or array.ndim != 1 or not array.any():
        return False
    return _write(node, index, np.zeros_like(array))


def epsilon(node: ir.Node, rng: random.Random) -> bool:
    """Take a hundred times the epsilon."""
    if "epsilon" in node.attributes:
        value = node.attributes.get_float("epsilon", 1e-5)
        node.attributes["epsilon"] = ir.AttrFloat32("epsilon", 100 * value)
        return True
    for index in _float_constants(node) if node.op_type == "Add" else ():
        array = _array(node, index)
        if array.size == 1 and 0 < float(array.reshape(-1)[0]) < 1e-3:
            return _write(node, index, array * np.float32(100))
    return False


def window(node: ir.Node, rng: random.Random) -> bool:
    """Slice one step beside."""
    if node.op_type != "Slice" or len(node.inputs) < 4:
        return False
    shape = static_shape(node.inputs[0])
    lists = [integers_of(input_at(node, at)) for at in (1, 2, 3)]
    steps = integers_of(input_at(node, 4)) or [1]
    if shape is None or None in lists or set(steps) != {1}:
        return False
    starts, ends, axes = ([*each] for each in lists if each is not None)
    size = shape[axes[0]]
    start = starts[0] + (size if starts[0] < 0 else 0)
    end = min(ends[0] + (size if ends[0] < 0 else 0), size)
    move = 1 if end < size else -1
    if not 0 <= start + move <= end + move <= size or start == end:
        return False
    starts[0], ends[0] = start + move, end + move
    _write(node, 1, np.array(starts, np.int64))
    return _write(node, 2, np.array(ends, np.int64))


def index(node: ir.Node, rng: random.Random) -> bool:
    """Gather one step beside."""
    shape = static_shape(node.inputs[0]) if node.inputs else None
    indices = array_of(node.inputs[1]) if node.op_type == "Gather" else None
    if shape is None or indices is None:
        return False
    size = shape[node.attributes.get_int("axis", 0)]
    moved = np.asarray((indices.astype(np.int64) + 1) % max(size, 1), indices.dtype)
    return size > 1 and _write(node, 1, moved)


def _float_constants(node: ir.Node) -> list[int]:
    found = []
    for index, value in enumerate(node.inputs):
        array = array_of(value)
        if array is not None and array.dtype == np.float32 and array.size:
            found.append(index)
    return found


def _array(node: ir.Node, index: int) -> npt.NDArray[np.float32]:
    array = array_of(node.inputs[index])
    assert array is not None
    return np.asarray(array, np.float32)


def _write(node: ir.Node, index: int, array: npt.NDArray[np.generic]) -> bool:
    """Give one node a constant of its own."""
    graph, old = node.graph, node.inputs[index]
    assert isinstance(graph, ir.Graph)
    assert old is not None
    made = rewrite.add_constant(graph, np.array(array), f"{old.name}_wrong")
    node.replace_input_with(index, made)
    return True
