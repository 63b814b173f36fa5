"""Sequences of tensors that a graph only takes apart again, as plain operators."""

from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress.graph import array_of, input_at, is_standard, opset_of
from me2e_compress.graph.nodes import graphs_of, integers_of
from me2e_compress.graph.rewrite import put, remove_node, value_names
from me2e_compress.graph.shapes import static_shape
from me2e_compress.operators import FusedCall


def unpack_sequences(model: ir.Model, by: str) -> int:
    """Write sequences of a known number of tensors as the tensors; count the nodes.

    A sequence goes where all its readers take one tensor out at a constant place, ask
    for its length, or join all. TensorRT's parser takes no sequence.

    Given:   s = SplitToSequence(x, [2, 4])  ;  y = SequenceAt(s, 1)

    Result:  a, b = Split(x, [2, 4])         ;  y = Identity(b)
    """
    count, names, opset = 0, value_names(model.graph), opset_of(model)
    for body in graphs_of(model.graph):
        for node in list(body):
            if node.op_type not in ("SplitToSequence", "SequenceConstruct"):
                continue
            readers = list(node.outputs[0].consumers())
            size = _length(node) if is_standard(node) else None
            if size is None or not readers or node.outputs[0].is_graph_output():
                continue
            if not all(_unpacks(reader, size) for reader in readers):
                continue
            call = FusedCall(node, opset=opset, by=by, names=names)
            tensors = _tensors(node, size, call)
            for reader in readers:
                _read(FusedCall(reader, opset=opset, by=by, names=names), tensors)
            remove_node(node)
            count += 1 + len(readers)
    return count


def _length(node: ir.Node) -> int | None:
    """Return how many tensors a sequence has; None where that is open."""
    if node.op_type == "SequenceConstruct":
        return len(node.inputs)
    lengths = _lengths(node)
    return None if lengths is None else len(lengths)


def _lengths(node: ir.Node) -> list[int] | None:
    """Return the lengths of the parts of a SplitToSequence along its axis."""
    if array_of(node.inputs[0]) is not None:  # a stored weight's are left to folding
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
    # one number is the length of each part but the last
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


def _tensors(node: ir.Node, size: int, call: FusedCall) -> Sequence[ir.Value | None]:
    """Return the tensors of a sequence: those of its making, or of a Split."""
    lengths = _lengths(node) if node.op_type == "SplitToSequence" else None
    source = node.inputs[0]
    if lengths is None or source is None:
        return node.inputs
    inputs, axis = [source, call.integers(lengths)], node.attributes.get_int("axis", 0)
    made = call.add("Split", inputs, {"axis": axis}, outputs=size).producer()
    assert made is not None
    for value in made.outputs:
        value.type = source.type
    return made.outputs


def _read(call: FusedCall, tensors: Sequence[ir.Value | None]) -> None:
    """Rewrite a reader of a sequence to read its tensors."""
    reader, by = call.node, call.by
    if reader.op_type == "SequenceAt":
        (place,) = integers_of(reader.inputs[1]) or (0,)
        put(reader, "Identity", [tensors[place]], by=by)
        return
    if reader.op_type == "SequenceLength":
        put(reader, "Identity", [call.integers(len(tensors))], by=by)
        return
    # a new axis is put into each tensor before they are joined along it
    axis = reader.attributes.get_int("axis", 0)
    if reader.attributes.get_int("new_axis", 0):
        axes = call.integers([axis])
        tensors = [call.add("Unsqueeze", [tensor, axes]) for tensor in tensors]
    put(reader, "Concat", tensors, by=by, attributes={"axis": axis})
