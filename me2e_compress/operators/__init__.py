"""The fused operators: dialects, body, float64 reference and cost of each.

An operator is one node of a graph: in the toolkit's own form, in the domain ``me2e``,
or in the dialect of a TensorRT plugin library.
"""

from me2e_compress.operators.base import (
    OPERATORS,
    RESERVED,
    Cost,
    Operator,
    dialect_names,
    dialect_of,
    find,
    int8_inputs,
    int8_op_types,
    op_types,
    operators,
    position_inputs,
    score_inputs,
)
from me2e_compress.operators.call import FusedCall
from me2e_compress.operators.dialect import OWN_DOMAIN, Attribute, Dialect, Operand
from me2e_compress.operators.replace import (
    FusedNode,
    expand,
    fused_nodes,
    import_domains,
    raise_for_bodies,
    set_output,
    translate,
)

__all__ = [
    "OPERATORS",
    "OWN_DOMAIN",
    "RESERVED",
    "Attribute",
    "Cost",
    "Dialect",
    "FusedCall",
    "FusedNode",
    "Operand",
    "Operator",
    "dialect_names",
    "dialect_of",
    "expand",
    "find",
    "fused_nodes",
    "import_domains",
    "int8_inputs",
    "int8_op_types",
    "op_types",
    "operators",
    "position_inputs",
    "raise_for_bodies",
    "score_inputs",
    "set_output",
    "translate",
]
