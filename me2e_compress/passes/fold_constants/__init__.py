"""Compute once what does not depend on the inputs.

Folding removes nodes but may add bytes: a table repeated for every token is one node
and megabytes. A group of connected expressions is folded if it adds at most so many
bytes for each of its nodes:

    bytes stored - bytes of weights that nothing reads any more  <=  limit * nodes

If it adds more, its largest value stays computed in every frame, and the rest is
grouped and tested again. A group that shrinks the weights is always folded.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Container, Iterable

import onnx_ir as ir

from me2e_compress import graph as graphs
from me2e_compress.base.display import plural
from me2e_compress.graph import provenance
from me2e_compress.graph.digest import digest_of_tensor
from me2e_compress.graph.nodes import Array, graphs_of
from me2e_compress.graph.rewrite import (
    add_constant,
    can_replace,
    fresh_name,
    lift_constants,
    put,
    remove_dead,
    remove_node,
    replace_value,
    value_names,
)
from me2e_compress.graph.summary import value_bytes
from me2e_compress.operators import FusedCall
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.fold_constants import knowledge
from me2e_compress.passes.fold_constants.knowledge import (
    Expression,
    Knowledge,
    Sweep,
    branch_fits,
)

__all__ = ["ENTRY_BYTES", "FoldConstants"]

# Bytes of an initializer in the file besides its data: name, shape, type.
ENTRY_BYTES = 64


def choose(known: Knowledge, sizes: "_Sizes", bytes_per_node: int) -> list[Expression]:
    """Return the constant expressions to fold, in the order of the graph."""
    gone: set[Expression] = set()
    waiting = sizes.groups(known.expressions)
    while waiting:
        group = waiting.pop()
        nodes = sum(len(one.nodes) for one in group)
        if sizes.growth(group) <= bytes_per_node * nodes:
            gone.update(group)
        else:
            waiting.extend(sizes.groups(sizes.without_largest(group)))
    return [one for one in known.expressions if one in gone]


class _Sizes:
    """Sizes of the values of one graph, and who reads them."""

    def __init__(self, known: Knowledge) -> None:
        self.known = known
        self.readers: dict[ir.Value, dict[Expression, None]] = {}
        for one in known.expressions:
            for value in one.inputs:
                if value is not None:
                    self.readers.setdefault(value, {})[one] = None
        # Values that nodes outside of constant expressions read
        self.outside = {
            value
            for one in known.expressions
            for place, value in enumerate(one.nodes[0].outputs)
            if any(self._is_read_outside(node.outputs[place]) for node in one.nodes)
        }
        # Weights that only constant expressions read
        self.weights = {
            value: value.const_value.nbytes + ENTRY_BYTES
            for value in self.readers
            if value.const_value is not None
            and value.is_initializer()
            and value not in known.maker
            and not self._is_read_outside(value)
        }

    def growth(self, group: Iterable[Expression]) -> float:
        """Return by how many bytes the weights grow if a group is folded."""
        gone = dict.fromkeys(group)
        stored = sum(map(self.bytes_of, self.stored(gone, gone.keys())))
        read = dict.fromkeys(value for one in gone for value in one.inputs if value)
        return stored - sum(
            self.weights[value]
            for value in read
            if value in self.weights and self.readers[value].keys() <= gone.keys()
        )

    def stored(
        self, group: Iterable[Expression], gone: Container[Expression]
    ) -> list[ir.Value]:
        """List the values of a group that something reads which is not gone."""
        return [
            value
            for one in group
            for value in one.nodes[0].outputs
            if value in self.outside
            or any(reader not in gone for reader in self.readers.get(value, ()))
        ]

    def bytes_of(self, value: ir.Value) -> float:
        """Return what a value takes in the file."""
        if isinstance(value.type, ir.SequenceType | ir.OptionalType):
            return math.inf
        array = self.known.arrays.get(value)
        size = value_bytes(value) if array is None else array.nbytes
        return 0 if size is None else size + ENTRY_BYTES

    def without_largest(self, group: list[Expression]) -> list[Expression]:
        """Return a group without the makers of its largest stored values."""
        gone = set(group)
        stored = {
            one: max(map(self.bytes_of, self.stored([one], gone)), default=-1.0)
            for one in group
        }
        largest = max(stored.values())
        return [one for one in group if stored[one] < largest]

    def groups(self, expressions: Iterable[Expression]) -> list[list[Expression]]:
        """Group expressions that read each other, or a weight that only they read."""
        group_of = {one: [one] for one in expressions}
        # Join the readers of a value, and its maker
        for value in dict.fromkeys(v for one in group_of for v in one.inputs if v):
            linked = [one for one in self.readers[value] if one in group_of]
            maker = self.known.maker.get(value)
            if maker in group_of:
                linked.append(maker)
            elif value not in self.weights or len(linked) < len(self.readers[value]):
                continue
            for other in linked[1:]:
                small, large = sorted((group_of[linked[0]], group_of[other]), key=len)
                if small is not large:
                    large.extend(small)
                    group_of.update(dict.fromkeys(small, large))
        return list({id(group): group for group in group_of.values()}.values())

    def _is_read_outside(self, value: ir.Value) -> bool:
        """Return whether a graph output, or a node of no expression, is or reads it."""
        readers = [use.node.outputs for use in value.uses()]
        return value.is_graph_output() or not all(
            outputs and outputs[0] in self.known.maker for outputs in readers
        )


# Bytes that a removed node may cost: at 2 us a node, 2 MB for 1 ms.
LIMIT_BYTES = 4096


@dataclasses.dataclass(frozen=True)
class FoldConstants(Pass):
    """Replace values that depend only on weights and static shapes by constants.

    Given:   Shape(x) -> Gather(1) -> Concat -> Reshape;  Transpose(weight) -> MatMul

    Result:  Reshape and MatMul read initializers

    Attributes:
        bytes_per_node: how many bytes the removal of a node may add to the weights. A
            fold that shrinks them is always done, so that a position table repeated
            for every token stays computed and a transposed weight does not.
        through_compute: fold through products, convolutions and softmax too; False
            keeps every named layer, e.g. to ablate it later.
    """

    name = "fold-constants"
    exact = True
    bytes_per_node: int = LIMIT_BYTES
    through_compute: bool = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Infer shapes, then fold every graph of the model, outermost first."""
        # Normalize first: Constant nodes, CastLike, and bounds of Range
        tally, refusals = Counter(changes=lift_constants(model)), Counter[str]()
        declared = [value.shape for value in model.graph.outputs]
        opset = graphs.opset_of(model)
        for body in graphs_of(model.graph):
            tally["changes"] += _write_casts(body, self.name)
            tally["changes"] += _reshape_bounds(body, opset, self.name)
        # Fold until nothing changes; a branch that is not taken is never looked into
        before, fresh = -1, set[ir.Value]()  # fresh: not seen by shape inference
        while tally["changes"] > before:
            before = tally["changes"]
            if model.functions:  # through which a sweep learns no shapes
                graphs.infer_shapes(model)
            tally["changes"] += remove_dead(model.graph)
            tally["kept"] = 0  # the last round's counts
            self._fold(model.graph, opset, tally, refusals, fresh, trust=True)
            # Every If of known condition, in bodies too, is its branch from now on
            taken = [
                branch
                for body in list(graphs_of(model.graph))
                for node in list(body)
                if node.op_type == "If" and node.graph is body
                if (branch := _inline_branch(node, opset, self.name)) is not None
            ]
            # The Ifs had hidden the shapes of what their branches read
            moved = (node for nodes in taken for node in nodes)
            fresh = {value for node in moved for value in node.inputs if value}
            if taken:
                tally.update(changes=1, inlined=1)
                continue
            for body in list(graphs_of(model.graph))[1:]:
                self._fold(body, opset, tally, refusals, set(), trust=False)
        # Shapes of graph outputs may have become known
        shapes = [value.shape for value in model.graph.outputs]
        refined = sum(a is not b for a, b in zip(declared, shapes, strict=True))
        return PassResult(model, tally["changes"] + refined, _notes(tally, refusals))

    def _fold(
        self,
        body: ir.Graph,
        opset: int,
        tally: Counter[str],
        refusals: Counter[str],
        fresh: set[ir.Value],
        *,
        trust: bool,
    ) -> None:
        """Fold one graph; ``fresh`` are values that shape inference has not seen."""
        refused: set[ir.Node] = set()
        while True:
            # Collect constant expressions and choose what to store
            through, learnt = self.through_compute, set(fresh)
            sweep = Sweep(
                opset, refused, learnt, through_compute=through, trust_shapes=trust
            )
            known = sweep.visit_nodes(body)
            sizes = _Sizes(known)
            gone = choose(known, sizes, self.bytes_per_node)
            values = sizes.stored(gone, set(gone))
            # Evaluate the choice; start over if it taught new shapes or failed
            asked = [value for value in values if value not in known.arrays]
            arrays, failed = knowledge.evaluate(asked, known, opset)
            refusals.update(node.op_type for node in failed)
            refused.update(failed)
            unshaped = [
                value
                for value in arrays
                if graphs.static_shape(value) is None and not value.is_graph_output()
            ]
            if failed or unshaped:
                for value in () if failed else unshaped:
                    value.shape = ir.Shape(arrays[value].shape)
                continue
            # Write the chosen values into the graph
            growth = int(sizes.growth(gone))
            if not gone:
                tally["kept"] += sum(len(one.nodes) for one in known.expressions)
                return
            arrays = {**known.arrays, **arrays}
            fresh.update(_commit(body, gone, values, arrays, self.name))
            folded = sum(len(one.nodes) for one in gone)
            tally.update(changes=folded, folded=folded, stored=len(values))
            tally["growth_bytes"] += growth


