"""Lint rules: can onnxruntime run a graph, its int8 fast, and as the nodes say?

Measured with onnxruntime 1.31.1 on the CPU, opsets 11 to 23. Our own measurements run
without these rewrites (``QDQ_OFF`` of runtime/runnable.py), deployed files get them.
"""

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np
import onnx_ir as ir
import onnxruntime as ort

from me2e_compress.graph import (
    channel_axis,
    input_at,
    is_standard,
    nodes_of,
    opset_of,
    rank_of,
)
from me2e_compress.graph.nodes import (
    Array,
    Numbers,
    array_of,
    constant_values,
    maker,
    sole_reader,
    unrenamed,
)
from me2e_compress.graph.opset import on_disk
from me2e_compress.graph.runtime_operators import has_operator, newest_ir, reads
from me2e_compress.graph.shapes import open_shape
from me2e_compress.graph.validity import ORIGINAL_DOMAIN
from me2e_compress.operators import find
from me2e_compress.runtime.kernel_types import float32_hint, nodes_without_kernel
from me2e_compress.runtime.runnable import known_operators
from me2e_compress.targets import (
    LintFinding,
    LintRule,
    divided_grids,
    error,
    name_of,
    of_opset,
    rule_of_nodes,
    valid,
)
from me2e_compress.targets.onnxruntime.region import never_negative
from me2e_compress.targets.quantized import (
    DEQUANTIZE,
    QUANTIZE,
    pairs_of,
)
from me2e_compress.targets.weights import evaluate_constants, quantize_weight

INT32_MAX = 2.0**31 - 1  # a bias of more steps becomes -2^31

# Relative difference of two scales that are meant to be equal: twice what rounding to
# float16 moves one
SCALES_APART = 1e-3

_REMEDY = "disabled_optimizers=['WeightBiasQuantization'] keeps it"
_CLIPS = ("Clip", "Dropout", "Identity", "Relu")
# Operators that onnxruntime moves a pair across, to the layer (QDQPropagation)
PASSED = ("MaxPool", "Reshape", "Slice", "Squeeze", "Transpose", "Unsqueeze")
_FOLDED = ("Add", "BatchNormalization", "Mul")  # into a float weight, first

Constants = Mapping[str, Array]


@dataclasses.dataclass(frozen=True)
class _Layer:
    """A layer that reads a dequantized activation."""

    node: ir.Node  # Conv, ConvTranspose, Gemm or MatMul
    end: ir.Value  # its output, behind the Add of a MatMul's bias
    pair: ir.Node  # the DequantizeLinear that it reads
    bias: ir.Value | None  # its third operand, or the other one of that Add

    @property
    def is_reshaped(self) -> bool:
        """Whether a MatMul's rows are flattened before the product, and not after."""
        return self.node.op_type == "MatMul" and rank_of(self.node.inputs[0]) != 2

    @property
    def weight(self) -> ir.Value:
        """Return its weight."""
        weight = self.node.inputs[1]
        assert weight is not None
        return unrenamed(weight)


def int8_rewrites(model: ir.Model) -> Iterator[LintFinding]:
    """Find layers that onnxruntime's int8 computes otherwise than the file says.

    * ``wrapped-bias``: it rounds a float bias to int32 in steps of input times weight,
      and more steps than int32 holds become -2^31.
    * ``bias-scale``: its QGemm takes an int32 bias in those steps, whatever the scale
      of the bias is.
    * ``float-weight``: it rounds a float weight between two pairs to int8, with one
      scale in all.
    """
    layers = list(_layers(model))
    constants = _constants(model, layers)
    for layer in layers:
        for rule, explain in _RULES.items():
            if message := explain(layer, constants):
                yield LintFinding("wrong", rule, name_of(layer.node), message)
                break


