"""Attach bodies of standard operators to fused operators."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress import graph, operators
from me2e_compress.graph import rewrite
from me2e_compress.graph.nodes import Array
from me2e_compress.graph.shapes import Dims, open_shape
from me2e_compress.graph.validity import ORIGINAL_DOMAIN
from me2e_compress.operators.replace import FusedNode, write_constant_nodes
from me2e_compress.passes.base import Context, Pass, PassResult

# Largest constant operand, in elements, that a body may hold (feature-map sizes).
LARGEST_TABLE = 256

# The first IR version whose functions may have overloads (onnx/onnx.proto).
_OVERLOADS_SINCE_IR = 10


@dataclasses.dataclass(frozen=True)
class AttachBodies(Pass):
    """Give every fused operator a body of standard operators that any runtime can run.

    Given:   y = me2e.MultiScaleDeformableAttention(value, sizes, starts, at, weights)

    Result:  the same node, and a function me2e.MultiScaleDeformableAttention in the
             file: { ... GridSample ... Mul ... ReduceSum ... }

    A runtime without the operator inlines the function; one that has it (this toolkit's
    sessions, or TensorRT with its plugin) uses its own. Nodes of a name that agree in
    attributes and number of inputs share one function; where some do not, the second
    and further functions are overloads ("2", "3", ...), which files hold since IR
    version 10 (onnx 1.16). Constants that the nodes of a function agree on, above all
    the sizes of feature maps, are stored in it. Plugins without a domain (which
    functions cannot have) get no body; the notes name them.
    """

    name = "attach-bodies"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Add a function for each kind of fused node that has none."""
        fused = [call.node for call in operators.fused_nodes(model)]
        bare = [node for node in fused if node.op_identifier() not in model.functions]
        # Functions need a domain: plugins without one stay as they are
        named = [
            n for n in bare if n.domain and ORIGINAL_DOMAIN not in n.metadata_props
        ]
        notes = list(operators.raise_for_bodies(model, named, self.name))
        kinds: dict[ir.OperatorIdentifier, list[FusedNode]] = {}
        for call in operators.fused_nodes(model):
            if call.node in bare:
                kinds.setdefault(call.node.op_identifier(), []).append(call)
        # Calls of a name that agree in attributes and number of inputs share a function
        count = 0
        for calls in kinds.values():
            what = f"for {len(calls)} {calls[0].node.op_type}"
            if calls[0].node not in named:
                notes.append(f"no body {what}: it has no domain of its own")
                continue
            alike: dict[tuple[object, ...], list[FusedNode]] = {}
            for call in calls:
                options = sorted(
                    (n, str(a.value)) for n, a in call.node.attributes.items()
                )
                alike.setdefault((len(call.node.inputs), *options), []).append(call)
            for group in alike.values():
                _set_overload(group, model)
                function = self._body(group)
                model.functions[function.identifier()] = function
            count += len(alike)
            bodies = "a body" if len(alike) == 1 else f"{len(alike)} bodies"
            notes.append(f"{bodies} {what}")
        return PassResult(model, count, tuple(notes))

    def _body(self, calls: Sequence[FusedNode]) -> ir.Function:
        first = calls[0]
        inputs = [
            _parameter(index, [call.node.inputs[index] for call in calls])
            for index in range(len(first.node.inputs))
        ]
        # One call of the operator inside a function of the same signature
        result = ir.Value(name="y")
        values, identifier = [v for v, _ in inputs], first.node.op_identifier()
        options = list(first.node.attributes.values())
        node = ir.Node(*identifier[:2], values, options, outputs=[result])
        node.overload, node.name = identifier[2], first.operator.name
        opsets = {"": first.opset}
        body = ir.Graph(values, [result], nodes=[node], opset_imports=opsets)
        attributes = [ir.Attr(a.name, a.type, a.value) for a in options]
        function = ir.Function(*identifier, graph=body, attributes=attributes)
        # Store shared constants, then expand the operator
        for value, known in inputs:
            if known is not None:
                name = f"{value.name}_known"
                constant = rewrite.add_constant(function.graph, known, name)
                value.replace_all_uses_with(constant)
        operators.expand(node, opset=first.opset, by=self.name)
        write_constant_nodes(function)
        return function


def _set_overload(calls: Sequence[FusedNode], model: ir.Model) -> None:
    """Give calls an overload of their own where their name has a function already."""
    domain, op_type, overload = calls[0].node.op_identifier()
    numbers = itertools.count(2)
    while (domain, op_type, overload) in model.functions:
        overload = str(next(numbers))
    for call in calls:
        call.node.overload = overload
    if overload:
        model.ir_version = max(model.ir_version, _OVERLOADS_SINCE_IR)


def _parameter(
    index: int, inputs: Sequence[ir.Value | None]
) -> tuple[ir.Value, Array | None]:
    """Make a function input with the type, shape and constant common to all calls."""
    shapes = [open_shape(value) for value in inputs if value is not None]
    types = {value.dtype for value in inputs if value is not None}
    value = ir.Value(name=f"x{index}", shape=_agreed(shapes))
    if len(types) == 1 and (kind := next(iter(types))) is not None:
        value.type = ir.TensorType(kind)
    # Only a small constant that is equal in every call is stored
    arrays = [None if v is None else graph.array_of(v) for v in inputs]
    first = arrays[0]
    if first is None or first.size > LARGEST_TABLE:
        return value, None
    same = (a is not None and a.dtype == first.dtype for a in arrays)
    equal = all(same) and all(np.array_equal(first, a) for a in arrays if a is not None)
    return value, first if equal else None


def _agreed(shapes: Sequence[Dims | None]) -> ir.Shape | None:
    known = [shape for shape in shapes if shape is not None]
    if len(known) < len(shapes) or len(set(map(len, known))) != 1:
        return None
    sizes = [set(axis) for axis in zip(*known, strict=True)]
    return ir.Shape([size.pop() if len(size) == 1 else None for size in sizes])
