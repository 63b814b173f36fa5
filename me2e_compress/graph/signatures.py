"""A node and the operator that it calls: inputs, outputs and attributes that fit."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import onnx

from me2e_compress.errors import GraphError

_TYPES = frozenset(onnx.AttributeProto.AttributeType.values()) - {0}
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
        if kind not in _TYPES:
            raise GraphError(f"{_called(node)}: attribute {name} is of no known type")
        field = _FIELD.get(kind)
        if field is not None and not each.HasField(field):
            raise GraphError(f"{_called(node)}: attribute {name} has no value")
        found[name] = kind
    return found
