"""Rewrite a graph, as it is opened, for kernels that read int8 themselves."""

import dataclasses
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import array_of, producer_of, rewrite
from me2e_compress.graph.nodes import input_at, is_standard, maker
from me2e_compress.graph.shapes import open_shape, product
from me2e_compress.operators import FusedCall

DOMAIN = "com.microsoft"
"""The domain of onnxruntime's own operators."""

# Integers, scale and zero point
Quantized: TypeAlias = tuple[ir.Value, ir.Value, ir.Value]
_KERNEL_SUFFIX = {ir.DataType.INT8: "Int8", ir.DataType.UINT8: "Uint8"}


@dataclasses.dataclass(frozen=True)
class _Product:
    """A quantized Gemm; ``reshape`` may lie in front of it, ``bias`` is float32 [N]."""

    gemm: ir.Node
    left: Quantized
    reshape: ir.Node | None
    weight: Quantized
    bias: npt.NDArray[np.float32]


def bias_numbers(node: ir.Node | None) -> npt.NDArray[np.float32] | None:
    """Return the float32 that a DequantizeLinear makes of constants; else None."""
    if node is None or node.op_type != "DequantizeLinear":
        return None
    integers, scales = array_of(node.inputs[0]), array_of(node.inputs[1])
    if integers is None or scales is None:
        return None
    numbers = integers.astype(np.float64) * scales.astype(np.float64)
    return numbers.astype(np.float32)


def write_float_products(graph: ir.Graph) -> int:
    """Replace the quantized Gemms that no QuantizeLinear reads; return how many.

    Given:   y = Gemm(Reshape(DequantizeLinear(x)), DequantizeLinear(w),
                 DequantizeLinear(b))               x uint8 [..., K], w int8 [K, N]
    Result:  y = MatMulIntegerToFloat(Reshape(x), w, scale of x, scales of w,
                 zero point of x, zero points of w, b)                   b float32 [N]
    """
    # onnxruntime makes a QGemm of a quantized Gemm. It writes the bias to every row of
    # the answer first, and adds the products to it; MatMulIntegerToFloat does both
    # while a tile lies in the cache, and takes 0.6 to 1.0 of the time
    # (benchmarks/measure/int8_shapes.py). onnxruntime 1.31 makes one with a bias of no
    # pattern of constant scales
    matches = [match for node in graph if (match := _match_product(node)) is not None]
    names = rewrite.value_names(graph)
    opset = graph.opset_imports[""]
    for match in matches:
        call = FusedCall(match.gemm, opset=opset, by="session", names=names)
        integers, step, middle = match.left
        # The Reshape moves to the integers
        if match.reshape is not None:
            integers = call.add("Reshape", [integers, match.reshape.inputs[1]])
        weight, scales, zeros = match.weight
        inputs = [integers, weight, step, scales, middle, zeros]
        inputs.append(call.constant(match.bias, "bias"))
        call.put(call.add("MatMulIntegerToFloat", inputs, domain=DOMAIN))
    if matches:
        graph.opset_imports.setdefault(DOMAIN, 1)
        rewrite.remove_dead(graph)
    return len(matches)


def _match_product(node: ir.Node) -> _Product | None:
    """Describe a quantized Gemm that is read in float; None for other nodes."""
    if node.op_type != "Gemm" or not is_standard(node) or node.attributes:
        return None
    if "QuantizeLinear" in {node.op_type for node in node.outputs[0].consumers()}:
        return None
    reshape = maker(node.inputs[0], "Reshape")
    left = _quantized(node.inputs[0] if reshape is None else reshape.inputs[0])
    weight = _quantized(node.inputs[1])
    bias = bias_numbers(maker(input_at(node, 2), "DequantizeLinear"))
    if left is None or weight is None or bias is None or bias.ndim != 1:
        return None
    kinds = left[2].dtype, weight[2].dtype
    fast = kinds == (ir.DataType.UINT8, ir.DataType.INT8)
    return _Product(node, left, reshape, weight, bias) if fast else None


