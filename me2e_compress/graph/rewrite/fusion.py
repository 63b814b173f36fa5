"""Fusions: a pattern, a check of the match, and its rewrite."""

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
from me2e_compress.graph.rewrite import edits
from me2e_compress.graph.rewrite.pattern import Match, Pattern, match

# A fusion can complete the pattern of another: real graphs need two or three.
ROUNDS = 16


@dataclasses.dataclass(frozen=True)
class Facts:
    """Facts about the graph besides the match: the version of ONNX's own operators."""

    opset: int


@dataclasses.dataclass(frozen=True)
class Kit:
    """Edits the graph around a match.

    Attributes:
        graph: the graph of the match: the main graph, or a body.
        match: the matched nodes and values.
        by: the pass's name.
        names: of all values of the model; new ones are added.
    """

    graph: ir.Graph
    match: Match
    by: str
    names: set[str]

    def constant(self, array: Array, name: str) -> ir.Value:
        """Register an initializer in the graph, under this name if it is free."""
        return edits.add_constant(self.graph, array, name, self.names)

    def refill(self, node: ir.Node, index: int, array: Array, name: str) -> None:
        """Replace the array of a constant operand, or add an operand of this name."""
        old = input_at(node, index)
        # An initializer that no other node reads keeps its name
        if old is not None and old.is_initializer() and sole_reader(old) is node:
            flat = np.ascontiguousarray(array).reshape(array.shape)
            old.const_value = ir.tensor(flat, name=old.name)
            old.shape = ir.Shape(array.shape)
            return
        node.resize_inputs(max(index + 1, len(node.inputs)))
        node.replace_input_with(index, self.constant(array, name))

    def replace_by(
        self,
        op_type: str,
        inputs: Sequence[ir.Value | None],
        attributes: Mapping[str, int | float | str | Sequence[int]] | None = None,
        *,
        domain: str = "",
    ) -> None:
        """Replace all matched nodes by one operator, of any ``domain``."""
        root, *sources = self.match.nodes
        edits.put(
            root, op_type, inputs, by=self.by, sources=sources,
            attributes=attributes, domain=domain,
        )  # fmt: skip

    def add(
        self,
        op_type: str,
        inputs: Sequence[ir.Value | None],
        attributes: Mapping[str, int | float | str | Sequence[int]] | None = None,
    ) -> ir.Value:
        """Insert a standard operator before the last matched node; return its value."""
        root = self.match.root
        name = edits.fresh_name(f"{root.outputs[0].name}_{op_type}", self.names)
        node = ir.node(op_type, inputs, attributes, name=name)
        node.outputs[0].name = name
        provenance.inherit(node, self.match.nodes, by=self.by)
        self.graph.insert_before(root, node)
        return node.outputs[0]

    def absorb(self, first: ir.Node, *others: ir.Node) -> None:
        """Remove the last matched node; the first of these nodes makes its output."""
        root = self.match.root
        for node in (first, *others):
            provenance.inherit(node, (node, root), by=self.by)
        edits.replace_value(root.outputs[0], first.outputs[0])
        edits.remove_node(root)


@dataclasses.dataclass(frozen=True)
class Fusion:
    """A named pattern with a check and a rewrite.

    ``Relu(Relu(x))`` is ``Relu(x)``::

        x = var("x")
        twice = op("Relu", op("Relu", x))
        once = Fusion("Relu pair", twice, lambda m, kit: kit.replace_by("Relu", [m[x]]))

    Attributes:
        name: its name in the report.
        pattern: the pattern.
        rewrite: edits the graph and returns None, or returns the reason why it does
            not, which is reported.
        where: returns whether a match counts; None accepts all.
    """

    name: str
    pattern: Pattern
    rewrite: Callable[[Match, Kit], str | None]
    where: Callable[[Match, Facts], bool] | None = None


@dataclasses.dataclass
class Fused:
    """Counts of fusions.

    Attributes:
        done: fusions by name.
        refused: matches that stay, by reason.
        unread: nodes and weights that were unread before the first fusion.
    """

    done: Counter[str] = dataclasses.field(default_factory=Counter)
    refused: Counter[str] = dataclasses.field(default_factory=Counter)
    unread: int = 0

    @property
    def changes(self) -> int:
        """The number of fusions, and of removed unread nodes and weights."""
        return self.done.total() + self.unread

    def notes(self) -> tuple[str, ...]:
        """Return sentences for the report."""
        what = ", ".join(f"{name} ({count})" for name, count in self.done.items())
        notes = [f"fused: {what}"] if what else []
        if self.unread:
            notes.append(f"removed: {self.unread} unread")
        notes += [f"left {count}: {why}" for why, count in self.refused.items()]
        return tuple(notes)


def fuse(model: ir.Model, fusions: Sequence[Fusion], *, by: str) -> Fused:
    """Apply fusions to every node, in order and in place, until none applies.

    Shapes must be inferred. Bodies are rewritten too. ``by`` is the pass's name.
    """
    table: dict[str, list[Fusion]] = {}
    for fusion in fusions:
        for root in sorted(fusion.pattern.roots()):
            table.setdefault(root, []).append(fusion)
    run = _Run(Facts(opset_of(model)), by, edits.value_names(model.graph), table)
    # Unread nodes would read inner values of patterns
    fused = Fused(unread=edits.remove_dead(model.graph))
    for _ in range(ROUNDS):
        done: Counter[str] = Counter()
        fused.refused.clear()  # those of the last round are left
        for body in graphs_of(model.graph):
            done.update(run.fuse_body(body, fused.refused))
        if not done:
            break
        fused.done.update(done)
        edits.remove_dead(model.graph)
    for node in nodes_in(model.graph):
        if not is_standard(node):
            model.graph.opset_imports.setdefault(node.domain, 1)
    return fused


@dataclasses.dataclass(frozen=True)
class _Run:
    """The constant context of a run of :func:`fuse`."""

    facts: Facts
    by: str
    names: set[str]
    table: Mapping[str, Sequence[Fusion]]

    def fuse_body(self, body: ir.Graph, refused: Counter[str]) -> Counter[str]:
        """Try every node once; return counts of fusions, and add those of refusals."""
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
        edits.remove_unread(node.outputs[0] for node in matched.nodes)
        return True
