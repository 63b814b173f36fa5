"""The rewriting kit: safe edits of a graph, and fusions written as patterns.

Every edit keeps the interface: an output that is replaced keeps its name, and an edit
that would need to change an input or output is refused. New nodes inherit the module
and the origins of those they replace, and name the pass that made them.
"""

from me2e_compress.graph import array_of, graphs_of, has_subgraph, is_standard
from me2e_compress.graph.provenance import inherit
from me2e_compress.rewrite.edits import (
    add_constant,
    bypass,
    can_replace,
    fresh_name,
    put,
    remove_dead,
    replace_value,
    sweep,
    value_names,
)
from me2e_compress.rewrite.values import (
    FLOATS,
    Array,
    Numbers,
    is_close,
    is_read,
    maker,
    numbers_of,
    scalar_of,
    sole_maker,
    sole_reader,
)

__all__ = [
    "FLOATS",
    "Array",
    "Numbers",
    "add_constant",
    "array_of",
    "bypass",
    "can_replace",
    "fresh_name",
    "graphs_of",
    "has_subgraph",
    "inherit",
    "is_close",
    "is_read",
    "is_standard",
    "maker",
    "numbers_of",
    "put",
    "remove_dead",
    "replace_value",
    "scalar_of",
    "sole_maker",
    "sole_reader",
    "sweep",
    "value_names",
]
