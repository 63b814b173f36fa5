"""Outputs that a graph draws anew at every run: nothing can be compared on them."""

from collections.abc import Iterator

import onnx_ir as ir

from me2e_compress.graph.nodes import DRAWS, bodies_of, nodes_in


def random_outputs(model: ir.Model) -> tuple[str, ...]:
    """Name the outputs of a graph that depend on what it draws without a seed."""
    drawn = set[ir.Value]()
    for node in model.graph:
        if _draws(node, model) or not drawn.isdisjoint(_read_by(node)):
            drawn.update(node.outputs)
    return tuple(str(each.name) for each in model.graph.outputs if each in drawn)


def _draws(node: ir.Node, model: ir.Model) -> bool:
    """Return whether a node draws, or one in its bodies or its function does."""
    if node.op_type in DRAWS and node.domain == "":
        return "seed" not in node.attributes
    function = model.functions.get(node.op_identifier())
    bodies = bodies_of(node) if function is None else (function,)
    return any(_draws(each, model) for body in bodies for each in body)


def _read_by(node: ir.Node) -> Iterator[ir.Value]:
    """Yield what a node reads, in its bodies too."""
    for each in (node, *_inside(node)):
        yield from (value for value in each.inputs if value is not None)


def _inside(node: ir.Node) -> Iterator[ir.Node]:
    for body in bodies_of(node):
        yield from nodes_in(body)
