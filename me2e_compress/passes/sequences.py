"""Replace sequences whose readers only take tensors out of them."""

from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress.graph import array_of, input_at, is_standard, opset_of
from me2e_compress.graph.nodes import graphs_of, integers_of
from me2e_compress.graph.rewrite import put, remove_node, value_names
from me2e_compress.graph.shapes import static_shape
from me2e_compress.operators import FusedCall


def unpack_sequences(model: ir.Model, by: str) -> int:
    """Replace sequences of a known number of tensors; return the number of nodes.

    All readers must take one tensor at a constant place, the length, or join all
    tensors. TensorRT's parser supports no sequences.

    Given:   s = SplitToSequence(x, [2, 4])  ;  y = SequenceAt(s, 1)

    Result:  a, b = Split(x, [2, 4])         ;  y = Identity(b)
    """
    count, names, opset = 0, value_names(model.graph), opset_of(model)
    for body in graphs_of(model.graph):
        for node in list(body):
            if node.op_type not in ("SplitToSequence", "SequenceConstruct"):
                continue
            readers = list(node.outputs[0].consumers())
            lengths = _lengths(node) if is_standard(node) else None
            if lengths is None or not readers or node.outputs[0].is_graph_output():
                continue
            if not all(_unpacks(reader, len(lengths)) for reader in readers):
                continue
            call = FusedCall(node, opset=opset, by=by, names=names)
            tensors = _tensors(node, lengths, call)
            for reader in readers:
                reading = FusedCall(reader, opset=opset, by=by, names=names)
                _rewrite_reader(reading, tensors)
            remove_node(node)
            count += 1 + len(readers)
    return count


def _lengths(node: ir.Node) -> list[int] | None:
    """Return the lengths of a sequence's tensors along its axis; None if unknown.

    Those of a SequenceConstruct count as 1 each.
    """
    if node.op_type == "SequenceConstruct":
        return [1] * len(node.inputs)
    if array_of(node.inputs[0]) is not None:  # fold-constants splits weights
        return None
    split = input_at(node, 1)
    shape, axis = static_shape(node.inputs[0]), node.attributes.get_int("axis", 0)
    size = None if shape is None else shape[axis]
    if split is None:
        kept = node.attributes.get_int("keepdims", 1)
        return [1] * size if size is not None and kept else None
    lengths, array = integers_of(split), array_of(split)
    if lengths is None or array is None or array.ndim:
        return lengths
    # One number is the length of each part but the last
    (most,) = lengths
    if size is None or most < 1:
        return None
    return [min(most, size - at) for at in range(0, size, most)]


def _unpacks(reader: ir.Node, size: int) -> bool:
    """Return whether a reader of a sequence is a plain operator on its tensors."""
    if reader.op_type == "SequenceAt":
        places = integers_of(reader.inputs[1])
        return places is not None and -size <= places[0] < size
    return reader.op_type in ("SequenceLength", "ConcatFromSequence")


def _tensors(
    node: ir.Node, lengths: list[int], call: FusedCall
) -> Sequence[ir.Value | None]:
    """Return the tensors that a sequence is made of; write the Split of one tensor."""
    source = node.inputs[0]
    if node.op_type == "SequenceConstruct" or source is None:
        return node.inputs
    inputs, axis = [source, call.integers(lengths)], node.attributes.get_int("axis", 0)
    made = call.add("Split", inputs, {"axis": axis}, outputs=len(lengths)).producer()
    assert made is not None
    for value in made.outputs:
        value.type = source.type
    return made.outputs


def _rewrite_reader(call: FusedCall, tensors: Sequence[ir.Value | None]) -> None:
    """Rewrite a reader of a sequence to read its tensors."""
    reader, by = call.node, call.by
    if reader.op_type == "SequenceAt":
        (place,) = integers_of(reader.inputs[1]) or (0,)
        put(reader, "Identity", [tensors[place]], by=by)
        return
    if reader.op_type == "SequenceLength":
        put(reader, "Identity", [call.integers(len(tensors))], by=by)
        return
    # Insert the new axis into each tensor, then join them along it
    axis = reader.attributes.get_int("axis", 0)
    if reader.attributes.get_int("new_axis", 0):
        axes = call.integers([axis])
        tensors = [call.add("Unsqueeze", [tensor, axes]) for tensor in tensors]
    put(reader, "Concat", tensors, by=by, attributes={"axis": axis})
