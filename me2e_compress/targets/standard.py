"""What any target asks of an ONNX graph."""

from collections.abc import Iterable, Iterator

import onnx
import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress.targets.finding import LintFinding, error, is_standard


def valid(model: ir.Model) -> Iterator[LintFinding]:
    """Ask ONNX's checker."""
    try:
        common.CheckerPass()(model)
    except (onnx.checker.ValidationError, ir.passes.PassError) as failure:
        reason = str(failure.__cause__ or failure).strip().splitlines()[0]
        yield error("onnx", None, f"not valid ONNX: {reason}")


def of_opset(model: ir.Model) -> Iterator[LintFinding]:
    """Find operators that are younger than the graph says it is.

    TensorRT's parser does not look at the opset; onnxruntime does.
    """
    main = model.opset_imports.get("", 0)
    yield from _too_young(model.graph.all_nodes(), main)
    for function in model.functions.values():
        own = function.opset_imports.get("", main)
        yield from _too_young(function.all_nodes(), own)


def _too_young(nodes: Iterable[ir.Node], opset: int) -> Iterator[LintFinding]:
    for node in nodes:
        if not is_standard(node) or not onnx.defs.has(node.op_type, domain=""):
            continue
        if not onnx.defs.has(node.op_type, max_inclusive_version=opset, domain=""):
            since = _first_version(node.op_type)
            yield error(
                "operator-of-opset",
                node,
                f"{node.op_type} came with opset {since}, the graph is of {opset}",
            )


def _first_version(op_type: str) -> int:
    return min(
        schema.since_version
        for schema in onnx.defs.get_all_schemas_with_history()
        if schema.name == op_type and schema.domain == ""
    )
