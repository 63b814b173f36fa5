"""Write into the graph what folding found."""

import hashlib

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.passes.fold_constants.choice import FoldChoice
from me2e_compress.rewrite import Array, add_constant, put, replace_value, value_names


def commit(
    graph: ir.Graph, choice: FoldChoice, arrays: dict[ir.Value, Array], name: str
) -> list[ir.Value]:
    """Put initializers in the place of the chosen values and drop their makers.

    A folded tensor takes the name of the value it replaces. A graph output cannot be
    an initializer for every runtime: an Identity hands it on. Gives the initializers.
    """
    leave = {
        value.name for one in choice.gone for n in one.nodes for value in n.outputs
    }
    stored = _Store(graph, value_names(graph) - leave)
    place = {
        value: (one, index)
        for one in choice.gone
        for index, value in enumerate(one.nodes[0].outputs)
    }
    for value in choice.values:
        one, index = place[value]
        answers = any(node.outputs[index].is_graph_output() for node in one.nodes)
        label = f"{value.name}_value" if answers else value.name or ""
        weight = stored.add(arrays[value], label)
        for node in one.nodes:
            equal = node.outputs[index]
            if equal.is_graph_output():
                _answer(graph, node, equal, weight, name)
            else:
                equal.replace_all_uses_with(weight)
    for one in reversed(choice.gone):
        graph.remove([node for node in one.nodes if node.graph is graph], safe=True)
    return list(stored.known.values())


class _Store:
    """Gives equal arrays one initializer."""

    def __init__(self, graph: ir.Graph, names: set[str]) -> None:
        self.graph = graph
        self.names = names
        self.known: dict[tuple[str, tuple[int, ...], bytes], ir.Value] = {}

    def add(self, array: Array, name: str) -> ir.Value:
        data = np.ascontiguousarray(array).tobytes()
        content = hashlib.blake2b(data, digest_size=16)
        key = (str(array.dtype), array.shape, content.digest())
        if key not in self.known:
            self.known[key] = add_constant(self.graph, array, name, self.names)
        return self.known[key]


def _answer(
    graph: ir.Graph, node: ir.Node, value: ir.Value, weight: ir.Value, name: str
) -> None:
    if len(node.outputs) == 1:
        put(node, "Identity", [weight], by=name)
        return
    label = f"{node.name}_{node.outputs.index(value)}"
    answer = ir.node("Identity", [weight], num_outputs=1, name=label)
    graph.insert_after(node, answer)
    provenance.inherit(answer, [node], by=name)
    new = answer.outputs[0]
    new.name, new.type, new.shape = value.name, value.type, value.shape
    replace_value(value, new)
