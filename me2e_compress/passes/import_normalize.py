"""Bring a graph of any origin into the form that the other passes expect."""

import dataclasses
import itertools
import math
import re
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
import onnx_ir as ir

from me2e_compress.base.display import plural
from me2e_compress.graph import (
    array_of,
    graphs_of,
    is_standard,
    opset_of,
    provenance,
    static_shape,
)
from me2e_compress.graph.modules.assign import assign
from me2e_compress.graph.nodes import FLOATS, bodies, is_plugin, nodes_in, nodes_of
from me2e_compress.graph.rewrite import add_constant, lift_constants, put, value_names
from me2e_compress.graph.rewrite.raise_opset import OLDEST_OPSET, raise_opset
from me2e_compress.graph.shapes import open_shape
from me2e_compress.graph.validity import ORIGINAL_DOMAIN, PLUGIN_DOMAIN
from me2e_compress.operators import FusedCall
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.sequences import unpack_sequences
from me2e_compress.targets.quantized import PAIR

# Attributes of standard operators that name an element type: Cast; EyeLike, Random*,
# Bernoulli, Multinomial, SequenceEmpty; the window functions and MelWeightMatrix.
_TYPE_ATTRIBUTES = ("to", "dtype", "output_datatype")

# Standard operators whose meaning depends on the width.
_BY_WIDTH = ("BitCast",)


def demote(model: ir.Model, by: str) -> tuple[int, str]:
    """Turn float64 into float32 everywhere; return the changes, and a note about them.

    Nothing changes where an input, output or unknown operator has doubles. Finite
    numbers beyond float32's range are clipped, so that a mask of ``-1.8e308`` stays
    finite.
    """
    # Stop where the outside needs double
    if keeper := _keeper(model):
        return 0, f"float64 stays: {keeper} is double"
    # Weights, attributes, then value types
    count = 0
    for graph in graphs_of(model.graph):
        for value in graph.initializers.values():
            tensor = value.const_value
            if tensor is not None and tensor.dtype == ir.DataType.DOUBLE:
                value.const_value = _as_float32(tensor, value.name)
                value.type = ir.TensorType(ir.DataType.FLOAT)
                count += 1
    for node in nodes_of(model):
        attributes = [
            _demoted(node, attribute) for attribute in node.attributes.values()
        ]
        changed = [attribute for attribute in attributes if attribute is not None]
        node.attributes.update({attribute.name: attribute for attribute in changed})
        if changed:
            provenance.inherit(node, [node], by=by)
        count += len(changed)
    nodes = set[ir.Node | None]()
    for value in _values(model):
        if value.type is not None and _is_double(value.type):
            value.type = _single(value.type)
            count += 1
            nodes.add(value.producer())
    note = f"float64 became float32: {plural(len(nodes - {None}), 'node')}"
    return count, note if count else ""


def _keeper(model: ir.Model) -> str:
    """Name what the outside needs in double; empty if nothing."""
    ports = {"input": model.graph.inputs, "output": model.graph.outputs}
    for kind, values in ports.items():
        for value in values:
            if value.type is not None and _is_double(value.type):
                return f"{kind} {value.name}"
    for node in nodes_of(model):
        # Standard operators and functions can change type
        known = node.domain == "" and node.op_type not in _BY_WIDTH
        if known or node.op_identifier() in model.functions:
            continue
        for touched in (*node.inputs, *node.outputs):
            if touched is not None and touched.dtype == ir.DataType.DOUBLE:
                custom = "custom " if node.domain else ""
                return f"{touched.name} of the {custom}operator {node.op_type}"
    return ""


def _demoted(node: ir.Node, attribute: ir.Attr) -> ir.Attr | None:
    """Return an attribute of a standard operator in float32; None if it stays."""
    name, kind = attribute.name, attribute.type
    if node.domain != "" or attribute.is_ref():
        return None
    if kind == ir.AttributeType.INT and name in _TYPE_ATTRIBUTES:
        double = attribute.as_int() == ir.DataType.DOUBLE.value
        return ir.AttrInt64(name, ir.DataType.FLOAT.value) if double else None
    if kind == ir.AttributeType.TENSOR:
        tensor = attribute.value  # as_tensor() checks a protocol: slow
        if tensor.dtype == ir.DataType.DOUBLE:
            return ir.AttrTensor(name, _as_float32(tensor, tensor.name))
    return None


