"""A fusion: what to look for, whether it may be done, and what takes its place."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.graph.nodes import (
    Array,
    graphs_of,
    input_at,
    is_standard,
    nodes_in,
    opset_of,
    sole_reader,
)
from me2e_compress.graph.rewrite.edits import (
    add_constant,
    fresh_name,
    put,
    remove_dead,
    remove_node,
    remove_unread,
    replace_value,
    value_names,
)
from me2e_compress.graph.rewrite.pattern import Match, Pattern, match

ROUNDS = 16
"""A fusion can complete the pattern of another: real graphs need two or three."""


@dataclasses.dataclass(frozen=True)
class Facts:
    """What may be asked for besides the match.

    Attributes:
        opset: the version of ONNX's own operators.
    """

    opset: int


@dataclasses.dataclass(frozen=True)
class Kit:
    """What a rewrite edits the graph with.

    Attributes:
        graph: where the match is: the main graph, or a body.
        match: where the expression was found.
        by: the pass's name.
        names: of all values of the model; new ones are entered.
    """

    graph: ir.Graph
    match: Match
    by: str
    names: set[str]

    def constant(self, array: Array, name: str) -> ir.Value:
        """Register an initializer beside the match, under this name if it is free."""
        return add_constant(self.graph, array, name, self.names)

    def refill(self, node: ir.Node, index: int, array: Array, name: str) -> None:
        """Write other numbers into a constant operand, or add one of this name.

        An initializer that nothing else reads keeps its name.
        """
        old = input_at(node, index)
        if old is not None and old.is_initializer() and sole_reader(old) is node:
            flat = np.ascontiguousarray(array).reshape(array.shape)
            old.const_value = ir.tensor(flat, name=old.name)
            old.shape = ir.Shape(array.shape)
            return
        node.resize_inputs(max(index + 1, len(node.inputs)))
        node.replace_input_with(index, self.constant(array, name))

    def put(
        self,
        op_type: str,
        inputs: Sequence[ir.Value | None],
        attributes: Mapping[str, int | float | str | Sequence[int]] | None = None,
        *,
        domain: str = "",
    ) -> None:
        """Replace all that matched by one operator, of any domain."""
        put(
            self.match.root,
            op_type,
            inputs,
            by=self.by,
            sources=self.match.nodes[1:],
            attributes=attributes,
            domain=domain,
        )

    def add(
        self,
        op_type: str,
        inputs: Sequence[ir.Value | None],
        attributes: Mapping[str, int | float | str | Sequence[int]] | None = None,
    ) -> ir.Value:
        """Insert one more standard operator before what takes the match's place.

        Returns:
            What it computes; its type and shape are inferred after the pass.
        """
        root = self.match.root
        name = fresh_name(f"{root.outputs[0].name}_{op_type}", self.names)
        node = ir.node(op_type, inputs, attributes, name=name)
        node.outputs[0].name = name
        provenance.inherit(node, self.match.nodes, by=self.by)
        self.graph.insert_before(root, node)
        return node.outputs[0]

    def absorb(self, first: ir.Node, *others: ir.Node) -> None:
        """Remove the last node, whose work these nodes do from now on.

        The first of them makes its output.
        """
        root = self.match.root
        for node in (first, *others):
            provenance.inherit(node, (node, root), by=self.by)
        replace_value(root.outputs[0], first.outputs[0])
        remove_node(root)


@dataclasses.dataclass(frozen=True)
class Fusion:
    """A pattern, a check and a rewrite.

    ``Relu(Relu(x))`` is ``Relu(x)``::

        x = var("x")
        twice = op("Relu", op("Relu", x))
        once = Fusion("Relu of Relu", twice, lambda m, kit: kit.put("Relu", [m[x]]))

    Attributes:
        name: what the report counts it as.
        pattern: the expression.
        rewrite: edits the graph; or leaves it alone and returns the reason, which is
            reported.
        where: whether a match is one at all; what it leaves out is not counted.
    """

    name: str
    pattern: Pattern
    rewrite: Callable[[Match, Kit], str | None]
    where: Callable[[Match, Facts], bool] | None = None


@dataclasses.dataclass
class Fused:
    """What was fused, and what was left and why; each counted.

    Attributes:
        done: by the name of the fusion.
        refused: by the reason.
        unread: nodes and weights that nothing read before anything was fused.
    """

    done: Counter[str] = dataclasses.field(default_factory=Counter)
    refused: Counter[str] = dataclasses.field(default_factory=Counter)
    unread: int = 0

    @property
    def changes(self) -> int:
        """How many fusions were done, and unread nodes and weights removed."""
        return self.done.total() + self.unread

    def notes(self) -> tuple[str, ...]:
        """Return sentences for the report."""
        what = ", ".join(f"{name} ({count})" for name, count in self.done.items())
        left = (f"left {count}: {reason}" for reason, count in self.refused.items())
        return (
            *((f"fused: {what}",) if what else ()),
            *((f"removed: {self.unread} unread",) if self.unread else ()),
            *left,
        )


def fuse(model: ir.Model, fusions: Sequence[Fusion], *, by: str) -> Fused:
    """Try fusions on every node, in order, until none applies.

    What nothing reads is removed first, and after every round: it would read what a
    pattern wants for itself. Shapes must be inferred; bodies are rewritten too, all in
    place. ``by`` is the pass's name.
    """
    table: dict[str, list[Fusion]] = {}
    for fusion in fusions:
        for root in sorted(fusion.pattern.roots()):
            table.setdefault(root, []).append(fusion)
    run = _Run(Facts(opset_of(model)), by, value_names(model.graph), table)
    fused = Fused(unread=remove_dead(model.graph))
    for _ in range(ROUNDS):
        done: Counter[str] = Counter()
        fused.refused.clear()  # those of the last round are left
        for body in graphs_of(model.graph):
            done.update(run.round(body, fused.refused))
        if not done:
            break
        fused.done.update(done)
        remove_dead(model.graph)
    for node in nodes_in(model.graph):
        if not is_standard(node):
            model.graph.opset_imports.setdefault(node.domain, 1)
    return fused


@dataclasses.dataclass(frozen=True)
class _Run:
    """What stays the same while a model is fused."""

    facts: Facts
    by: str
    names: set[str]
    table: Mapping[str, Sequence[Fusion]]

    def round(self, body: ir.Graph, refused: Counter[str]) -> Counter[str]:
        """Try every node once; count what was done, and enter what was refused."""
        done: Counter[str] = Counter()
        for node in list(body):
            for fusion in self.table.get(node.op_type, ()):
                if node.graph is body and self._attempt(fusion, node, body, refused):
                    done[fusion.name] += 1
                    break
        return done

    def _attempt(
        self, fusion: Fusion, node: ir.Node, body: ir.Graph, refused: Counter[str]
    ) -> bool:
        matched = match(fusion.pattern, node)
        if matched is None or (fusion.where and not fusion.where(matched, self.facts)):
            return False
        reason = fusion.rewrite(matched, Kit(body, matched, self.by, self.names))
        if reason is not None:
            refused[reason] += 1
            return False
        remove_unread(each.outputs[0] for each in matched.nodes)
        return True
