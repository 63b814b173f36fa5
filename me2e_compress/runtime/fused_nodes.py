"""Replace the fused nodes of a graph by compiled kernels or by their bodies.

A node is replaced by its body, which calls compiled kernels where there are any, in a
domain of their own. So nothing depends on whether onnxruntime prefers a function of
the file or a registered operator of the same name, and no other library can register
the same name and domain twice, which onnxruntime refuses.
"""

import functools
from collections.abc import Callable, Iterator

import onnx_ir as ir
import onnxruntime as ort
from onnxruntime.capi import (
    onnxruntime_pybind11_state as _native,  # pyright: ignore[reportAttributeAccessIssue]
)

from me2e_compress import graph, operators
from me2e_compress.errors import GraphError, PreconditionError
from me2e_compress.graph import is_standard
from me2e_compress.operators import OWN_DOMAIN, kernels
from me2e_compress.rewrite import value_names
from me2e_compress.runtime.int8_values import read_int8
from me2e_compress.runtime.providers import CPU, Provider

_BY = "session"
_FLOAT_KERNEL = kernels.KERNELS[0].op_type
_COMPILED = {each.op_type: each for each in kernels.KERNELS}


@functools.cache
def known_operators() -> frozenset[tuple[str, str]]:
    """List the known (domain, operator) pairs; ai.onnx is written ``""``."""
    return frozenset(
        ("" if schema.domain == "ai.onnx" else schema.domain, schema.name)
        for schema in _native.get_all_operator_schema()
    )


def unknown_nodes(model: ir.Model) -> Iterator[ir.Node]:
    """Yield the nodes that onnxruntime does not know and that have no body in the file.

    Nodes in the toolkit's own domain are included although they may have a body.
    """
    known = known_operators()
    for where in (*model.graphs(), *model.functions.values()):
        for node in where:
            domain = "" if is_standard(node) else node.domain
            if (domain, node.op_type) in known:
                continue
            if node.op_identifier() not in model.functions or domain == OWN_DOMAIN:
                yield node


def runnable(
    model: ir.Model, options: ort.SessionOptions, provider: Provider
) -> ir.Model:
    """Return a graph whose fused nodes onnxruntime can run with these options.

    The kernels that it needs are registered in ``options``. Kernels are for the CPU;
    operators that a library of the user implements are left to that library. A graph
    without fused nodes is returned itself, others are copied.
    """
    compiled = provider.native == CPU.native and kernels.why_not() is None
    theirs = provider.claims
    made, needed = compiled_or_expanded(model, compiled=compiled, theirs=theirs)
    if not needed:
        return made
    from me2e_compress.operators.kernels import custom_ops  # needs the extra `fast`

    try:
        custom_ops.register(options, needed)
    except (ImportError, OSError):
        made, _ = compiled_or_expanded(model, compiled=False, theirs=theirs)
    return made


def compiled_or_expanded(
    model: ir.Model,
    *,
    compiled: bool,
    theirs: Callable[[str], bool] = lambda op_type: False,
) -> tuple[ir.Model, tuple[kernels.CompiledKernel, ...]]:
    """Replace the fused nodes by kernels, if ``compiled``, or by bodies.

    Operators for which ``theirs`` is true are left as they are. Returns a copy, or the
    graph itself if it has no fused nodes, and the kernels in it.
    """
    names = {node.op_type for node in unknown_nodes(model) if is_fused(node)}
    ours = {name for name in sorted(names) if not theirs(name)}
    if not ours:
        return model, ()
    copy = model.clone()
    # Bodies depend on the types and ranks of their inputs.
    if any(_is_bare(node) for node in unknown_nodes(copy) if node.op_type in ours):
        graph.infer_shapes(copy)  # the file does not say what bodies have to know
    # Expand the fused nodes; bodies may call kernels.
    taken = value_names(copy.graph)
    try:
        for node in list(unknown_nodes(copy)):
            if node.op_type in ours and operators.find(node) is not None:
                _expand(node, copy, taken, compiled)
    except PreconditionError as error:
        raise GraphError(str(error)) from error
    for node in list(unknown_nodes(copy)):
        if compiled and _calls_kernel(node):
            read_int8(node, _opset(node, copy), _names(node, taken))
    # List the kernels, and import their domain.
    needed: dict[str, kernels.CompiledKernel] = {}
    for node in unknown_nodes(copy):
        if node.domain == kernels.DOMAIN and node.graph is not None:
            needed[node.op_type] = _COMPILED[node.op_type]
            node.graph.opset_imports[kernels.DOMAIN] = 1
    return copy, tuple(needed.values())


def is_fused(node: ir.Node) -> bool:
    """Return whether a kernel or a body is known for a node."""
    kernel = node.domain == kernels.DOMAIN and node.op_type in _COMPILED
    return kernel or operators.find(node) is not None


def _is_bare(node: ir.Node) -> bool:
    """Return whether the type or the rank of an input is unknown."""
    return any(
        value is not None and (value.type is None or value.shape is None)
        for value in node.inputs
    )


def _expand(node: ir.Node, model: ir.Model, names: set[str], compiled: bool) -> None:
    """Replace a node by its body, unless the file has one that may run."""
    if node.op_identifier() in model.functions and not compiled:
        return
    opset, taken = _opset(node, model), _names(node, names)
    operators.expand(node, opset=opset, by=_BY, names=taken, compiled=compiled)


def _calls_kernel(node: ir.Node) -> bool:
    return node.domain == kernels.DOMAIN and node.op_type == _FLOAT_KERNEL


def _opset(node: ir.Node, model: ir.Model) -> int:
    assert node.graph is not None
    return node.graph.opset_imports.get("", model.opset_imports.get("", 1))


def _names(node: ir.Node, names: set[str]) -> set[str] | None:
    return names if isinstance(node.graph, ir.Graph) else None
