"""What a file declares: names, types and sizes, and nodes that fit their operators."""

import dataclasses
import functools
import math
from collections.abc import Iterable, Mapping
from typing import Any

import onnx
from onnx import TensorProto

from me2e_compress.errors import GraphError

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

    Args:
        port: an input, an output or a value in between.
        typed: whether it must say what it is, as the inputs of a graph must.

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


_ATTRIBUTE_TYPES = frozenset(onnx.AttributeProto.AttributeType.values()) - {0}
_FIELD = {onnx.AttributeProto.TENSOR: "t", onnx.AttributeProto.GRAPH: "g"}
"""The field of an attribute that has no value of its own where it is left out."""


def check_signature(
    node: onnx.NodeProto,
    versions: Mapping[str, int],
    functions: Mapping[tuple[str, str, str], onnx.FunctionProto],
    *,
    in_function: bool,
) -> None:
    """Check a node against the operator or function of its name, if there is one.

    An operator that nobody knows, as plugins are, takes anything.

    Args:
        node: the node.
        versions: opset of every domain.
        functions: of the model.
        in_function: whether it stands in one, where attributes may refer to its own.

    Raises:
        GraphError: too many or too few inputs or outputs, or an attribute of another
            type, without a name, or twice.
    """
    kinds = _kinds(node, in_function=in_function)
    function = functions.get((node.domain, node.op_type, node.overload))
    if function is not None:
        _at_most(node, "inputs", len(node.input), len(function.input))
        _at_most(node, "outputs", len(node.output), len(function.output))
        return
    operator = _operator(node, versions)
    if operator is None:
        return
    _at_most(node, "inputs", len(node.input), operator.most_inputs)
    _at_most(node, "outputs", len(node.output), operator.most_outputs)
    if len(node.input) < operator.least_inputs:
        raise GraphError(
            f"{_called(node)} has {len(node.input)} inputs, at least"
            f" {operator.least_inputs} are needed"
        )
    for name, needed in zip(node.input, operator.needed, strict=False):
        if needed and not name:
            raise GraphError(f"{_called(node)}: input {needed} is left out")
    for name, kind in kinds.items():
        if name not in operator.attributes:
            raise GraphError(f"{_called(node)} has no attribute {name}")
        wanted = operator.attributes[name]
        if kind not in (wanted, None):
            raise GraphError(
                f"{_called(node)}: attribute {name} is of type {_type_name(kind)}, it"
                f" must be {_type_name(wanted)}"
            )
    if node.op_type == "Transpose":
        _check_permutation(node)
    for name in operator.required:
        if name not in kinds:
            raise GraphError(f"{_called(node)} lacks the attribute {name}")


def _check_permutation(node: onnx.NodeProto) -> None:
    for each in node.attribute:
        if each.name == "perm" and sorted(each.ints) != list(range(len(each.ints))):
            raise GraphError(f"{_called(node)}: perm {list(each.ints)} is none")


@dataclasses.dataclass(frozen=True)
class _Operator:
    """What a standard operator takes and gives, of one opset.

    Attributes:
        least_inputs: that must be there.
        most_inputs: that may be.
        most_outputs: likewise.
        needed: the names of the first inputs; empty for one that may be left out.
        attributes: their types.
        required: those that must be there.
    """

    least_inputs: int
    most_inputs: int
    most_outputs: int
    needed: tuple[str, ...]
    attributes: Mapping[str, int | None]
    required: tuple[str, ...]


def _operator(node: onnx.NodeProto, versions: Mapping[str, int]) -> _Operator | None:
    if node.domain not in ("", "ai.onnx"):
        return None
    version = versions.get("", versions.get("ai.onnx"))
    return None if version is None else _known(node.op_type, version)


@functools.cache
def _known(op_type: str, version: int) -> _Operator | None:
    if not onnx.defs.has(op_type, max_inclusive_version=version, domain=""):
        return None
    schema = onnx.defs.get_schema(op_type, version, "")
    single = onnx.defs.OpSchema.FormalParameterOption.Single
    return _Operator(
        schema.min_input,
        schema.max_input,
        schema.max_output,
        tuple(each.name if each.option == single else "" for each in schema.inputs),
        {name: _number(each.type) for name, each in schema.attributes.items()},
        tuple(name for name, each in schema.attributes.items() if each.required),
    )


def _number(kind: Any) -> int:
    """Return the number of a type that ONNX's stubs do not describe."""
    return int(kind.value)


def _called(node: onnx.NodeProto) -> str:
    return f"node {node.name!r} ({node.op_type})"


def _type_name(kind: int | None) -> str:
    return onnx.AttributeProto.AttributeType.Name(kind or 0)


def _at_most(node: onnx.NodeProto, what: str, found: int, most: int) -> None:
    if found > most:
        raise GraphError(f"{_called(node)} has {found} {what}, at most {most} may be")


def _kinds(node: onnx.NodeProto, *, in_function: bool) -> dict[str, int | None]:
    """Return the types of attributes by name; None for one that refers to another."""
    found: dict[str, int | None] = {}
    for each in node.attribute:
        name = each.name
        if type(name) is not str or not name or name in found:
            raise GraphError(f"{_called(node)}: attribute {name!r} twice, or nameless")
        if each.ref_attr_name:
            if not in_function:
                raise GraphError(
                    f"{_called(node)}: attribute {name} refers to one of a function,"
                    " and stands in none"
                )
            found[name] = None
            continue
        kind = each.type
        if kind not in _ATTRIBUTE_TYPES:
            raise GraphError(f"{_called(node)}: attribute {name} is of no known type")
        field = _FIELD.get(kind)
        if field is not None and not each.HasField(field):
            raise GraphError(f"{_called(node)}: attribute {name} has no value")
        found[name] = kind
    return found
