"""Convert a graph quantized for TensorRT, or say that onnxruntime runs it slowly."""

import dataclasses
from collections.abc import Collection

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import PreconditionError
from me2e_compress.calibration.observers import QUANT_MAX
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import (
    CONVOLUTIONS,
    WEIGHTED,
    array_of,
    bias_of,
    input_at,
    is_standard,
    nodes_of,
    producer_of,
    rewrite,
)
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, maker
from me2e_compress.runtime.int8_values import bias_numbers
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.targets.onnxruntime.lint_rules import PASSED
from me2e_compress.targets.onnxruntime.lower import Draft, lower, symmetric
from me2e_compress.targets.onnxruntime.region import (
    LAYERS,
    find_region,
    is_clip_at_zero,
    objection,
)
from me2e_compress.targets.quantized import (
    DEQUANTIZE,
    QUANTIZE,
    is_dequantized,
    stored_type,
)
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
    more = {} if ranges is None else symmetric(ranges.tensors)
    return lower(dataclasses.replace(draft, ranges={**more, **draft.ranges}))


def unranged(model: ir.Model) -> tuple[str, ...]:
    """Return the outputs of convolutions without a pair, whose range is needed."""
    draft = _draft_of_qdq(model)
    region = find_region(draft.model.graph, draft.weights)
    return tuple(name for name in region.ranged if name not in draft.ranges)


def int8_layers(
    model: ir.Model, kinds: Collection[str] = graph.WEIGHTED
) -> tuple[ir.Node, ...]:
    """List the layers whose two operands both come through a DequantizeLinear."""
    # Whether a runtime computes them in integers is another matter: onnxruntime's CPU
    # runs those of a graph placed for TensorRT in float
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
    """Copy a quantized graph without the pairs of its activations."""
    # A layer becomes int8 if both its input and its weight come through a pair, and it
    # has a kernel. Weights are stored as int8 or, by ModelOpt, in float before a
    # QuantizeLinear. Biases stored as int32 become float again.
    copy = model.clone()
    graph.infer_shapes(copy)
    # Find the pairs of activations
    pairs = dict[ir.Node, ir.Value]()
    for node in copy.graph:
        is_second = node.op_type == DEQUANTIZE
        quantize = maker(node.inputs[0], QUANTIZE) if is_second else None
        value = None if quantize is None else quantize.inputs[0]
        if value is not None and array_of(value) is None:
            pairs[node] = value
    if not pairs:
        raise PreconditionError(
            "the graph has no quantized activation; lower a graph with int8 pairs, or"
            " quantize a float one for this target"
        )
    reach = dict[ir.Value, float]()
    for node, value in pairs.items():
        step = _step_of(node)
        if step.size != 1:
            message = "onnxruntime's kernels take one for an activation"
            raise PreconditionError(f"{node.name} has {step.size} scales: {message}")
        reach[value] = float(step.reshape(())) * QUANT_MAX
    # Read biases and weights before the pairs go.
    candidates = [node for node in copy.graph if node.op_type in LAYERS]
    layers = [node for node in candidates if producer_of(node.inputs[0]) in pairs]
    for node in layers:
        bias = bias_numbers(producer_of(graph.bias_of(node)))
        if bias is not None:
            name = f"{node.inputs[2].name}_stored" if node.inputs[2] else ""
            node.replace_input_with(2, rewrite.add_constant(copy.graph, bias, name))
    # Only layers with a kernel become int8.
    weights = {node: _weight_of(node) for node in layers if objection(node) is None}
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
    by_name = {str(n.outputs[0].name): w for n, w in weights.items() if w is not None}
    ranges = {str(value.name): (-most, most) for value, most in reach.items()}
    return Draft(copy, by_name, ranges)


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
    kind = "uint8" if zero is None else zero.dtype
    grid = "" if kind == np.int8 else f"quantizes to {kind}"
    if zero is not None and not grid and zero.any():
        grid = f"has zero point {int(zero.flat[np.flatnonzero(zero)[0]])}"
    if grid:
        raise PreconditionError(
            f"{name} {grid}: only symmetric int8, as TensorRT takes it, can be lowered"
        )
    return scale.astype(np.float32)


def _weight_of(layer: ir.Node) -> QuantizedWeight | None:
    """Read a layer's weight as int8 with a scale for each output channel.

    None if it is not quantized, or not for a kernel. Another grid than symmetric int8,
    or scales along another axis, are a PreconditionError.
    """
    node = producer_of(layer.inputs[1])
    if node is None or node.op_type != DEQUANTIZE:
        return None
    step, source = _step_of(node), node.inputs[0]
    stored = array_of(source)
    quantize = maker(source, QUANTIZE) if stored is None else None
    if quantize is not None:  # ModelOpt stores floats: they are quantized here
        stored = array_of(quantize.inputs[0])
    if stored is None:
        return None
    along = node.attributes.get_int("axis", 1) % stored.ndim
    if quantize is not None:
        by_axis = step.reshape([-1 if at == along else 1 for at in range(stored.ndim)])
        steps: Floats = np.rint(stored.astype(np.float32) / by_axis)
        stored = np.clip(steps, -QUANT_MAX, QUANT_MAX)
    integers, axis = stored.astype(np.int8), graph.channel_axis(layer)
    # A batch of one matrix, [1, ..., K, N], is read as that matrix. onnxruntime's own
    # quantizer, and so ModelOpt, puts scales along axis 1, K: no kernel takes those
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
    name = str(layer.outputs[0].name if source is None else source.name)
    return QuantizedWeight(name, integers, np.ascontiguousarray(scales), axis)


