"""A finding as text that can be pasted into a test."""

import numpy as np
import onnx
import onnx.parser
import onnx.printer
from onnx import numpy_helper

INLINE = 64
"""Weights of more elements are drawn by the reader of the text, not written out."""

TYPES = {1: "float", 7: "int64", 9: "bool", 11: "double", 6: "int32"}


def as_text(model: onnx.ModelProto) -> str:
    """Write a graph in ONNX's syntax, small weights inlined, large ones as inputs."""
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    kept: list[onnx.TensorProto] = []
    drawn: list[onnx.TensorProto] = []
    for tensor in copy.graph.initializer:
        small = np.prod(tensor.dims, dtype=int) <= INLINE
        (kept if small and tensor.data_type in TYPES else drawn).append(tensor)
    del copy.graph.initializer[:]
    lines = [
        f"# weight {each.name}: {TYPES.get(each.data_type)}{list(each.dims)}, normal"
        for each in drawn
    ]
    text = onnx.printer.to_text(copy)
    listed = ", ".join(_written(each) for each in kept)
    if listed:
        begin = text.index(f"{copy.graph.name} (")
        brace = text.index("{", text.index(") => (", begin))
        text = f"{text[:brace]}\n<{listed}>\n{text[brace:]}"
    return "\n".join([*lines, text])


def _written(tensor: onnx.TensorProto) -> str:
    array = numpy_helper.to_array(tensor)
    values = ", ".join(_number(each, array.dtype.kind) for each in array.reshape(-1))
    dims = f"[{','.join(map(str, tensor.dims))}]" if tensor.dims else ""
    return f"{TYPES[tensor.data_type]}{dims} {_quoted(tensor.name)} = {{{values}}}"


def _number(value: object, kind: str) -> str:
    if kind == "f":
        return f"{float(str(value)):.9g}"
    return str(int(str(value) == "True")) if kind == "b" else str(value)


def _quoted(name: str) -> str:
    return name if name.isidentifier() else f'"{name}"'
