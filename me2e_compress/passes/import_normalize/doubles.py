"""Remove float64 that leaked into a float32 graph (``torch.linspace`` in exporters)."""

from collections.abc import Iterator

import numpy as np
import onnx_ir as ir

from me2e_compress.display import counted
from me2e_compress.graph import graphs_of, nodes_of, provenance

_TYPE_ATTRIBUTES = ("to", "dtype", "output_datatype")
"""Attributes of standard operators that name an element type: Cast; EyeLike, Random*,
Bernoulli, Multinomial, SequenceEmpty; the window functions and MelWeightMatrix."""

_BY_WIDTH = ("BitCast",)
"""Standard operators whose meaning depends on the width."""


def demote(model: ir.Model, by: str) -> tuple[int, str]:
    """Turn float64 into float32 everywhere; return the changes, and what to say of it.

    Nothing changes where an input, output or unknown operator has doubles. Finite
    numbers beyond float32's range are clipped, so that a mask of ``-1.8e308`` stays
    finite.
    """
    if not any(True for _ in _doubles(model)):
        return 0, ""
    # Stop where the outside needs double
    keeper = _keeper(model)
    if keeper:
        return 0, f"float64 stays: {keeper} is double"
    # Weights, attributes, then value types
    count = _demote_weights(model)
    for node in nodes_of(model):
        if found := _demote_attributes(node):
            provenance.inherit(node, [node], by=by)
            count += found
    nodes = dict[ir.Node, None]()
    for value in _values(model):
        if value.type is not None and _is_double(value.type):
            value.type = _single(value.type)
            count += 1
            if (made := value.producer()) is not None:
                nodes[made] = None
    return count, f"float64 became float32: {counted(len(nodes), 'node')}"


def _doubles(model: ir.Model) -> Iterator[object]:
    for value in _values(model):
        if value.type is not None and _is_double(value.type):
            yield value
    for node in nodes_of(model):
        for attribute in node.attributes.values():
            if _names_double(node, attribute) or _holds_double(node, attribute):
                yield attribute


def _keeper(model: ir.Model) -> str:
    for kind, values in (
        ("input", model.graph.inputs),
        ("output", model.graph.outputs),
    ):
        for value in values:
            if value.type is not None and _is_double(value.type):
                return f"{kind} {value.name}"
    for node in nodes_of(model):
        # Standard operators and functions can change type
        known = node.domain == "" and node.op_type not in _BY_WIDTH
        if known or node.op_identifier() in model.functions:
            continue
        for touched in (*node.inputs, *node.outputs):
            if touched is not None and touched.dtype == ir.DataType.DOUBLE:
                custom = "custom " if node.domain else ""
                return f"{touched.name} of the {custom}operator {node.op_type}"
    return ""


def _demote_weights(model: ir.Model) -> int:
    count = 0
    for graph in graphs_of(model.graph):
        for value in graph.initializers.values():
            tensor = value.const_value
            if tensor is not None and tensor.dtype == ir.DataType.DOUBLE:
                value.const_value = _as_float32(tensor, value.name)
                value.type = ir.TensorType(ir.DataType.FLOAT)
                count += 1
    return count


def _demote_attributes(node: ir.Node) -> int:
    count = 0
    for name, attribute in list(node.attributes.items()):
        if _names_double(node, attribute):
            node.attributes[name] = ir.AttrInt64(name, ir.DataType.FLOAT.value)
        elif _holds_double(node, attribute):
            tensor = attribute.as_tensor()
            single = _as_float32(tensor, tensor.name)
            node.attributes[name] = ir.AttrTensor(name, single)
        else:
            continue
        count += 1
    return count


def _names_double(node: ir.Node, attribute: ir.Attr) -> bool:
    return (
        node.domain == ""
        and attribute.name in _TYPE_ATTRIBUTES
        and attribute.type == ir.AttributeType.INT
        and not attribute.is_ref()
        and attribute.as_int() == ir.DataType.DOUBLE.value
    )


def _holds_double(node: ir.Node, attribute: ir.Attr) -> bool:
    return (
        node.domain == ""
        and attribute.type == ir.AttributeType.TENSOR
        and not attribute.is_ref()
        and attribute.value.dtype == ir.DataType.DOUBLE
    )


def _as_float32(tensor: ir.TensorProtocol, name: str | None) -> ir.TensorProtocol:
    exact = tensor.numpy()
    limits = np.finfo(np.float32)
    bounded = np.where(
        np.isfinite(exact), np.clip(exact, limits.min, limits.max), exact
    )
    return ir.tensor(bounded.astype(np.float32), name=name)


def _is_double(kind: ir.TypeProtocol) -> bool:
    return bool(kind.dtype == ir.DataType.DOUBLE)


def _single(kind: ir.TypeProtocol) -> ir.TypeProtocol:
    if isinstance(kind, ir.SequenceType):
        return ir.SequenceType(_single(kind.elem_type))
    if isinstance(kind, ir.OptionalType):
        return ir.OptionalType(_single(kind.elem_type))
    if isinstance(kind, ir.SparseTensorType):
        return ir.SparseTensorType(ir.DataType.FLOAT)
    return ir.TensorType(ir.DataType.FLOAT)


def _values(model: ir.Model) -> Iterator[ir.Value]:
    for graph in graphs_of(model.graph):
        yield from graph.inputs
        yield from graph.initializers.values()
    for function in model.functions.values():
        yield from function.inputs
    for node in nodes_of(model):
        yield from node.outputs
