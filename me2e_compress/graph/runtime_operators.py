"""Which operators onnxruntime has in which opset, by its own list of kernels."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import onnx
import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as _native  # pyright: ignore[reportAttributeAccessIssue]

# First and last version of a kernel's operator, and types by name of a constraint
Kernel: TypeAlias = tuple[int, int, Mapping[str, Sequence[str]]]

# What every onnxruntime that we run on reads (1.20 is the oldest)
SURE_OPSET, SURE_IR = 21, 10

# The last version of a kernel that nothing has replaced
_UNREPLACED = 2**31 - 1
# Operators that passes add to any graph
ADDED = ("QuantizeLinear", "DequantizeLinear")


@functools.cache
def kernels() -> Mapping[str, Sequence[Kernel]]:
    """Return the CPU's kernels of ONNX's own operators, by operator; 8 ms, once."""
    listed: dict[str, list[Kernel]] = {}
    for definition in _native.get_all_opkernel_def():
        if definition.provider == "CPUExecutionProvider" and not definition.domain:
            kernel = (*definition.version_range, dict(definition.type_constraints))
            listed.setdefault(definition.op_name, []).append(kernel)
    return listed


def serves(kernel: Kernel, since: int) -> bool:
    """Return whether a kernel runs the operator that is as it is since an opset."""
    # One without a last version runs the version of its operator alone
    first, last, _ = kernel
    return since == first if last == _UNREPLACED else first <= since <= last


@functools.cache
def has_operator(op_type: str, opset: int) -> bool:
    """Return whether onnxruntime runs an operator of ONNX's own in an opset."""
    if not onnx.defs.has(op_type, opset, ""):
        return False
    schema: Any = onnx.defs.get_schema(op_type, opset, "")  # stubs lack functions
    if op_type == "Constant":  # which becomes a weight
        return True
    if any(
        serves(kernel, schema.since_version) for kernel in kernels().get(op_type, ())
    ):
        return True
    # Or ONNX makes it of others. Such a body must mean the same in the opset of the
    # graph: that of Swish holds a Constant, which is another from 25 on
    if not schema.has_function:
        return bool(schema.has_context_dependent_function)
    version = max(other for other in schema.function_opset_versions if other <= opset)
    body = onnx.FunctionProto.FromString(
        schema.get_function_with_opset_version(version)
    )
    return all(
        since(node.op_type, version) == since(node.op_type, opset)
        and has_operator(node.op_type, opset)
        for node in body.node
    )


def since(op_type: str, opset: int) -> int:
    """Return the opset that an operator has been as it is since; 0 if it is unknown."""
    if not onnx.defs.has(op_type, opset, ""):
        return 0
    return int(onnx.defs.get_schema(op_type, opset, "").since_version)


@functools.cache
def newest_opset() -> int:
    """Return the newest opset that onnxruntime reads and int8 can be written in."""
    # onnxruntime 1.32 reads opset 28 and has no QuantizeLinear of it
    known = onnx.defs.onnx_opset_version()
    return next(
        opset
        for opset in range(known, 0, -1)
        if opset <= SURE_OPSET
        or (all(has_operator(name, opset) for name in ADDED) and reads(opset))
    )


@functools.cache
def newest_ir() -> int:
    """Return the newest version of the file format that onnxruntime reads."""
    return next(
        version
        for version in range(onnx.IR_VERSION, 0, -1)
        if version <= SURE_IR or reads(SURE_OPSET, version)
    )


def reads(opset: int, ir_version: int = SURE_IR) -> bool:
    """Return whether onnxruntime opens files of an opset and IR version; 2 ms."""
    port = onnx.helper.make_tensor_value_info
    x, y = (port(name, onnx.TensorProto.FLOAT, [1]) for name in "xy")
    node = onnx.helper.make_node("Relu", ["x"], ["y"])
    model = onnx.helper.make_model(
        onnx.helper.make_graph([node], "one", [x], [y]),
        opset_imports=[onnx.helper.make_opsetid("", opset)],
        ir_version=ir_version,
    )
    # A graph of one Relu is opened, and nothing logged
    options = ort.SessionOptions()
    options.log_severity_level = 4
    try:
        ort.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
    except (_native.Fail, _native.InvalidGraph, _native.NotImplemented):
        return False
    return True
