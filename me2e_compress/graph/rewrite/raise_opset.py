"""Convert a graph to another opset node by node."""

from collections.abc import Sequence

import onnx
import onnx.version_converter
import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.graph.nodes import (
    STANDARD,
    array_of,
    bodies,
    converted_opset,
    has_subgraph,
    is_standard,
    opset_of,
)
from me2e_compress.graph.rewrite import edits
from me2e_compress.graph.runtime_operators import since
from me2e_compress.graph.shapes import infer_shapes

# The first opset whose Scan has no axis of batches
_SCAN_AS_IS = 9
# The first opset whose Resize says how coordinates are made. Earlier ones, and
# Upsample, are asymmetric (onnx/docs/Changelog.md, Resize-11), which the converter of
# onnx 1.23 does not write; onnxruntime takes the left neighbour where it enlarges, the
# right one where it shrinks (GetNearestPixelFromOriginal, `SIMPLE`).
_RESIZE_AS_IS = 11
# The oldest opset that a graph is written in, as *import-normalize* does
OLDEST_OPSET = 13


def raise_opset(model: ir.Model, opset: int, by: str) -> tuple[int, str]:
    """Convert a graph to a newer opset: see :func:`write_in`."""
    if opset > (known := onnx.defs.onnx_opset_version()):
        return 0, f"onnx {onnx.__version__} converts to {known} at most"
    return write_in(model, min(opset, opset_of(model)), opset, by)


def write_in(
    model: ir.Model, before: int, opset: int, by: str, *, one_by_one: bool = False
) -> tuple[int, str]:
    """Convert a graph to another opset; return the changes, and why there are none.

    ``before`` is the newest imported opset. ``one_by_one`` refuses nodes that become
    another operator or several, for results that are not proven afterwards.
    """
    # Operators that did not change in between stay
    changed = [
        (node, own, after, body is not model.graph)
        for body, own in bodies(model)
        for node in body.all_nodes()
        if _changes(node, own, after := converted_opset(own, before, opset))
    ]
    if changed:
        infer_shapes(model)
    # Convert the others one by one, so that names, metadata and plugins stay: all of
    # them before the first is replaced, equal ones once
    made, known = dict[ir.Node, ir.Graph](), dict[bytes, onnx.ModelProto]()
    for node, own, after, in_function in changed:
        called, old = f"{node.op_type} {node.name!r}", _single_node_model(node, own)
        if reason := _why_misconverted(node, own):
            return 0, f"{called} stays as it is: {reason}"
        key = old.SerializeToString() + bytes([after])
        try:
            if key not in known:
                known[key] = onnx.version_converter.convert_version(old, after)
        except (onnx.version_converter.ConvertError, RuntimeError) as error:
            reason = " ".join(str(error).split()).rpartition("failed: ")[2]
            return 0, f"{called} cannot be written in {after}: {reason}"
        if one_by_one and _operators(known[key].graph) != _operators(old.graph):
            return 0, f"{called} cannot be written in {after}: it becomes another"
        if not in_function:
            made[node] = ir.serde.deserialize_model(known[key]).graph
        elif not _is_same(known[key].graph, old.graph):
            return 0, f"{called} of a function is another there"
    # Nothing changes unless every node can be converted
    own, names = opset_of(model), edits.value_names(model.graph)
    for node, instead in made.items():
        _replace(node, instead, own, names, by)
    for body, _ in bodies(model):
        for domain in STANDARD:
            if imported := body.opset_imports.get(domain, 0):
                body.opset_imports[domain] = converted_opset(imported, before, opset)
    return len(made) + 1, ""


def _changes(node: ir.Node, own: int, after: int) -> bool:
    """Return whether a standard operator differs between two opsets."""
    # If and Loop only take more types; Scan had an axis of batches
    if has_subgraph(node) and (node.op_type != "Scan" or own >= _SCAN_AS_IS):
        return False
    before = since(node.op_type, own) if is_standard(node) else 0
    return bool(before) and before != since(node.op_type, after)


