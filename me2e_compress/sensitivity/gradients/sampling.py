"""Gradients of what samples between elements."""

from collections.abc import Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress.graph.nodes import Array
from me2e_compress.runtime.session import run_once
from me2e_compress.sensitivity.gradients.tape import (
    Found,
    NoRuleError,
    Rule,
    Tape,
    given,
    numpy_of,
    sizes_of,
)


def _resize(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    """Multiply by the transposed matrix of each axis, which the operator tells."""
    have, made = sizes_of(node.inputs[0]), sizes_of(node.outputs[0])
    for at, (n, m) in enumerate(zip(have, made, strict=True)):
        if n == m:
            continue
        matrix = t.constant(_axis_matrix(node, n, m, numpy_of(node.inputs[0])))
        last = len(have) - 1
        order = list(range(last + 1))
        order[at], order[last] = last, at
        turned = g if at == last else t.op("Transpose", [g], {"perm": order})
        g = t.op("MatMul", [turned, matrix])
        g = g if at == last else t.op("Transpose", [g], {"perm": order})
    return [g]


def _axis_matrix(node: ir.Node, n: int, m: int, kind: np.dtype[np.generic]) -> Array:
    """Return the [m, n] matrix by which Resize maps n columns to m."""
    opset = 13 if node.graph is None else node.graph.opset_imports.get("", 13)
    left_out = ("axes", "keep_aspect_ratio_policy")
    x = ir.val("x", ir.DataType.FLOAT, [1, 1, n, n])
    size = ir.tensor(np.array([1, 1, n, m]), name="size")
    sizes = ir.Value(name="size", const_value=size, type=ir.TensorType(size.dtype))
    made = ir.node(
        "Resize",
        [x, None, None, sizes],
        {name: each for name, each in node.attributes.items() if name not in left_out},
    )
    made.outputs[0].name = "y"
    part = ir.Graph(
        [x], made.outputs, nodes=[made], initializers=[sizes], opset_imports={"": opset}
    )
    feeds = {"x": np.eye(n, dtype=np.float32)[None, None]}
    columns = run_once(ir.Model(part, ir_version=9), feeds)["y"][0, 0]
    return np.ascontiguousarray(columns.T.astype(kind))


def _grid_sample(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    """Bilinear: a pixel gets the shares of its samples, a position the slope there."""
    x, grid = given(node.inputs[0]), given(node.inputs[1])
    options = node.attributes
    mode = options.get_string("mode", "bilinear")
    padding = options.get_string("padding_mode", "zeros")
    if (
        len(sizes_of(x)) != 4
        or mode not in ("linear", "bilinear")
        or padding != "zeros"
    ):
        raise NoRuleError("no rule but for bilinear samples of images, zeros outside")
    n, channels, height, width = sizes_of(x)
    rows, columns = sizes_of(grid)[1:3]
    aligned = options.get_int("align_corners", 0)
    # column and row of each sample, its pixel and the fraction beyond
    last = np.array([width, height]) - aligned
    half = t.constant((last / 2).astype(numpy_of(x)))
    middle = t.constant(((np.array([width, height]) - 1) / 2).astype(numpy_of(x)))
    place = t.op("Add", [t.times(grid, half), middle])
    pixel = t.op("Floor", [place])
    beyond = t.op("Sub", [place, pixel])

    # slopes: differences of the samples at the two columns, at the two rows
    def sampled(at: ir.Value) -> ir.Value:
        back = t.op("Div", [t.op("Sub", [at, middle]), half])
        return t.op("GridSample", [x, back], {
            "align_corners": aligned, "mode": mode, "padding_mode": padding,
        })  # fmt: skip

    slopes = []
    for at in range(2):
        this = t.constant(np.eye(2, dtype=numpy_of(x))[at])
        low = t.op("Sub", [place, t.times(beyond, this)])
        rise = t.op("Sub", [sampled(t.op("Add", [low, this])), sampled(low)])
        slopes.append(t.total(t.times(g, rise), [1], keep=False))
    both = [t.op("Unsqueeze", [each, t.ints([3])]) for each in slopes]
    to_grid = t.times(t.op("Concat", both, {"axis": 3}), half)

    # shares: each sample adds its gradient to two rows and two columns of pixels
    count = n * rows * columns
    across, share_across = _pixels(t, grid, 0, width, aligned, count)
    along, share_along = _pixels(t, grid, 1, height, aligned, count)
    across, share_across = (t.shaped(e, [1, 2, count]) for e in (across, share_across))
    along, share_along = (t.shaped(e, [2, 1, count]) for e in (along, share_along))
    place = t.op("Add", [across, t.times(along, t.number(width, x))])
    first = np.repeat(np.arange(n) * height * width, rows * columns)
    index = t.op("Add", [t.op("Cast", [place], {"to": 7}), t.constant(first)])
    moved = t.op("Transpose", [g], {"perm": [0, 2, 3, 1]})
    samples = t.shaped(moved, [count, channels])
    image = t.zeros([n * height * width, channels], x)
    index = t.shaped(index, [4, count, 1])
    weights = t.shaped(t.times(share_across, share_along), [4, count, 1])
    for at in range(4):  # one by one, for what all would take of memory
        corner = t.constant(np.array(at))
        its, weight = (
            t.op("Gather", [each, corner], {"axis": 0}) for each in (index, weights)
        )
        added = t.times(samples, weight)
        image = t.op("ScatterND", [image, its, added], {"reduction": "add"})
    back = t.shaped(image, [n, height, width, channels])
    return [t.op("Transpose", [back], {"perm": [0, 3, 1, 2]}), to_grid]


def _pixels(
    t: Tape, grid: ir.Value, axis: int, size: int, aligned: int, count: int
) -> tuple[ir.Value, ir.Value]:
    """Return the two pixels of each sample along an axis, and its shares in them."""
    u = t.op("Gather", [grid, t.constant(np.array(axis))], {"axis": 3})
    half, middle = t.number((size - aligned) / 2, grid), t.number((size - 1) / 2, grid)
    place = t.shaped(t.op("Add", [t.times(u, half), middle]), [1, count])
    low, one = t.op("Floor", [place]), t.number(1, grid)
    beyond = t.op("Sub", [place, low])
    ends = t.op("Concat", [low, t.op("Add", [low, one])], {"axis": 0})
    inner = t.op("Clip", [ends, t.number(0, grid), t.number(size - 1, grid)])
    inside = t.as_number(t.op("Equal", [inner, ends]), grid)
    shares = t.op("Concat", [t.op("Sub", [one, beyond]), beyond], {"axis": 0})
    return inner, t.times(shares, inside)


RULES: Mapping[str, Rule] = {
    "Resize": _resize,
    "GridSample": _grid_sample,
}
