"""Graphs in an opset in which onnxruntime cannot run them: written in another."""

from collections.abc import Iterator
from pathlib import Path

import onnx
import onnx.version_converter
import onnx_ir as ir

from me2e_compress.errors import GraphError
from me2e_compress.graph.nodes import STANDARD, has_subgraph, is_standard, opset_of
from me2e_compress.graph.runtime_operators import (
    ADDED,
    has_operator,
    newest_ir,
    newest_opset,
    since,
)
from me2e_compress.graph.shapes import infer_shapes

OLDEST_OPSET = 13
"""The oldest opset that a graph is written in, as *import-normalize* does."""

_CHANGES = "me2e.read_as"
"""Key of ``model.meta`` with what was changed on reading, in words."""

_ON_DISK = "me2e.on_disk"
"""Key of ``model.meta`` with IR version and opset of a file that is read as another."""

_NO_NEWER = "onnxruntime reads no newer"


def fit(model: ir.Model, path: Path) -> None:
    """Write a graph in an opset and IR version in which onnxruntime can run it.

    One that is newer than onnxruntime is written in the newest that it reads. Where
    it has an operator of the graph in other opsets alone (RoiAlign before 22,
    RMSNormalization from 23 on), the graph is written in the nearest older one in which
    it has all of them, or else in a newer one. Operators that did not change stay as
    they are, others are converted by ONNX's version converter, one by one, so that
    names and metadata stay. :func:`read_as` says what changed.

    Raises:
        GraphError: the graph is newer than onnxruntime, and its opset is unknown or an
            operator cannot be written in an older one.
    """
    changes, on_disk = [], (model.ir_version, opset_of(model))
    if model.ir_version > newest_ir():
        version = f"IR version {model.ir_version} became {newest_ir()}"
        changes.append(f"{version}: {_NO_NEWER}")
        model.ir_version = newest_ir()
    if change := _fit_opset(model, path):
        changes.append(change)
    if changes:
        note_change(model, ", ".join(changes))
        model.meta[_ON_DISK] = on_disk


def read_as(model: ir.Model) -> str:
    """Say what was changed when a graph was read, and why; empty if nothing was."""
    return str(model.meta.get(_CHANGES, ""))


def note_change(model: ir.Model, words: str) -> None:
    """Note what was changed when a graph was read."""
    model.meta[_CHANGES] = "; ".join(filter(None, [read_as(model), words]))


def on_disk(model: ir.Model) -> tuple[int, int]:
    """Return IR version and opset of the file that a graph was read from."""
    version, opset = model.meta.get(_ON_DISK, (model.ir_version, opset_of(model)))
    return int(version), int(opset)


def _fit_opset(model: ir.Model, path: Path) -> str:
    """Write a graph in another opset if it needs one; return what changed and why."""
    opset, newest = max(opset for _, opset in bodies(model)), newest_opset()
    lacking, why = _lacking(model, opset, opset), _NO_NEWER
    if opset <= newest and not lacking:
        return ""
    if opset > (known := onnx.defs.onnx_opset_version()):
        raise GraphError(
            f"{path}: opset {opset}: onnxruntime reads up to {newest}, and onnx"
            f" {onnx.__version__} converts from {known} at most"
        )
    if lacking := lacking or [each for each in ADDED if not has_operator(each, opset)]:
        why = f"onnxruntime has no {' and no '.join(lacking)} in {opset}"
    older = range(min(opset, newest), OLDEST_OPSET - 1, -1)
    nearest = (*older, *range(opset + 1, newest + 1))
    able = [each for each in nearest if not _lacking(model, opset, each)]
    refusals = []
    for wanted in able or ([newest] if opset > newest else []):
        refusal = _write_in(model, opset, wanted)
        if not refusal:
            return f"opset {opset} became {wanted}: {why}"
        refusals.append(refusal)
    if opset <= newest:  # what cannot be run may be looked at
        return ""
    raise GraphError(
        f"{path}: opset {opset}: onnxruntime reads up to {newest}, and {refusals[0]}"
    )


