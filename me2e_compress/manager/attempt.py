"""One pass on a copy of a graph, and what must hold after it, whatever the pass is.

Its contract is checked, and whether what it touched fits together: a wrong axis shows
without a run.
"""

import dataclasses

import onnx
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import plural
from me2e_compress.base.errors import (
    GraphError,
    Me2eError,
    PassError,
    VerificationError,
)
from me2e_compress.graph import provenance
from me2e_compress.graph.nodes import has_subgraph, is_standard, nodes_in, opset_of
from me2e_compress.graph.provenance import is_same
from me2e_compress.graph.shapes import REFUSALS, infer_node, refined, without_weights
from me2e_compress.graph.validity import refusal
from me2e_compress.passes.base import Context, Pass, PassResult


def attempt(
    current: Pass, model: ir.Model, context: Context, digest: str | None = None
) -> tuple[PassResult, str]:
    """Run a pass on a clone, check its contract, and infer the new shapes.

    Returns what the pass returned and the digest of its graph. Shapes are inferred in
    both graphs; ``digest`` is that of the first, if known.

    Raises:
        VerificationError: the pass misreports its changes, changed the interface, lost
            or invented the provenance of a node, or left an invalid graph.
        PassError: it broke.
        Me2eError: it refused the graph.
    """
    known = graph.digest(model) if digest is None else digest
    try:
        result = current.run(model.clone(), context)
        return result, _check(current, model, result, known)
    except Me2eError:
        raise
    except Exception as cause:  # whatever a pass may raise: chained, never swallowed
        raise PassError(
            f"{current.name} broke: {type(cause).__name__}: {cause}"
        ) from cause


def _check(current: Pass, before: ir.Model, result: PassResult, known: str) -> str:
    """Check the contract, infer shapes, and return the digest of the graph after."""
    name, after = current.name, result.model
    try:
        written = without_weights(after)  # once, to check it and to infer its shapes
    except ir.serde.SerdeError:
        written = None  # the contract says why
    # What it claims, its interface and its nodes
    digest = graph.digest(after)
    changed = digest != known
    if result.changes and not changed:
        raise VerificationError(
            f"{name} claims {plural(result.changes, 'change')} but made none"
        )
    if changed and not result.changes:
        raise VerificationError(f"{name} changed the graph and denies it")
    if not current.changes_interface:
        _check_interface(current, before, result)
    _check_provenance(current, before, after)
    check_valid(name, after, written)
    if not result.changes:
        return digest
    # Shapes, those that the pass touched strictly
    interface = graph.interface(after)
    graph.infer_shapes(after, written=written)
    check_shapes(name, before, after)
    stale = any(has_subgraph(node) for node in after.graph)
    stale |= graph.interface(after) != interface  # an output has a shape now
    return graph.digest(after) if stale else digest


def check_valid(
    name: str, model: ir.Model, written: onnx.ModelProto | None = None
) -> None:
    """Check that a graph is valid ONNX: SSA form, topological order, known operators.

    ``written`` is the graph without its large weights; None writes it.

    Raises:
        VerificationError: it is not; the message names who left it so.
    """
    if reason := refusal(model, written=written):
        raise VerificationError(f"{name} left an invalid graph: {reason}")


def blame_file(name: str, before: ir.Model, error: Me2eError) -> None:
    """Raise a GraphError if a graph was as invalid before a pass; else return."""
    try:
        check_valid(name, before)
    except VerificationError as earlier:
        if str(earlier) == str(error):
            reason = str(earlier).partition(": ")[2] or str(earlier)
            raise GraphError(f"not a valid ONNX graph: {reason}") from earlier


def _check_provenance(current: Pass, before: ir.Model, after: ir.Model) -> None:
    """Raise a VerificationError if nodes have no, wrong or unstamped provenance."""
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
    """Raise a VerificationError if inputs or outputs changed, but for known sizes."""
    inputs, outputs = graph.interface(before)
    # Open dimensions of outputs may have become numbers
    shapes = {value.name: value.shape for value in result.model.graph.outputs}
    expected = tuple(
        dataclasses.replace(
            port, shape=str(refined(value.shape, shapes.get(value.name)))
        )
        for port, value in zip(outputs, before.graph.outputs, strict=True)
        if port.name not in result.removed_outputs
    )
    for old, new in zip((inputs, expected), graph.interface(result.model), strict=True):
        if old != new:
            removed = [port for port in old if port not in new]
            added = [port for port in new if port not in old]
            raise VerificationError(
                f"{current.name} changed the interface: {removed or old} became"
                f" {added or new}"
            )


def check_shapes(name: str, before: ir.Model, after: ir.Model) -> None:
    """Infer strictly what each node gives that a pass made, changed or rewired.

    Where the maker of the same value contradicted itself before the pass, nothing is
    said, nor of nodes with bodies, of plugins, and of nodes whose inputs have no type.
    Shapes are inferred in both graphs.

    Raises:
        VerificationError: a node refuses what it reads, or gives another shape or type
            than the graph says; the message names it.
    """
    old = {
        value.name: node for node in nodes_in(before.graph) for value in node.outputs
    }
    opset = opset_of(after)
    for node in nodes_in(after.graph):
        was = old.get(node.outputs[0].name) if node.outputs else None
        if was is not None and _reads_same(was, node) and is_same(was, node):
            continue
        reason = why_contradictory(node, opset)
        if reason and (was is None or why_contradictory(was, opset_of(before)) is None):
            raise VerificationError(
                f"{name} left node {node.name} ({node.op_type}) that does not fit what"
                f" it reads: {reason}"
            )


def _reads_same(one: ir.Node, other: ir.Node) -> bool:
    """Return whether two nodes read the same names, types, shapes and constants."""
    return len(one.inputs) == len(other.inputs) and all(
        a is b  # both left out
        or (
            a is not None
            and b is not None
            and a.name == b.name
            and a.const_value is b.const_value  # a graph and its copy share it
            and a.dtype == b.dtype
            and a.shape == b.shape
        )
        for a, b in zip(one.inputs, other.inputs, strict=True)
    )


def why_contradictory(node: ir.Node, opset: int) -> str | None:
    """Return why a standard node cannot have the types and shapes that it has, or None.

    None also of nodes with bodies, or with inputs of unknown type.
    """
    typed = all(isinstance(v.type, ir.TensorType) for v in filter(None, node.inputs))
    if not is_standard(node) or has_subgraph(node) or not typed:
        return None
    try:
        inferred = infer_node(node, opset)
    except REFUSALS as error:
        return " ".join(str(error).split())
    for value, (kind, shape) in inferred.items():
        if value.type is not None and kind is not None and value.type != kind:
            return f"{value.name} is {kind}, not {value.type}"
        if value.shape is None or shape is None:
            continue
        same = len(value.shape) == len(shape) and not any(
            isinstance(a, int) and isinstance(b, int) and a != b
            for a, b in zip(value.shape, shape, strict=True)
        )
        if not same:
            return f"{value.name} is {shape}, not {value.shape}"
    return None
