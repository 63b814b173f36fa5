"""A quantized graph without its int8: what it would compute in float."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import numpy_helper

Array = npt.NDArray[Any]

HALF = 0.5 * (1 + 1e-4)
"""How many steps a weight may be off; its scale is a rounded number itself."""


class StrippingError(Exception):
    """A weight is none of the float graph's, to half a step."""


def stripped(model: onnx.ModelProto, weights: Sequence[Array]) -> onnx.ModelProto:
    """Take every QuantizeLinear and DequantizeLinear out.

    Args:
        model: quantized for TensorRT.
        weights: those of the float graph.

    Raises:
        StrippingError: a weight is none of these.
    """
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    held = {each.name: numpy_helper.to_array(each) for each in copy.graph.initializer}
    source = {
        node.output[0]: node.input[0]
        for node in copy.graph.node
        if node.op_type == "QuantizeLinear"
    }
    for node in copy.graph.node:
        if node.op_type != "DequantizeLinear":
            continue
        if node.input[0] in source:
            _become(node, "Identity", [source[node.input[0]]])
            continue
        name = f"{node.output[0]}__float"
        original = _original(node, held, weights)
        copy.graph.initializer.append(numpy_helper.from_array(original, name))
        _become(node, "Identity", [name])
    kept = [node for node in copy.graph.node if node.op_type != "QuantizeLinear"]
    del copy.graph.node[:]
    copy.graph.node.extend(kept)
    return copy


def _become(node: onnx.NodeProto, kind: str, inputs: Sequence[str]) -> None:
    node.op_type = kind
    del node.input[:]
    node.input.extend(inputs)
    del node.attribute[:]


def _original(
    node: onnx.NodeProto, held: Mapping[str, Array], weights: Sequence[Array]
) -> Array:
    """Find the float weight that an integer one stands for."""
    if node.input[0] not in held:
        raise StrippingError(f"{node.output[0]} dequantizes what nobody quantized")
    integers, scale = held[node.input[0]], held[node.input[1]]
    axis = next((each.i for each in node.attribute if each.name == "axis"), 1)
    if scale.ndim == 1 and integers.ndim:
        shape = [1] * integers.ndim
        shape[axis] = -1
        scale = scale.reshape(shape)
    found = integers.astype(np.float64) * scale.astype(np.float64)
    best = np.inf
    for weight in weights:
        for each in (weight, weight.T):
            if each.dtype.kind != "f" or each.size != found.size:
                continue
            if each.squeeze().shape != found.squeeze().shape:
                continue
            array = each.reshape(found.shape)
            off = np.abs(array - found) / scale
            if off.size == 0 or off.max() <= HALF:
                return np.asarray(array, scale.dtype)
            best = min(best, float(off.max()))
    raise StrippingError(
        f"{node.output[0]}: a weight {list(integers.shape)} is {best:.3g} steps off"
    )
