"""What is to be lowered: a float graph, its int8 weights and its ranges."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.calibration.plan import Decision, QuantPlan
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.weights import quantize_weight
from me2e_compress.errors import PreconditionError
from me2e_compress.runtime.evaluate import evaluate_constants
from me2e_compress.runtime.frames import Array


@dataclasses.dataclass(frozen=True)
class Weight:
    """A weight on the symmetric int8 grid: ``integers * scales`` along an axis.

    Attributes:
        name: what its initializers are called after.
        integers: int8, of the weight's shape.
        scales: float32 [channels], or [1] for one step everywhere.
        axis: which axis of the weight the channels run along.
    """

    name: str
    integers: npt.NDArray[np.int8]
    scales: npt.NDArray[np.float32]
    axis: int


@dataclasses.dataclass(frozen=True)
class Draft:
    """A graph in which everything is read as float, and what of it becomes int8.

    Attributes:
        model: the graph; lowering writes into it.
        weights: of every layer that is to be int8, by the name of its first output.
        reach: max(|low|, |high|) of the activations whose range is known, by name.
    """

    model: ir.Model
    weights: Mapping[str, Weight]
    reach: Mapping[str, float]


def draft_of_plan(model: ir.Model, plan: QuantPlan, ranges: Ranges) -> Draft:
    """Copy a float graph and quantize the weights of the layers that a plan chose.

    Raises:
        PreconditionError: what the plan calls a weight is none.
    """
    copy = model.clone()
    nodes = {str(node.outputs[0].name): node for node in copy.graph}
    chosen = [(nodes[each.output], each) for each in layers_of(plan)]
    computed = evaluate_constants(model, _computed(chosen))
    weights = {}
    quantized: dict[tuple[str, int], Weight] = {}
    for node, decision in chosen:
        weight, axis = _planned(node, decision)
        name = str(weight.name)
        if (name, axis) not in quantized:
            integers, scales = quantize_weight(_array(weight, computed), axis)
            quantized[name, axis] = Weight(name, integers, scales, axis)
        weights[decision.output] = quantized[name, axis]
    reach = {name: max(-low, high) for name, (low, high) in ranges.tensors.items()}
    return Draft(copy, weights, reach)


def layers_of(plan: QuantPlan) -> tuple[Decision, ...]:
    """Give the int8 layers of a plan: the products of attention have no weight.

    Int8 makes those slower on this target: 0.55 to 0.9 times the speed of float.
    """
    return tuple(each for each in plan.chosen if each.weight is not None)


def _computed(chosen: list[tuple[ir.Node, Decision]]) -> list[str]:
    """Name the weights that are computed from initializers: transposed, sliced."""
    weights = (_planned(node, decision)[0] for node, decision in chosen)
    return list(
        dict.fromkeys(str(each.name) for each in weights if each.producer() is not None)
    )


def _planned(node: ir.Node, decision: Decision) -> tuple[ir.Value, int]:
    index, axis = decision.weight, decision.axis
    weight = None if index is None else node.inputs[index]
    if weight is None or axis is None:
        raise PreconditionError(f"{decision.node} is planned as a layer without weight")
    return weight, axis


def _array(weight: ir.Value, computed: Mapping[str, Array]) -> npt.NDArray[np.float32]:
    name = str(weight.name)
    if name in computed:
        return computed[name].astype(np.float32)
    if weight.const_value is None:
        raise PreconditionError(f"{name} is planned as a weight, but is none")
    return weight.const_value.numpy().astype(np.float32)
