"""Replace sequences of which only tensors are read by these tensors."""

from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress.graph import (
    array_of,
    graphs_of,
    input_at,
    is_standard,
    opset_of,
    static_shape,
)
from me2e_compress.graph.nodes import integers_of
from me2e_compress.graph.rewrite import put, remove_node, value_names
from me2e_compress.operators import FusedCall


def unpack_sequences(model: ir.Model, by: str) -> int:
    """Replace sequences of a known number of tensors; return how many nodes change.

    All readers must take one tensor at a constant place, the length, or join all
    tensors. TensorRT's parser supports no sequences.

    Given:   s = SplitToSequence(x, [2, 4])  ;  y = SequenceAt(s, 1)

    Result:  a, b = Split(x, [2, 4])         ;  y = Identity(b)
    """
    count, names, opset = 0, value_names(model.graph), opset_of(model)
    for body in graphs_of(model.graph):
        for node in list(body):
            built = node.op_type == "SequenceConstruct"
            if not (built or node.op_type == "SplitToSequence"):
                continue
            # The number of tensors, and what is read of them, must be known
            sequence, lengths = node.outputs[0], _lengths(node)
            readers = list(sequence.consumers())
            if lengths is None or not readers or sequence.is_graph_output():
                continue
            if not all(_unpacks(reader, len(lengths)) for reader in readers):
                continue
            # Split a tensor, and read its parts
            call = FusedCall(node, opset=opset, by=by, names=names)
            tensors = node.inputs if built else _split(call, lengths)
            for reader in readers:
                _rewire(FusedCall(reader, opset=opset, by=by, names=names), tensors)
            remove_node(node)
            count += 1 + len(readers)
    return count


def _lengths(node: ir.Node) -> list[int] | None:
    """Return the lengths of a sequence's tensors along its axis; None if unknown.

    Those of a SequenceConstruct count as 1 each.
    """
    if not is_standard(node):
        return None
    if node.op_type == "SequenceConstruct":
        return [1] * len(node.inputs)
    if array_of(node.inputs[0]) is not None:  # fold-constants splits weights
        return None
    split, shape = input_at(node, 1), static_shape(node.inputs[0])
    size = None if shape is None else shape[node.attributes.get_int("axis", 0)]
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


def _unpacks(reader: ir.Node, count: int) -> bool:
    """Return whether a reader of ``count`` tensors is a plain operator on them."""
    if reader.op_type == "SequenceAt":
        places = integers_of(reader.inputs[1])
        return places is not None and -count <= places[0] < count
    return reader.op_type in ("SequenceLength", "ConcatFromSequence")


def _split(call: FusedCall, lengths: list[int]) -> Sequence[ir.Value]:
    """Write the Split of a SplitToSequence; return the parts."""
    source, axis = call.node.inputs[0], call.node.attributes.get_int("axis", 0)
    inputs, options = [source, call.integers(lengths)], {"axis": axis}
    split = call.add("Split", inputs, options, outputs=len(lengths)).producer()
    assert source is not None
    assert split is not None
    for part in split.outputs:
        part.type = source.type
    return split.outputs


def _rewire(call: FusedCall, tensors: Sequence[ir.Value | None]) -> None:
    """Replace a reader of a sequence by an operator on its ``tensors``."""
    reader, by = call.node, call.by
    if reader.op_type == "SequenceAt":
        (place,) = integers_of(reader.inputs[1]) or (0,)
        put(reader, "Identity", [tensors[place]], by=by)
    elif reader.op_type == "SequenceLength":
        put(reader, "Identity", [call.integers(len(tensors))], by=by)
    else:
        # Insert the new axis into each tensor, then join them along it
        axis = reader.attributes.get_int("axis", 0)
        if reader.attributes.get_int("new_axis", 0):
            axes = call.integers([axis])
            tensors = [call.add("Unsqueeze", [tensor, axes]) for tensor in tensors]
        put(reader, "Concat", tensors, by=by, attributes={"axis": axis})
