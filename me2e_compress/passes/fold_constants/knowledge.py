"""A forward sweep that finds the values of a graph that are known before it runs."""

import math
from collections.abc import Mapping

import numpy as np
import onnx
import onnx_ir as ir

from me2e_compress.graph import array_of, shapes, static_shape
from me2e_compress.graph.nodes import DRAWS, NATIVE, attribute_values, unrenamed
from me2e_compress.graph.rewrite import Array, has_subgraph, is_standard
from me2e_compress.graph.shapes import refined
from me2e_compress.graph.summary import value_bytes
from me2e_compress.passes.fold_constants import evaluation
from me2e_compress.passes.fold_constants.evaluation import Expression, Knowledge
from me2e_compress.runtime.opening import REFUSALS

# Shape inference of single nodes, given the data that folding has found.


def learn_shapes(
    node: ir.Node,
    known: Mapping[ir.Value, Array],
    opset: int,
    *,
    trust_shapes: bool = True,
) -> bool:
    """Infer missing shapes of a node's outputs; return whether any is new.

    Use ``trust_shapes=False`` in loops, whose outputs may change shape between rounds.
    """
    try:
        found = shapes.infer_node(node, opset, known=known.get)
    except shapes.REFUSALS:
        return False
    return _record(node, found, answers=trust_shapes)


def branch_fits(node: ir.Node, branch: ir.Graph, opset: int) -> bool:
    """Return whether an If's readers would be valid if they read a branch directly.

    An If hides the shapes of its branches: a reader may work only because of that (a
    Range up to a vector of one element).
    """
    instead = dict(zip(node.outputs, branch.outputs, strict=True))
    readers = dict.fromkeys(use.node for value in instead for use in value.uses())
    return all(_accepts(reader, instead, opset) for reader in readers)


def _accepts(node: ir.Node, instead: Mapping[ir.Value, ir.Value], opset: int) -> bool:
    arrays = {
        value: array
        for value in node.inputs
        if value is not None
        and (array := array_of(unrenamed(instead.get(value, value)))) is not None
    }
    try:
        shapes.infer_node(node, opset, known=arrays.get, instead=instead)
    except shapes.REFUSALS:
        return False
    return True


def _record(
    node: ir.Node, found: Mapping[str, onnx.TypeProto], *, answers: bool
) -> bool:
    learnt = False
    for value in node.outputs:
        proto = found.get(value.name or "")
        if proto is None:
            continue
        # Shapes of graph outputs are only refined
        if value.is_graph_output():
            shape = ir.serde.deserialize_type_proto_for_shape(proto)
            if answers and (more := refined(value.shape, shape)) is not value.shape:
                value.shape, learnt = more, True
            continue
        if value.type is None:
            value.type = ir.serde.deserialize_type_proto_for_type(proto)
        shape = ir.serde.deserialize_type_proto_for_shape(proto)
        if shape is None or (value.shape is not None and value.shape.is_static()):
            continue
        if value.shape is None or shape.is_static():
            value.shape = shape
            learnt = True
    return learnt


SMALL = 1024
"""Arrays of up to this many elements (shapes, indices) are computed immediately."""

LARGEST = 1 << 30
"""Limit in bytes of a computed value: a chain of Concats may claim any size."""

NEVER = DRAWS | {
    "Constant",
    "DequantizeLinear",
    "DynamicQuantizeLinear",
    "QuantizeLinear",
}
"""Random operators, and quantization, which is an instruction to the runtime."""

COMPUTE = frozenset(
    {"Conv", "ConvTranspose", "Einsum", "Gemm", "GridSample", "MatMul", "Softmax"}
)
"""Operators through which folding turns a computation into a weight."""