def _notes(tally: Counter[str], refused: Counter[str]) -> tuple[str, ...]:
    inlined, growth = tally["inlined"], tally["growth_bytes"]
    folded, kept = plural(tally["folded"], "node"), plural(tally["kept"], "node")
    stored = plural(tally["stored"], "initializer")
    listed = ", ".join(f"{count} {op}" for op, count in sorted(refused.items()))
    left = f"{kept} left to compute constants: smaller than their values"
    notes = (
        (tally["folded"], f"{folded} became {stored} ({growth:+,} bytes)"),
        (inlined, "branches took the places of Ifs whose conditions are known"),
        (tally["kept"], left),
        (listed, f"onnxruntime cannot evaluate {listed}: left as they are"),
    )
    return tuple(note for condition, note in notes if condition)


def _commit(
    graph: ir.Graph,
    gone: list[Expression],
    values: list[ir.Value],
    arrays: dict[ir.Value, Array],
    name: str,
) -> list[ir.Value]:
    """Replace the chosen values by initializers of the same names, and return these.

    Not every runtime allows an initializer as a graph output: an Identity passes it on.
    """
    # Names of the removed nodes are free again
    names = value_names(graph)
    names -= {str(v.name) for one in gone for node in one.nodes for v in node.outputs}
    stored: dict[bytes, ir.Value] = {}
    equals = {
        outputs[0]: outputs
        for one in gone
        for outputs in zip(*(node.outputs for node in one.nodes), strict=True)
    }
    # Store equal values once, for all nodes that compute them
    for value in values:
        is_output = any(equal.is_graph_output() for equal in equals[value])
        label = f"{value.name}_value" if is_output else value.name or ""
        key = digest_of_tensor(ir.tensor(arrays[value]))
        if key not in stored:
            stored[key] = add_constant(graph, arrays[value], label, names)
        for equal in equals[value]:
            maker, weight = equal.producer(), stored[key]
            if maker is None or not equal.is_graph_output():
                equal.replace_all_uses_with(weight)
                continue
            # A branch may declare another shape than its result has
            if graphs.static_shape(equal) is not None:
                equal.shape = weight.shape
            put(maker, "Identity", [weight], by=name)
    # Remove the nodes, readers first
    for one in reversed(gone):
        graph.remove([node for node in one.nodes if node.graph is graph], safe=True)
    return list(stored.values())


