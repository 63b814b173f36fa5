"""Whether a graph can run here, and how its fused nodes are made to.

A fused node is replaced by its body, which calls compiled kernels where there are any,
in a domain of their own. So nothing depends on whether onnxruntime prefers a function
of the file or a registered operator of the same name, and no other library can register
the same name and domain twice, which onnxruntime refuses.
"""

import functools
import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import onnx_ir as ir
import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as _native  # pyright: ignore[reportAttributeAccessIssue]

from me2e_compress import graph, operators
from me2e_compress.base.errors import GraphError, PreconditionError
from me2e_compress.graph.nodes import (
    array_of,
    bodies_of,
    input_at,
    is_standard,
    unrenamed,
)
from me2e_compress.graph.rewrite import add_constant, value_names
from me2e_compress.operators import OWN_DOMAIN, kernels
from me2e_compress.runtime.int8_values import use_int8_kernel, write_float_products
from me2e_compress.runtime.providers import CPU, Provider

QDQ_OFF = "session.disable_quant_qdq"
"""The entry that keeps pairs and their layers as they are: float kernels then answer
what the nodes say. onnxruntime's own int8 (1.31) answers otherwise where it

* writes a float bias as int32 in steps of input times weight, and it does not fit;
* takes a Gemm's int32 bias in those steps, whatever its own scale is;
* quantizes a float weight between pairs, with one scale in all;
* adds uint8 by int8 products in 16 bits, on processors without VNNI."""

NO_OVERFLOW = "session.x64quantprecision"
"""The entry with which a processor without VNNI adds products of int8 in 32 bits: up to
1.2 times as slow, and 35 dB instead of 13 on a small transformer. Others do not ignore
it: a Xeon with AMX takes 3 to 5 times as long for a convolution."""

_SUM_MODEL = f"""<ir_version: 9, opset_import: ["" : 17]>
m (uint8[1,64] x) => (int32[1,16] y)
<int8[64,16] w = {{{",".join(["127"] * 1024)}}}> {{ y = MatMulInteger(x, w) }}"""