class Sweep:
    """Walks one graph in order and collects its constant expressions.

    ``refused`` nodes failed in onnxruntime; ``fresh`` initializers are new to ONNX's
    shape inference; ``trust_shapes`` is False inside loops, where shapes may change.
    """

    def __init__(
        self,
        opset: int,
        refused: set[ir.Node],
        fresh: set[ir.Value],
        *,
        through_compute: bool,
        trust_shapes: bool,
    ) -> None:
        self.opset = opset
        self.refused = refused
        self.through_compute = through_compute
        self.trust_shapes = trust_shapes
        self.known = Knowledge({}, [], {}, {})
        self.learnt = set(fresh)
        self.keys: dict[object, Expression] = {}

    def run(self, graph: ir.Graph) -> Knowledge:
        """Visit every node once, producers before readers."""
        for node in graph:
            if self._is_shape(node) or self._is_constant(node):
                self._infer(node)
                self._add(node)
            elif self._touched(node):
                self._infer(node)
        return self.known

    def _is_shape(self, node: ir.Node) -> bool:
        return (
            self.trust_shapes
            and is_standard(node)
            and node.op_type in ("Shape", "Size")
            and node not in self.refused
            and static_shape(node.inputs[0]) is not None
        )

    def _is_constant(self, node: ir.Node) -> bool:
        if node in self.refused or node.op_type in NEVER or not is_standard(node):
            return False
        if node.op_type in COMPUTE and not self.through_compute:
            return False
        if node.op_type == "Dropout" and not _is_inference(node, self.opset):
            return False
        # Bodies may read outer values
        if has_subgraph(node) or not node.inputs or _is_constant_output(node):
            return False
        return all(value is None or self._known(value) for value in node.inputs)

    def _known(self, value: ir.Value) -> bool:
        if value in self.known.maker:
            return True
        if value.is_graph_input() or not value.is_initializer():
            return False
        if value.const_value is None or value.const_value.dtype not in NATIVE:
            return False
        if value not in self.known.arrays and value.const_value.size <= SMALL:
            array = array_of(value)
            if array is not None:
                self.known.arrays[value] = array
        return True

    def _touched(self, node: ir.Node) -> bool:
        if all(static_shape(value) is not None for value in node.outputs):
            return False
        return any(
            value in self.learnt or value in self.known.maker
            for value in node.inputs
            if value is not None
        )

    def _infer(self, node: ir.Node) -> None:
        outputs = node.outputs
        if all(static_shape(v) is not None and v.type is not None for v in outputs):
            return
        for value in node.inputs:
            if value is not None:
                self._known(value)
        arrays, trust = self.known.arrays, self.trust_shapes
        if learn_shapes(node, arrays, self.opset, trust_shapes=trust):
            self.learnt.update(outputs)

    def _add(self, node: ir.Node) -> None:
        named = [value for value in node.outputs if value.name]
        if not all(
            _is_native(each) and (value_bytes(each) or 0) <= LARGEST for each in named
        ):
            return
        # Group nodes of equal operator, inputs and attributes
        inputs = tuple(
            None if value is None else self.known.canonical(value)
            for value in node.inputs
        )
        key = (node.op_type, inputs, len(node.outputs), attribute_values(node))
        equal = self.keys.get(key)
        if equal is None:
            equal = Expression([], inputs)
            self.keys[key] = equal
            self.known.expressions.append(equal)
        equal.nodes.append(node)
        # Enter its outputs, with their arrays if they are small
        small = self._evaluate(equal)
        for first, value in zip(equal.nodes[0].outputs, node.outputs, strict=True):
            self.known.maker[value] = equal
            if value is not first:
                self.known.first[value] = first
            if small is not None:
                self.known.arrays[value] = small
                if value.shape is None and not value.is_graph_output():
                    value.shape = ir.Shape(small.shape)

    def _evaluate(self, one: Expression) -> Array | None:
        node, arrays = one.nodes[0], self.known.arrays
        output = node.outputs[0]
        if len(node.outputs) != 1 or output in arrays:
            return arrays.get(output)
        # Shapes need no data
        if node.op_type in ("Shape", "Size"):
            shape = static_shape(node.inputs[0])
            return None if shape is None else _shape(node, shape)
        # Other nodes are computed if they are small and fully known
        expected = static_shape(output)
        if expected is None or math.prod(expected) > SMALL:
            return None
        if any(value is not None and value not in arrays for value in one.inputs):
            return None
        try:
            found = evaluation.run([one], [output], arrays, self.opset)[output]
        except REFUSALS:
            return None
        # It may be a sequence, or have another shape than the file claims
        is_array = isinstance(found, np.ndarray) and found.shape == expected
        return found if is_array else None


def _shape(node: ir.Node, shape: tuple[int, ...]) -> Array:
    if node.op_type == "Size":
        return np.array(math.prod(shape), dtype=np.int64)
    start = node.attributes.get_int("start", 0)
    end = node.attributes.get_int("end", len(shape))
    rank = len(shape)
    start = min(max(start + rank if start < 0 else start, 0), rank)
    end = min(max(end + rank if end < 0 else end, 0), rank)
    return np.array(shape[start:end], dtype=np.int64)


def _is_constant_output(node: ir.Node) -> bool:
    if node.op_type != "Identity" or not node.outputs[0].is_graph_output():
        return False
    return node.inputs[0] is not None and node.inputs[0].is_initializer()


def _is_native(value: ir.Value) -> bool:
    if isinstance(value.type, ir.SequenceType | ir.OptionalType):
        return value.type.elem_type.dtype in NATIVE
    return value.dtype in NATIVE


def _is_inference(node: ir.Node, opset: int) -> bool:
    return opset >= 7 and (len(node.inputs) < 3 or node.inputs[2] is None)
