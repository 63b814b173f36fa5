"""What scales and shifts channels, folded into the layer before it.

Given:   Conv (ConvTranspose, Gemm) -> BatchNormalization, or a constant Add, Mul, ...
Result:  one Conv with other weights

With y = k x + d per output channel: weight' = k weight, bias' = k bias + d, computed
in float64 (Ioffe, Szegedy 2015 for the k and d of a normalization).
"""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import provenance, static_shape
from me2e_compress.passes.fuse_basic.match import (
    Numbers,
    Site,
    constant_and_rest,
    numbers_of,
    sole_maker,
)
from me2e_compress.rewrite import Array, add_constant, replace_value, sole_reader

LAYERS = ("Conv", "ConvTranspose", "Gemm")


@dataclasses.dataclass
class _Affine:
    """``y = scale * x + shift``, one number a channel; the value it reads."""

    source: ir.Value
    scale: Numbers
    shift: Numbers


def fuse_affine(node: ir.Node, site: Site) -> bool:
    """Fold a normalization or a constant Add, Sub, Mul, Div into its layer."""
    if node.op_type == "BatchNormalization":
        affine = _normalization(node, site)
    elif node.op_type in ("Add", "Sub", "Mul", "Div"):
        affine = _arithmetic(node)
    else:
        return False
    layer = sole_maker(affine.source, *LAYERS) if affine is not None else None
    if affine is None or layer is None or layer.graph is not node.graph:
        return False
    weight, bias = numbers_of(layer.inputs[1]), _bias(layer)
    if weight is None or bias is None:
        return site.refuse(f"{layer.op_type} whose weights are computed")
    channels = _channels(layer, weight)
    scale = np.broadcast_to(affine.scale, (channels,))
    new_weight = weight * _shaped(layer, weight, scale)
    new_bias = np.broadcast_to(bias * scale + affine.shift, (channels,))
    reason = _objection(layer, scale, new_weight, new_bias)
    if reason is not None:
        return site.refuse(reason)
    _write(layer, node, site, new_weight, new_bias)
    return True


def _normalization(node: ir.Node, site: Site) -> _Affine | None:
    """Read an inference-time BatchNormalization."""
    outputs = [value for value in node.outputs[1:] if value.name]
    if node.attributes.get_int("training_mode", 0) or outputs or site.opset < 9:
        return None
    source = node.inputs[0]
    arrays = [numbers_of(value) for value in node.inputs[1:5]]
    known = [array for array in arrays if array is not None]
    if source is None or len(known) != 4:
        return None
    gamma, beta, mean, variance = known
    scale = gamma / np.sqrt(variance + node.attributes.get_float("epsilon", 1e-5))
    return _Affine(source, scale, beta - mean * scale)


def _arithmetic(node: ir.Node) -> _Affine | None:
    parts = constant_and_rest(node)
    if parts is None:
        return None
    numbers, source = parts
    channels = _per_channel(numbers, source, node)
    one, zero = np.ones(1), np.zeros(1)
    first = source is node.inputs[0]
    if channels is None:
        return None
    if node.op_type == "Add":
        return _Affine(source, one, channels)
    if node.op_type == "Mul":
        return _Affine(source, channels, zero)
    if node.op_type == "Sub":
        return _Affine(source, one if first else -one, -channels if first else channels)
    if not first or not channels.all():
        return None
    return _Affine(source, 1 / channels, zero)


def _per_channel(numbers: Numbers, source: ir.Value, node: ir.Node) -> Numbers | None:
    """Flatten a constant that differs along axis 1 at most."""
    shape = static_shape(source)
    rank = len(source.shape) if source.shape is not None else 0
    if numbers.ndim > rank or rank < 2:
        return None
    if numbers.size == 1:
        return numbers.reshape(1)
    full = (1,) * (rank - numbers.ndim) + numbers.shape
    if any(size != 1 for axis, size in enumerate(full) if axis != 1):
        return None
    if shape is None or shape[1] != full[1] or shape != static_shape(node.outputs[0]):
        return None
    return numbers.reshape(-1)


def _bias(layer: ir.Node) -> Numbers | None:
    """Give the bias as a vector (zero if there is none); None if it is not one."""
    if len(layer.inputs) < 3 or layer.inputs[2] is None:
        return np.zeros(1)
    bias = numbers_of(layer.inputs[2])
    if bias is None or any(size != 1 for size in bias.shape[:-1]):
        return None
    beta = layer.attributes.get_float("beta", 1.0)
    return bias.reshape(-1) * (beta if layer.op_type == "Gemm" else 1.0)


def _channels(layer: ir.Node, weight: Numbers) -> int:
    if layer.op_type == "Conv":
        return int(weight.shape[0])
    if layer.op_type == "ConvTranspose":
        return int(weight.shape[1]) * layer.attributes.get_int("group", 1)
    return int(weight.shape[0 if layer.attributes.get_int("transB", 0) else 1])


def _shaped(layer: ir.Node, weight: Numbers, scale: Numbers) -> Numbers:
    """Give the scale in the form in which it multiplies the weight."""
    if layer.op_type == "Gemm":
        return scale[:, None] if layer.attributes.get_int("transB", 0) else scale
    rest = (1,) * (weight.ndim - 2)
    if layer.op_type == "Conv":
        return scale.reshape(-1, 1, *rest)
    groups = layer.attributes.get_int("group", 1)
    rows = np.repeat(scale.reshape(groups, -1), weight.shape[0] // groups, axis=0)
    return rows.reshape(*rows.shape, *rest)


def _objection(
    layer: ir.Node, scale: Numbers, weight: Numbers, bias: Numbers
) -> str | None:
    value = layer.inputs[1]
    if value is None or value.dtype is None:
        return f"{layer.op_type} of unknown type"
    if not (scale == 1).all() and sole_reader(value) is None:
        return f"{layer.op_type} that shares its weights"
    limit = np.finfo(value.dtype.numpy()).max
    if not (np.all(np.abs(weight) <= limit) and np.all(np.abs(bias) <= limit)):
        return f"{layer.op_type} whose weights would overflow"
    return None


def _write(
    layer: ir.Node, node: ir.Node, site: Site, weight: Numbers, bias: Numbers
) -> None:
    old = layer.inputs[1]
    kind = old.dtype.numpy() if old is not None and old.dtype is not None else None
    if old is not None and sole_reader(old) is layer:
        old.const_value = ir.tensor(weight.astype(kind), name=old.name)
    _write_bias(layer, site, bias.astype(kind))
    if layer.op_type == "Gemm":
        layer.attributes["beta"] = ir.AttrFloat32("beta", 1.0)
    provenance.inherit(layer, (layer, node), by=site.by)
    replace_value(node.outputs[0], layer.outputs[0])
    site.graph.remove(node, safe=True)


def _write_bias(layer: ir.Node, site: Site, bias: Array) -> None:
    old = layer.inputs[2] if len(layer.inputs) > 2 else None
    if old is not None and sole_reader(old) is layer:
        old.const_value = ir.tensor(np.ascontiguousarray(bias), name=old.name)
        old.shape = ir.Shape(bias.shape)
        return
    weight = layer.inputs[1]
    stem = (weight.name if weight is not None else None) or layer.name or "layer"
    name = f"{stem.removesuffix('.weight')}.bias"
    value = add_constant(site.graph, bias, name)
    if len(layer.inputs) < 3:
        layer.resize_inputs(3)
    layer.replace_input_with(2, value)
