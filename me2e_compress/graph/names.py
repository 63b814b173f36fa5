"""Names for what is new: ONNX wants those of values to be unique."""

import onnx_ir as ir


def value_names(graph: ir.Graph) -> set[str]:
    """Collect the names of all values of a graph and of the bodies inside it."""
    names: set[str] = set()
    for body in (graph, *graph.subgraphs()):
        names.update(value.name or "" for value in body.inputs)
        names.update(body.initializers)
        names.update(value.name or "" for node in body for value in node.outputs)
    return names


def fresh_name(name: str, names: set[str]) -> str:
    """Take ``name``, or ``name_1``, ... where that is taken, and enter it."""
    unique, count = name, 0
    while unique in names:
        count += 1
        unique = f"{name}_{count}"
    names.add(unique)
    return unique
