"""Everything in a model that holds nodes."""

from collections.abc import Iterator

import onnx_ir as ir


def bodies(model: ir.Model) -> Iterator[ir.Graph | ir.Function]:
    """Walk the main graph, then the functions; subgraphs are within their nodes."""
    yield model.graph
    yield from model.functions.values()
