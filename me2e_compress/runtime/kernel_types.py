"""The element types that onnxruntime's CPU has kernels for, by its own list of them.

A graph with an operator of another type is not opened at all: GridSample of float64
before opset 20, for one, which exporters write where a Python number leaked in.
"""

import functools
from collections.abc import Iterator
from typing import Any

import onnx
import onnx_ir as ir

from me2e_compress.graph import opset_of
from me2e_compress.graph.nodes import is_read, is_standard, nodes_in
from me2e_compress.graph.runtime_operators import kernels, serves

# Types that onnxruntime casts to float32 and back where it has no kernel
_CAST_BY_ITSELF = (ir.DataType.FLOAT16, ir.DataType.BFLOAT16)


def nodes_without_kernel(model: ir.Model) -> Iterator[tuple[ir.Node, str]]:
    """Yield the nodes that onnxruntime has no kernel for, with what is missing."""
    opset = opset_of(model)
    for node in nodes_in(model.graph):
        if not is_standard(node) or not any(map(is_read, node.outputs)):
            continue
        # Nodes of unknown types are not judged, nor those of operators made of others
        if missing := _missing_types(node, opset):
            yield node, f"onnxruntime has no kernel for {node.op_type} of {missing}"


def _missing_types(node: ir.Node, opset: int) -> str:
    """Name the opset or the types that no kernel is for; empty if there is one."""
    schema = _schema(node.op_type, opset)
    if schema is None or node.op_type == "Constant":  # which becomes a weight
        return ""
    tensor_types = _tensor_types(node, schema)
    if tensor_types is None:
        return ""
    listed = kernels().get(node.op_type, ())
    usable = [kernel for kernel in listed if serves(kernel, schema.since_version)]
    if not usable:
        return f"opset {opset}"
    for _, _, types in usable:
        if all(word in types.get(n, (word,)) for n, word, _ in tensor_types):
            return ""
    return " and ".join(dict.fromkeys(kind for _, _, kind in tensor_types))


def _tensor_types(
    node: ir.Node, schema: onnx.defs.OpSchema
) -> list[tuple[str, str, str]] | None:
    """Return (constraint, type as onnxruntime writes it, its name) of all tensors."""
    plain_types = dict[tuple[str, str], str]()
    sides = ((node.inputs, schema.inputs), (node.outputs, schema.outputs))
    # The last formal parameter may stand for many tensors
    for values, formals in sides:
        for index, value in enumerate(values):
            formal = formals[min(index, len(formals) - 1)]
            if value is None or (not value.name and value.dtype is None):
                continue
            kind = value.dtype
            if kind is None or kind in _CAST_BY_ITSELF:
                return None  # not known, or cast by onnxruntime itself
            if not isinstance(value.type, ir.TensorType):
                return None  # a sequence, of whatever
            word = kind.name.lower()
            for name in (formal.type_str, formal.name):
                plain = "float64" if kind == ir.DataType.DOUBLE else word
                plain_types[name, f"tensor({word})"] = plain
    return [(name, word, plain) for (name, word), plain in plain_types.items()]


@functools.cache
def _schema(op_type: str, opset: int) -> onnx.defs.OpSchema | None:
    """Return an operator's definition; None of what is made of other operators."""
    try:
        schema: Any = onnx.defs.get_schema(op_type, opset, "")  # stubs lack functions
    except onnx.defs.SchemaError:
        return None
    is_made = schema.has_function or schema.has_context_dependent_function
    return None if is_made else schema


def float32_hint(model: ir.Model, missing: str) -> str:
    """Return advice where a pass can write float32; empty for ports of float64."""
    ports = (*model.graph.inputs, *model.graph.outputs)
    if "float64" not in missing or any(e.dtype == ir.DataType.DOUBLE for e in ports):
        return ""
    return ": import-normalize makes it float32 (compress -r exact)"
