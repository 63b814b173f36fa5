"""What a file declares: names, types and sizes, and nodes that fit their operators."""

import functools
import math
from collections.abc import Iterable, Mapping

import onnx
from onnx import TensorProto
from onnx.onnx_cpp2py_export.checker import CheckerContext

from me2e_compress.errors import GraphError
from me2e_compress.graph.nodes import STANDARD

LARGEST_ELEMENTS = 2**40
"""Elements of one tensor: no memory holds more."""
HIGHEST_RANK = 64

_TYPES = frozenset(TensorProto.DataType.values()) - {TensorProto.UNDEFINED}
_BITS: Mapping[int, int] = {
    TensorProto.FLOAT: 32, TensorProto.UINT8: 8, TensorProto.INT8: 8,
    TensorProto.UINT16: 16, TensorProto.INT16: 16, TensorProto.INT32: 32,
    TensorProto.INT64: 64, TensorProto.BOOL: 8, TensorProto.FLOAT16: 16,
    TensorProto.DOUBLE: 64, TensorProto.UINT32: 32, TensorProto.UINT64: 64,
    TensorProto.COMPLEX64: 64, TensorProto.COMPLEX128: 128, TensorProto.BFLOAT16: 16,
    TensorProto.FLOAT8E4M3FN: 8, TensorProto.FLOAT8E4M3FNUZ: 8,
    TensorProto.FLOAT8E5M2: 8, TensorProto.FLOAT8E5M2FNUZ: 8, TensorProto.UINT4: 4,
    TensorProto.INT4: 4, TensorProto.FLOAT4E2M1: 4,
}  # fmt: skip
"""Bits of an element in ``raw_data``; of other types, such as text, it has none."""

_FIELDS = (
    "float_data", "int32_data", "string_data", "int64_data", "double_data",
    "uint64_data",
)  # fmt: skip


def check_text(where: str, texts: Iterable[str]) -> None:
    """Refuse names that are not UTF-8: protobuf hands them out as bytes.

    Raises:
        GraphError: one of them is not.
    """
    for text in texts:
        if type(text) is not str:
            raise GraphError(f"{where}: {text!r} is not UTF-8")


def check_port(port: onnx.ValueInfoProto, *, typed: bool) -> None:
    """Check a type; a size below 0 becomes an open one, a type of nothing none.

    ``typed`` ports must say what they are, as the inputs of a graph must.

    Raises:
        GraphError: it is no tensor, sequence or optional, or of an unknown element.
    """
    kind = port.type.WhichOneof("value")
    if kind == "tensor_type":
        _check_tensor_type(port, typed=typed)
    elif kind in ("map_type", "sparse_tensor_type") or (kind is None and typed):
        raise GraphError(
            f"{port.name!r} is not a tensor: its type is {kind or 'missing'}"
        )


def _check_tensor_type(port: onnx.ValueInfoProto, *, typed: bool) -> None:
    about = port.type.tensor_type
    if about.elem_type not in _TYPES:
        if typed or about.elem_type != TensorProto.UNDEFINED:
            raise GraphError(
                f"{port.name!r} is of element type {about.elem_type}, which is none"
            )
        port.ClearField("type")
        return
    if len(about.shape.dim) > HIGHEST_RANK:
        raise GraphError(f"{port.name!r} has {len(about.shape.dim)} dimensions")
    for dim in about.shape.dim:
        if dim.WhichOneof("value") == "dim_param":
            check_text(f"{port.name!r}: a dimension", (dim.dim_param,))
        elif dim.dim_value < 0:
            dim.ClearField("dim_value")
        elif dim.dim_value > LARGEST_ELEMENTS:
            raise GraphError(f"{port.name!r} has a dimension of {dim.dim_value}")