def _as_float32(tensor: ir.TensorProtocol, name: str | None) -> ir.TensorProtocol:
    exact, limits = tensor.numpy(), np.finfo(np.float32)
    clipped = np.clip(exact, limits.min, limits.max)
    bounded = np.where(np.isfinite(exact), clipped, exact)
    return ir.tensor(bounded.astype(np.float32), name=name)


def _is_double(kind: ir.TypeProtocol) -> bool:
    return bool(kind.dtype == ir.DataType.DOUBLE)


def _single(kind: ir.TypeProtocol) -> ir.TypeProtocol:
    """Return a type of float32 instead of float64."""
    if isinstance(kind, ir.SequenceType | ir.OptionalType):
        return type(kind)(_single(kind.elem_type))
    sparse = isinstance(kind, ir.SparseTensorType)
    return (ir.SparseTensorType if sparse else ir.TensorType)(ir.DataType.FLOAT)


def _values(model: ir.Model) -> Iterator[ir.Value]:
    for graph in graphs_of(model.graph):
        yield from graph.inputs
        yield from graph.initializers.values()
    for function in model.functions.values():
        yield from function.inputs
    for node in nodes_of(model):
        yield from node.outputs


# The first ONNX IR version whose models may hold functions (onnx/docs/IR.md).
_FUNCTIONS_SINCE_IR = 8


