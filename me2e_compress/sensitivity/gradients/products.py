"""Gradients of products, convolutions and pools."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of
from me2e_compress.graph.nodes import input_at
from me2e_compress.sensitivity.gradients.tape import (
    Found,
    NoRuleError,
    Rule,
    Tape,
    given,
    numpy_of,
    sizes_of,
)


def _turned(t: Tape, value: ir.Value, rank: int) -> ir.Value:
    """Exchange the last two axes."""
    order = [*range(rank - 2), rank - 1, rank - 2]
    return t.op("Transpose", [value], {"perm": order})


def _matmul(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    y, (a, b) = node.outputs[0], map(given, node.inputs)
    left, right, made = sizes_of(a), sizes_of(b), sizes_of(y)
    if min(len(left), len(right)) < 2:
        raise NoRuleError("no rule for a vector")
    to_a = t.op("MatMul", [g, _turned(t, b, len(right))])
    to_b = t.op("MatMul", [_turned(t, a, len(left)), g])
    return [
        _summed(t, to_a, (*made[:-1], left[-1]), left),
        _summed(t, to_b, (*made[:-2], *right[-2:]), right),
    ]


def _summed(t: Tape, g: ir.Value, have: Sequence[int], want: Sequence[int]) -> ir.Value:
    """Sum over the leading axes that were broadcast."""
    if tuple(have) == tuple(want):
        return g
    lead = len(have) - len(want)
    axes = [at for at in range(len(have)) if at < lead or want[at - lead] != have[at]]
    return t.shaped(t.total(g, axes, keep=False), want)


def _gemm(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    a, b = given(node.inputs[0]), given(node.inputs[1])
    options = node.attributes
    turn_a, turn_b = options.get_int("transA", 0), options.get_int("transB", 0)
    alpha = t.number(options.get_float("alpha", 1.0), a)
    scaled = t.times(g, alpha) if options.get_float("alpha", 1.0) != 1 else g
    to_a = t.op("MatMul", [scaled, b if turn_b else _turned(t, b, 2)])
    to_b = t.op("MatMul", [a if turn_a else _turned(t, a, 2), scaled])
    found: list[ir.Value | None] = [
        _turned(t, to_a, 2) if turn_a else to_a,
        _turned(t, to_b, 2) if turn_b else to_b,
    ]
    if (bias := input_at(node, 2)) is not None:
        beta = t.number(options.get_float("beta", 1.0), a)
        found.append(t.narrowed(t.times(g, beta), node.outputs[0], bias))
    return found


def _window(node: ir.Node, rank: int) -> tuple[list[int], list[int], list[int]]:
    """Return strides, dilations and pads; pads that a size decides are refused."""
    options = node.attributes
    if options.get_string("auto_pad", "NOTSET") not in ("NOTSET", "VALID"):
        raise NoRuleError("no rule for auto_pad")
    strides = list(options.get_ints("strides") or [1] * rank)
    dilations = list(options.get_ints("dilations") or [1] * rank)
    return strides, dilations, list(options.get_ints("pads") or [0] * 2 * rank)


def _conv(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x, w = given(node.inputs[0]), given(node.inputs[1])
    size, kernel = sizes_of(x)[2:], sizes_of(w)[2:]
    strides, dilations, pads = _window(node, len(size))
    groups, rank = node.attributes.get_int("group", 1), len(size)
    weight = array_of(w)
    reach = [d * (k - 1) for d, k in zip(dilations, kernel, strict=True)]
    options: dict[str, int | list[int]] = {"group": groups, "dilations": dilations}
    if weight is not None and set(strides) == {1} and min(pads) >= 0:
        # a convolution by the mirrored kernel, which has the faster kernels
        flipped = np.flip(weight, tuple(range(2, 2 + rank)))
        parts = np.split(flipped, groups)
        mirrored = np.concatenate([np.swapaxes(part, 0, 1) for part in parts])
        inner = [r - p for r, p in zip([*reach, *reach], pads, strict=True)]
        if min(inner) >= 0:
            options["pads"] = inner
            turned = t.constant(np.ascontiguousarray(mirrored))
            return [t.op("Conv", [g, turned], options)]
    made, ends = sizes_of(node.outputs[0])[2:], range(rank)
    extra = [
        size[at] - (strides[at] * (made[at] - 1) + reach[at] + 1)
        + pads[at] + pads[at + rank]
        for at in ends
    ]  # fmt: skip
    options |= {"strides": strides, "pads": pads, "output_padding": extra}
    return [t.op("ConvTranspose", [g, w], options)]


def _conv_transpose(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    strides, dilations, pads = _window(node, len(sizes_of(node.inputs[0])) - 2)
    groups = node.attributes.get_int("group", 1)
    options: dict[str, int | list[int]] = {"group": groups, "strides": strides}
    return [
        t.op(
            "Conv",
            [g, node.inputs[1]],
            {**options, "dilations": dilations, "pads": pads},
        )
    ]


def _max_pool(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x = given(node.inputs[0])
    sizes = sizes_of(x)
    options = {
        name: list(ints)
        for name in ("kernel_shape", "strides", "pads", "dilations")
        if (ints := node.attributes.get_ints(name)) is not None
    }
    _window(node, len(sizes) - 2)
    ceil = node.attributes.get_int("ceil_mode", 0)
    places = t.op("MaxPool", [x], {**options, "ceil_mode": ceil}, outputs=2)
    flat = t.op(
        "ScatterElements",
        [t.zeros([math.prod(sizes)], x), t.shaped(places, [-1]), t.shaped(g, [-1])],
        {"axis": 0, "reduction": "add"},
    )
    return [t.shaped(flat, sizes)]


def _average_pool(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x = given(node.inputs[0])
    sizes, made = sizes_of(x), sizes_of(node.outputs[0])
    rank = len(sizes) - 2
    strides, _, pads = _window(node, rank)
    kernel = list(node.attributes.get_ints("kernel_shape") or ())
    counts_pads = node.attributes.get_int("count_include_pad", 0)
    if any(pads) and not counts_pads:
        raise NoRuleError("no rule for pads that do not count")
    extra = [
        sizes[2 + at] - strides[at] * (made[2 + at] - 1) - kernel[at]
        + pads[at] + pads[at + rank]
        for at in range(rank)
    ]  # fmt: skip
    weight = np.full([sizes[1], 1, *kernel], 1 / math.prod(kernel), numpy_of(x))
    options: dict[str, int | list[int]] = {"group": sizes[1], "strides": strides}
    options |= {"pads": pads, "output_padding": extra}
    return [t.op("ConvTranspose", [g, t.constant(weight)], options)]


def _global_average_pool(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x = given(node.inputs[0])
    part = t.times(g, t.number(1 / math.prod(sizes_of(x)[2:]), x))
    return [t.op("Expand", [part, t.ints(sizes_of(x))])]


RULES: Mapping[str, Rule] = {
    "MatMul": _matmul,
    "Gemm": _gemm,
    "Conv": _conv,
    "ConvTranspose": _conv_transpose,
    "MaxPool": _max_pool,
    "AveragePool": _average_pool,
    "GlobalAveragePool": _global_average_pool,
}
