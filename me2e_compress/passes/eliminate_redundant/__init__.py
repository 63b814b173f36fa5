"""Remove what does nothing or is there twice."""

import dataclasses
from collections import Counter

import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress.graph import infer_shapes, opset_of, provenance, static_shape
from me2e_compress.graph.digest import digest_of_tensor
from me2e_compress.graph.nodes import (
    attribute_values,
    draws,
    graphs_of,
    has_subgraph,
    is_read,
    is_standard,
)
from me2e_compress.graph.rewrite import bypass, can_replace, remove_dead, remove_node
from me2e_compress.graph.rewrite.raise_opset import OLDEST_OPSET
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.eliminate_redundant.rules import MergeSite, identity_of, merge

COMMUTATIVE = frozenset({"Add", "And", "Equal", "Mul", "Or", "Xor"})


def share_nodes(graph: ir.Graph, by: str) -> int:
    """Merge equal nodes into the first of them and count the removed ones.

    Nodes of different modules stay apart, so that a module can be taken out later.
    """
    # Find equal nodes and bypass all but the first
    first: dict[object, ir.Node] = {}
    merged: dict[ir.Node, list[ir.Node]] = {}
    for node in graph:
        if not is_standard(node) or draws(node) or has_subgraph(node):
            continue
        module = provenance.module_of(node)
        inputs = [id(value) for value in node.inputs]
        if node.op_type in COMMUTATIVE:
            inputs.sort()
        named = tuple(bool(value.name) for value in node.outputs)
        values = attribute_values(node)
        key = (node.op_type, tuple(inputs), named, values, module)
        known = first.setdefault(key, node)
        if known is node:
            continue
        pairs = list(zip(node.outputs, known.outputs, strict=True))
        if all(can_replace(old, new) for old, new in pairs):
            for old, new in pairs:
                bypass(old, new)
            merged.setdefault(known, [known]).append(node)
    # Remove the duplicates; the first inherits their provenance
    for known, nodes in merged.items():
        provenance.inherit(known, nodes, by=by)
        graph.remove(nodes[1:], safe=True)
    return sum(len(nodes) - 1 for nodes in merged.values())


def share_initializers(graph: ir.Graph) -> int:
    """Merge equal initializers into the first and count the removed ones."""
    count, first = 0, dict[bytes, ir.Value]()
    for value in list(graph.initializers.values()):
        if value.const_value is None or value.is_graph_input():
            continue
        known = first.setdefault(digest_of_tensor(value.const_value), value)
        if known is not value and not value.is_graph_output():
            value.replace_all_uses_with(known)
            del graph.initializers[value.name or ""]
            count += 1
    return count


__all__ = ["EliminateRedundant"]

# Each round works on what the last one changed; real graphs need three or four.
ROUNDS = 32


@dataclasses.dataclass(frozen=True)
class EliminateRedundant(Pass):
    """Remove nodes that change nothing, merge pairs, and share equal ones.

    Given:   x -> Identity -> Transpose -> Transpose -> y;  Add(a, b), Add(b, a)
    Result:  x -> y;  one Add

    Exact to the bit: x + 0.0 stays, since it turns -0.0 into +0.0.
    """

    name = "eliminate-redundant"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Apply the rules until none applies, then drop unread nodes."""
        if opset_of(model) < OLDEST_OPSET:  # operators had other rules then
            return PassResult(model, 0)
        tally: Counter[str] = Counter()
        tally["unread"] += remove_dead(model.graph)
        # Repeat: each round enables rules for the next
        for _ in range(ROUNDS):
            before = tally.total()
            for body in graphs_of(model.graph):
                self._round(body, tally)
            tally["unread"] += remove_dead(model.graph)
            if tally.total() == before:
                break
            # what read a removed node may know its shape now, and another rule apply
            values = (value for node in model.graph for value in node.outputs)
            if any(static_shape(value) is None for value in values):
                infer_shapes(model)
        # Remove functions and opsets that are no longer used
        declared = _count_declared(model)
        functions = common.RemoveUnusedFunctionsPass()  # type: ignore[no-untyped-call]
        functions(model)
        common.RemoveUnusedOpsetsPass()(model)
        tally["functions and opsets"] += declared - _count_declared(model)
        removed = ", ".join(f"{count} {what}" for what, count in tally.items() if count)
        notes = (f"removed: {removed}",) if removed else ()
        return PassResult(model, tally.total(), notes)

    def _round(self, body: ir.Graph, tally: Counter[str]) -> None:
        site = MergeSite(body, self.name)
        tally["initializers"] += share_initializers(body)
        work = dict.fromkeys(reversed(list(body)))
        while work:
            node, _ = work.popitem()
            if node.graph is body:
                work.update(dict.fromkeys(self._visit(node, site, tally)))
        tally["equal nodes"] += share_nodes(body, self.name)

    def _visit(
        self, node: ir.Node, site: MergeSite, tally: Counter[str]
    ) -> list[ir.Node]:
        # Unread nodes go first
        if not any(is_read(value) for value in node.outputs):
            makers = list(node.predecessors())
            remove_node(node)
            tally["unread"] += 1
            return makers
        # A node that repeats its input is bypassed
        same = identity_of(node)
        if same is not None and bypass(node.outputs[0], same):
            remove_node(node)
            tally["identities"] += 1
            return [use.node for use in same.uses()]
        merged = merge(node, site)
        if merged is None:
            return []
        tally["merged pairs"] += 1
        return [merged, *merged.successors(), *merged.predecessors()]


def _count_declared(model: ir.Model) -> int:
    inner = sum(len(body.opset_imports) for body in model.functions.values())
    return len(model.functions) + len(model.opset_imports) + inner
