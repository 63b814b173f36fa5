"""Find the fused operator and the dialect of a node."""

import functools
from collections.abc import Mapping

import onnx_ir as ir

from me2e_compress.errors import PreconditionError, RecipeError
from me2e_compress.graph.nodes import is_plugin, is_standard
from me2e_compress.graph.validity import PLUGIN_DOMAIN
from me2e_compress.operators.base import Operator
from me2e_compress.operators.dialect import OWN_DOMAIN, Dialect
from me2e_compress.registry import Registry

_HERE = "me2e_compress.operators"

OPERATORS: Registry[Operator] = Registry(
    "operator",
    _HERE,
    RecipeError,
    {
        "deformable-attention": f"{_HERE}.deformable_attention:DeformableAttention",
        "deformable-aggregation": (
            f"{_HERE}.deformable_aggregation:DeformableAggregation"
        ),
        "rotate": f"{_HERE}.rotate:Rotate",
        "inverse": f"{_HERE}.inverse:Inverse",
        "grid-sampler-2d": f"{_HERE}.grid_sampler:GridSampler2D",
        "grid-sampler-3d": f"{_HERE}.grid_sampler:GridSampler3D",
        "select-and-pad": f"{_HERE}.select_and_pad:SelectAndPad",
        "bev-pool": f"{_HERE}.bev_pool:BEVPool",
        "multi-head-attention": f"{_HERE}.multi_head_attention:FusedMultiHeadAttention",
        "deformable-convolution": (
            f"{_HERE}.deformable_convolution:DeformableConvolution"
        ),
        "winograd-convolution": f"{_HERE}.winograd_convolution:WinogradConvolution",
    },
)

_RESERVED = (OWN_DOMAIN, "com.microsoft")
"""Domains that define their operators; names there match no other dialect."""


def find(node: ir.Node) -> tuple[Operator, Dialect] | None:
    """Return a node's fused operator and dialect; None if it is not one.

    TensorRT finds a plugin by the operator's name, and exporters put it in any domain
    or none: so the name decides. Among several dialects of one name, the domain and
    ``plugin_version`` decide, then the types and shapes of the node's inputs.
    """
    rows = _rows().get(node.op_type)
    if rows is None or (is_standard(node) and not is_plugin(node)):
        return None
    # Reserved domains match only their own dialects
    domain = "" if is_standard(node) or node.domain == PLUGIN_DOMAIN else node.domain
    if domain in _RESERVED:
        rows = [row for row in rows if row[1].domain == domain]
    else:
        rows = [row for row in rows if row[1].domain not in _RESERVED]
    version = node.attributes.get_string("plugin_version", "1")
    return max(
        rows,
        key=lambda row: (
            row[1].domain == domain,
            row[1].version == version,
            _fits(row[1], node),
        ),
        default=None,
    )


def dialect_of(operator: Operator, name: str) -> Dialect | None:
    """Return an operator's dialect of this name, if there is one."""
    return next((each for each in operator.all_dialects() if each.name == name), None)


def dialect_names() -> tuple[str, ...]:
    """Return the names of all dialects, in the order of the operators."""
    return tuple(
        dict.fromkeys(
            dialect.name
            for operator in operators()
            for dialect in operator.all_dialects()
        )
    )


@functools.cache
def operators() -> tuple[Operator, ...]:
    """Build every operator that can be imported, built-in ones first."""
    return tuple(OPERATORS.build(name, {}) for name in OPERATORS.usable())


@functools.cache
def op_types(name: str) -> frozenset[str]:
    """Return the node types of an operator in every dialect."""
    return frozenset(
        dialect.op_type
        for operator in operators()
        for dialect in operator.all_dialects()
        if operator.name == name
    )


@functools.cache
def position_inputs() -> Mapping[str, tuple[int, ...]]:
    """Return the indices of inputs with positions or matrices to invert, by op_type."""
    return {
        op_type: tuple(
            index
            for index, operand in enumerate(rows[0][1].operands)
            if operand.positions
        )
        for op_type, rows in _rows().items()
    }


@functools.cache
def score_inputs() -> Mapping[str, int]:
    """Return the index of the input with weights before their softmax, by op_type."""
    return {
        op_type: index
        for op_type, rows in _rows().items()
        for index, operand in enumerate(rows[0][1].operands)
        if operand.scores
    }


def int8_inputs(node: ir.Node) -> tuple[int, ...]:
    """Return the inputs of a fused node that may be int8."""
    found = find(node) if node.op_type in int8_op_types() else None
    return () if found is None else found[0].int8_inputs


@functools.cache
def int8_op_types() -> frozenset[str]:
    """Return the op_types of fused operators that have int8 inputs."""
    return frozenset(
        op_type for op_type, rows in _rows().items() if rows[0][0].int8_inputs
    )


@functools.cache
def _rows() -> dict[str, list[tuple[Operator, Dialect]]]:
    rows: dict[str, list[tuple[Operator, Dialect]]] = {}
    for operator in operators():
        for dialect in operator.all_dialects():
            rows.setdefault(dialect.op_type, []).append((operator, dialect))
    return rows


def _fits(dialect: Dialect, node: ir.Node) -> bool:
    try:
        dialect.check(node)
    except PreconditionError:
        return False
    return True
