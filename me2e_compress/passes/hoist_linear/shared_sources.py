"""Merge linear layers that read the same rows into one layer and a Split.

Fewer nodes, but the same multiply-accumulates and a copy of the result. On
onnxruntime's CPU (1.31, two cores of an AMD Zen 5, ``python -m
benchmarks.bench_hoisting``), relative to three products of queries, keys and values:
0.8 to 0.9 for 20 rows of 64, 1.0 for 150 rows, 1.0 to 1.1 for 300 x 256, at least 1.2
for 2,000 x 256; sampling offsets and weights of 10,000 rows take 1.1. In int8 all
columns would share one range.
"""

import itertools

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import provenance, static_shape
from me2e_compress.passes.hoist_linear.linear_layers import LinearLayer, layer_at
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter
from me2e_compress.rewrite import fresh_name, inherit, sole_reader

SPLIT_INPUT_OPSET = 13
"""The opset from which the sizes of a Split are an input."""


def merge_layers(rewriter: Rewriter, opset: int) -> int:
    """Merge the layers of one module that read the same value, and count them."""
    groups: dict[tuple[int, str], list[LinearLayer]] = {}
    for node in rewriter.graph:
        layer = layer_at(node)
        if layer is not None and sole_reader(layer.weight) is not None:
            key = (id(layer.source), provenance.module_of(node))
            groups.setdefault(key, []).append(layer)
    shared = [group for group in groups.values() if len(group) > 1]
    for group in shared:
        _merge(group, rewriter, opset)
    return sum(map(len, shared))


def _merge(group: list[LinearLayer], rewriter: Rewriter, opset: int) -> None:
    first = group[0].product.outputs[0]
    assert first.dtype is not None
    lead, kind = (static_shape(first) or ())[:-1], first.dtype.numpy()
    # One product with the concatenated matrices
    sources = tuple(itertools.chain(*(layer.nodes for layer in group)))
    matrices = [layer.matrix() for layer in group]
    widths = [matrix.shape[1] for matrix in matrices]
    name = f"{group[0].weight.name}_merged"
    weight = rewriter.store(np.concatenate(matrices, axis=1).astype(kind), name)
    shape = (*lead, sum(widths))
    value = rewriter.write(
        "MatMul", [group[0].source, weight], [], shape, sources=sources, like=first
    )
    # One sum with the concatenated biases
    biases = [layer.bias() for layer in group]
    if any(bias is not None for bias in biases):
        parts = [
            np.zeros(width) if bias is None else bias
            for bias, width in zip(biases, widths, strict=True)
        ]
        vector = rewriter.store(np.concatenate(parts).astype(kind), f"{name}_bias")
        value = rewriter.write(
            "Add", [value, vector], [], shape, sources=sources, like=first
        )
    # Split the columns again
    split = _split(value, widths, first, rewriter, opset)
    inherit(split, sources, by=rewriter.by)
    for layer, column in zip(group, split.outputs, strict=True):
        column.type = first.type
        column.shape = ir.Shape((*lead, layer.matrix().shape[1]))
        rewriter.swap(layer.result, column)


def _split(
    value: ir.Value, widths: list[int], first: ir.Value, rewriter: Rewriter, opset: int
) -> ir.Node:
    place = first.producer()
    assert place is not None
    name = fresh_name(f"{place.name}_Split", rewriter.names)
    inputs, attributes = [value], [ir.AttrInt64("axis", -1)]
    if opset < SPLIT_INPUT_OPSET:
        attributes.append(ir.AttrInt64s("split", widths))
    else:
        inputs.append(rewriter.store(np.array(widths, np.int64), f"{name}_sizes"))
    split = ir.Node("", "Split", inputs, attributes, num_outputs=len(widths), name=name)
    for index, column in enumerate(split.outputs):
        column.name = fresh_name(f"{name}_{index}", rewriter.names)
    rewriter.graph.insert_before(place, split)
    return split
