"""The rounding errors of the int8 nodes of a float graph, written as nodes in it."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import array_of, producer_of, static_shape
from me2e_compress.graph.nodes import Array, input_at, maker
from me2e_compress.quantization.plan import RESIDUAL, Decision, QuantPlan
from me2e_compress.runtime.runnable import compiled_or_expanded
from me2e_compress.sensitivity.gradients.tape import Tape, given, sizes_of
from me2e_compress.targets.base import Grids
from me2e_compress.targets.weights import QuantizedWeight, weights_of

HEAVY = 4_000_000
"""Products of a layer; the error of its weight is then not computed channel by channel
for all of them."""

SHARE, FEWEST = 8, 16
"""Of such a layer one channel in so many is looked at, but no fewer than a block of
those that onnxruntime's convolutions compute together."""


@dataclasses.dataclass(frozen=True)
class Reading:
    """A vector that tells of the error of a layer: one number a channel, mostly.

    ``squares`` is what the squares of its numbers count, ``sums`` what its sum does.
    """

    layer: str
    vector: ir.Value
    size: int
    squares: float = 1
    sums: float = 1


@dataclasses.dataclass(frozen=True)
class ErrorSources:
    """The places of a float graph where int8 makes errors.

    ``probes`` are the values that int8 nodes read, ``layers`` those that layers with an
    int8 weight give: each with the first output of the node that is blamed. ``errors``
    are those of rounding that are written already.
    """

    model: ir.Model
    probes: Mapping[ir.Value, str]
    grids: Mapping[ir.Value, tuple[np.float32, int]]
    layers: Mapping[ir.Value, str]
    weights: Mapping[str, QuantizedWeight]
    decisions: Mapping[str, Decision]
    errors: dict[tuple[ir.Value, np.float32, int], ir.Value] = dataclasses.field(
        default_factory=dict
    )

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
                found[made.name] = _grid(read, grids)
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

    def rounded(self, node: ir.Node) -> Array | None:
        """Return the weight of a heavy layer as int8 keeps it; None of any other.

        Gradients pass through it in that form: of what they are then, <g, W x + b>
        is known without another product, and so is what rounding does to it.
        """
        if node.outputs[0] not in self.layers or node.inputs[0] not in self.probes:
            return None
        decision = self.decisions[self.layers[node.outputs[0]]]
        near = _stored(self.weights[decision.output])
        exact, options = array_of(input_at(node, 1)), node.attributes
        plain = node.op_type in ("Conv", "MatMul", "Gemm") and decision.weight == 1
        if not plain or exact is None or exact.shape != near.shape:
            return None
        channels = near.shape[_axis(node)]
        bias = static_shape(input_at(node, 2)) or (channels,)
        scaled = {options.get_float(name, 1.0) for name in ("alpha", "beta")} != {1.0}
        if options.get_int("group", 1) > 1 or scaled or math.prod(bias) != channels:
            return None
        products = (
            math.prod(static_shape(node.outputs[0]) or ()) * near.size // channels
        )
        return near if products >= HEAVY and channels >= 2 * FEWEST else None

    def readings(
        self, t: Tape, node: ir.Node, g: ir.Value, to_input: ir.Value | None = None
    ) -> list[Reading]:
        """Write what an error does to what a node gives, of its gradient.

        With that ``to_input`` of a heavy layer, a part of the channels is looked at,
        and <g, W x + b> of the rounded weight beside that of the exact one.
        """
        value = node.outputs[0]
        if value in self.probes:
            return [self._of_rounding(t, node, g)]
        if to_input is None:
            return [self._of_weight(t, node, g)]
        channels = sizes_of(value)[_channel(node)]
        looked = max(channels // SHARE, FEWEST)
        part = self._of_weight(t, node, g, channels // looked)
        layer, x, sizes = part.layer, given(node.inputs[0]), sizes_of(value)
        found, inner = [part], _inner(node, sizes)
        for left, right, sums in ((to_input, x, 1), (g, _behind_relu(value), -1)):
            rows = [t.shaped(each, [1, -1]) for each in (left, right)]
            dot = t.op("Gemm", rows, {"transB": 1})
            found.append(Reading(layer, t.shaped(dot, [-1]), 1, 0, sums))
        if (bias := input_at(node, 2)) is not None:
            both = t.times(t.total(g, inner, keep=False), bias)
            size = math.prod(each for at, each in enumerate(sizes) if at not in inner)
            found.append(Reading(layer, t.shaped(both, [-1]), size, 0, 1))
        return found

    def _of_rounding(self, t: Tape, probe: ir.Node, g: ir.Value) -> Reading:
        value = probe.outputs[0]
        layer, sizes = next(iter(value.consumers()), None), sizes_of(value)
        rank = len(sizes)
        convolved = layer is not None and layer.op_type.startswith("Conv")
        along = range(2, rank) if convolved else range(max(rank - 2, 0), rank - 1)
        # readers of one tensor share its error
        step, zero = self.grids[value]
        key = (given(probe.inputs[0]), step, zero)
        if key not in self.errors:
            late = t.late(np.array(step), g, math.prod(sizes))
            self.errors[key] = _rounding(t, probe, late, zero)
        effect = t.times(g, self.errors[key])
        return _reading(t, self.probes[value], effect, sizes, along)

    def _of_weight(
        self, t: Tape, node: ir.Node, g: ir.Value, share: int = 1
    ) -> Reading:
        """Write what the rounding of a weight does: a product as the layer's own."""
        name, sizes = self.layers[node.outputs[0]], [*sizes_of(node.outputs[0])]
        channel, size = _channel(node), math.prod(sizes)
        at, near = self.decisions[name].weight or 0, _stored(self.weights[name])
        exact, inputs = array_of(node.inputs[at]), [*node.inputs[:2]]
        if exact is None:
            flat = t.op("Reshape", [node.inputs[at], t.ints(near.shape)])
            inputs[at] = t.op("Sub", [t.late(near, g, size), flat])
        else:
            error = near - exact.reshape(near.shape).astype(np.float32)
            if share > 1:  # one channel in so many
                error = error.take(range(0, sizes[channel], share), _axis(node))
                lists = [0], [sizes[channel]], [channel], [share]
                g = t.op("Slice", [g, *map(t.ints, lists)])
                sizes[channel] = error.shape[_axis(node)]
            rows = math.prod(sizes) // sizes[channel]
            if (
                node.op_type == "MatMul"
                and at == error.ndim - 1 == 1
                and rows > len(error)
            ):
                # the weight's own gradient, which is smaller than what the layer gives
                x = t.shaped(given(node.inputs[0]), [rows, len(error)])
                turned = t.op("Transpose", [x], {"perm": [1, 0]})
                whole = t.op("MatMul", [turned, t.shaped(g, [rows, sizes[channel]])])
                effect = t.times(whole, t.constant(error))
                return _reading(t, name, effect, error.shape, [0], share)
            inputs[at] = t.late(error, g, size)
        effect = t.times(g, t.op(node.op_type, inputs, node.attributes))
        along = [axis for axis in range(len(sizes)) if axis != channel]
        return _reading(t, name, effect, sizes, along, share)

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


def _grid(value: ir.Value, grids: Grids) -> tuple[np.float32, int]:
    """Return the grid of a value; fused operators sample theirs through reshapes."""
    while str(value.name) not in grids and (node := maker(value, "Reshape")):
        assert node.inputs[0] is not None
        value = node.inputs[0]
    return grids[str(value.name)]


def _axis(node: ir.Node) -> int:
    """Return the axis of a weight along which its channels lie."""
    turned = node.op_type == "Gemm" and bool(node.attributes.get_int("transB", 0))
    return 0 if node.op_type == "Conv" or turned else 1


def _channel(node: ir.Node) -> int:
    """Return the axis of a layer's answer along which its channels lie."""
    rank = len(sizes_of(node.outputs[0]))
    return 1 if node.op_type.startswith("Conv") else rank - 1


def _inner(node: ir.Node, sizes: Sequence[int]) -> range:
    """Return the axes of a tensor beside its channels, and a convolution's batch."""
    return range(2, len(sizes)) if node.op_type == "Conv" else range(len(sizes) - 1)


def _behind_relu(value: ir.Value) -> ir.Value:
    """Return the Relu's answer if a Relu alone reads a value.

    Where they differ a gradient is zero, and onnxruntime joins the two nodes.
    """
    reader, *others = value.consumers()
    return value if others or reader.op_type != "Relu" else reader.outputs[0]


def _reading(
    t: Tape,
    layer: str,
    products: ir.Value,
    sizes: Sequence[int],
    along: Sequence[int],
    share: int = 1,
) -> Reading:
    """Sum products along axes; of one channel in ``share`` squares alone count."""
    left = [axis for axis in range(len(sizes)) if axis not in along]
    many = [axis for axis in left if sizes[axis] > 1] or left[:1]
    if len(many) == 1:  # a vector by itself
        left, along = many, [axis for axis in range(len(sizes)) if axis not in many]
    if along:
        products = t.total(products, [*along], keep=False)
    vector = products if len(left) == 1 else t.shaped(products, [-1])
    size = math.prod(sizes[axis] for axis in left)
    return Reading(layer, vector, size, share, float(share == 1))


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
