"""Convert a graph quantized for TensorRT, by this package or another."""

import dataclasses
from collections.abc import Collection

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.observers import QUANT_MAX
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.errors import PreconditionError
from me2e_compress.graph import producer_of, rewrite
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, maker
from me2e_compress.targets.onnxruntime.kernels import LAYERS, has_kernel
from me2e_compress.targets.onnxruntime.lower import Draft, lower
from me2e_compress.targets.onnxruntime.region import find_region
from me2e_compress.targets.quantized import DEQUANTIZE, QUANTIZE
from me2e_compress.targets.weights import QuantizedWeight

Floats = npt.NDArray[np.float32]


def convert(model: ir.Model, ranges: Ranges | None = None) -> ir.Model:
    """Return a copy of an int8 graph that onnxruntime runs in int8 on the CPU.

    Unconverted, such a graph is slower than a float one: onnxruntime's convolutions
    write uint8 and so need a pair after them, and it has no fast kernel for int8
    activations. Layers, weights and ranges stay the same. ``ranges`` has the tensors of
    :func:`unranged`.

    Raises:
        PreconditionError: the pairs are not symmetric int8, or there are none.
        FramesError: the range of a tensor is missing.
    """
    draft = _draft_of_qdq(model)
    measured = {} if ranges is None else ranges.tensors
    more = {name: max(-low, high) for name, (low, high) in measured.items()}
    return lower(dataclasses.replace(draft, reach={**more, **draft.reach}))


def unranged(model: ir.Model) -> tuple[str, ...]:
    """Return the outputs of convolutions without a pair, whose range is needed."""
    draft = _draft_of_qdq(model)
    region = find_region(draft.model.graph, draft.weights)
    return tuple(name for name in region.ranged if name not in draft.reach)


def int8_layers(
    model: ir.Model, kinds: Collection[str] = graph.WEIGHTED
) -> tuple[ir.Node, ...]:
    """List the layers whose two operands both come through a DequantizeLinear.

    Whether a runtime computes them in integers is another matter: onnxruntime's CPU
    runs those of a graph placed for TensorRT in float.
    """
    return tuple(
        node for node in model.graph if node.op_type in kinds and reads_integers(node)
    )


def reads_integers(layer: ir.Node) -> bool:
    """Return whether both operands of a layer come through a DequantizeLinear."""
    return all(dequantizer_of(value) is not None for value in layer.inputs[:2])


def dequantizer_of(value: ir.Value | None) -> ir.Node | None:
    """Return the DequantizeLinear of a value, past a change of its layout."""
    node = producer_of(value)
    while node is not None and node.op_type in ("Reshape", "Transpose"):
        node = producer_of(node.inputs[0])
    return node if node is not None and node.op_type == DEQUANTIZE else None


def _draft_of_qdq(model: ir.Model) -> Draft:
    """Copy a quantized graph without the pairs of its activations.

    A layer becomes int8 if both its input and its weight come through a pair, and it
    has a kernel. Weights are stored as int8 or, by ModelOpt, in float before a
    QuantizeLinear. Biases stored as int32 become float again.
    """
    copy = model.clone()
    graph.infer_shapes(copy)
    # Find the pairs of activations, and their ranges.
    pairs = {node: value for node in copy.graph if (value := _activation(node))}
    if not pairs:
        raise PreconditionError(
            "the graph has no quantized activation; lower a graph with int8 pairs, or"
            " quantize a float one for this target"
        )
    reach = {value: _reach(node) for node, value in pairs.items()}
    # Read biases and weights before the pairs go.
    layers = [
        node
        for node in copy.graph
        if node.op_type in LAYERS and producer_of(node.inputs[0]) in pairs
    ]
    for node in layers:
        bias = _bias_of(node)
        if bias is not None:
            name = f"{node.inputs[2].name}_stored" if node.inputs[2] else ""
            node.replace_input_with(2, rewrite.add_constant(copy.graph, bias, name))
    # Only layers with a kernel become int8.
    weights = {node: _weight_of(node) for node in layers if has_kernel(node)}
    # Remove the pairs of activations.
    for node, value in pairs.items():
        if rewrite.can_replace(node.outputs[0], value):
            rewrite.replace_value(node.outputs[0], value)
    rewrite.sweep(copy)
    # What only changes the layout has the range of its input.
    for node in reversed(copy.graph):
        value = node.inputs[0] if maker(node.outputs[0], *LAYOUT_OPERATORS) else None
        if value is not None and node.outputs[0] in reach:
            reach.setdefault(value, reach[node.outputs[0]])
    return Draft(
        copy,
        {str(n.outputs[0].name): w for n, w in weights.items() if w is not None},
        {str(value.name): largest for value, largest in reach.items()},
    )


def _activation(node: ir.Node) -> ir.Value | None:
    """Return the tensor that a DequantizeLinear stands for, unless it is constant."""
    quantize = producer_of(node.inputs[0]) if node.op_type == DEQUANTIZE else None
    if quantize is None or quantize.op_type != QUANTIZE:
        return None
    value = quantize.inputs[0]
    return value if graph.array_of(value) is None else None


def _reach(dequantize: ir.Node) -> float:
    """Return the largest magnitude on a pair's grid."""
    step = _step_of(dequantize)
    if step.size != 1:
        raise PreconditionError(
            f"{dequantize.name} has {step.size} scales: onnxruntime's kernels take one"
            " for an activation"
        )
    return float(step.reshape(())) * QUANT_MAX


def _step_of(node: ir.Node) -> Floats:
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


def _weight_of(layer: ir.Node) -> QuantizedWeight | None:
    """Read the weight of a layer; None if it is not quantized for its kernel.

    A MatMul by [1, ..., K, N] reads [K, N]. onnxruntime's own quantizer, and so
    ModelOpt, puts scales along axis 1 of such a weight, which is K: no kernel takes it.
    Another grid than symmetric int8, or other axes, are a PreconditionError.
    """
    node = producer_of(layer.inputs[1])
    if node is None or node.op_type != DEQUANTIZE:
        return None
    step = _step_of(node)
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


def _bias_of(layer: ir.Node) -> Floats | None:
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
