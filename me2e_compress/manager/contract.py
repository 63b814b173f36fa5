"""What must hold after every pass, whatever the pass is."""

import onnx
import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress import graph
from me2e_compress.errors import VerificationError
from me2e_compress.graph import provenance
from me2e_compress.passes.base import Pass, PassResult


def check(current: Pass, before: ir.Model, result: PassResult) -> None:
    """Hold a pass to its contract; the interface before is the graph's own.

    Raises:
        VerificationError: the pass lied about having changed something, changed the
            interface, lost the past of a node, or left an invalid graph.
    """
    _check_claim(current, before, result)
    if not current.changes_interface:
        _check_interface(current, before, result)
    if lost := provenance.missing(result.model):
        raise VerificationError(
            f"{current.name} lost where {len(lost)} nodes come from, {lost[0]} first"
        )
    check_valid(current.name, result.model)


def check_valid(name: str, model: ir.Model) -> None:
    """Check that a graph is valid ONNX, in SSA form and topological order.

    Raises:
        VerificationError: it is not; the message names who left it so.
    """
    _check_order(name, model.graph)
    try:
        common.CheckerPass()(model)
    except (onnx.checker.ValidationError, ir.passes.PassError) as error:
        reason = str(error.__cause__ or error).strip().splitlines()[0]
        raise VerificationError(f"{name} left an invalid graph: {reason}") from error


def _check_claim(current: Pass, before: ir.Model, result: PassResult) -> None:
    same = graph.digest(before) == graph.digest(result.model)
    if same and result.changes:
        raise VerificationError(
            f"{current.name} claims {result.changes} changes but made none"
        )
    if not same and not result.changes:
        raise VerificationError(f"{current.name} changed the graph and denies it")


def _check_interface(current: Pass, before: ir.Model, result: PassResult) -> None:
    inputs, outputs = graph.interface(before)
    kept = tuple(port for port in outputs if port.name not in result.removed_outputs)
    after = graph.interface(result.model)
    for old, new in zip((inputs, kept), after, strict=True):
        if old != new:
            gone = [port for port in old if port not in new]
            come = [port for port in new if port not in old]
            raise VerificationError(
                f"{current.name} changed the interface: {gone or old} became"
                f" {come or new}"
            )


def _check_order(name: str, body: ir.Graph) -> None:
    known = {id(value) for value in (*body.inputs, *body.initializers.values())}
    names = {value.name for value in (*body.inputs, *body.initializers.values())}
    for node in body:
        for value in node.inputs:
            if value is not None and value.graph is body and id(value) not in known:
                raise VerificationError(
                    f"{name} left node {node.name} before the maker of {value.name}"
                )
        for value in node.outputs:
            if value.name and value.name in names:
                raise VerificationError(f"{name} left two values named {value.name}")
            known.add(id(value))
            names.add(value.name)
