"""Matrix products and constant chains.

Given:   MatMul(x, weight) + bias, x of rank 2;  MatMul(x, weight) * c;  (x * c) * d
Result:  Gemm;  MatMul(x, c weight);  x * (c d)

At rank 3 MatMul + Add stays: Reshape, Gemm, Reshape would hide the product from
attention patterns and misplace the quantizers.
"""

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, provenance, static_shape
from me2e_compress.passes.fuse_basic.match import (
    Numbers,
    Site,
    constant_and_rest,
    numbers_of,
    sole_maker,
)
from me2e_compress.rewrite import FLOATS, add_constant, put, replace_value, sole_reader

CANCELLATION = 1e3
"""Constants that cancel more than three decimal digits are not added up ahead."""


def fuse_gemm(node: ir.Node, site: Site) -> bool:
    """Make MatMul + Add a Gemm where both operands are matrices."""
    if node.op_type != "Add" or node.outputs[0].dtype not in FLOATS or site.opset < 7:
        return False
    for product_index in (0, 1):
        product = sole_maker(node.inputs[product_index], "MatMul")
        bias = node.inputs[1 - product_index]
        if product is None or bias is None or array_of(bias) is None:
            continue
        shapes = [static_shape(value) for value in product.inputs]
        out, added = static_shape(product.outputs[0]), static_shape(bias)
        if any(shape is None or len(shape) != 2 for shape in shapes):
            return False
        if out is None or added not in ((), (1,), (out[1],), (1, out[1])):
            return False
        put(node, "Gemm", [*product.inputs, bias], by=site.by, sources=[product])
        return True
    return False


def fuse_scale(node: ir.Node, site: Site) -> bool:
    """Fold a constant factor after a linear layer into its weight (and bias)."""
    factor = _factor(node)
    if factor is None:
        return False
    numbers, value = factor
    added = sole_maker(value, "Add")
    parts = constant_and_rest(added) if added is not None else None
    product = sole_maker(parts[1] if parts is not None else value, "MatMul")
    weight = numbers_of(product.inputs[1]) if product is not None else None
    if product is None or weight is None or weight.ndim != 2:
        return False
    if numbers.shape not in ((), (1,), (weight.shape[1],)):
        return False
    if product.graph is not node.graph or not _is_owned(product, 1):
        return site.refuse("a factor after a MatMul that shares its weight")
    if added is not None and parts is not None:
        place = 0 if array_of(added.inputs[0]) is not None else 1
        if parts[0].ndim != 1 or not _is_owned(added, place):
            return site.refuse("a factor after a MatMul that shares its bias")
        if not _rewrite(added.inputs[place], parts[0] * numbers):
            return site.refuse("a factor under which a bias would overflow")
    if not _rewrite(product.inputs[1], weight * numbers):
        return site.refuse("a factor under which a weight would overflow")
    last = added if added is not None and parts is not None else product
    for changed in dict.fromkeys((product, last)):
        provenance.inherit(changed, (changed, node), by=site.by)
    replace_value(node.outputs[0], last.outputs[0])
    site.graph.remove(node, safe=True)
    return True


def fuse_chain(node: ir.Node, site: Site) -> bool:
    """Multiply (add) two constants in a row ahead of time."""
    if node.op_type not in ("Add", "Mul"):
        return False
    outer = constant_and_rest(node)
    inner_node = sole_maker(outer[1], node.op_type) if outer is not None else None
    inner = constant_and_rest(inner_node) if inner_node is not None else None
    if outer is None or inner is None or inner_node is None:
        return False
    if node.op_type == "Mul":
        together = outer[0] * inner[0]
    else:
        together = outer[0] + inner[0]
        if np.any(np.abs(inner[0]) > CANCELLATION * np.abs(together)):
            return site.refuse("constants that cancel when added up")
    kind = node.outputs[0].dtype
    if kind is None or not _fits(together, kind):
        return site.refuse("constants that overflow when multiplied")
    if together.size > max(outer[0].size, inner[0].size):
        return site.refuse("constants that grow when combined")
    array = together.astype(kind.numpy())
    name = f"{node.outputs[0].name}_{node.op_type.lower()}"
    value = add_constant(site.graph, array, name)
    put(node, node.op_type, [inner[1], value], by=site.by, sources=[inner_node])
    return True


def _factor(node: ir.Node) -> tuple[Numbers, ir.Value] | None:
    if node.op_type not in ("Mul", "Div"):
        return None
    parts = constant_and_rest(node)
    if parts is None or node.op_type == "Mul":
        return parts
    if parts[1] is not node.inputs[0] or not parts[0].all():
        return None
    return 1 / parts[0], parts[1]


def _is_owned(node: ir.Node, index: int) -> bool:
    value = node.inputs[index]
    return value is not None and value.is_initializer() and (sole_reader(value) is node)


def _fits(numbers: Numbers, kind: ir.DataType) -> bool:
    """Say whether numbers neither overflow nor lose digits in a type."""
    limits = np.finfo(kind.numpy())
    size = np.abs(numbers[numbers != 0])
    return bool(np.all((size <= limits.max) & (size >= limits.tiny)))


def _rewrite(value: ir.Value | None, numbers: Numbers) -> bool:
    if value is None or value.dtype is None:
        return False
    limit = np.finfo(value.dtype.numpy()).max
    if not np.all(np.abs(numbers) <= limit):
        return False
    array = numbers.astype(value.dtype.numpy())
    value.const_value = ir.tensor(array, name=value.name)
    return True
