"""A quantized graph without its int8: what is left must compute what the graph did.

Pairs of QuantizeLinear and DequantizeLinear on activations are taken out, and every
dequantized weight gives way to the float one, from which it may differ by half a step.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import numpy_helper

HALF = 0.5 * (1 + 1e-4)
"""How many steps a weight may be off; its scale is a rounded number itself."""
WHOLE = 2 * HALF
"""The same of rules that round so that errors cancel."""

Array = npt.NDArray[Any]


class StrippingError(Exception):
    """A weight is none of the float graph's, to the steps that it may be off."""


def constants(model: onnx.ModelProto) -> list[Array]:
    """List the constants of a graph: a node holds one that is an output as well."""
    nodes = [
        attribute.t
        for node in model.graph.node
        if node.op_type == "Constant"
        for attribute in node.attribute
        if attribute.name == "value"
    ]
    return [numpy_helper.to_array(each) for each in (*model.graph.initializer, *nodes)]


def stripped(
    model: onnx.ModelProto, weights: Sequence[Array], most: float = HALF
) -> onnx.ModelProto:
    """Take every QuantizeLinear and DequantizeLinear out.

    Args:
        model: quantized for TensorRT.
        weights: those of the float graph.
        most: steps that a weight may be off.

    Raises:
        StrippingError: a weight is none of these.
    """
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    held = {each.name: numpy_helper.to_array(each) for each in copy.graph.initializer}
    kept, source = list[onnx.NodeProto](), dict[str, str]()
    for node in copy.graph.node:
        if node.op_type == "QuantizeLinear":
            source[node.output[0]] = node.input[0]
            continue
        if node.op_type == "DequantizeLinear":
            name = source.get(node.input[0])
            if name is None:
                name = f"{node.output[0]}__float"
                original = _original(node, held, weights, most)
                copy.graph.initializer.append(numpy_helper.from_array(original, name))
            node = onnx.helper.make_node("Identity", [name], node.output)
        kept.append(node)
    del copy.graph.node[:]
    copy.graph.node.extend(kept)
    return copy


def _original(
    node: onnx.NodeProto,
    held: Mapping[str, Array],
    weights: Sequence[Array],
    most: float,
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
    for each in (turned for weight in weights for turned in (weight, weight.T)):
        if each.dtype.kind != "f" or each.squeeze().shape != found.squeeze().shape:
            continue
        array = each.reshape(found.shape)
        off = float((np.abs(array - found) / scale).max(initial=0.0))
        if off <= most:
            return np.asarray(array, scale.dtype)
        best = min(best, off)
    raise StrippingError(
        f"{node.output[0]}: a weight {list(integers.shape)} is {best:.3g} steps off"
    )
