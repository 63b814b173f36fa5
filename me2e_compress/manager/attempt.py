"""One pass on a copy of a graph: a result, or the error.

Its contract is checked, and whether what it touched fits together: a wrong axis shows
without a run.
"""

import dataclasses

import onnx
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.display import counted
from me2e_compress.errors import GraphError, Me2eError, PassError, VerificationError
from me2e_compress.graph import provenance
from me2e_compress.graph.nodes import has_subgraph, is_standard, nodes_in, opset_of
from me2e_compress.graph.provenance import is_same
from me2e_compress.graph.shapes import REFUSALS, infer_node, refined, without_weights
from me2e_compress.graph.validity import refusal
from me2e_compress.passes.base import Context, Pass, PassResult

# What must hold after every pass, whatever the pass is.


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


@dataclasses.dataclass(frozen=True)
class Checked:
    """What a pass returned, found to keep its contract.

    Attributes:
        result: the graph, shapes inferred, and what to say about it.
        digest: of the graph.
    """

    result: PassResult
    digest: str


def attempt(
    current: Pass, model: ir.Model, context: Context, digest: str | None = None
) -> Checked | Me2eError:
    """Run a pass on a clone and check its contract; failures are values here.

    Args:
        current: the pass.
        model: the graph, shapes inferred; it stays as it is.
        context: what the pass may ask for.
        digest: of the graph, if that is known.
    """
    known = graph.digest(model) if digest is None else digest
    try:
        result = current.run(model.clone(), context)
        written = _written(result.model)  # once, to check it and to infer its shapes
        after = check(current, model, result, known, written)
        if result.changes:
            after = _infer(current, model, result.model, after, written)
        return Checked(result, after)
    except Me2eError as error:
        return error
    except Exception as cause:  # whatever a pass may raise: chained, never swallowed
        broken = PassError(f"{current.name} broke: {type(cause).__name__}: {cause}")
        broken.__cause__ = cause
        return broken


def _infer(
    current: Pass,
    before: ir.Model,
    after: ir.Model,
    digest: str,
    written: onnx.ModelProto | None,
) -> str:
    """Infer shapes, those that the pass touched strictly; return the digest then."""
    interface = graph.interface(after)
    graph.infer_shapes(after, written=written)
    check_shapes(current.name, before, after)
    stale = any(has_subgraph(node) for node in after.graph)
    stale |= graph.interface(after) != interface  # an output has a shape now
    return graph.digest(after) if stale else digest


def _written(model: ir.Model) -> onnx.ModelProto | None:
    try:
        return without_weights(model)
    except ir.serde.SerdeError:
        return None  # the contract says why


def check_shapes(name: str, before: ir.Model, after: ir.Model) -> None:
    """Infer strictly what each node gives that a pass made, changed or fed anew.

    Where the maker of the same value contradicted itself before the pass, nothing is
    said, nor of nodes with bodies, of plugins, and of nodes whose inputs have no type.

    Args:
        name: of the pass.
        before: the graph that it was given, shapes inferred.
        after: the graph that it returned, shapes inferred.

    Raises:
        VerificationError: a node refuses what it reads, or gives another shape or type
            than the graph says; the message names it.
    """
    old = {each.name: node for node in nodes_in(before.graph) for each in node.outputs}
    opset = opset_of(after)
    for node in nodes_in(after.graph):
        was = old.get(node.outputs[0].name) if node.outputs else None
        if was is not None and _reads_alike(was, node) and is_same(was, node):
            continue
        reason = contradiction(node, opset)
        if reason and (was is None or contradiction(was, opset_of(before)) is None):
            raise VerificationError(
                f"{name} left node {node.name} ({node.op_type}) that does not fit what"
                f" it reads: {reason}"
            )


def _reads_alike(one: ir.Node, other: ir.Node) -> bool:
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


def contradiction(node: ir.Node, opset: int) -> str | None:
    """Return why a node of ONNX's own cannot give what the graph says it gives.

    Args:
        node: whose inputs and outputs say what types and shapes they have.
        opset: the version of ONNX's own operators.
    """
    if not is_standard(node) or has_subgraph(node):
        return None
    if not all(
        isinstance(each.type, ir.TensorType) for each in filter(None, node.inputs)
    ):
        return None
    try:
        found = infer_node(node, opset)
    except REFUSALS as error:
        return " ".join(str(error).split())
    for value in node.outputs:
        kind = found.get(value.name or "")
        if kind is not None and (reason := _conflict(value, kind)):
            return reason
    return None


def _conflict(value: ir.Value, kind: onnx.TypeProto) -> str | None:
    """Return how what a value is said to be differs from what was inferred."""
    shape = ir.serde.deserialize_type_proto_for_shape(kind)
    found = ir.serde.deserialize_type_proto_for_type(kind)
    if value.type is not None and found is not None and value.type != found:
        return f"{value.name} is {found}, not {value.type}"
    if value.shape is None or shape is None:
        return None
    same = len(value.shape) == len(shape) and not any(
        isinstance(a, int) and isinstance(b, int) and a != b
        for a, b in zip(value.shape, shape, strict=True)
    )
    return None if same else f"{value.name} is {shape}, not {value.shape}"