def _quantized(value: ir.Value | None) -> Quantized | None:
    """Return what a DequantizeLinear along axis 1 reads; None of any other value."""
    node = maker(value, "DequantizeLinear")
    if node is None or node.attributes.get_int("axis", 1) != 1:
        return None
    integers, scale, zero = (input_at(node, index) for index in range(3))
    if integers is None or scale is None or zero is None:
        return None
    return integers, scale, zero


def use_int8_kernel(node: ir.Node, opset: int, names: set[str] | None) -> None:
    """Let a kernel call read int8 where its float value only dequantizes int8.

    Given: DequantizeLinear (one scale, or one a channel), or a Cast times a scale a
        channel, then any Reshape, then the value of a call.
    Result: the same Reshape of the integers, read by the int8 kernel; nodes that nobody
        else reads are removed.
    """
    # Half of the kernel's time is spent fetching rows, which int8 makes four times
    # smaller. Positions and attention weights stay in float: in int8 they cost 19 to 25
    # % of the result (measured by SparseDriveV2's deployment)
    value = node.inputs[0]
    assert value is not None
    # Look through reshapes for the integers.
    dims = open_shape(value)  # [N, S, M, D]: heads times channels in a row
    channels = None if dims is None or len(dims) != 4 else product(dims[2:])
    reshapes: list[ir.Node] = []
    while (made := maker(value, "Reshape")) and made.inputs[0] is not None:
        reshapes.append(made)
        value = made.inputs[0]
    stored = _int8_rows(value, channels)
    if stored is None:
        return
    rows, scale, zero = stored
    kind = rows.dtype
    if kind is None or kind not in _KERNEL_SUFFIX:
        return
    # Repeat the reshapes on the integers.
    call = FusedCall(node, opset=opset, by="session", names=names)
    for layout in reversed(reshapes):
        options = {key: item.as_int() for key, item in layout.attributes.items()}
        rows = call.add("Reshape", [rows, layout.inputs[1]], options)
    zero = zero or call.constant(np.zeros(1, kind.numpy()), "zero")
    # Switch the call to the int8 kernel.
    before, count = node.inputs[0], len(node.inputs)
    node.op_type += _KERNEL_SUFFIX[kind]
    node.resize_inputs(count + 2)
    for index, new in ((0, rows), (count, scale), (count + 1, zero)):
        node.replace_input_with(index, new)
    # Remove the nodes that nobody reads any more.
    unread = None if before is None else producer_of(before)
    while unread is not None and unread.graph is not None:
        if any(value.uses() or value.is_graph_output() for value in unread.outputs):
            return
        first = unread.inputs[0]
        unread.graph.remove(unread, safe=True)
        unread = None if first is None else producer_of(first)


def _int8_rows(
    value: ir.Value | None, channels: int | None
) -> tuple[ir.Value, ir.Value, ir.Value | None] | None:
    """Return the integers of a value, their scale and zero, if they fit the kernel.

    ``channels`` is the length of a row's last axis, None if unknown; zero may be None.
    """
    if node := maker(value, "DequantizeLinear"):
        source, scale, *rest = node.inputs
        zero = rest[0] if rest else None
        if source is None or scale is None or source.shape is None:
            return None
        # A zero point per channel must be zero everywhere.
        if zero is not None and _count(zero) != 1:
            known = array_of(zero)
            if known is None or known.any():
                return None
            zero = None
        # The kernel takes one scale, or one for each channel.
        last = node.attributes.get_int("axis", 1) in (-1, len(source.shape) - 1)
        fits = _count(scale) == 1 or (last and _count(scale) == channels)
        return (source, scale, zero) if fits else None
    # The other form: integers cast to float, times a scale.
    if node := maker(value, "Mul"):
        cast, scale = maker(node.inputs[0], "Cast"), node.inputs[1]
        if cast is None or cast.inputs[0] is None or scale is None:
            return None
        if channels is not None and scale.shape == (channels,):
            return cast.inputs[0], scale, None
    return None


def _count(value: ir.Value) -> int | None:
    dims = open_shape(value)
    return None if dims is None else product(dims)
