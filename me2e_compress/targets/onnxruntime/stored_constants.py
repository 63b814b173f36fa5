"""Constants behind a DequantizeLinear: what a quantized graph stores."""

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.observers import QUANT_MAX
from me2e_compress.errors import PreconditionError
from me2e_compress.targets.onnxruntime.kernels import channel_axis
from me2e_compress.targets.weights import QuantizedWeight

QUANTIZE, DEQUANTIZE = "QuantizeLinear", "DequantizeLinear"
Floats = npt.NDArray[np.float32]


def step_of(node: ir.Node) -> Floats:
    """Read the scale of a QuantizeLinear or DequantizeLinear.

    Raises:
        PreconditionError: it is computed or not float32, the integers are not int8, or
            the zero point is not zero.
    """
    scale = graph.array_of(node.inputs[1])
    zero = graph.array_of(node.inputs[2]) if len(node.inputs) > 2 else None
    name = node.name or node.outputs[0].name
    if scale is None or scale.dtype != np.float32:
        kind = "computed" if scale is None else scale.dtype
        raise PreconditionError(f"{name} has a {kind} scale, expected float32")
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

    Args:
        layer: one that has an int8 kernel.

    Raises:
        PreconditionError: it is quantized, but not on the symmetric int8 grid with one
            scale an output channel, or one in all.
    """
    value = layer.inputs[1]
    node = None if value is None else value.producer()
    if node is None or node.op_type != DEQUANTIZE:
        return None
    step = step_of(node)
    axis = channel_axis(layer)
    integers = _integers(node, step)
    if integers is None:
        return None
    along = node.attributes.get_int("axis", 1) % integers.ndim
    if layer.op_type == "MatMul" and integers.ndim > 2:
        if step.size > 1 and along != integers.ndim - 1:
            return None
        integers, along = integers.reshape(integers.shape[-2:]), axis
    if step.size > 1 and (along != axis or step.shape != (integers.shape[axis],)):
        raise PreconditionError(
            f"{node.name} has scales of shape {list(step.shape)} along axis {along},"
            f" expected one for each of {integers.shape[axis]} along axis {axis}"
        )
    scales = np.broadcast_to(step.reshape(-1), (integers.shape[axis],))
    source = node.inputs[0]
    name = str(layer.outputs[0].name if source is None else source.name)
    return QuantizedWeight(name, integers, np.ascontiguousarray(scales), axis)


def bias_of(layer: ir.Node) -> Floats | None:
    """Read a bias that is stored as int32; None if there is none."""
    value = layer.inputs[2] if len(layer.inputs) > 2 else None
    node = None if value is None else value.producer()
    if node is None or node.op_type != DEQUANTIZE:
        return None
    stored, scale = graph.array_of(node.inputs[0]), graph.array_of(node.inputs[1])
    if stored is None or scale is None:
        return None
    return np.asarray(stored.astype(np.float64) * scale.astype(np.float64), np.float32)


def _integers(dequantize: ir.Node, step: Floats) -> npt.NDArray[np.int8] | None:
    """Give what a DequantizeLinear reads, if it is constant, as int8."""
    source = dequantize.inputs[0]
    stored = graph.array_of(source)
    if stored is not None:
        return stored.astype(np.int8)
    quantize = None if source is None else source.producer()
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
