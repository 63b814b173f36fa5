"""Plugin operators that an exporter left in ONNX's own domain."""

import functools

import onnx
import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.passes.import_normalize.bodies import bodies

PLUGIN_DOMAIN = "me2e.plugin"
"""Where they live in our graphs: the checker and functions work with a domain only."""

ORIGINAL_DOMAIN = "me2e.domain"
"""Node metadata with the domain that a plugin had in the file it came from."""


def isolate(model: ir.Model, by: str) -> int:
    """Move default-domain nodes that ONNX has no operator for; count them.

    Such nodes come from ``OperatorExportTypes.ONNX_FALLTHROUGH`` (BEVFormer_tensorrt,
    DL4AGX uniad-trt: ``MultiScaleDeformableAttnTRT``, ``RotateTRT``, ``InverseTRT``)
    or from a plugin symbolic without a domain (``MSDAPlugin``). A node that calls a
    function of the model is none of them.
    """
    count = 0
    for body in bodies(model):
        moved = [
            node
            for node in body.all_nodes()
            if node.domain == ""
            and not _is_standard(node.op_type)
            and node.op_identifier() not in model.functions
        ]
        for node in moved:
            node.metadata_props.setdefault(ORIGINAL_DOMAIN, node.domain)
            node.domain = PLUGIN_DOMAIN
            provenance.inherit(node, [node], by=by)
        if moved:
            body.opset_imports.setdefault(PLUGIN_DOMAIN, 1)
        count += len(moved)
    return count


@functools.cache
def _is_standard(op_type: str) -> bool:
    return bool(onnx.defs.has(op_type, domain=""))
