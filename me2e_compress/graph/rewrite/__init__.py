"""The rewriting kit: safe edits of a graph, and fusions written as patterns.

Every edit keeps the interface: an output that is replaced keeps its name, and an edit
that would need to change an input or output is refused. New nodes inherit the module
and the origins of those they replace, and name the pass that made them.
"""

from me2e_compress.graph import array_of, graphs_of, has_subgraph, is_standard
from me2e_compress.graph.nodes import (
    FLOATS,
    Array,
    Numbers,
    holds_numbers,
    is_close,
    is_read,
    maker,
    numbers_of,
    overflow,
    scalar_of,
    sole_maker,
    sole_reader,
)
from me2e_compress.graph.provenance import inherit
from me2e_compress.graph.rewrite.edits import (
    add_constant,
    bypass,
    can_replace,
    fresh_name,
    lift_constants,
    put,
    remove_dead,
    remove_node,
    replace_value,
    sweep,
    value_names,
)
from me2e_compress.graph.rewrite.fusion import (
    Facts,
    Fused,
    Fusion,
    Kit,
    fuse,
    needs_opset,
)
from me2e_compress.graph.rewrite.pattern import (
    Match,
    Pattern,
    constant,
    either,
    match,
    moved,
    op,
    product,
    var,
)

__all__ = [
    "FLOATS",
    "Array",
    "Facts",
    "Fused",
    "Fusion",
    "Kit",
    "Match",
    "Numbers",
    "Pattern",
    "add_constant",
    "array_of",
    "bypass",
    "can_replace",
    "constant",
    "either",
    "fresh_name",
    "fuse",
    "graphs_of",
    "has_subgraph",
    "holds_numbers",
    "inherit",
    "is_close",
    "is_read",
    "is_standard",
    "lift_constants",
    "maker",
    "match",
    "moved",
    "needs_opset",
    "numbers_of",
    "op",
    "overflow",
    "product",
    "put",
    "remove_dead",
    "remove_node",
    "replace_value",
    "scalar_of",
    "sole_maker",
    "sole_reader",
    "sweep",
    "value_names",
    "var",
]