def _write_casts(graph: ir.Graph, by: str) -> int:
    """Write CastLike as the Cast that it is, where the type is known, and count them.

    Its second input is a value of the frame, so that nothing could be folded.
    """
    count = 0
    for node in list(graph):
        like = node.inputs[1] if node.op_type == "CastLike" else None
        if like is None or like.dtype is None or node.domain != "":
            continue
        attributes = {key: option.value for key, option in node.attributes.items()}
        attributes["to"] = int(like.dtype)
        put(node, "Cast", node.inputs[:1], by=by, attributes=attributes)
        count += 1
    return count


def _reshape_bounds(graph: ir.Graph, opset: int, by: str) -> int:
    """Reshape vectors that an If passes to a Range to scalars, and count them.

    ONNX's own function bodies pass a vector of one element through an If to a Range,
    which takes scalars. Runtimes accept it while the If hides the shape; folding
    would reveal it.

    Given:   If -> n of shape [1] -> Range(0, n, 1)

    Result:  If -> n -> Reshape to a scalar -> Range(0, n, 1)
    """
    count = 0
    for choice in [node for node in graph if node.op_type == "If"]:
        branches = [attribute.as_graph() for attribute in choice.attributes.values()]
        if all(branch_fits(choice, branch, opset) for branch in branches):
            continue
        # A branch of shape [1] in front of a Range: reshape what reads the If
        bounds = [
            (use.node, use.idx, value)
            for value in choice.outputs
            for use in value.uses()
            if use.node.op_type == "Range" and use.node.graph is graph
        ]
        for node, index, value in bounds:
            scalar = FusedCall(node, opset=opset, by=by).reshape(value, ())
            scalar.type = value.type
            node.replace_input_with(index, scalar)
            provenance.inherit(node, [node], by=by)
        count += len(bounds)
    return count


