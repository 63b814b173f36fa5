"""Graphs: read, write, measure and compare them.

The in-memory form is ``onnx_ir.Model``; these few words are all that the rest of the
package says about it, besides walking nodes and values.
"""

from me2e_compress.graph.digest import digest
from me2e_compress.graph.files import (
    file_bytes,
    is_external,
    load,
    save,
    sha256_of,
)
from me2e_compress.graph.interface import Port, interface
from me2e_compress.graph.nodes import (
    array_of,
    graphs_of,
    has_subgraph,
    is_standard,
)
from me2e_compress.graph.provenance import Provenance
from me2e_compress.graph.shapes import infer_shapes, open_shape, static_shape
from me2e_compress.graph.size_of import Size, macs, node_count, size

__all__ = [
    "Port",
    "Provenance",
    "Size",
    "array_of",
    "digest",
    "file_bytes",
    "graphs_of",
    "has_subgraph",
    "infer_shapes",
    "interface",
    "is_external",
    "is_standard",
    "load",
    "macs",
    "node_count",
    "open_shape",
    "save",
    "sha256_of",
    "size",
    "static_shape",
]
