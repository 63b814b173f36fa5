"""Replace a fused node by its body, or by the same call in another dialect."""

import contextlib
import dataclasses
from collections.abc import Iterable

import onnx_ir as ir

from me2e_compress.base.errors import GraphError, PreconditionError
from me2e_compress.graph import opset_of
from me2e_compress.graph.nodes import STANDARD, bodies, is_read, nodes_in
from me2e_compress.graph.rewrite import value_names
from me2e_compress.graph.rewrite.raise_opset import raise_opset
from me2e_compress.graph.shapes import open_shape
from me2e_compress.graph.validity import ORIGINAL_DOMAIN, PLUGIN_DOMAIN
from me2e_compress.operators.base import Operator, find
from me2e_compress.operators.call import Attributes, FusedCall, names_in
from me2e_compress.operators.dialect import (
    OWN_DOMAIN,
    PLUGIN_ATTRIBUTES,
    Dialect,
    Values,
)


@dataclasses.dataclass(frozen=True)
class FusedNode:
    """A fused node of a model; ``names`` are those of all values around it."""

    node: ir.Node
    operator: Operator
    dialect: Dialect
    opset: int
    names: set[str]


def fused_nodes(model: ir.Model) -> list[FusedNode]:
    """Return the fused nodes of a graph, of its bodies and of its functions."""
    names = value_names(model.graph)
    names.update(node.name or "" for node in nodes_in(model.graph))
    names_of: dict[ir.Graph | ir.Function, set[str]] = {model.graph: names}
    names_of |= {function: names_in(function) for function in model.functions.values()}
    return [
        FusedNode(node, *call, opset_of(body), names)
        for body, names in names_of.items()
        for node in nodes_in(body)
        if (call := find(node)) is not None
    ]


def raise_for_bodies(
    model: ir.Model, nodes: Iterable[ir.Node], by: str
) -> tuple[str, ...]:
    """Raise a graph to the opset that the bodies of fused nodes need.

    Returns notes for the report: one if the opset changed, else none.

    Raises:
        PreconditionError: the graph cannot be written in it; nothing changed.
    """
    # The newest opset that a body needs and its graph has not
    wanted = 0
    for node in nodes:
        row, where = find(node), node.graph
        least = 0 if row is None else row[0].opset
        opset = 0 if where is None else where.opset_imports.get("", opset_of(model))
        wanted = max(wanted, least if opset < least else 0)
    if not wanted:
        return ()
    _, reason = raise_opset(model, wanted, by)
    if reason:
        raise PreconditionError(f"{by} needs opset {wanted} or later: {reason}")
    return (f"the graph is of opset {wanted} now: bodies need it",)


def import_domains(model: ir.Model) -> None:
    """Import exactly the used domains; constants of functions become Constant nodes."""
    for body, _ in bodies(model):
        # Drop unused imports and add missing ones
        used = {node.domain for node in nodes_in(body)}
        for domain in body.opset_imports.keys() - used - {*STANDARD}:
            del body.opset_imports[domain]
        for domain in sorted(used - {*STANDARD, *body.opset_imports}):
            body.opset_imports[domain] = 1
    for function in model.functions.values():
        write_constant_nodes(function)


def expand(
    node: ir.Node,
    *,
    opset: int,
    by: str,
    names: set[str] | None = None,
    compiled: bool = False,
    known: tuple[Operator, Dialect] | None = None,
) -> None:
    """Replace a fused node by standard operators; its output keeps its name.

    Args:
        node: recognised by :func:`~me2e_compress.operators.find`; it is removed.
        opset: of the standard operators; see :func:`raise_for_bodies`.
        by: the name of the pass, for the provenance.
        names: of all values of the model, where many nodes are expanded.
        compiled: allow calls of compiled kernels, which a session must then register.
        known: operator and dialect of the node, if it is not a registered one.

    Raises:
        PreconditionError: attributes or inputs that do not fit the dialect.
        GraphError: the node is not a fused operator.
    """
    operator, dialect = _operator_of(node, known)
    if opset < operator.opset:
        raise PreconditionError(
            f"{by} needs opset {operator.opset} or later; the graph is of {opset}"
        )
    # Own form, body, and back to the layout of the dialect
    call = FusedCall(node, opset=opset, by=by, names=names, compiled=compiled)
    if compiled:
        dialect.check(node)
        result = dialect.by_kernel(call, tuple(node.inputs))
        if result is not None:
            call.put(result)
            return
    inputs, attributes = _own_call(call, dialect)
    result = operator.body(call, inputs, attributes)
    call.put(dialect.result_from_own(call, result, inputs))