# Replace an If whose condition is known by the branch that it takes.


def _inline_branch(node: ir.Node, opset: int, by: str) -> list[ir.Node] | None:
    """Replace an If whose condition is known by the nodes of its branch.

    It stays (None) where its branch passes an outer value on as a graph output, or
    where a reader would refuse the branch's shape, which the If had hidden from it.
    """
    graph = node.graph
    chosen = graphs.array_of(node.inputs[0]) if node.inputs else None
    if node.op_type != "If" or chosen is None or not isinstance(graph, ir.Graph):
        return None
    # Choose the branch and check that it can take the place
    branch = node.attributes[
        "then_branch" if chosen.reshape(-1)[0] else "else_branch"
    ].as_graph()
    results = list(branch.outputs)
    if len(set(results)) < len(results):
        return None
    for old, new in zip(node.outputs, results, strict=True):
        if old.is_graph_output() and new.producer() is None:
            return None
        outside = new.producer() is not None and new.graph is not branch
        if outside and not can_replace(old, new):
            return None
    if not branch_fits(node, branch, opset):
        return None
    # Move the nodes out and rewire their readers
    nodes = list(branch)
    _move_nodes(branch, node, graph, by)
    for old, new in zip(node.outputs, results, strict=True):
        replace_value(old, new)
    remove_node(node)
    return nodes


def _move_nodes(branch: ir.Graph, node: ir.Node, graph: ir.Graph, by: str) -> None:
    names = value_names(graph)
    weights = list(branch.initializers.values())
    nodes = list(branch)
    # Detach everything before it enters the outer graph
    branch.outputs.clear()
    branch.initializers.clear()
    branch.remove(nodes)
    # Names must be unique in the whole model
    for value in weights:
        value.name = fresh_name(value.name or "weight", names)
        if value.const_value is not None:
            value.const_value.name = value.name
        graph.register_initializer(value)
    for inner in nodes:
        for value in inner.outputs:
            if value.name:
                value.name = fresh_name(value.name, names)
        provenance.inherit(inner, (inner, node), by=by)
    graph.insert_before(node, nodes)