def _lacking(model: ir.Model, before: int, wanted: int) -> list[str]:
    """List the operators that onnxruntime has, but not once a graph is rewritten."""
    opsets = range(OLDEST_OPSET, newest_opset() + 1)
    used = {
        (node.op_type, _written(opset, before, wanted))
        for body, opset in bodies(model)
        for node in body.all_nodes()
        if is_standard(node)
    }
    return [
        op_type
        for op_type, opset in sorted(used)
        if not has_operator(op_type, opset)
        and any(has_operator(op_type, each) for each in opsets)
    ]


def _written(opset: int, before: int, wanted: int) -> int:
    """Return the opset of a body once the newest of its graph is another."""
    return min(opset, wanted) if wanted < before else max(opset, wanted)


def bodies(model: ir.Model) -> Iterator[tuple[ir.Graph | ir.Function, int]]:
    """List the graph and the functions, each with its opset."""
    main = opset_of(model)
    yield model.graph, main
    for function in model.functions.values():
        yield function, opset_of(function) or main


def _write_in(model: ir.Model, before: int, wanted: int) -> str:
    """Write a graph in another opset; return why it stays as it was if it does."""
    changed = [
        (node, opset, after)
        for body, opset in bodies(model)
        for node in body.all_nodes()
        if is_standard(node)
        and since(node.op_type, opset)
        != since(node.op_type, after := _written(opset, before, wanted))
        and since(node.op_type, opset)
    ]
    if changed:
        infer_shapes(model)
    gone = list[tuple[ir.Node, str]]()
    for node, opset, after in changed:
        try:
            gone += [(node, name) for name in _dropped(node, opset, after)]
        except _RefusedError as refusal:
            called = f"{node.op_type} {node.name!r}"
            return f"{called} cannot be written in that: {refusal}"
    for node, name in gone:
        del node.attributes[name]
    # What the bodies import
    main = model.opset_imports
    for imports in (main, *(each.opset_imports for each in model.functions.values())):
        for domain in STANDARD:
            if domain in imports:
                imports[domain] = _written(imports[domain], before, wanted)
    return ""


class _RefusedError(Exception):
    """Why a node cannot be written in another opset."""


def _dropped(node: ir.Node, opset: int, wanted: int) -> list[str]:
    """Return the attributes that a node loses as another opset has it."""
    if has_subgraph(node):  # If, Loop and Scan are as they were, for more types
        if opset < OLDEST_OPSET:
            raise _RefusedError("it holds a graph")
        return []
    try:
        other = onnx.version_converter.convert_version(alone(node, opset), wanted)
    except (onnx.version_converter.ConvertError, RuntimeError) as error:
        raise _RefusedError(why_not(error)) from error
    written = other.graph.node
    if len(written) != 1 or written[0].op_type != node.op_type:
        raise _RefusedError("it takes several operators")
    names = [value.name if value is not None else "" for value in node.inputs]
    if list(written[0].input) != names:
        raise _RefusedError("its inputs are others")
    schema = onnx.defs.get_schema(node.op_type, wanted, "")
    kept = {attribute.name for attribute in written[0].attribute}
    if new := [name for name in kept if name not in schema.attributes]:
        raise _RefusedError(f"{new[0]} is new")
    return [name for name in node.attributes if name not in kept]


def changed_since(node: ir.Node, before: int, opset: int) -> bool:
    """Return whether a standard operator is another one in a newer opset."""
    return is_standard(node) and since(node.op_type, before) != since(
        node.op_type, opset
    )


def why_not(error: Exception) -> str:
    """Return the reason in an error of ONNX's version converter."""
    return " ".join(str(error).split()).rpartition("failed: ")[2]


def alone(node: ir.Node, opset: int) -> onnx.ModelProto:
    """Build a model of one node; values of unknown type are taken for float32."""

    def info(value: ir.Value) -> onnx.ValueInfoProto:
        typed = ir.Value(name=value.name, type=value.type, shape=value.shape)
        typed.type = typed.type or ir.TensorType(ir.DataType.FLOAT)
        return ir.serde.serialize_value(typed)

    inputs = dict.fromkeys(value for value in node.inputs if value is not None)
    body = onnx.helper.make_graph(
        [ir.serde.serialize_node(node)],
        "alone",
        [info(value) for value in inputs],
        [info(value) for value in node.outputs if value.name],
    )
    imports = [onnx.helper.make_opsetid("", opset)]
    return onnx.helper.make_model(
        body, opset_imports=imports, ir_version=onnx.IR_VERSION
    )
