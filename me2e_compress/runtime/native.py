"""The compiled part of onnxruntime: its exceptions, its operators, what it can run."""

import functools

import onnx_ir as ir

# The compiled module has no stubs.
from onnxruntime.capi import (
    onnxruntime_pybind11_state as _native,  # pyright: ignore[reportAttributeAccessIssue]
)

from me2e_compress.graph import is_standard

InvalidArgument: type[Exception] = _native.InvalidArgument
"""Raised where inputs do not fit."""

REFUSALS: tuple[type[Exception], ...] = (
    _native.Fail,
    _native.InvalidArgument,
    _native.InvalidGraph,
    _native.InvalidProtobuf,
    _native.NoModel,
    _native.NoSuchFile,
    _native.NotImplemented,
    _native.RuntimeException,
    RuntimeError,  # an output of a type that numpy lacks, such as bfloat16
)
"""Everything raised where a graph cannot be read, built or run."""


@functools.cache
def operators() -> frozenset[tuple[str, str]]:
    """List the (domain, operator) pairs that are known; ai.onnx is written ``""``."""
    return frozenset(
        ("" if schema.domain == "ai.onnx" else schema.domain, schema.name)
        for schema in _native.get_all_operator_schema()
    )


def unsupported(model: ir.Model) -> str | None:
    """Return why the CPU cannot run a graph; None if it knows every operator.

    A known operator may still lack a kernel for its element type; only building a
    :class:`~me2e_compress.runtime.session.Session` finds that.
    """
    known = operators()
    unknown = {
        f"{node.domain or 'ai.onnx'}::{node.op_type}": node
        for graph in (*model.graphs(), *model.functions.values())
        for node in graph
        if node.op_identifier() not in model.functions
        and ("" if is_standard(node) else node.domain, node.op_type) not in known
    }
    if not unknown:
        return None
    node = next(iter(unknown.values()))
    return f"onnxruntime has no operator {', '.join(unknown)} (node {node.name!r})"
