"""The compiled part of onnxruntime: its exceptions and its operators."""

import functools

# The compiled module has no stubs.
from onnxruntime.capi import (
    onnxruntime_pybind11_state as _native,  # pyright: ignore[reportAttributeAccessIssue]
)

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