def _layers(model: ir.Model) -> Iterator[_Layer]:
    """Yield the layers that read a dequantized activation."""
    for node in nodes_of(model):
        if not is_standard(node) or len(node.inputs) < 2 or node.inputs[1] is None:
            continue
        # The pair may stand before Identities and moves
        value = node.inputs[0]
        while (moved := maker(value, "Identity", *PASSED)) is not None:
            value = moved.inputs[0]
        pair = maker(value, DEQUANTIZE)
        if pair is None:
            continue
        if node.op_type in ("Conv", "ConvTranspose", "Gemm"):
            yield _Layer(node, node.outputs[0], pair, input_at(node, 2))
        elif node.op_type == "MatMul" and rank_of(node.inputs[1]) == 2:
            # onnxruntime makes a Gemm of a MatMul and the Add of a row behind it
            addition = sole_reader(node.outputs[0])
            if addition is None or addition.op_type != "Add":
                continue
            sides = [v for v in addition.inputs if v is not node.outputs[0]]
            shape = open_shape(sides[0]) if len(sides) == 1 else None
            columns = open_shape(node.inputs[1])
            most = 2 if rank_of(node.inputs[0]) == 2 else 1
            if shape and columns and len(shape) <= most and shape[-1] == columns[-1]:
                yield _Layer(node, addition.outputs[0], pair, sides[0])


def _constants(model: ir.Model, layers: list[_Layer]) -> Constants:
    """Return the scales and biases of layers, and the float weights, by name."""
    wanted: list[ir.Value | None] = []
    for layer in layers:
        stored = maker(layer.weight, DEQUANTIZE)
        wanted += [layer.pair.inputs[1], stored.inputs[1] if stored else layer.weight]
        scale = _scale_of_bias(layer)
        wanted += [layer.bias if scale is None else scale]
    values = [value for value in dict.fromkeys(wanted) if value is not None]
    known = {str(v.name): array for v in values if (array := array_of(v)) is not None}
    # onnxruntime folds what nodes compute of constants, too
    constant = constant_values(model)
    names = [str(v.name) for v in values if v in constant and str(v.name) not in known]
    return {**known, **evaluate_constants(model, names)}


def _scale_of_bias(layer: _Layer) -> ir.Value | None:
    """Return the scale of a bias that is stored as integers."""
    stored = None if layer.bias is None else maker(unrenamed(layer.bias), DEQUANTIZE)
    return None if stored is None else stored.inputs[1]


def _numbers(value: ir.Value | None, constants: Constants) -> Numbers | None:
    """Return a constant, widened to float64; None if it is not known."""
    array = None if value is None else constants.get(str(value.name))
    return None if array is None else np.asarray(array, np.float64)


def _steps(layer: _Layer, constants: Constants) -> Numbers | None:
    """Return the step of the products: [channels], or [1] for one step everywhere."""
    stored = maker(layer.weight, DEQUANTIZE)
    if stored is None:
        return None
    left = _numbers(layer.pair.inputs[1], constants)
    right = _numbers(stored.inputs[1], constants)
    if left is None or right is None or left.size != 1 or right.ndim > 1:
        return None
    # Scales must run along the output channels
    if right.size > 1:
        rank, axis = rank_of(layer.weight), stored.attributes.get_int("axis", 1)
        if rank is not None and axis % rank != channel_axis(layer.node):
            return None
    return left.reshape(-1) * right.reshape(-1)


def _wrapped(layer: _Layer, constants: Constants) -> str:
    """Say by how much a float bias exceeds int32; empty if it does not."""
    steps, bias = _steps(layer, constants), _numbers(layer.bias, constants)
    if steps is None or bias is None or _scale_of_bias(layer) is not None:
        return ""
    fits = bias.ndim == 1 and steps.size in (1, bias.size)
    if not fits or _quantizer(layer) is None:
        return ""
    # |bias| / (input step * weight step) must be at most 2^31 - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        counts = np.nan_to_num(np.abs(bias) / np.abs(steps), nan=0.0, posinf=np.inf)
    wrapped = np.flatnonzero(counts > INT32_MAX)
    if not wrapped.size:
        return ""
    worst = int(counts.argmax())
    return (
        "onnxruntime rounds its bias to int32 in steps of input times weight, and"
        f" {wrapped.size} of {bias.size} do not fit: {bias[worst]:.3g} of channel"
        f" {worst} is {counts[worst]:.1e} steps; {_REMEDY} in float"
    )


def _misread(layer: _Layer, constants: Constants) -> str:
    """Say how far the scale of a product's int32 bias is from what QGemm takes."""
    steps = _steps(layer, constants)
    own = _numbers(_scale_of_bias(layer), constants)
    if steps is None or own is None or not own.size or not _becomes_gemm(layer):
        return ""
    if own.size > 1 and 1 < steps.size != own.size:
        return ""
    # The bias is read as steps, and stored as own: a factor of own / steps
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = own.reshape(-1) / steps
    if np.all(np.abs(ratios - 1) <= SCALES_APART):
        return ""
    worst = int(np.abs(np.log(np.abs(ratios) + 1e-300)).argmax())
    return (
        "onnxruntime's QGemm takes its int32 bias in steps of input times weight,"
        f" {steps[min(worst, steps.size - 1)]:.3g}, the file in steps of"
        f" {own.reshape(-1)[min(worst, own.size - 1)]:.3g}: a bias {ratios[worst]:.3g}"
        " times as large; lower-int8, or a float bias, mends it"
    )