def _single_node_model(node: ir.Node, opset: int) -> onnx.ModelProto:
    """Build a model of one node without its name; unknown types become float32."""
    inputs = list(dict.fromkeys(value for value in node.inputs if value is not None))
    outputs = _named(node.outputs)
    # Values are named by position: `i0`, `i1`, ..., `o0`, ...
    names = {value: f"i{place}" for place, value in enumerate(inputs)}
    names |= {value: f"o{place}" for place, value in enumerate(outputs)}

    def info(value: ir.Value) -> onnx.ValueInfoProto:
        typed = ir.Value(name=names[value], type=value.type, shape=value.shape)
        typed.type = typed.type or ir.TensorType(ir.DataType.FLOAT)
        return ir.serde.serialize_value(typed)

    # The node itself, without names that two equal nodes differ by
    proto = ir.serde.serialize_node(node)
    proto.name, proto.doc_string = "", ""
    del proto.metadata_props[:]
    for ends, values in ((proto.input, node.inputs), (proto.output, node.outputs)):
        ends[:] = [names.get(value, "") if value else "" for value in values]
    ports = [info(value) for value in inputs], [info(value) for value in outputs]
    body = onnx.helper.make_graph([proto], "alone", *ports)
    imports = [onnx.helper.make_opsetid("", opset)]
    return onnx.helper.make_model(
        body, opset_imports=imports, ir_version=onnx.IR_VERSION
    )


def _is_same(new: onnx.GraphProto, old: onnx.GraphProto) -> bool:
    """Return whether a graph of one node was converted without a change."""
    one, other = ([sorted(map(str, n.attribute)) for n in g.node] for g in (new, old))
    return _operators(new) == _operators(old) and one == other


def _operators(graph: onnx.GraphProto) -> list[tuple[str, ...]]:
    return [(node.op_type, *node.input) for node in graph.node]


def _why_misconverted(node: ir.Node, opset: int) -> str:
    """Return why the converter errs on a node that it takes; "" where it is right."""
    if has_subgraph(node):
        return "Scan of opset 8 has a batch"
    if node.op_type == "Hardmax":
        return "onnx converts it without its axis"
    if node.op_type != "Resize" or opset >= _RESIZE_AS_IS:
        return ""
    scales = _scales(node)
    both = not scales or (max(scales) > 1 and min(scales) < 1)
    return "it enlarges and shrinks" if both else ""


def _scales(node: ir.Node) -> list[float]:
    array = array_of(node.inputs[1]) if len(node.inputs) > 1 else None
    return [] if array is None else [float(scale) for scale in array]


def _replace(
    node: ir.Node, instead: ir.Graph, before: int, names: set[str], by: str
) -> None:
    """Replace a node by the nodes of a small graph, with its names and origin."""
    graph = node.graph
    if not isinstance(graph, ir.Graph):
        raise TypeError(f"{node.name} is not in a graph")
    # Read the inputs of the node, and weights of its graph
    outer = dict.fromkeys(value for value in node.inputs if value is not None)
    for inner, value in zip(list(instead.inputs), outer, strict=True):
        inner.replace_all_uses_with(value)
    for inner in list(instead.initializers.values()):
        if inner.const_value is not None:
            array = inner.const_value.numpy()
            label = f"{node.name}_{inner.name}"
            inner.replace_all_uses_with(edits.add_constant(graph, array, label, names))
    # Move the nodes; the last of the same operator keeps the name
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
                value.name = edits.fresh_name(f"{node.name}_{value.name}", names)
        new.metadata_props.update(node.metadata_props)
        provenance.inherit(new, [node], by=by)
    graph.insert_before(node, nodes)
    for old, new_value in zip(_named(node.outputs), results, strict=True):
        new_value.shape, new_value.type, name = old.shape, old.type, old.name
        edits.replace_value(old, new_value, names)
        new_value.name = name
    edits.remove_node(node)


def _named(values: Sequence[ir.Value]) -> list[ir.Value]:
    return [value for value in values if value.name]
