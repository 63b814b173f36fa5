"""Graphs: read, write, measure and compare them.

The in-memory form is ``onnx_ir.Model``; these few words are all that the rest of the
package says about it, besides walking nodes and values.
"""

from me2e_compress.graph.digest import digest
from me2e_compress.graph.files import file_bytes, load, save, sha256_of
from me2e_compress.graph.nodes import (
    array_of,
    graphs_of,
    has_subgraph,
    input_at,
    is_standard,
    nodes_of,
    opset_of,
    producer_of,
)
from me2e_compress.graph.shapes import (
    CONVOLUTIONS,
    WEIGHTED,
    bias_of,
    channel_axis,
    infer_shapes,
    rank_of,
    static_shape,
)
from me2e_compress.graph.summary import (
    interface,
    macs,
    node_count,
    size,
)

__all__ = [
    "CONVOLUTIONS",
    "WEIGHTED",
    "array_of",
    "bias_of",
    "channel_axis",
    "digest",
    "file_bytes",
    "graphs_of",
    "has_subgraph",
    "infer_shapes",
    "input_at",
    "interface",
    "is_standard",
    "load",
    "macs",
    "node_count",
    "nodes_of",
    "opset_of",
    "producer_of",
    "rank_of",
    "save",
    "sha256_of",
    "size",
    "static_shape",
]
