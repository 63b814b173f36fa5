"""The decomposed layer normalization (Ba, Kiros, Hinton 2016).

Given:   d = x - ReduceMean(x);  d / Sqrt(ReduceMean(d * d) + eps) * scale + bias
Result:  LayerNormalization(x, scale, bias)
"""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, static_shape
from me2e_compress.passes.fuse_basic.match import (
    Site,
    constant_and_rest,
    maker,
    scalar_of,
    sole_maker,
)
from me2e_compress.rewrite import add_constant, put, sole_reader

KINDS = (ir.DataType.FLOAT, ir.DataType.FLOAT16)
SINCE = 17
"""The opset that brought LayerNormalization."""


@dataclasses.dataclass
class _Core:
    source: ir.Value
    axis: int
    epsilon: float
    nodes: list[ir.Node]


def fuse_layer_norm(node: ir.Node, site: Site) -> bool:
    """Fuse the normalization that ends in this Div, scale and bias included."""
    core = _core(node)
    if core is None:
        return False
    if site.opset < SINCE:
        return site.refuse(f"LayerNormalization needs opset {SINCE}")
    shape = static_shape(core.source)
    kind = core.source.dtype
    if shape is None or kind is None or kind not in KINDS:
        return site.refuse("LayerNormalization of an unknown shape or of float64")
    last, scale = _affine(node, "Mul", shape[core.axis :])
    last, bias = _affine(last, "Add", shape[core.axis :])
    if scale is None:
        ones = np.ones(shape[core.axis :], kind.numpy())
        scale = add_constant(site.graph, ones, f"{node.outputs[0].name}_scale")
    put(
        last,
        "LayerNormalization",
        [core.source, scale, *([] if bias is None else [bias])],
        by=site.by,
        sources=[node, *core.nodes],
        attributes={"axis": core.axis - len(shape), "epsilon": core.epsilon},
    )
    return True


def _core(node: ir.Node) -> _Core | None:
    if node.op_type != "Div":
        return None
    root = sole_maker(node.inputs[1], "Sqrt")
    total = sole_maker(root.inputs[0], "Add") if root is not None else None
    parts = constant_and_rest(total) if total is not None else None
    if root is None or total is None or parts is None or parts[0].size != 1:
        return None
    variance = sole_maker(parts[1], "ReduceMean")
    square = sole_maker(variance.inputs[0], "Mul", "Pow") if variance else None
    centred = _squared(square) if square is not None else None
    first, second = maker(node.inputs[0], "Sub"), maker(centred, "Sub")
    if variance is None or square is None or first is None or second is None:
        return None
    source = first.inputs[0]
    means = [_mean_axes(one.inputs[1], source) for one in (first, second)]
    axes = _axes(variance)
    if source is None or axes is None or second.inputs[0] is not source:
        return None
    rank = len(source.shape) if source.shape is not None else 0
    if means != [axes, axes] or not _are_last(axes, rank):
        return None
    return _Core(
        source,
        min(axis % rank for axis in axes),
        float(parts[0].item()),
        [root, total, variance, square, first],
    )


def _squared(node: ir.Node) -> ir.Value | None:
    if node.op_type == "Mul":
        return node.inputs[0] if node.inputs[0] is node.inputs[1] else None
    return node.inputs[0] if scalar_of(node.inputs[1]) == 2.0 else None


def _mean_axes(value: ir.Value | None, source: ir.Value | None) -> list[int] | None:
    node = maker(value, "ReduceMean")
    return _axes(node) if node is not None and node.inputs[0] is source else None


def _axes(node: ir.Node) -> list[int] | None:
    if not node.attributes.get_int("keepdims", 1):
        return None
    if "axes" in node.attributes:
        return [int(axis) for axis in node.attributes["axes"].as_ints()]
    axes = array_of(node.inputs[1]) if len(node.inputs) > 1 else None
    return None if axes is None else [int(axis) for axis in axes.reshape(-1)]


def _are_last(axes: list[int], rank: int) -> bool:
    if not rank or not axes:
        return False
    return sorted(axis % rank for axis in axes) == list(range(rank - len(axes), rank))


def _affine(
    node: ir.Node, op_type: str, shape: tuple[int, ...]
) -> tuple[ir.Node, ir.Value | None]:
    """Step over the Mul (Add) that scales (shifts) what was normalized."""
    reader = sole_reader(node.outputs[0])
    if reader is None or reader.op_type != op_type or reader.graph is not node.graph:
        return node, None
    for value in reader.inputs:
        if value is not None and value is not node.outputs[0]:
            array = array_of(value)
            if array is not None and array.shape == shape:
                return reader, value
    return node, None