def _becomes_gemm(layer: _Layer) -> bool:
    """Return whether onnxruntime makes a QGemm of a product: 8 bits, no factors."""
    # The weight's zero point must be written, even 0
    node, integers = layer.node, layer.pair.inputs[0]
    factors = [node.attributes.get_float(name, 1.0) for name in ("alpha", "beta")]
    kind = None if integers is None else integers.dtype
    if node.op_type not in ("Gemm", "MatMul") or factors != [1.0, 1.0]:
        return False
    if kind not in (ir.DataType.INT8, ir.DataType.UINT8, None):
        return False
    stored = maker(layer.weight, DEQUANTIZE)
    if stored is not None and input_at(stored, 2) is None:
        return False
    # A quantizer beside other readers hides the product
    readers = [] if layer.is_reshaped else list(layer.end.consumers())
    if any(reader.op_type == QUANTIZE for reader in readers):
        return len(readers) == 1 and not layer.end.is_graph_output()
    # So does a clip that one node reads, unless that is a quantizer that clips as far
    clip = sole_reader(layer.end) if readers else None
    if clip is None or clip.op_type not in ("Clip", "Relu"):
        return True
    quantizer = sole_reader(clip.outputs[0])
    if quantizer is None or quantizer.op_type != QUANTIZE:
        return quantizer is None
    zero = array_of(input_at(quantizer, 2))
    return zero is None or bool(np.all(zero == np.iinfo(zero.dtype.name).min))


def rounded_layers(model: ir.Model) -> Iterator[tuple[ir.Node, ir.Node]]:
    """Yield the layers of rule ``float-weight``, with the quantizers behind them."""
    layers = list(_layers(model))
    constants = _constants(model, layers)
    for layer in layers:
        if (quantizer := _quantizer_of_float(layer, constants)) is not None:
            yield layer.node, quantizer


def _quantizer_of_float(layer: _Layer, constants: Constants) -> ir.Node | None:
    """Return the quantizer for which a float weight is rounded; None if it is not."""
    weight = constants.get(str(layer.weight.name))
    bias = _numbers(layer.bias, constants)
    if weight is None or weight.dtype != np.float32 or not weight.size:
        return None
    if layer.bias is not None and (
        bias is None or bias.ndim != 1 or _scale_of_bias(layer) is not None
    ):
        return None
    folded = _FOLDED if layer.node.op_type == "Conv" else ("BatchNormalization",)
    return _quantizer(layer, folded)


def _rounded(layer: _Layer, constants: Constants) -> str:
    """Say what rounding a float weight between pairs costs; empty if none is."""
    if _quantizer_of_float(layer, constants) is None:
        return ""
    exact = constants[str(layer.weight.name)].astype(np.float32)
    integers, step = quantize_weight(exact, None)
    noise = float(np.square(exact - integers * step).sum(dtype=np.float64))
    signal = float(np.square(exact).sum(dtype=np.float64))
    loss = f" ({10 * np.log10(signal / noise):.1f} dB)" if noise and signal else ""
    return (
        "it stands between two pairs, so onnxruntime rounds its float weight to int8,"
        f" with one scale in all{loss}; {_REMEDY}"
    )


def _quantizer(layer: _Layer, folded: tuple[str, ...] = ()) -> ir.Node | None:
    """Return the QuantizeLinear that alone reads a layer; None if there is none."""
    # Behind what is folded into the layer, then clips, then moves
    value = layer.end
    moves: tuple[str, ...] = PASSED
    if layer.node.op_type == "Gemm" and layer.bias is None:
        moves = tuple(op for op in moves if op != "Transpose")  # fused before
    stages = [moves] if layer.is_reshaped else [folded, _CLIPS, moves]
    while len(value.uses()) == 1:
        (reader,) = value.consumers()
        if reader.op_type == QUANTIZE:
            return reader
        while stages and reader.op_type not in stages[0]:
            stages.pop(0)
        others = [v for v in reader.inputs[1:] if v is not None and v is not value]
        if not stages or any(array_of(v) is None for v in others):
            return None
        value = reader.outputs[0]
    return None