# Tell a quantized file that onnxruntime's CPU runs slower than float: TensorRT's form.
#
# TensorRT wants pairs where a layer reads. onnxruntime wants one behind a layer, too:
# it computes in integers what stands between two pairs, and everything else in float,
# each pair in a kernel of its own. Measured with 1.31.1 on one core of an AMD EPYC (Zen
# 3): convolutions take 1.26 of float's time with pairs on their inputs alone and 0.52
# between two, products with a bias 1.14 to 1.25 and 0.52 to 0.58. Signed activations
# become unsigned when a session opens, so the sign alone costs nothing.


# Types of activations that there are integer kernels for, with their least number
_LEAST = {ir.DataType.INT8: -128, ir.DataType.UINT8: 0}
# Types of activations that TensorRT takes, with zero points 0
_OF_TENSORRT = (ir.DataType.INT8, ir.DataType.FLOAT8E4M3FN)


def slow_here(model: ir.Model, provider: Provider = CPU) -> str | None:
    """Say that a quantized graph is slow in onnxruntime's CPU, and what is fast.

    That is so where half or more of the layers whose operands both come through a pair
    gain nothing by it, whoever placed the pairs. None for other graphs, and where
    another provider runs it.
    """
    if provider.native != CPU.native:
        return None
    layers = [
        node
        for node in nodes_of(model)
        if is_standard(node) and node.op_type in WEIGHTED and reads_integers(node)
    ]
    slow = [node for node in layers if not _is_fast(node)]
    if not slow or 2 * len(slow) < len(layers):
        return None
    # TensorRT's form: signed, with zero points 0; lower-int8 rewrites its int8
    form, remedy = "a form that is", ""
    read = [pair for node in slow if (pair := dequantizer_of(node.inputs[0]))]
    kinds = {stored_type(pair) for pair in read}
    if kinds.issubset(_OF_TENSORRT) and not any(_zeros_of(pair).any() for pair in read):
        form = "TensorRT's form,"
        if kinds == {ir.DataType.INT8}:
            remedy = ", --passes import-normalize,lower-int8 makes it of this file"
    return (
        f"it is quantized in {form} slow in onnxruntime's CPU (no fast kernel for"
        f" {len(slow)} of {len(layers)} layers): compress --target onnxruntime writes"
        f" what is fast here{remedy}"
    )


def _is_fast(layer: ir.Node) -> bool:
    """Return whether onnxruntime has a kernel for a layer that beats float."""
    end, bias = layer.outputs[0], bias_of(layer)
    left, right = (dequantizer_of(value) for value in layer.inputs[:2])
    if layer.op_type == "ConvTranspose" or left is None:
        return False
    # Sessions take a pair in that is of uint8, or of int8 with a zero point
    kind = stored_type(left)
    if kind not in _LEAST or (kind != ir.DataType.UINT8 and len(left.inputs) <= 2):
        return False
    # Products of two activations, as an attention's, take 1.1 to 1.8 of float's time
    quantize = None if right is None else maker(right.inputs[0], QUANTIZE)
    if quantize is not None and array_of(quantize.inputs[0]) is None:
        return False
    # A MatMul and its bias become one Gemm before pairs are looked for
    merged, readers = False, list(end.consumers())
    if layer.op_type == "MatMul" and [r.op_type for r in readers] == ["Add"]:
        merged = any(array_of(value) is not None for value in readers[0].inputs)
        end = readers[0].outputs[0] if merged else end
    ends = _ends(end, takes_relu=not merged)
    pairs = [node for node in ends if node.op_type == QUANTIZE]
    if ends and len(pairs) == len(ends):
        return True
    # A product may write float, unless a ReLU or a pair was to be taken in
    biased = merged or (bias is not None and not is_dequantized(bias))
    return layer.op_type not in CONVOLUTIONS and not biased and not pairs


def _ends(value: ir.Value, *, takes_relu: bool) -> list[ir.Node]:
    """List the readers of a layer's output, past what onnxruntime takes in."""
    # A ReLU goes where the grid behind it begins at zero; elsewhere it hides the layer,
    # and a Gemm that was made of a MatMul takes none
    readers = [] if value.is_graph_output() else list(value.consumers())
    if len(readers) != 1:
        return readers
    behind = readers[0].outputs[0]
    if is_clip_at_zero(readers[0]):
        ends = _ends(behind, takes_relu=takes_relu)
        for end in ends if takes_relu else ():
            least = _LEAST.get(stored_type(end)) if end.op_type == QUANTIZE else None
            takes_relu &= least is not None and bool((_zeros_of(end) == least).all())
        return ends if takes_relu else [*readers, *ends]
    passed = readers[0].op_type in PASSED
    return _ends(behind, takes_relu=takes_relu) if passed else readers


def _zeros_of(pair: ir.Node) -> npt.NDArray[np.generic]:
    """Return the zero points of a QuantizeLinear or DequantizeLinear; 0 without."""
    zeros = array_of(input_at(pair, 2))
    return np.zeros(1, np.int8) if zeros is None else zeros
