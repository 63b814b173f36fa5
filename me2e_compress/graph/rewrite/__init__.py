"""The rewriting kit: safe edits of a graph, and fusions written as patterns.

Every edit keeps the interface: an output that is replaced keeps its name, and an edit
that would need to change an input or output is refused. New nodes inherit the module
and the origins of those they replace, and name the pass that made them.
"""

from me2e_compress.graph.rewrite.edits import (
    add_constant,
    bypass,
    can_replace,
    fresh_name,
    lift_constants,
    put,
    remove_dead,
    remove_node,
    remove_unread,
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
)
from me2e_compress.graph.rewrite.pattern import (
    Match,
    Pattern,
    constant,
    either,
    match,
    op,
    var,
)

__all__ = [
    "Facts",
    "Fused",
    "Fusion",
    "Kit",
    "Match",
    "Pattern",
    "add_constant",
    "bypass",
    "can_replace",
    "constant",
    "either",
    "fresh_name",
    "fuse",
    "lift_constants",
    "match",
    "op",
    "put",
    "remove_dead",
    "remove_node",
    "remove_unread",
    "replace_value",
    "sweep",
    "value_names",
    "var",
]
