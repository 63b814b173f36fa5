"""Convert a float16 graph to float32; change the element types of nodes."""

import dataclasses
from collections.abc import Collection, Iterable, Sequence

import onnx
import onnx_ir as ir

from me2e_compress.base.display import plural
from me2e_compress.graph import has_subgraph, is_standard, opset_of, provenance, rewrite
from me2e_compress.graph.nodes import Array
from me2e_compress.passes.base import Context, Pass, PassResult

FLOAT, HALF = ir.DataType.FLOAT, ir.DataType.FLOAT16


@dataclasses.dataclass(frozen=True)
class ConvertFloat32(Pass):
    """Compute in float32 what a graph computes in float16.

    Given:   y = Conv(x, w_half, b_half)                       x, y float16

    Result:  y = Cast<float16>(Conv(Cast<float>(x), w, b))

    A CPU has almost no float16 kernels: onnxruntime casts every operand back and forth.
    Inputs and outputs keep their types. Nodes that round to float16 on purpose, plugins
    and bodies of If, Loop and Scan are left alone.
    """

    name = "convert-float32"
    exact = False

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Retype every node that can be retyped and drop the Casts that become idle."""
        types = ElementTypes(HALF, FLOAT, opset_of(model))
        nodes = [n for n in model.graph if types.inputs(n) or types.outputs(n)]
        changes = Retyping(model, types, self.name).retype(nodes)
        # Casts that cast to what they read have become idle
        changes += sum(
            rewrite.bypass(node.outputs[0], source)
            for node in list(model.graph)
            if node.op_type == "Cast"
            and (source := node.inputs[0]) is not None
            and source.dtype == node.outputs[0].dtype == FLOAT
        )
        if changes:
            rewrite.sweep(model)
        computing = sum(node.op_type != "Cast" for node in nodes)
        return PassResult(model, changes, (f"{plural(computing, 'node')} in float32",))


# Change the element type of nodes with as few Casts as possible.


_ONNX = {FLOAT: "tensor(float)", HALF: "tensor(float16)"}
# How many inputs hold data, where later ones are scales and regions.
_FIRST_ONLY = {"Resize": 1}
# Operators whose meaning depends on the type, or whose schema omits one: a random
# tensor has the type of its input where no attribute names another.
_BY_TYPE = frozenset(
    {
        "Bernoulli", "BitCast", "Cast", "CastLike", "EyeLike", "Optional",
        "OptionalGetElement", "RandomNormalLike", "RandomUniformLike",
    }
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class ElementTypes:
    """Which inputs and outputs of a node can change from one element type to another.

    ``opset`` is the graph's: operators allow float16 from different opsets on.
    """

    source: ir.DataType
    wanted: ir.DataType
    opset: int

    def inputs(self, node: ir.Node) -> tuple[int, ...]:
        """Return the inputs to change.

        That of a Cast changes only to a wider type: else it would round before it
        casts.
        """
        if node.op_type == "Cast":
            read = None if node.inputs[0] is None else node.inputs[0].dtype
            return (0,) if self.wanted == FLOAT and read == self.source else ()
        return tuple(
            index
            for index, value in enumerate(node.inputs)
            if value is not None
            and value.dtype == self.source
            and self._variable(node, index) is not None
        )

    def outputs(self, node: ir.Node) -> tuple[int, ...]:
        """Return the outputs that change type when those inputs do."""
        if node.op_type == "Cast" and node.outputs[0].dtype == self.source:
            return (0,)
        # Outputs share the type variables of the inputs that change
        schema = self._schema(node)
        bound = {self._variable(node, index) for index in self.inputs(node)}
        if schema is None or not bound:
            return ()
        if node.op_type == "DequantizeLinear":  # its output is of its scale's type
            return (0,)
        return tuple(
            index
            for index, value in enumerate(node.outputs)
            if value.dtype == self.source
            and _type_variable(schema.outputs, index) in bound
        )

    def _variable(self, node: ir.Node, index: int) -> str | None:
        """Return the type variable of an input that may have the wanted type."""
        schema = self._schema(node)
        if schema is None or index >= _FIRST_ONLY.get(node.op_type, index + 1):
            return None
        name, wanted = _type_variable(schema.inputs, index), _ONNX[self.wanted]
        allowed = any(
            constraint.type_param_str == name and wanted in constraint.allowed_type_strs
            for constraint in schema.type_constraints
        )
        return name if allowed else None

    def _schema(self, node: ir.Node) -> onnx.defs.OpSchema | None:
        if not is_standard(node) or node.op_type in _BY_TYPE or has_subgraph(node):
            return None
        if node.op_type == "DequantizeLinear" and "output_dtype" in node.attributes:
            return None  # of that type, whatever its scale is of
        values = [value for value in (*node.inputs, *node.outputs) if value is not None]
        if not all(isinstance(v.type, ir.TensorType | None) for v in values):
            return None  # sequences and optionals
        if not onnx.defs.has(node.op_type, self.opset, ""):
            return None
        return onnx.defs.get_schema(node.op_type, self.opset, "")


def _type_variable(
    parameters: Sequence[onnx.defs.OpSchema.FormalParameter], index: int
) -> str:
    # The last parameter may be variadic
    return str(parameters[min(index, len(parameters) - 1)].type_str)


class Retyping:
    """Changes the element type of nodes in place, with Casts at the borders."""

    def __init__(self, model: ir.Model, types: ElementTypes, by: str) -> None:
        self._graph, self._types, self._by = model.graph, types, by
        # onnxruntime refuses two nodes of one name
        node_names = {node.name or "" for node in model.graph}
        self._names = rewrite.value_names(model.graph) | node_names
        self._casts: dict[tuple[ir.Value, ir.DataType], ir.Value] = {}
        self._changes = 0

    def retype(self, nodes: Collection[ir.Node]) -> int:
        """Retype nodes of the main graph and the constants that only they read.

        Returns the number of retyped nodes and constants, and of new Casts.
        """
        # Choose the inputs and results that change type
        types = self._types
        wanted = {(node, index) for node in nodes for index in types.inputs(node)}
        results = {
            node.outputs[index] for node in nodes for index in types.outputs(node)
        }
        self._leave_casts(nodes, results, wanted)
        # Record the readers before types and inputs change
        made = (value for node in self._graph for value in node.outputs)
        every = (*self._graph.inputs, *self._graph.initializers.values(), *made)
        uses = {
            value: [(node, index) for node, index in value.uses()]
            for value in dict.fromkeys(every)
            if value.dtype == types.source
        }
        for value in results:
            value.type = ir.TensorType(types.wanted)  # clones share the old one
        # Update Casts and provenance of the retyped nodes
        readers = {node for node, _ in wanted}
        for node in nodes:
            if node.op_type == "Cast" and node.outputs[0] in results:
                node.attributes["to"] = ir.AttrInt64("to", types.wanted.value)
            if node in readers or not results.isdisjoint(node.outputs):
                provenance.inherit(node, [node], by=self._by)
                self._changes += 1
        # Insert Casts for the readers, then for the graph outputs
        for value, users in uses.items():
            self._cast_for_readers(value, users, wanted)
        self._restore_outputs(results)
        return self._changes

    def _leave_casts(
        self,
        nodes: Iterable[ir.Node],
        results: set[ir.Value],
        wanted: set[tuple[ir.Node, int]],
    ) -> None:
        """Skip Casts whose retyping would only require another Cast next to them."""
        casts = [node for node in nodes if node.op_type == "Cast"]
        for node in casts:
            uses = ((use.node, use.idx) for use in node.outputs[0].uses())
            if wanted.isdisjoint(uses):
                results.discard(node.outputs[0])
        for node in casts:
            value = node.inputs[0]
            if value is None or not (value in results or _is_constant(value)):
                wanted.discard((node, 0))

    def _cast_for_readers(
        self,
        value: ir.Value,
        users: list[tuple[ir.Node, int]],
        wanted: set[tuple[ir.Node, int]],
    ) -> None:
        """Give the readers of a value their type; a constant of these alone changes."""
        types, alone = self._types, bool(users) and wanted.issuperset(users)
        if _is_constant(value) and alone and not value.is_graph_output():
            array = _converted(value, types.wanted)
            value.const_value = ir.tensor(array, name=value.name)
            value.type = ir.TensorType(types.wanted)
            self._changes += 1
            return
        for node, index in users:
            kind = types.wanted if (node, index) in wanted else types.source
            if kind != value.dtype:
                node.replace_input_with(index, self._as(value, kind, node))

    def _as(self, value: ir.Value, kind: ir.DataType, reader: ir.Node) -> ir.Value:
        """Return a value in a type: a constant, or a Cast that its readers share."""
        if (value, kind) in self._casts:
            return self._casts[value, kind]
        # A constant is stored once more in the other type
        name, names = f"{value.name}_{kind.name.lower()}", self._names
        if _is_constant(value):
            array = _converted(value, kind)
            result = rewrite.add_constant(self._graph, array, name, names)
            self._casts[value, kind] = result
            return result
        # Write the Cast right behind its producer, or in front of everything
        name = rewrite.fresh_name(name, names)
        cast = ir.node("Cast", [value], {"to": kind.value}, name=name)
        result, producer = cast.outputs[0], value.producer()
        result.name, result.shape, result.type = name, value.shape, ir.TensorType(kind)
        provenance.inherit(cast, [producer or reader], by=self._by)
        if producer is None:
            self._graph.insert_before(self._graph[0], cast)
        else:
            self._graph.insert_after(producer, cast)
        self._changes += 1
        self._casts[value, kind] = result
        return result

    def _restore_outputs(self, results: Collection[ir.Value]) -> None:
        """Cast retyped graph outputs back to their old type, under their old names."""
        for index, value in enumerate(self._graph.outputs):
            producer = value.producer()
            if value not in results or producer is None:
                continue
            result = self._as(value, self._types.source, producer)
            name, shape = value.name, value.shape
            value.name = rewrite.fresh_name(f"{name}_inside", self._names)
            result.name, result.shape = name, shape
            self._graph.outputs[index] = result


def _is_constant(value: ir.Value) -> bool:
    return value.is_initializer() and not value.is_graph_input()


def _converted(value: ir.Value, kind: ir.DataType) -> Array:
    """Return the array of an initializer in another element type."""
    assert value.const_value is not None
    return value.const_value.numpy().astype(kind.numpy(), order="C")
