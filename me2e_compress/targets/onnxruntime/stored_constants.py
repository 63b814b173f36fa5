"""Read the constants that a quantized graph stores before a DequantizeLinear."""

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.observers import QUANT_MAX
from me2e_compress.errors import PreconditionError
from me2e_compress.graph import producer_of
from me2e_compress.targets.quantized import DEQUANTIZE, QUANTIZE
from me2e_compress.targets.weights import QuantizedWeight

Floats = npt.NDArray[np.float32]


def step_of(node: ir.Node) -> Floats:
    """Read the float32 scale of a symmetric int8 QuantizeLinear or DequantizeLinear."""
    scale = graph.array_of(node.inputs[1])
    zero = graph.array_of(graph.input_at(node, 2))
    name = node.name or node.outputs[0].name
    # The scale must be constant, the grid symmetric int8.
    if scale is None or scale.dtype != np.float32:
        kind = "computed" if scale is None else scale.dtype
        way = ": convert-float32 makes it so" if kind == np.float16 else ""
        raise PreconditionError(f"{name} has a {kind} scale, expected float32{way}")
    if zero is None or zero.dtype != np.int8:
        kind = "uint8" if zero is None else zero.dtype
        raise PreconditionError(
            f"{name} quantizes to {kind}: only symmetric int8, as TensorRT takes it,"
            " can be lowered"
        )
    if zero.any():
        raise PreconditionError(
            f"{name} has zero point {int(zero.flat[np.flatnonzero(zero)[0]])}: only"
            " symmetric int8, as TensorRT takes it, can be lowered"
        )
    return scale.astype(np.float32)


def weight_of(layer: ir.Node) -> QuantizedWeight | None:
    """Read the weight of a layer; None if it is not quantized for its kernel.

    A MatMul by [1, ..., K, N] reads [K, N]. onnxruntime's own quantizer, and so
    ModelOpt, puts scales along axis 1 of such a weight, which is K: no kernel takes it.
    Another grid than symmetric int8, or other axes, are a PreconditionError.
    """
    node = producer_of(layer.inputs[1])
    if node is None or node.op_type != DEQUANTIZE:
        return None
    step = step_of(node)
    integers = _integers(node, step)
    if integers is None:
        return None
    # A batch of one matrix is read as that matrix.
    along = node.attributes.get_int("axis", 1) % integers.ndim
    axis = graph.channel_axis(layer)
    if layer.op_type == "MatMul" and integers.ndim > 2:
        if step.size > 1 and along != integers.ndim - 1:
            return None
        integers, along, axis = integers.reshape(integers.shape[-2:]), 1, 1
    # Scales must run along the output channels.
    if step.size > 1 and (along != axis or step.shape != (integers.shape[axis],)):
        raise PreconditionError(
            f"{node.name} has scales of shape {list(step.shape)} along axis {along},"
            f" expected one for each of {integers.shape[axis]} along axis {axis}"
        )
    # One scale in all is repeated for every channel.
    scales = np.broadcast_to(step.reshape(-1), (integers.shape[axis],))
    source = node.inputs[0]
    name = str(layer.outputs[0].name if source is None else source.name)
    return QuantizedWeight(name, integers, np.ascontiguousarray(scales), axis)


def bias_of(layer: ir.Node) -> Floats | None:
    """Read a bias that is stored as int32; None if there is none."""
    node = producer_of(graph.bias_of(layer))
    if node is None or node.op_type != DEQUANTIZE:
        return None
    stored, scale = graph.array_of(node.inputs[0]), graph.array_of(node.inputs[1])
    if stored is None or scale is None:
        return None
    return np.asarray(stored.astype(np.float64) * scale.astype(np.float64), np.float32)


def _integers(dequantize: ir.Node, step: Floats) -> npt.NDArray[np.int8] | None:
    """Return the constant input of a DequantizeLinear as int8."""
    source = dequantize.inputs[0]
    stored = graph.array_of(source)
    if stored is not None:
        return stored.astype(np.int8)
    # ModelOpt stores floats: quantize them here.
    quantize = producer_of(source)
    if quantize is None or quantize.op_type != QUANTIZE:
        return None
    weight = graph.array_of(quantize.inputs[0])
    if weight is None:
        return None
    shape = [1] * weight.ndim
    if step.size > 1:
        shape[dequantize.attributes.get_int("axis", 1) % weight.ndim] = step.size
    steps: Floats = np.rint(weight.astype(np.float32) / step.reshape(shape))
    return np.clip(steps, -QUANT_MAX, QUANT_MAX).astype(np.int8)