def check_tensor(tensor: TensorProto, what: str = "") -> None:
    """Check that a tensor has as many elements as its shape says.

    Raises:
        GraphError: it has not, or its type is unknown.
    """
    what = what or f"initializer {tensor.name!r}"
    kind, count = tensor.data_type, math.prod(tensor.dims)
    if kind not in _TYPES:
        raise GraphError(f"{what} is of element type {kind}, which is none")
    if len(tensor.dims) > HIGHEST_RANK or any(dim < 0 for dim in tensor.dims):
        raise GraphError(f"{what} has shape {list(tensor.dims)[:70]}")
    if count > LARGEST_ELEMENTS:
        raise GraphError(f"{what} has shape {list(tensor.dims)}: too many elements")
    if tensor.data_location == TensorProto.EXTERNAL:
        return
    filled = [name for name in _FIELDS if getattr(tensor, name)]
    if filled and (len(filled) > 1 or tensor.raw_data):
        raise GraphError(f"{what} holds its data twice")
    if filled or kind not in _BITS:
        _check_values(tensor, what, count)
        return
    wanted, found = -(-count * _BITS[kind] // 8), len(tensor.raw_data)
    if wanted != found:
        raise GraphError(f"{what} has {found} bytes, its shape says {wanted}")


def _check_values(tensor: TensorProto, what: str, count: int) -> None:
    """Check the elements of a tensor that stand one by one in a field of their type."""
    field = onnx.helper.tensor_dtype_to_field(tensor.data_type)
    wanted = count
    if tensor.data_type in (TensorProto.COMPLEX64, TensorProto.COMPLEX128):
        wanted = 2 * count  # real and imaginary part
    elif _BITS.get(tensor.data_type) == 4:
        wanted = -(-count // 2)  # two in a byte
    found = len(getattr(tensor, field))
    if wanted != found:
        raise GraphError(f"{what} has {found} values, its shape says {wanted}")


def check_signature(node: onnx.NodeProto, versions: Mapping[str, int]) -> None:
    """Check a node of ONNX's own against its operator, by ONNX's checker.

    One that nobody knows, as plugins are, takes anything, and so does an operator that
    ONNX gave up: runtimes may have it still. ``versions`` are opsets by domain.

    Raises:
        GraphError: too many or too few inputs or outputs, or an attribute that is
            unknown or of another type.
    """
    version = versions.get("", versions.get("ai.onnx", 0))
    if node.domain not in STANDARD or not onnx.defs.has(node.op_type, version, ""):
        return
    if onnx.defs.get_schema(node.op_type, version, "").deprecated:
        return
    try:
        onnx.checker.check_node(_without_contents(node), _context(version))
    except onnx.checker.ValidationError as error:
        reason = " ".join(str(error).split("==> Context")[0].split())
        raise GraphError(f"{_called(node)}: {reason}") from error
    for each in node.attribute if node.op_type == "Transpose" else ():
        if each.name == "perm" and sorted(each.ints) != list(range(len(each.ints))):
            raise GraphError(f"{_called(node)}: perm {list(each.ints)} is none")


@functools.cache
def _context(version: int) -> CheckerContext:
    context = CheckerContext()
    context.ir_version, context.opset_imports = onnx.IR_VERSION, {"": version}
    return context


def _without_contents(node: onnx.NodeProto) -> onnx.NodeProto:
    """Return a node with empty tensors and graphs: those are checked apart."""
    contents = {onnx.AttributeProto.TENSOR, onnx.AttributeProto.GRAPH}
    if not node.domain and contents.isdisjoint(each.type for each in node.attribute):
        return node
    bare = onnx.NodeProto(
        name=node.name, op_type=node.op_type, input=node.input, output=node.output
    )
    for each in node.attribute:
        if each.type not in contents or each.ref_attr_name:
            bare.attribute.append(each)
        elif each.type == onnx.AttributeProto.TENSOR:
            empty = TensorProto(data_type=TensorProto.FLOAT, dims=[0])
            bare.attribute.add(name=each.name, type=each.type, t=empty)
        else:
            bare.attribute.add(
                name=each.name, type=each.type, g=onnx.GraphProto(name="body")
            )
    return bare


def check_attributes(node: onnx.NodeProto, *, in_function: bool) -> None:
    """Check that each attribute has a name and a value, or refers to a function's.

    Raises:
        GraphError: one has not, is there twice, or refers to one where there is none.
    """
    found = set[str]()
    for each in node.attribute:
        name = each.name
        if type(name) is not str or not name or name in found:
            raise GraphError(f"{_called(node)}: attribute {name!r} twice, or nameless")
        found.add(name)
        if each.ref_attr_name:
            if not in_function:
                raise GraphError(
                    f"{_called(node)}: attribute {name} refers to one of a function,"
                    " and stands in none"
                )
            continue
        if each.type not in _ATTRIBUTE_TYPES:
            raise GraphError(f"{_called(node)}: attribute {name} is of no known type")
        field = _FIELD.get(each.type)
        if field is not None and not each.HasField(field):
            raise GraphError(f"{_called(node)}: attribute {name} has no value")


_ATTRIBUTE_TYPES = frozenset(onnx.AttributeProto.AttributeType.values()) - {0}
_FIELD = {onnx.AttributeProto.TENSOR: "t", onnx.AttributeProto.GRAPH: "g"}
"""The field of an attribute that has no value of its own where it is left out."""


def check_call(node: onnx.NodeProto, function: onnx.FunctionProto) -> None:
    """Refuse a call of a function with more inputs or outputs than it has."""
    for what, given, most in (
        ("inputs", node.input, function.input),
        ("outputs", node.output, function.output),
    ):
        if len(given) > len(most):
            raise GraphError(
                f"{_called(node)} has {len(given)} {what}, at most {len(most)} may be"
            )


def _called(node: onnx.NodeProto) -> str:
    return f"node {node.name!r} ({node.op_type})"