# What says how a layer is computed otherwise, or nothing, by rule
_RULES = {"wrapped-bias": _wrapped, "bias-scale": _misread, "float-weight": _rounded}


# Lint rules: can onnxruntime's CPU run a graph, and its int8 fast?


def opset(model: ir.Model) -> Iterator[LintFinding]:
    """Find files that onnxruntime cannot run as they lie on disk."""
    (version, opset), reasons = on_disk(model), list[str]()
    if version > newest_ir():
        reasons.append(f"onnxruntime reads IR version {newest_ir()} at most")
    if not reads(opset):
        reasons.append(f"onnxruntime does not read opset {opset}")
    used = {node.op_type for node in nodes_of(model) if is_standard(node)}
    for op_type in sorted(used):
        if has_operator(op_type, opset_of(model)) and not has_operator(op_type, opset):
            reasons.append(f"onnxruntime has no {op_type} in opset {opset}")
    if reasons:
        file = f"the file is of opset {opset} and IR version {version}"
        cure = "compress -r exact writes it so that it runs"
        yield error("opset", None, f"{file}: {', '.join(reasons)}; {cure}")


@rule_of_nodes("scale-shape", "error", pairs_of)
def scale_shapes(node: ir.Node) -> Iterator[str]:
    """Find scales of a rank that no kernel takes, though the file opens."""
    shape = open_shape(node.inputs[1])
    if shape and len(shape) > 1 and not node.attributes.get_int("block_size", 0):
        yield f"its scale is {list(shape)}: one number, or a row of one a channel"


def operators(model: ir.Model) -> Iterator[LintFinding]:
    """Find operators that have neither a kernel nor a function in the file."""
    known = known_operators()
    for node in nodes_of(model):
        domain = "" if is_standard(node) else node.domain
        if (domain, node.op_type) in known or node.op_identifier() in model.functions:
            continue
        # Name the pass that helps a fused operator: functions need a domain
        way = ""
        if find(node) is not None:
            way = ": attach-bodies writes one, expand-operators the body in its place"
            if is_standard(node) or ORIGINAL_DOMAIN in node.metadata_props:
                way = ": expand-operators writes its body"
        name = f"{node.domain or 'ai.onnx'}::{node.op_type}"
        yield error(
            "operator", node, f"{name} has no kernel and no local function{way}"
        )


def kernels(model: ir.Model) -> Iterator[LintFinding]:
    """Find operators that have a kernel, but none for these element types."""
    for node, missing in nodes_without_kernel(model):
        yield error("kernel", node, f"{missing}{float32_hint(model, missing)}")


def fuses_pads_wrongly() -> bool:
    """Return whether the installed onnxruntime is one before 1.32."""
    major, minor = ort.__version__.split(".")[:2]
    return (int(major), int(minor)) < (1, 32)


@rule_of_nodes("padded-pool", "wrong")
def padded_pools(node: ir.Node) -> Iterator[str]:
    """Find a Pad of zeros before a MaxPool: wrong in onnxruntime up to 1.31."""
    # Its Pad fusion turns the zeros into the pool's own padding, which is minus
    # infinity; inputs that are never negative give the same result. Our own sessions
    # disable it.
    pad = maker(node.inputs[0], "Pad") if node.op_type == "MaxPool" else None
    if pad is None or not is_standard(pad) or not fuses_pads_wrongly():
        return
    if len(list(pad.outputs[0].consumers())) != 1:
        return
    # It must fill in zeros: by default, or by a constant
    constant = pad.attributes.get_string("mode", "constant") == "constant"
    filling, value = input_at(pad, 2), array_of(input_at(pad, 2))
    if not constant or (filling is not None and (value is None or value.any())):
        return
    # Without negative values the result is the same
    image = pad.inputs[0]
    if image is None or not never_negative(image):
        yield (
            f"reads the zeros of Pad {pad.name!r}: the Pad fusion of onnxruntime up to"
            " 1.31 makes them minus infinity; open it with"
            " disabled_optimizers=['Pad_Fusion']"
        )


RULES: tuple[LintRule, ...] = (
    valid,
    of_opset,
    divided_grids,
    opset,
    scale_shapes,
    operators,
    kernels,
    padded_pools,
    int8_rewrites,
)