def translate(
    node: ir.Node,
    to: Dialect,
    *,
    opset: int,
    by: str,
    names: set[str] | None = None,
    known: tuple[Operator, Dialect] | None = None,
) -> None:
    """Replace a fused node by the same call in the dialect ``to`` of its operator.

    If that has no domain, the node moves to ``me2e.plugin`` and its metadata record it,
    as with import-normalize. For arguments and errors see :func:`expand`; a dialect
    that cannot express the call is a PreconditionError.
    """
    # Bring the call into the own form
    operator, dialect = _operator_of(node, known)
    call = FusedCall(node, opset=opset, by=by, names=names)
    own, attributes = _own_call(call, dialect)
    # Write it in the new dialect
    inputs = to.inputs_from_own(call, own, attributes)
    options = dict(to.options_from_own(attributes))
    if to.domain != OWN_DOMAIN:
        options |= zip(PLUGIN_ATTRIBUTES, (to.version, to.namespace), strict=True)
    result = call.add(to.op_type, inputs, options, domain=to.domain)
    plugin = result.producer()
    assert plugin is not None
    if not to.domain:
        plugin.domain = PLUGIN_DOMAIN
        plugin.metadata_props[ORIGINAL_DOMAIN] = ""
    set_output(plugin, operator, to)
    # Convert the output back to the old layout
    result = to.result_to_own(call, result, own)
    call.put(dialect.result_from_own(call, result, own))


def set_output(node: ir.Node, operator: Operator, dialect: Dialect) -> bool:
    """Write the type and shape of a fused node's output; return whether any is new."""
    shapes = dialect.shapes_to_own([open_shape(value) for value in node.inputs])
    attributes = dialect.options_to_own(dialect.attributes_of(node))
    # Merge the inferred dimensions into the known ones
    shape = operator.output_shape(shapes, attributes)
    result, known = node.outputs[0], False
    if shape is not None and None in (inferred := open_shape(result) or (None,)):
        own = dialect.shape_from_own(shape)
        merged = [b if a is None else a for a, b in zip(inferred, own, strict=False)]
        dims = own if result.shape is None else merged
        if len(dims) == len(own) and (result.shape is None or tuple(dims) != inferred):
            result.shape, known = ir.Shape(list(dims)), True
    # The type follows from the inputs
    kind = dialect.output_type(node.inputs)
    if result.type is None and kind is not None:
        result.type, known = ir.TensorType(kind), True
    return known


def write_constant_nodes(function: ir.Function) -> None:
    """Replace a function's initializers, which no file can hold, by Constant nodes."""
    graph = function.graph
    for name, value in list(graph.initializers.items()):
        tensor = value.const_value
        node = ir.node("Constant", [], {"value": tensor}, num_outputs=1)
        result = node.outputs[0]
        node.name = result.name = name
        result.type, result.shape, result.const_value = value.type, value.shape, tensor
        del graph.initializers[name]
        value.replace_all_uses_with(result)
        graph.insert_before(graph[0], node)


def _operator_of(
    node: ir.Node, known: tuple[Operator, Dialect] | None
) -> tuple[Operator, Dialect]:
    """Return a node's operator and dialect, or raise as :func:`expand` does."""
    match = known or find(node)
    if match is None:
        raise GraphError(f"node {node.name}: {node.op_type} is no fused operator")
    if extra := [value.name for value in node.outputs[1:] if is_read(value)]:
        raise PreconditionError(f"node {node.name}: it has no output {extra[0]}")
    return match


def _own_call(call: FusedCall, dialect: Dialect) -> tuple[Values, Attributes]:
    """Write a call's inputs in the own form; return them with its attributes."""
    dialect.check(call.node)
    attributes = dialect.attributes_of(call.node)
    inputs = dialect.inputs_to_own(call, tuple(call.node.inputs), attributes)
    return inputs, dialect.options_to_own(attributes)


class DialectKnowledge:
    """See :class:`me2e_compress.graph.shapes.PluginKnowledge`.

    A node that its dialect refuses counts as unknown.
    """

    def infer(self, node: ir.Node) -> bool:
        """Write the type and shape of a node's output; return whether any is new."""
        call = find(node)
        with contextlib.suppress(PreconditionError):
            if call is not None:
                call[1].check(node)
                return set_output(node, *call)
        return False

    def macs(self, node: ir.Node) -> int | None:
        """Count a node's multiply-accumulates, if known."""
        call = find(node)
        with contextlib.suppress(PreconditionError):
            return None if call is None else call[0].cost(node, call[1]).macs
        return None
