"""Find the values of a graph that are known before it runs, and compute them.

A forward sweep collects the constant expressions; onnxruntime evaluates those that are
chosen, all at once, or one by one.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
import onnxruntime

from me2e_compress.graph import array_of, shapes, static_shape
from me2e_compress.graph.nodes import (
    NATIVE,
    Array,
    attribute_values,
    draws,
    has_subgraph,
    is_standard,
    unrenamed,
)
from me2e_compress.graph.shapes import refined
from me2e_compress.graph.summary import value_bytes
from me2e_compress.runtime.session import REFUSALS

# onnxruntime's log level "fatal": the notes report what cannot be evaluated.
SILENT = 4


@dataclasses.dataclass(eq=False)
class Expression:
    """Equal nodes of constants; each input is replaced by its first equal."""

    nodes: list[ir.Node]
    inputs: tuple[ir.Value | None, ...]


@dataclasses.dataclass
class Knowledge:
    """What is known about the values of one graph.

    ``first`` maps a value that is computed twice to the first value that equals it.
    """

    arrays: dict[ir.Value, Array] = dataclasses.field(default_factory=dict)
    expressions: list[Expression] = dataclasses.field(default_factory=list)
    maker: dict[ir.Value, Expression] = dataclasses.field(default_factory=dict)
    first: dict[ir.Value, ir.Value] = dataclasses.field(default_factory=dict)


def evaluate(
    values: Sequence[ir.Value], known: Knowledge, opset: int
) -> tuple[dict[ir.Value, Array], list[ir.Node]]:
    """Return the computed values, and the nodes that the runtime refused.

    Nodes run in one session, or each in its own if that fails.
    """
    # The expressions that they need, in order
    wanted = {known.maker[value] for value in values}
    for one in reversed(known.expressions):
        if one in wanted:
            unknown = known.maker.keys() & {*one.inputs} - known.arrays.keys()
            wanted.update(known.maker[value] for value in unknown)
    needed = [one for one in known.expressions if one in wanted]
    if not needed:
        return {}, []
    # All of them in one session, or else each on its own
    try:
        return run(needed, list(values), known.arrays, opset), []
    except REFUSALS:
        pass
    done: dict[ir.Value, Any] = dict(known.arrays)
    refused: list[ir.Node] = []
    for one in needed:
        outputs = [value for value in one.nodes[0].outputs if value.name]
        inputs = [value for value in one.inputs if value is not None]
        # Skip nodes whose inputs could not be computed
        if any(value in known.maker and value not in done for value in inputs):
            continue
        try:
            done.update(run([one], outputs, done, opset))
        except REFUSALS:
            refused.extend(one.nodes)
    return {value: done[value] for value in values if value in done}, refused


def run(
    expressions: Sequence[Expression],
    values: Sequence[ir.Value],
    arrays: Mapping[ir.Value, Any],
    opset: int,
) -> dict[ir.Value, Any]:
    """Compute values of expressions, as written, in one session of onnxruntime."""
    # Copy the nodes under short names: v0, v1, ...
    names: dict[ir.Value, str] = {}
    feeds: dict[str, Any] = {}
    nodes: list[onnx.NodeProto] = []
    for one in expressions:
        proto = ir.serde.serialize_node(one.nodes[0])
        del proto.input[:], proto.output[:], proto.metadata_props[:]
        for value in one.inputs:
            if value is not None and value not in names:
                names[value] = f"v{len(names)}"
                array = arrays.get(value)
                feeds[names[value]] = array_of(value) if array is None else array
            proto.input.append("" if value is None else names[value])
        for value in one.nodes[0].outputs:
            if value.name:
                names[value] = f"v{len(names)}"
            proto.output.append(names[value] if value.name else "")
        nodes.append(proto)
    # Write them as a model of their own
    kind_of = onnx.helper.np_dtype_to_tensor_dtype
    port = onnx.helper.make_tensor_value_info
    ports = [port(n, kind_of(np.dtype(a.dtype)), a.shape) for n, a in feeds.items()]
    made = [onnx.ValueInfoProto(name=names[value]) for value in values]
    model = onnx.helper.make_model(
        onnx.helper.make_graph(nodes, "constants", ports, made),
        opset_imports=[onnx.helper.make_opsetid("", opset)],
        ir_version=8,
    )
    # No optimization: run exactly the nodes as written
    options = onnxruntime.SessionOptions()
    disabled = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.graph_optimization_level = disabled
    options.intra_op_num_threads = 1
    options.enable_cpu_mem_arena = False  # it would live as long as a constant does
    options.log_severity_level = SILENT
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    run = onnxruntime.RunOptions()
    run.log_severity_level = SILENT
    outputs = session.run([names[value] for value in values], feeds, run)
    return dict(zip(values, outputs, strict=True))


def branch_fits(node: ir.Node, branch: ir.Graph, opset: int) -> bool:
    """Return whether an If's readers would be valid if they read a branch directly.

    An If hides the shapes of its branches: a reader may work only because of that (a
    Range up to a vector of one element).
    """
    instead = dict(zip(node.outputs, branch.outputs, strict=True))
    readers = dict.fromkeys(use.node for value in instead for use in value.uses())

    def known(value: ir.Value) -> Array | None:
        return array_of(unrenamed(instead.get(value, value)))

    for reader in readers:
        try:
            shapes.infer_node(reader, opset, known=known, instead=instead)
        except shapes.REFUSALS:
            return False
    return True


# Arrays of up to this many elements (shapes, indices) are computed immediately.
SMALL = 1024

# Limit in bytes of a computed value: a chain of Concats may claim any size.
LARGEST = 1 << 30

# Operators without an input, and those that tell the runtime to compute in int8.
NEVER = ("Constant", "DequantizeLinear", "DynamicQuantizeLinear")

# Operators through which folding turns a computation into a weight.
COMPUTE = frozenset(
    {"Conv", "ConvTranspose", "Einsum", "Gemm", "GridSample", "MatMul", "Softmax"}
)


@dataclasses.dataclass
class Sweep:
    """Walks one graph in order and collects its constant expressions."""

    opset: int
    refused: set[ir.Node]  # failed in onnxruntime
    learnt: set[ir.Value]  # ONNX's shape inference did not know their shape or data
    _: dataclasses.KW_ONLY
    through_compute: bool  # whether products and convolutions are constant expressions
    trust_shapes: bool  # False inside loops, where shapes may change
    known: Knowledge = dataclasses.field(default_factory=Knowledge)
    # Expressions by operator, inputs and attributes
    keys: dict[object, Expression] = dataclasses.field(default_factory=dict)

    def visit_nodes(self, graph: ir.Graph) -> Knowledge:
        """Visit every node once, producers before readers."""
        for node in graph:
            if self._is_constant(node):
                self._infer(node)
                self._add(node)
            # What it reads has become known only now
            elif any(v in self.learnt or v in self.known.maker for v in node.inputs):
                self._infer(node)
        return self.known

    def _is_constant(self, node: ir.Node) -> bool:
        never = node in self.refused or node.op_type in NEVER
        if never or not is_standard(node) or draws(node):
            return False
        shown = self.trust_shapes and node.op_type in ("Shape", "Size")
        if shown and static_shape(node.inputs[0]) is not None:
            return True
        if node.op_type in COMPUTE and not self.through_compute:
            return False
        # Bodies may read outer values; a weight that is an output needs its Identity
        if has_subgraph(node) or not node.inputs:
            return False
        if len(node.outputs) > 1 and any(v.is_graph_output() for v in node.outputs):
            return False
        passes_on = node.op_type == "Identity" and node.outputs[0].is_graph_output()
        source = node.inputs[0]
        if passes_on and source is not None and source.is_initializer():
            return False
        return all(value is None or self._known(value) for value in node.inputs)

    def _known(self, value: ir.Value) -> bool:
        """Return whether a value is constant, and keep the array of a small one."""
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

    def _infer(self, node: ir.Node) -> None:
        """Infer missing types and shapes of a node's outputs.

        Shapes of graph outputs are only refined, and not in loops, where they may
        change between rounds.
        """
        if all(
            static_shape(v) is not None and v.type is not None for v in node.outputs
        ):
            return
        for value in filter(None, node.inputs):
            self._known(value)
        arrays = self.known.arrays
        try:
            inferred = shapes.infer_node(node, self.opset, known=arrays.get)
        except shapes.REFUSALS:
            return
        # Write what is new; a static shape is known already
        learnt = False
        for value, (kind, shape) in inferred.items():
            if value.is_graph_output():
                more = refined(value.shape, shape) if self.trust_shapes else value.shape
                if more is not value.shape:
                    value.shape, learnt = more, True
                continue
            if value.type is None:
                value.type = kind
            if shape is None or (value.shape is not None and value.shape.is_static()):
                continue
            if value.shape is None or shape.is_static():
                value.shape, learnt = shape, True
        if learnt:
            self.learnt.update(node.outputs)

    def _add(self, node: ir.Node) -> None:
        """Enter a constant node, unless its values are too large or of odd types."""
        named = [value for value in node.outputs if value.name]
        if any(not _is_native(v) or (value_bytes(v) or 0) > LARGEST for v in named):
            return
        # Group nodes of equal operator, inputs and attributes
        first = self.known.first
        inputs = tuple(value and first.get(value, value) for value in node.inputs)
        key = (node.op_type, inputs, len(node.outputs), attribute_values(node))
        if key not in self.keys:
            self.keys[key] = Expression([], inputs)
            self.known.expressions.append(self.keys[key])
        equal = self.keys[key]
        equal.nodes.append(node)
        # Enter its outputs, with their arrays if they are small
        small = self._evaluate(equal)
        for earliest, value in zip(equal.nodes[0].outputs, node.outputs, strict=True):
            self.known.maker[value] = equal
            if value is not earliest:
                first[value] = earliest
            if small is not None:
                self.known.arrays[value] = small
                if value.shape is None and not value.is_graph_output():
                    value.shape = ir.Shape(small.shape)

    def _evaluate(self, one: Expression) -> Array | None:
        """Return the array of an expression's only output, if it is small."""
        node, arrays = one.nodes[0], self.known.arrays
        output = node.outputs[0]
        if len(node.outputs) != 1 or output in arrays:
            return arrays.get(output)
        # Shapes need no data
        shape = static_shape(node.inputs[0])
        if node.op_type == "Size" and shape is not None:
            return np.array(math.prod(shape), dtype=np.int64)
        if node.op_type == "Shape" and shape is not None:
            start = node.attributes.get_int("start", 0)
            end = node.attributes.get_int("end", len(shape))
            return np.array(shape[start:end], dtype=np.int64)
        # Other nodes are computed if they are small and fully known
        expected = static_shape(output)
        if expected is None or math.prod(expected) > SMALL:
            return None
        if any(value is not None and value not in arrays for value in one.inputs):
            return None
        try:
            array = run([one], [output], arrays, self.opset)[output]
        except REFUSALS:
            return None
        # It may be a sequence, or have another shape than the file claims
        is_array = isinstance(array, np.ndarray) and array.shape == expected
        return array if is_array else None


def _is_native(value: ir.Value) -> bool:
    if isinstance(value.type, ir.SequenceType | ir.OptionalType):
        return value.type.elem_type.dtype in NATIVE
    return value.dtype in NATIVE
