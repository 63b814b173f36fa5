"""Min and Max with constants in a row are one Clip.

Given:   Min(Max(x, 0), 6), or Min(Relu(x), 6)
Result:  Clip(x, 0, 6)
"""

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, static_shape
from me2e_compress.passes.fuse_basic.match import Site, sole_maker
from me2e_compress.rewrite import Array, add_constant, put

SINCE = 12
"""The opset from which Clip takes its bounds as inputs, for all types."""


def fuse_clip(node: ir.Node, site: Site) -> bool:
    """Fuse a Min or Max with the Max, Min or Relu before it."""
    if node.op_type not in ("Min", "Max"):
        return False
    outer = _bound(node)
    if outer is None:
        return False
    other = "Max" if node.op_type == "Min" else "Min"
    inner = sole_maker(outer[0], other, *(["Relu"] if other == "Max" else []))
    if inner is None:
        return False
    bound: tuple[ir.Value | None, Array] | None = _bound(inner)
    if inner.op_type == "Relu":
        bound = inner.inputs[0], np.zeros((), outer[1].dtype)
    if bound is None or bound[0] is None:
        return False
    low, high = (bound[1], outer[1]) if other == "Max" else (outer[1], bound[1])
    if not bool(np.less_equal(low, high)) or static_shape(bound[0]) != static_shape(
        node.outputs[0]
    ):
        return False
    if site.opset < SINCE:
        return site.refuse(f"Clip of all types needs opset {SINCE}")
    name = node.outputs[0].name or ""
    limits = [
        add_constant(site.graph, array, f"{name}_{which}")
        for which, array in (("min", low), ("max", high))
    ]
    put(node, "Clip", [bound[0], *limits], by=site.by, sources=[inner])
    return True


def _bound(node: ir.Node) -> tuple[ir.Value, Array] | None:
    """Tell the scalar constant of a Min or Max from its other operand."""
    if len(node.inputs) != 2:
        return None
    for constant, rest in ((0, 1), (1, 0)):
        array, value = array_of(node.inputs[constant]), node.inputs[rest]
        if array is not None and value is not None and array.size == 1:
            return value, array.reshape(())
    return None
