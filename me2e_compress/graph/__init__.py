"""Graphs: read, write, measure, compare and rewrite them.

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
from me2e_compress.graph.names import fresh_name, value_names
from me2e_compress.graph.provenance import Provenance
from me2e_compress.graph.rewrite import (
    add_constant,
    array_of,
    replace_value,
    sort,
    sweep,
)
from me2e_compress.graph.shapes import infer_shapes, open_shape, static_shape
from me2e_compress.graph.size_of import Size, macs, node_count, size

__all__ = [
    "Port",
    "Provenance",
    "Size",
    "add_constant",
    "array_of",
    "digest",
    "file_bytes",
    "fresh_name",
    "infer_shapes",
    "interface",
    "is_external",
    "load",
    "macs",
    "node_count",
    "open_shape",
    "replace_value",
    "save",
    "sha256_of",
    "size",
    "sort",
    "static_shape",
    "sweep",
    "value_names",
]
