"""Candidates that are smaller within bodies: of If, Loop and Scan."""

from collections.abc import Iterator

import numpy as np
import onnx
from onnx import numpy_helper


def bodies(graph: onnx.GraphProto) -> Iterator[onnx.GraphProto]:
    """Walk the bodies of a graph, the outermost first."""
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.GRAPH:
                yield attribute.g
                yield from bodies(attribute.g)


def smaller_bodies(model: onnx.ModelProto) -> Iterator[onnx.ModelProto]:
    """Yield the graph with one node less in a body: its readers read an input of it."""
    for which, body in enumerate(bodies(model.graph)):
        for at in reversed(range(len(body.node))):
            for source in dict.fromkeys(body.node[at].input):
                copy = onnx.ModelProto.FromString(model.SerializeToString())
                inner = list(bodies(copy.graph))[which]
                if source and _bypass(inner, at, source):
                    yield copy


def _bypass(body: onnx.GraphProto, at: int, source: str) -> bool:
    """Take out a node of a body; an output of the body cannot be bypassed."""
    gone = set(body.node[at].output)
    if gone & {each.name for each in body.output}:
        return False
    del body.node[at]
    for node in body.node:
        for index, name in enumerate(node.input):
            if name in gone:
                node.input[index] = source
    _drop_dead(body)
    return True


def _drop_dead(body: onnx.GraphProto) -> None:
    needed = {each.name for each in body.output}
    kept = []
    for node in reversed(body.node):
        if needed & set(node.output) or (node.attribute and _has_body(node)):
            kept.append(node)
            needed.update(node.input)
    kept.reverse()
    del body.node[:]
    body.node.extend(kept)
    used = [each for each in body.initializer if each.name in needed]
    if not any(_has_body(node) for node in kept):
        del body.initializer[:]
        body.initializer.extend(used)


def _has_body(node: onnx.NodeProto) -> bool:
    return any(each.type == onnx.AttributeProto.GRAPH for each in node.attribute)


def plain_constants(model: onnx.ModelProto) -> onnx.ModelProto:
    """Write constants as initializers, in short numbers."""
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    for graph in (copy.graph, *bodies(copy.graph)):
        for node in [each for each in graph.node if each.op_type == "Constant"]:
            if node.attribute[0].name == "value":
                tensor = node.attribute[0].t
                tensor.name = node.output[0]
                graph.initializer.append(tensor)
                graph.node.remove(node)
        for tensor in graph.initializer:
            _rounded(tensor)
    return copy


def _rounded(tensor: onnx.TensorProto) -> None:
    array = numpy_helper.to_array(tensor)
    if array.dtype.kind == "f" and np.isfinite(array).all():
        short = np.asarray(np.round(array, 1), array.dtype)
        tensor.CopyFrom(numpy_helper.from_array(short, tensor.name))