@functools.cache
def int8_entry() -> tuple[str, str]:
    """Return :data:`NO_OVERFLOW` and its value, "1" where a sum overflows here."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    model = ir.to_proto(ir.from_onnx_text(_SUM_MODEL)).SerializeToString()
    session = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    sums = np.asarray(session.run(None, {"x": np.full((1, 64), 255, np.uint8)})[0])
    return NO_OVERFLOW, "0" if (sums == 64 * 255 * 127).all() else "1"


_BY = "session"
_AS_WRITTEN = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
_FLOAT_KERNELS = ("MultiScaleDeformableAttention", "RawDeformableAttention")
_COMPILED = {kernel.op_type: kernel for kernel in kernels.KERNELS}


@functools.cache
def known_operators() -> frozenset[tuple[str, str]]:
    """List the known (domain, operator) pairs; ai.onnx is written ``""``."""
    return frozenset(
        ("" if schema.domain == "ai.onnx" else schema.domain, schema.name)
        for schema in _native.get_all_operator_schema()
    )


def unknown_nodes(model: ir.Model) -> Iterator[ir.Node]:
    """Yield the nodes that onnxruntime does not know and the file has no body of."""
    known = known_operators()
    for graph_or_function in (*model.graphs(), *model.functions.values()):
        for node in graph_or_function:
            domain = "" if is_standard(node) else node.domain
            if (domain, node.op_type) in known:
                continue
            # Own nodes are included even with a body, but those of older versions
            known_here = domain == OWN_DOMAIN and is_fused(node)
            if node.op_identifier() not in model.functions or known_here:
                yield node


def make_runnable(
    model: ir.Model, options: ort.SessionOptions, provider: Provider
) -> ir.Model:
    """Return a graph whose fused nodes onnxruntime can run with these options.

    A graph without fused nodes is returned itself, others are copied.
    """
    # Kernels are for the CPU; operators that a library of the user implements are left
    # to that library
    compiled = provider.native == CPU.native and kernels.why_not() is None
    in_library = provider.claims
    prepared, needed = replace_fused(model, compiled=compiled, in_library=in_library)
    # The kernels of the graph are registered in the options
    if needed:
        from me2e_compress.operators.kernels import custom_ops  # needs the extra `fast`

        try:
            custom_ops.register(options, needed)
        except (ImportError, OSError):
            prepared, _ = replace_fused(model, compiled=False, in_library=in_library)
    if provider.native != CPU.native:
        return prepared
    # May onnxruntime make int8 kernels of pairs?
    try:
        as_written = str(options.get_session_config_entry(QDQ_OFF)) == "1"
    except RuntimeError:  # it is not set
        as_written = False
    if as_written or options.graph_optimization_level == _AS_WRITTEN:
        return prepared
    # Files without fused nodes are opened unread, so their products stay, too.
    if prepared is not model:
        write_float_products(prepared.graph)
    return _unshare_weights(prepared)


def _unshare_weights(model: ir.Model) -> ir.Model:
    """Return a graph in which no two nodes read one int8 weight or zero point."""
    # With `NO_OVERFLOW` onnxruntime (1.31) writes each as uint8 under one new name, and
    # refuses the second
    if not any(_shared_weights(model)):
        return model
    copy = model.clone()
    names = value_names(copy.graph)
    for node, index in list(_shared_weights(copy)):
        value = node.inputs[index]
        assert value is not None
        assert value.const_value is not None
        array, name = value.const_value.numpy(), str(value.name)
        node.replace_input_with(index, add_constant(copy.graph, array, name, names))
    return copy


def _shared_weights(model: ir.Model) -> Iterator[tuple[ir.Node, int]]:
    """Yield nodes and input indices of int8 weights and zero points read twice."""
    for node in model.graph:
        indices = _WEIGHT_INPUTS.get(node.op_type, ())
        weight = input_at(node, indices[0]) if indices else None
        if weight is None or weight.dtype != ir.DataType.INT8:
            continue
        if not weight.is_initializer():
            continue
        for index in indices:
            value = input_at(node, index)
            if value is not None and value.const_value and len(value.uses()) > 1:
                yield node, index


# Input indices of an int8 weight and its zero point
_WEIGHT_INPUTS = {"DequantizeLinear": (0, 2), "MatMulIntegerToFloat": (1, 5)}


def replace_fused(
    model: ir.Model,
    *,
    compiled: bool,
    in_library: Callable[[str], bool] = lambda op_type: False,
) -> tuple[ir.Model, tuple[kernels.CompiledKernel, ...]]:
    """Replace the fused nodes by kernels, if ``compiled``, or by bodies.

    Operators for which ``in_library`` is true are left. Returns a copy, or the graph
    itself if it has no fused nodes, and the kernels in it.
    """
    names = {node.op_type for node in unknown_nodes(model) if is_fused(node)}
    fused_types = {name for name in sorted(names) if not in_library(name)}
    if not fused_types:
        return model, ()
    copy = model.clone()
    known = [node for node in unknown_nodes(copy) if node.op_type in fused_types]
    # Bodies depend on the types and ranks of their inputs, which a file may leave out.
    if any(
        value is not None and (value.type is None or value.shape is None)
        for node in known
        for value in node.inputs
    ):
        graph.infer_shapes(copy)
    # Expand the fused nodes, unless the file has bodies that may run.
    fused = [
        node
        for node in known
        if operators.find(node) is not None
        if compiled or node.op_identifier() not in copy.functions
    ]
    try:
        operators.raise_for_bodies(copy, fused, _BY)
        names_in_use = value_names(copy.graph)
        for node in fused:
            opset, used = _opset_and_names(node, copy, names_in_use)
            operators.expand(node, opset=opset, by=_BY, names=used, compiled=compiled)
    except PreconditionError as error:
        raise GraphError(str(error)) from error
    # Kernels that can read int8 do.
    calls = [node for node in unknown_nodes(copy) if node.domain == kernels.DOMAIN]
    for node in calls:
        if compiled and node.op_type in _FLOAT_KERNELS:
            use_int8_kernel(node, *_opset_and_names(node, copy, names_in_use))
    # List the kernels, and import their domain.
    needed: dict[str, kernels.CompiledKernel] = {}
    for node in calls:
        if node.graph is not None:
            needed[node.op_type] = _COMPILED[node.op_type]
            node.graph.opset_imports[kernels.DOMAIN] = 1
    return copy, tuple(needed.values())


def _opset_and_names(
    node: ir.Node, model: ir.Model, names_in_use: set[str]
) -> tuple[int, set[str] | None]:
    """Return the opset of a node, and the names that its graph must not use again."""
    owner = node.graph
    assert owner is not None
    opset = owner.opset_imports.get("", model.opset_imports.get("", 1))
    return opset, names_in_use if isinstance(owner, ir.Graph) else None


def is_fused(node: ir.Node) -> bool:
    """Return whether a kernel or a body is known for a node."""
    kernel = node.domain == kernels.DOMAIN and node.op_type in _COMPILED
    return kernel or operators.find(node) is not None


# Most iterations of a loop times those around it: one takes at least 5 us
MOST_ROUNDS = 1 << 24


def why_endless(model: ir.Model) -> str | None:
    """Describe a loop that would run for minutes or forever; None if none is known."""
    # Native code runs loops and ignores signals. A condition that is computed at run
    # time may end one
    for nodes in (model.graph, *model.functions.values()):
        if (node := _endless_loop(nodes, 1)) is not None:
            name = node.name or node.outputs[0].name
            return f"Loop node {name!r} goes on for more than {MOST_ROUNDS:,} rounds"
    return None


def _endless_loop(nodes: Iterable[ir.Node], rounds: float) -> ir.Node | None:
    """Return a loop of more iterations than allowed, within loops of ``rounds``."""
    for node in nodes:
        if not (bodies := bodies_of(node)):
            continue
        inside = rounds * _iterations(node)
        if inside > MOST_ROUNDS:
            return node
        for body in bodies:
            if (inner := _endless_loop(body, inside)) is not None:
                return inner
    return None


def _iterations(node: ir.Node) -> float:
    """Return the iterations of a loop if constants alone decide them; else 1."""
    if node.op_type != "Loop" or not is_standard(node):
        return 1
    (body,) = bodies_of(node)
    if len(body.inputs) < 2 or not body.outputs:
        return 1
    # Both conditions must be constantly true, or passed through unchanged
    goes_on, first = unrenamed(body.outputs[0]), input_at(node, 1)
    conditions = [] if first is None else [unrenamed(first)]
    if goes_on is not body.inputs[1]:
        conditions.append(goes_on)
    for array in map(array_of, conditions):
        if array is None or array.size != 1 or not array.item():
            return 1
    most = input_at(node, 0)
    if most is None:
        return math.inf
    count = array_of(most)
    return 1 if count is None or count.size != 1 else max(0, int(count.item()))


def why_unsupported(model: ir.Model, provider: Provider = CPU) -> str | None:
    """Return why a graph cannot be run; None if operators are known and loops end.

    A known operator may still lack a kernel for its element type; only building a
    :class:`~me2e_compress.runtime.session.Session` shows it.
    """
    if reason := why_endless(model):
        return reason
    # Fused operators are supported: a kernel or a body runs them
    unknown = {
        f"{node.domain or 'ai.onnx'}::{node.op_type}": node
        for node in unknown_nodes(model)
        if not is_fused(node)
    }
    # The operators of a provider's libraries are unknown before a session is built
    if not unknown or provider.plugins:
        return None
    node = next(iter(unknown.values()))
    name = node.name or node.outputs[0].name
    return f"onnxruntime has no operator {', '.join(unknown)} (node {name!r})"