@dataclasses.dataclass(frozen=True)
class ImportNormalize(Pass):
    """Give every node a name and an origin, and normalize the graph.

    1. Nodes without a name, or with a name that is taken, get one.
    2. Every node gets its module and its origin before anything renames it.
    3. Plugin nodes of the default domain move to ``me2e.plugin``; their metadata keep
       the old domain for the way back to TensorRT.
    4. A graph older than opset 13 is written in that, operator by operator.
    5. float64 that leaked into a float32 graph becomes float32.
    6. Constant nodes become initializers.
    7. A model with functions declares at least IR version 8, and all used domains are
       imported.
    8. Stored scales and zero points by channel become vectors.
    9. An Einsum that is a product becomes a MatMul, a weight in front of columns a
       Conv: layers, which become int8.
    10. A sequence of which tensors, their number or all of them joined are read becomes
        these tensors.

    Subgraphs and function bodies are included. Unknown operators are left alone.

    Given:
        n = RotateTRT(x)  ;  c = Constant<double>()  ;  y = Mul(n, c)

    Result:
        n = me2e.plugin.RotateTRT(x)  ;  y = Mul(n, c)   with c a float32 initializer
    """

    name = "import-normalize"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Rewrite the model in place."""
        # Stamp names, modules and origins before anything renames a node
        changes = _name_nodes(model, self.name)
        if provenance.missing(model):
            for node, place in assign(model, context.modules).placements.items():
                if provenance.read(node) is None:
                    past = provenance.Provenance(place.module, (node.name or "",))
                    provenance.stamp(node, past)
                    changes += 1
        # Normalize domains, opset, element types and constants
        changes += _isolate_plugins(model, self.name)
        raised, raise_note = _raise(model, self.name)
        demoted, note = demote(model, self.name)
        changes += raised + demoted + lift_constants(model)
        # Versions and domains that are used are declared
        if model.functions and model.ir_version < _FUNCTIONS_SINCE_IR:
            model.ir_version = _FUNCTIONS_SINCE_IR
            changes += 1
        for body, _ in bodies(model):
            for node in nodes_in(body):
                if node.domain not in body.opset_imports:
                    body.opset_imports[node.domain] = 1
                    changes += 1
        # Scales, products and parts of tensors in their plain forms
        changes += _flatten_scales(model, self.name)
        changes += _write_einsums(model, self.name)
        changes += _write_convolutions(model, self.name)
        if opset_of(model) >= OLDEST_OPSET:
            changes += unpack_sequences(model, self.name)
        return PassResult(model, changes, tuple(filter(None, (raise_note, note))))


def needs_import(model: ir.Model) -> bool:
    """Return whether nodes lack provenance, or plugins a domain of their own."""
    return bool(provenance.missing(model)) or any(
        _plugins_without_domain(body, model) for body, _ in bodies(model)
    )


def with_own_domains(model: ir.Model) -> ir.Model:
    """Return the graph, or a copy whose plugins have their old domains again."""
    if not any(ORIGINAL_DOMAIN in node.metadata_props for node in nodes_of(model)):
        return model
    copy = model.clone()
    for body, _ in bodies(copy):
        for node in nodes_in(body):
            if ORIGINAL_DOMAIN in node.metadata_props:
                node.domain = node.metadata_props.pop(ORIGINAL_DOMAIN)
        if all(node.domain != PLUGIN_DOMAIN for node in nodes_in(body)):
            body.opset_imports.pop(PLUGIN_DOMAIN, None)
    return copy


def _raise(model: ir.Model, by: str) -> tuple[int, str]:
    opset = opset_of(model)
    if not 0 < opset < OLDEST_OPSET:
        return 0, ""
    changes, reason = raise_opset(model, OLDEST_OPSET, by)
    became = f"opset {opset} became {OLDEST_OPSET}"
    return changes, f"opset {opset} stays: {reason}" if reason else became


def _name_nodes(model: ir.Model, by: str) -> int:
    """Name nodes without a unique name; new names depend only on the order of nodes."""
    count = 0
    for body, _ in bodies(model):
        # Reserve all existing names first
        nodes = list(nodes_in(body))
        reserved = {node.name for node in nodes if node.name}
        used = set[str]()
        counters = defaultdict[str, Iterator[int]](itertools.count)
        for node in nodes:
            if node.name and node.name not in used:
                used.add(node.name)
                continue
            # Take the first free number
            stem = node.name or node.op_type
            names = (f"{stem}_{number}" for number in counters[stem])
            node.name = next(name for name in names if name not in reserved)
            reserved.add(node.name)
            used.add(node.name)
            provenance.inherit(node, [node], by=by)
            count += 1
    return count


def _isolate_plugins(model: ir.Model, by: str) -> int:
    """Move plugins of the default domain to one of their own, and count them.

    They come from ``OperatorExportTypes.ONNX_FALLTHROUGH`` (BEVFormer_tensorrt, DL4AGX
    uniad-trt: ``MultiScaleDeformableAttnTRT``, ``RotateTRT``, ``InverseTRT``) or from a
    plugin symbolic without a domain (``MSDAPlugin``).
    """
    count = 0
    for body, _ in bodies(model):
        moved = _plugins_without_domain(body, model)
        for node in moved:
            node.metadata_props.setdefault(ORIGINAL_DOMAIN, node.domain)
            node.domain = PLUGIN_DOMAIN
            provenance.inherit(node, [node], by=by)
        if moved:
            body.opset_imports.setdefault(PLUGIN_DOMAIN, 1)
        count += len(moved)
    return count


def _plugins_without_domain(
    body: ir.Graph | ir.Function, model: ir.Model
) -> list[ir.Node]:
    return [
        node
        for node in nodes_in(body)
        if node.domain == ""
        and is_plugin(node)
        and node.op_identifier() not in model.functions
    ]


def _flatten_scales(model: ir.Model, by: str) -> int:
    """Write stored scales and zero points by channel as vectors, and count them.

    NNCF stores those of a Conv's weight as [channels, 1, 1].
    """
    count = 0
    for node in model.graph:
        shape = static_shape(node.inputs[0]) if node.op_type in PAIR else None
        axis = node.attributes.get_int("axis", 1)
        if not shape or axis >= len(shape) or "block_size" in node.attributes:
            continue
        for index in range(1, len(node.inputs)):
            array = array_of(node.inputs[index])
            if array is None or array.ndim < 2:
                continue
            if array.size == max(array.shape) == shape[axis]:
                name = f"{node.name}_vector_{index}"
                vector = add_constant(model.graph, array.reshape(-1), name)
                node.replace_input_with(index, vector)
                provenance.inherit(node, [node], by=by)
                count += 1
    return count


_TWO_OPERANDS = re.compile(r"([A-Za-z]+),([A-Za-z]+)->([A-Za-z]+)")


def _write_einsums(model: ir.Model, by: str) -> int:
    """Write Einsums that are products of two matrices as MatMul, and count them.

    Given:   y = Einsum<"bnd,ed->bne">(x, w)

    Result:  y = MatMul(x, Transpose(w))
    """
    names, opset = value_names(model.graph), opset_of(model)
    return sum(
        _write_einsum(FusedCall(node, opset=opset, by=by, names=names))
        for body in graphs_of(model.graph)
        for node in list(body)
        if node.op_type == "Einsum" and is_standard(node)
        if node.outputs[0].dtype in FLOATS and None not in node.inputs
    )


def _write_einsum(call: FusedCall) -> bool:
    """Write one Einsum; False where it is no product of two matrices."""
    equation = call.node.attributes.get_string("equation", "").replace(" ", "")
    match = _TWO_OPERANDS.fullmatch(equation)
    terms = () if match is None else match.groups()
    if not terms or any(len(set(labels)) < len(labels) for labels in terms):
        return False
    # Batch labels are in all three terms, those of rows, columns and sums in two
    one, two, out = terms
    batch = "".join(x for x in out if x in one and x in two)
    rows = "".join(x for x in out if x in one and x not in two)
    columns = "".join(x for x in out if x in two and x not in one)
    summed = "".join(x for x in one if x in two and x not in out)
    labels = {*batch, *rows, *columns, *summed}
    if not (rows and columns and summed) or labels != {*one, *two, *out}:
        return False
    # Several rows need no reshaping without a batch: MatMul broadcasts them
    left, right = filter(None, call.node.inputs)
    shapes = static_shape(left), static_shape(right)
    sizes = dict(zip(one + two, (shapes[0] or ()) + (shapes[1] or ()), strict=False))
    groups = (columns, summed, rows if batch else "")
    reshapes = any(len(group) > 1 for group in groups)
    if reshapes and None in shapes:
        return False
    # Bring both operands to [*batch, rows, summed] and [*batch, summed, columns]
    left = _transposed(call, left, one, batch + rows + summed)
    right = _transposed(call, right, two, batch + summed + columns)
    if reshapes:
        lead = [sizes[x] for x in batch]
        count, depth, width = (
            math.prod(sizes[x] for x in group) for group in (rows, summed, columns)
        )
        left = call.reshape(left, [*lead, count, depth])
        right = call.reshape(right, [*lead, depth, width])
    # Multiply, and restore the axes
    result = call.add("MatMul", [left, right])
    if reshapes:
        result = call.reshape(result, [sizes[x] for x in batch + rows + columns])
    call.put(_transposed(call, result, batch + rows + columns, out))
    return True


def _transposed(call: FusedCall, value: ir.Value, have: str, want: str) -> ir.Value:
    """Transpose a value from one order of labelled axes to another, if they differ."""
    if have == want:
        return value
    return call.transpose(value, [have.index(label) for label in want])


def _write_convolutions(model: ir.Model, by: str) -> int:
    """Write products of a weight with columns as convolutions, and count them.

    Given:   y = MatMul(w [m, k], x [batch, k, n])

    Result:  y = Conv(x, w [m, k, 1])
    """
    count, names = 0, value_names(model.graph)
    for body in graphs_of(model.graph):
        for node in list(body):
            if node.op_type != "MatMul" or not is_standard(node):
                continue
            weight, columns = node.inputs
            array, shape = array_of(weight), open_shape(columns) or ()
            if weight is None or array is None or (array.ndim, len(shape)) != (2, 3):
                continue
            if array_of(columns) is not None or node.outputs[0].dtype not in FLOATS:
                continue
            name = f"{weight.name}_kernel"
            kernel = add_constant(body, array[:, :, None], name, names)
            options = {"kernel_shape": [1]}
            put(node, "Conv", [columns, kernel], by=by, attributes=options)
            count += 1
    return count
