"""Graphs of an older opset, written in a newer one node by node."""

from collections.abc import Sequence

import onnx
import onnx.version_converter
import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.graph.nodes import STANDARD, array_of, has_subgraph, opset_of
from me2e_compress.graph.opset import alone, bodies, changed_since, why_not
from me2e_compress.graph.rewrite.edits import (
    add_constant,
    fresh_name,
    remove_node,
    replace_value,
    value_names,
)
from me2e_compress.graph.shapes import infer_shapes

_SCAN_AS_IS = 9
"""The first opset whose Scan has no axis of batches."""
_RESIZE_AS_IS = 11
"""The first opset whose Resize says how coordinates are made. Earlier ones, and
Upsample, are asymmetric (onnx/docs/Changelog.md, Resize-11), which the converter of
onnx 1.23 does not write; onnxruntime takes the left neighbour where it enlarges, the
right one where it shrinks (GetNearestPixelFromOriginal, ``SIMPLE``)."""


def raise_opset(model: ir.Model, opset: int, by: str) -> tuple[int, str]:
    """Write a graph in a newer opset; return the changes, and why it stays if it does.

    Operators that did not change in between stay, others are converted by ONNX's
    version converter, one by one, so that names, metadata and plugins stay. Functions
    are taken along, as they are. Nothing changes unless every node can be written, and
    those of functions stay the same.
    """
    before, known = opset_of(model), onnx.defs.onnx_opset_version()
    if opset > known:
        return 0, f"onnx {onnx.__version__} converts to {known} at most"
    changed = [
        (node, own, body is not model.graph)
        for body, own in bodies(model)
        for node in body.all_nodes()
        if own < opset and changed_since(node, own, opset) and _converts(node, own)
    ]
    if changed:
        infer_shapes(model)
    # Convert all of them before the first is replaced
    written = dict[ir.Node, ir.Graph]()
    for node, own, in_function in changed:
        reason = _not_converted(node, own)
        if reason:
            return 0, f"{node.op_type} {node.name!r} stays as it is: {reason}"
        try:
            proto = onnx.version_converter.convert_version(alone(node, own), opset)
        except (onnx.version_converter.ConvertError, RuntimeError) as error:
            called = f"{node.op_type} {node.name!r}"
            return 0, f"{called} cannot be written in {opset}: {why_not(error)}"
        if not in_function:
            written[node] = ir.serde.deserialize_model(proto).graph
        elif not _is_same(proto.graph, alone(node, own).graph):
            return 0, f"{node.op_type} {node.name!r} of a function is another there"
    names = value_names(model.graph)
    for node, instead in written.items():
        _replace(node, instead, before, names, by)
    for body, _ in bodies(model):
        for domain in STANDARD:
            if 0 < body.opset_imports.get(domain, 0) < opset:
                body.opset_imports[domain] = opset
    return len(written) + 1, ""


def _converts(node: ir.Node, before: int) -> bool:
    """Return whether a node is another one in a newer opset: If and Loop take more."""
    return not has_subgraph(node) or (node.op_type == "Scan" and before < _SCAN_AS_IS)


def _is_same(new: onnx.GraphProto, old: onnx.GraphProto) -> bool:
    """Return whether a graph of one node was converted without a change."""
    one, other = (
        [
            (node.op_type, [*node.input], sorted(map(str, node.attribute)))
            for node in graph.node
        ]
        for graph in (new, old)
    )
    return one == other


def _not_converted(node: ir.Node, before: int) -> str:
    """Return why a node cannot be trusted to the converter, which would take it."""
    if has_subgraph(node):
        return "Scan of opset 8 has a batch"
    if node.op_type == "Hardmax":
        return "onnx converts it without its axis"
    if node.op_type != "Resize" or before >= _RESIZE_AS_IS:
        return ""
    scales = _scales(node)
    if not scales or (max(scales) > 1 and min(scales) < 1):
        return "it enlarges and shrinks"
    return ""


def _scales(node: ir.Node) -> list[float]:
    array = array_of(node.inputs[1]) if len(node.inputs) > 1 else None
    return [] if array is None else [float(each) for each in array]


def _replace(
    node: ir.Node, instead: ir.Graph, before: int, names: set[str], by: str
) -> None:
    """Put the nodes of a small graph in the place of one, with its names and origin."""
    graph = node.graph
    if not isinstance(graph, ir.Graph):
        raise TypeError(f"{node.name} is not in a graph")
    outer = {value.name: value for value in node.inputs if value is not None}
    for inner in instead.inputs:
        inner.replace_all_uses_with(outer[inner.name])
    for inner in list(instead.initializers.values()):
        if inner.const_value is not None:
            array = inner.const_value.numpy()
            label = f"{node.name}_{inner.name}"
            inner.replace_all_uses_with(add_constant(graph, array, label, names))
    nodes, results = list(instead), list(instead.outputs)
    instead.outputs.clear()
    instead.remove(nodes)
    for place, new in enumerate(nodes):
        if before < _RESIZE_AS_IS and new.op_type == "Resize":
            mode = "coordinate_transformation_mode"
            new.attributes[mode] = ir.AttrString(mode, "asymmetric")
            nearest = "ceil" if min(_scales(node), default=1.0) < 1 else "floor"
            new.attributes["nearest_mode"] = ir.AttrString("nearest_mode", nearest)
        last = new.op_type == nodes[-1].op_type and place == len(nodes) - 1
        new.name = node.name if last else f"{node.name}_{new.op_type}_{place}"
        for value in new.outputs:
            if value not in results and value.name:
                value.name = fresh_name(f"{node.name}_{value.name}", names)
        provenance.inherit(new, [node], by=by)
    graph.insert_before(node, nodes)
    for old, new_value in zip(_named(node.outputs), results, strict=True):
        new_value.shape, new_value.type = old.shape, old.type
        replace_value(old, new_value)
    remove_node(node)


def _named(values: Sequence[ir.Value]) -> list[ir.Value]:
    return [value for value in values if value.name]
