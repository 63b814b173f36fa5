"""What onnxruntime's CPU can run, asked without building a session."""

import onnx_ir as ir

from me2e_compress.runtime.native import operators


def can_run(model: ir.Model) -> str | None:
    """Say why the CPU cannot run this graph: None if it knows every operator.

    A known operator may still lack a kernel for its element type; only building a
    :class:`~me2e_compress.runtime.session.Session` finds that.
    """
    known = operators()
    unknown = {
        f"{node.domain or 'ai.onnx'}::{node.op_type}": node
        for graph in (*model.graphs(), *model.functions.values())
        for node in graph
        if node.op_identifier() not in model.functions
        and (_domain(node.domain), node.op_type) not in known
    }
    if not unknown:
        return None
    node = next(iter(unknown.values()))
    return f"onnxruntime has no operator {', '.join(unknown)} (node {node.name!r})"


def _domain(name: str) -> str:
    return "" if name == "ai.onnx" else name
