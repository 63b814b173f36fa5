"""The rounding errors of the int8 nodes of a float graph, written as nodes in it."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import array_of, producer_of, static_shape
from me2e_compress.quantization.plan import RESIDUAL, Decision, QuantPlan
from me2e_compress.runtime.runnable import compiled_or_expanded
from me2e_compress.sensitivity.gradients import Tape
from me2e_compress.targets.base import Grids
from me2e_compress.targets.weights import QuantizedWeight, weights_of


@dataclasses.dataclass(frozen=True)
class ErrorSources:
    """The places of a float graph where int8 makes errors.

    ``probes`` are the values that int8 nodes read, ``layers`` those that layers with an
    int8 weight give: each with the first output of the node that is blamed.
    """

    model: ir.Model
    probes: Mapping[ir.Value, str]
    grids: Mapping[ir.Value, tuple[np.float32, int]]
    layers: Mapping[ir.Value, str]
    weights: Mapping[str, QuantizedWeight]
    decisions: Mapping[str, Decision]

    @classmethod
    def of(cls, model: ir.Model, plan: QuantPlan, grids: Grids) -> "ErrorSources":
        """Copy a graph, probe what its int8 nodes read, and expand fused nodes."""
        origin = {str(n.outputs[0].name): n for n in model.graph}
        copy = model.clone()
        nodes = {str(n.outputs[0].name): n for n in copy.graph}
        probes, found = dict[str, str](), dict[str, tuple[np.float32, int]]()
        for each in plan.placed:
            node = nodes[each.output]
            for index in each.activations:
                value, read = node.inputs[index], origin[each.output].inputs[index]
                if value is None or read is None:
                    continue
                probe = ir.node("Identity", [value])
                made = probe.outputs[0]
                made.name = f"me2e_sensitivity_probe_{len(probes)}"
                made.shape, made.type = value.shape, value.type
                copy.graph.insert_before(node, probe)
                node.replace_input_with(index, made)
                probes[made.name] = blamed(origin[each.output], each)
                found[made.name] = grids[str(read.name)]
        made_of, _ = compiled_or_expanded(copy, compiled=False)
        graph.infer_shapes(made_of)
        values = {str(v.name): v for node in made_of.graph for v in node.outputs}
        weights = weights_of(model, plan.placed, balanced=plan.balanced)
        return cls(
            made_of,
            {values[name]: layer for name, layer in probes.items()},
            {values[name]: each for name, each in found.items()},
            {values[name]: name for name in weights},
            weights,
            {each.output: each for each in plan.placed},
        )

    def reached(self) -> set[ir.Value]:
        """Return every value that depends on an error."""
        found = {*self.probes, *self.layers}
        for node in self.model.graph:
            if not found.isdisjoint(filter(None, node.inputs)):
                found.update(node.outputs)
        return found

    def layer_of(self, node: ir.Node) -> str:
        """Return the layer whose error a node's output shows; empty for most nodes."""
        value = node.outputs[0]
        return self.probes.get(value) or self.layers.get(value, "")

    def effect(self, t: Tape, node: ir.Node, g: ir.Value) -> ir.Value:
        """Write what an error does: its channels' squares summed, and its sum."""
        value = node.outputs[0]
        rank = len(static_shape(value) or ())
        if value not in self.probes:
            return self._effect_of_weight(t, node, g, rank)
        layer = next(iter(value.consumers()), None)
        convolved = layer is not None and layer.op_type.startswith("Conv")
        along = range(2, rank) if convolved else range(max(rank - 2, 0), rank - 1)
        step, zero = self.grids[value]
        late = t.op("Add", [t.constant(np.array(step)), t.zero_after([g])])
        effect = t.times(g, _rounding(t, node, late, zero))
        return _summed(t, t.total(effect, [*along], keep=False))

    def _effect_of_weight(
        self, t: Tape, node: ir.Node, g: ir.Value, rank: int
    ) -> ir.Value:
        """Write what the rounding of a weight does: a product as the layer's own."""
        name = self.layers[node.outputs[0]]
        at, weight = self.decisions[name].weight or 0, self.weights[name]
        near, exact = _stored(weight), array_of(node.inputs[at])
        inputs = list(node.inputs[:2])
        channel = 1 if node.op_type.startswith("Conv") else rank - 1
        if exact is None:
            flat = t.op("Reshape", [node.inputs[at], t.ints(near.shape)])
            inputs[at] = t.op("Sub", [t.constant(near), flat])
        else:
            error = near - exact.reshape(near.shape).astype(np.float32)
            inputs[at] = t.constant(np.ascontiguousarray(error))
        inputs[at] = t.op("Add", [inputs[at], t.zero_after([g])])
        effect = t.times(g, t.op(node.op_type, inputs, node.attributes))
        along = [axis for axis in range(rank) if axis != channel]
        return _summed(t, t.total(effect, along, keep=False))

    def behind(self, missing: Mapping[ir.Value, str]) -> dict[str, str]:
        """Return the layers whose gradient lacks a part, with the reasons."""
        reasons, waiting = dict(missing), list(missing)
        while waiting:
            value = waiting.pop()
            node = producer_of(value)
            for each in () if node is None else node.inputs:
                if each is not None and each not in reasons:
                    reasons[each] = reasons[value]
                    waiting.append(each)
        return {
            layer: reasons[value]
            for where in (self.probes, self.layers)
            for value, layer in where.items()
            if value in reasons
        }


def _summed(t: Tape, value: ir.Value) -> ir.Value:
    sums = [
        t.shaped(t.op(each, [value], {"keepdims": 0}), [1])
        for each in ("ReduceSumSquare", "ReduceSum")
    ]
    return t.op("Concat", sums, {"axis": 0})


def _stored(weight: QuantizedWeight) -> npt.NDArray[np.float32]:
    """Return a weight as int8 keeps it."""
    steps = weight.scales
    if weight.axis is not None:
        sides = [1] * weight.integers.ndim
        sides[weight.axis] = -1
        steps = steps.reshape(sides)
    return np.asarray(weight.integers * steps, np.float32)


def _rounding(t: Tape, probe: ir.Node, step: ir.Value, zero: int) -> ir.Value:
    """Write the difference between a tensor in int8 and the tensor."""
    value = probe.inputs[0]
    grid = [step, t.constant(np.array(zero, np.uint8))]
    integers = t.op("QuantizeLinear", [value, *grid])
    return t.op("Sub", [t.op("DequantizeLinear", [integers, *grid]), value])


def blamed(node: ir.Node, decision: Decision) -> str:
    """Return the layer that an error is due to: of a residual Add its convolution."""
    if decision.rule != RESIDUAL:
        return decision.output
    layer = producer_of(node.inputs[1 - decision.activations[0]])
    if layer is not None and layer.op_type == "BatchNormalization":
        layer = producer_of(layer.inputs[0])
    return decision.output if layer is None else str(layer.outputs[0].name)
