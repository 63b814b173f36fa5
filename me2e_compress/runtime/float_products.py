"""Let int8 products that are read in float run by onnxruntime's faster kernel.

onnxruntime makes a QGemm of a quantized Gemm. It writes the bias to every row of the
answer first, and adds the products to it; MatMulIntegerToFloat does both while a tile
lies in the cache, and takes 0.6 to 1.0 of the time
(``benchmarks/bench_int8_shapes.py``). onnxruntime 1.31 makes one with a bias of no
pattern of constant scales, so it is written as a graph is opened.
"""

import dataclasses

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import array_of, rewrite
from me2e_compress.graph.nodes import input_at, is_standard, maker

DOMAIN = "com.microsoft"
"""The domain of onnxruntime's own operators."""

Stored = tuple[ir.Value, ir.Value, ir.Value]
"""Integers, scale and zero point."""


@dataclasses.dataclass(frozen=True)
class _Product:
    """A quantized Gemm; ``reshape`` may lie in front of it, ``bias`` is float32 [N]."""

    gemm: ir.Node
    left: Stored
    reshape: ir.Node | None
    weight: Stored
    bias: npt.NDArray[np.float32]


def write_float_products(where: ir.Graph) -> int:
    """Replace the quantized Gemms that no QuantizeLinear reads; return how many.

    Given:   y = Gemm(Reshape(DequantizeLinear(x)), DequantizeLinear(w),
                 DequantizeLinear(b))               x uint8 [..., K], w int8 [K, N]
    Result:  y = MatMulIntegerToFloat(Reshape(x), w, scale of x, scales of w,
                 zero point of x, zero points of w, b)                   b float32 [N]
    """
    found = [each for node in where if (each := _product(node)) is not None]
    names = rewrite.value_names(where)
    for each in found:
        _write(where, each, names)
    if found:
        where.opset_imports.setdefault(DOMAIN, 1)
        rewrite.remove_dead(where)
    return len(found)


def _write(where: ir.Graph, product: _Product, names: set[str]) -> None:
    gemm, (integers, step, middle) = product.gemm, product.left
    old = gemm.outputs[0]
    # The Reshape moves to the integers.
    if product.reshape is not None:
        rows = ir.node("Reshape", [integers, product.reshape.inputs[1]])
        rows.name = rewrite.fresh_name(f"{old.name}_integers", names)
        rows.outputs[0].name = rows.name
        where.insert_before(gemm, rows)
        integers = rows.outputs[0]
    weight, scales, zeros = product.weight
    bias = rewrite.add_constant(where, product.bias, f"{old.name}_bias", names)
    inputs = [integers, weight, step, scales, middle, zeros, bias]
    node = ir.node("MatMulIntegerToFloat", inputs, domain=DOMAIN, name=gemm.name)
    made = node.outputs[0]
    made.name = rewrite.fresh_name(f"{old.name}_product", names)
    made.type, made.shape = old.type, old.shape
    where.insert_before(gemm, node)
    rewrite.replace_value(old, made)
    where.remove(gemm, safe=True)


def _product(node: ir.Node) -> _Product | None:
    """Describe a quantized Gemm that is read in float; None for other nodes."""
    if node.op_type != "Gemm" or not is_standard(node) or node.attributes:
        return None
    if any(each.op_type == "QuantizeLinear" for each in node.outputs[0].consumers()):
        return None
    reshape = maker(node.inputs[0], "Reshape")
    left = _stored(node.inputs[0] if reshape is None else reshape.inputs[0])
    weight, bias = _stored(node.inputs[1]), _bias(input_at(node, 2))
    if left is None or weight is None or bias is None:
        return None
    kinds = left[2].dtype, weight[2].dtype
    fast = kinds == (ir.DataType.UINT8, ir.DataType.INT8)
    return _Product(node, left, reshape, weight, bias) if fast else None


def _stored(value: ir.Value | None) -> Stored | None:
    """Return what a DequantizeLinear reads, one scale in all or one a column."""
    node = maker(value, "DequantizeLinear")
    if node is None or node.attributes.get_int("axis", 1) != 1:
        return None
    integers, scale, zero = (input_at(node, index) for index in range(3))
    if integers is None or scale is None or zero is None:
        return None
    return integers, scale, zero


def _bias(value: ir.Value | None) -> npt.NDArray[np.float32] | None:
    """Compute a bias that is stored as int32."""
    node = maker(value, "DequantizeLinear")
    if node is None:
        return None
    integers, scales = array_of(node.inputs[0]), array_of(node.inputs[1])
    if integers is None or scales is None or integers.ndim != 1:
        return None
    numbers = integers.astype(np.float64) * scales.astype(np.float64)
    return numbers.astype(np.float32)
