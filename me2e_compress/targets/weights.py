"""The weights that a plan makes int8, quantized."""

import dataclasses
from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.errors import PreconditionError
from me2e_compress.quantization.int8_weights import quantize_weight
from me2e_compress.quantization.plan import Decision
from me2e_compress.runtime.constant_values import evaluate_constants
from me2e_compress.runtime.frames import Array


@dataclasses.dataclass(frozen=True)
class QuantizedWeight:
    """A weight on the symmetric int8 grid: ``integers * scales`` along an axis.

    Attributes:
        name: what its initializers are called after.
        integers: int8, of the weight's shape; of a MatMul's [1, ..., K, N] that is one
            matrix for all its rows, [K, N].
        scales: float32 [channels], or [] for one step everywhere.
        axis: which axis of the integers the channels run along; None without channels.
    """

    name: str
    integers: npt.NDArray[np.int8]
    scales: npt.NDArray[np.float32]
    axis: int | None


def weights_of(
    model: ir.Model, chosen: Iterable[Decision]
) -> dict[str, QuantizedWeight]:
    """Quantize the weights of int8 layers; layers that share one share the result.

    Args:
        model: the float graph that was planned.
        chosen: what becomes int8; decisions without a weight are passed over.

    Returns:
        The weights by the name of the layer's first output.

    Raises:
        PreconditionError: what the plan calls a weight is none.
    """
    nodes = {str(node.outputs[0].name): node for node in model.graph}
    layers = {
        each.output: _planned(nodes[each.output], each, each.weight)
        for each in chosen
        if each.weight is not None
    }
    values = dict.fromkeys(value for value, _ in layers.values())
    made = [str(each.name) for each in values if each.producer() is not None]
    computed = evaluate_constants(model, made)
    quantized = {
        (value, axis): _quantize(value, axis, computed)
        for value, axis in dict.fromkeys(layers.values())
    }
    return {output: quantized[layer] for output, layer in layers.items()}


def _planned(
    node: ir.Node, decision: Decision, index: int
) -> tuple[ir.Value, int | None]:
    """Give a weight and the axis of its channels; -1 is the last axis of a MatMul's."""
    weight, axis = node.inputs[index], decision.axis
    if weight is None:
        raise PreconditionError(f"{decision.node} is planned as a layer without weight")
    return weight, -1 if axis is not None and node.op_type == "MatMul" else axis


def _quantize(
    value: ir.Value, axis: int | None, computed: Mapping[str, Array]
) -> QuantizedWeight:
    name = str(value.name)
    if name in computed:
        array = computed[name]
    elif value.const_value is not None:
        array = value.const_value.numpy()
    else:
        raise PreconditionError(f"{name} is planned as a weight, but is none")
    if axis == -1:
        array, axis = array.reshape(array.shape[-2:]), 1
    integers, scales = quantize_weight(array.astype(np.float32), axis)
    return QuantizedWeight(name, integers, scales, axis)
