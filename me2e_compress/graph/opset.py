"""Graphs that are newer than the runtime: written down to what it reads."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import onnx
import onnx.version_converter
import onnx_ir as ir

from me2e_compress.errors import GraphError
from me2e_compress.graph.nodes import STANDARD, has_subgraph, is_standard, opset_of
from me2e_compress.graph.shapes import infer_shapes

NEWEST_OPSET, NEWEST_IR = 26, 13
"""The newest opset and IR version that onnxruntime 1.31 reads."""

LOWERED = "me2e.lowered"
"""Key of ``model.meta`` with what :func:`lower` changed, in words."""


def lower(model: ir.Model, path: Path) -> None:
    """Write a graph in the newest opset and IR version that onnxruntime reads.

    Operators that did not change since then stay as they are, others are converted by
    ONNX's version converter, one by one, so that names and metadata stay. What changed
    stands in ``model.meta`` under ``LOWERED``.

    Raises:
        GraphError: the opset is unknown, or an operator cannot be written in it.
    """
    changes = []
    if model.ir_version > NEWEST_IR:
        changes.append(f"IR version {model.ir_version} became {NEWEST_IR}")
        model.ir_version = NEWEST_IR
    newest = max(opset for _, opset in bodies(model))
    if newest > NEWEST_OPSET:
        changes.append(f"opset {newest} became {NEWEST_OPSET}")
        _lower_opset(model, newest, path)
    if changes:
        model.meta[LOWERED] = ", ".join(changes)


def lowered(model: ir.Model) -> str:
    """Say what was changed when a graph was read; empty if nothing was."""
    return str(model.meta.get(LOWERED, ""))


def _lower_opset(model: ir.Model, newest: int, path: Path) -> None:
    known = onnx.defs.onnx_opset_version()
    if newest > known:
        raise GraphError(
            f"{path}: opset {newest}: onnxruntime reads up to {NEWEST_OPSET}, and onnx"
            f" {onnx.__version__} converts from {known} at most"
        )
    changed = [
        (node, opset)
        for body, opset in bodies(model)
        for node in body.all_nodes()
        if _since(node, opset) > NEWEST_OPSET
    ]
    if failure := _write_in(model, changed, NEWEST_OPSET):
        node, opset, reason = failure
        raise GraphError(
            f"{path}: opset {opset}: onnxruntime reads up to {NEWEST_OPSET}, and"
            f" {node.op_type} {node.name!r} cannot be written in that: {reason}"
        )
    functions = [function.opset_imports for function in model.functions.values()]
    for imports in (model.opset_imports, *functions):
        for domain in STANDARD:
            if imports.get(domain, 0) > NEWEST_OPSET:
                imports[domain] = NEWEST_OPSET


def bodies(model: ir.Model) -> Iterator[tuple[ir.Graph | ir.Function, int]]:
    """List the graph and the functions, each with its opset."""
    main = opset_of(model)
    yield model.graph, main
    for function in model.functions.values():
        yield function, opset_of(function) or main


def _since(node: ir.Node, opset: int) -> int:
    """Return the opset that an operator has been as it is since; 0 of a plugin."""
    if not is_standard(node) or not onnx.defs.has(node.op_type, opset, ""):
        return 0
    return int(onnx.defs.get_schema(node.op_type, opset, "").since_version)


def _write_in(
    model: ir.Model, nodes: Sequence[tuple[ir.Node, int]], opset: int
) -> tuple[ir.Node, int, str] | None:
    """Write nodes, each with its opset, in another; return the first that refuses."""
    if nodes:
        infer_shapes(model)
    for node, before in nodes:
        if (reason := _rewrite(node, before, opset)) is not None:
            return node, before, reason
    return None


def _rewrite(node: ir.Node, opset: int, wanted: int) -> str | None:
    """Write a node as another opset has it; return why that cannot be done."""
    if has_subgraph(node):
        return "it holds a graph"
    try:
        older = onnx.version_converter.convert_version(alone(node, opset), wanted)
    except (onnx.version_converter.ConvertError, RuntimeError) as error:
        return why_not(error)
    written = older.graph.node
    if len(written) != 1 or written[0].op_type != node.op_type:
        return "it takes several operators"
    names = [value.name if value is not None else "" for value in node.inputs]
    if list(written[0].input) != names:
        return "its inputs are others"
    schema = onnx.defs.get_schema(node.op_type, wanted, "")
    kept = {attribute.name for attribute in written[0].attribute}
    for name in list(node.attributes):
        if name not in kept:
            del node.attributes[name]
        elif name not in schema.attributes:
            return f"{name} is new"
    return None


def changed_since(node: ir.Node, before: int, opset: int) -> bool:
    """Return whether a standard operator is another one in a newer opset."""
    return _since(node, before) != _since(node, opset)


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
    return onnx.helper.make_model(body, opset_imports=imports, ir_version=NEWEST_IR)
