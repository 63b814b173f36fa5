"""What must hold after every pass, whatever the pass is."""

import dataclasses

import onnx
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.display import counted
from me2e_compress.errors import GraphError, Me2eError, VerificationError
from me2e_compress.graph import provenance
from me2e_compress.graph.shapes import refined
from me2e_compress.graph.validity import refusal
from me2e_compress.passes.base import Pass, PassResult


def check(
    current: Pass,
    before: ir.Model,
    result: PassResult,
    known: str,
    written: onnx.ModelProto | None = None,
) -> str:
    """Check that a pass kept its contract.

    Args:
        current: the pass.
        before: the graph that a copy of was given to it; the interface is its own.
        result: what the pass returned.
        known: the digest of the graph before.
        written: the graph after without its large weights; None writes it.

    Returns:
        The digest of the graph after.

    Raises:
        VerificationError: the pass lied about having changed something, changed the
            interface, lost or made up the past of a node, or left an invalid graph.
    """
    after = graph.digest(result.model)
    _check_claim(current, result, changed=after != known)
    if not current.changes_interface:
        _check_interface(current, before, result)
    _check_provenance(current, before, result.model)
    check_valid(current.name, result.model, written)
    return after


def check_valid(
    name: str, model: ir.Model, written: onnx.ModelProto | None = None
) -> None:
    """Check that a graph is valid ONNX, in SSA form and topological order.

    Args:
        name: of who made it.
        model: the graph.
        written: the graph without its large weights; None writes it.

    Raises:
        VerificationError: it is not; the message names who left it so.
    """
    _check_order(name, model.graph)
    if reason := refusal(model, written=written):
        raise VerificationError(f"{name} left an invalid graph: {reason}")


def blame_file(name: str, before: ir.Model, found: Me2eError) -> None:
    """Refuse a graph that was as invalid before the pass that left it invalid.

    Raises:
        GraphError: it was; no pass is to blame.
    """
    try:
        check_valid(name, before)
    except VerificationError as error:
        if str(error) == str(found):
            reason = str(error).partition(": ")[2] or str(error)
            raise GraphError(f"not a valid ONNX graph: {reason}") from error


def _check_claim(current: Pass, result: PassResult, *, changed: bool) -> None:
    if result.changes and not changed:
        raise VerificationError(
            f"{current.name} claims {counted(result.changes, 'change')} but made none"
        )
    if changed and not result.changes:
        raise VerificationError(f"{current.name} changed the graph and denies it")


def _check_provenance(current: Pass, before: ir.Model, after: ir.Model) -> None:
    if lost := provenance.missing(after):
        raise VerificationError(
            f"{current.name} lost where {len(lost)} nodes come from, {lost[0]} first"
        )
    if unstamped := provenance.unstamped(before, after, current.name):
        raise VerificationError(
            f"{current.name} made or changed {len(unstamped)} nodes that do not name"
            f" it among their passes, {unstamped[0]} first"
        )
    if foreign := provenance.foreign(before, after):
        raise VerificationError(
            f"{current.name} says that {len(foreign)} nodes stand for nodes that never"
            f" were, {foreign[0]} first"
        )


def _check_interface(current: Pass, before: ir.Model, result: PassResult) -> None:
    inputs, _ = graph.interface(before)
    kept = tuple(
        port
        for port in _refined_outputs(before, result.model)
        if port.name not in result.removed_outputs
    )
    after = graph.interface(result.model)
    for old, new in zip((inputs, kept), after, strict=True):
        if old != new:
            gone = [port for port in old if port not in new]
            come = [port for port in new if port not in old]
            raise VerificationError(
                f"{current.name} changed the interface: {gone or old} became"
                f" {come or new}"
            )


def _refined_outputs(before: ir.Model, after: ir.Model) -> tuple[graph.Port, ...]:
    """List the outputs before, open dimensions replaced by numbers found since."""
    found = {value.name: value.shape for value in after.graph.outputs}
    return tuple(
        dataclasses.replace(
            port, shape=str(refined(value.shape, found.get(value.name)))
        )
        for port, value in zip(
            graph.interface(before)[1], before.graph.outputs, strict=True
        )
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
