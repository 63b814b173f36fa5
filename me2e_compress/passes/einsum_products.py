"""Rewrite products written as Einsum, or with the weight first, as layers."""

import dataclasses
import math
import re

import onnx_ir as ir

from me2e_compress.graph import array_of, is_standard, opset_of, static_shape
from me2e_compress.graph.nodes import FLOATS, graphs_of
from me2e_compress.graph.rewrite import add_constant, put, value_names
from me2e_compress.operators import FusedCall

_TWO_OPERANDS = re.compile(r"([A-Za-z]+),([A-Za-z]+)->([A-Za-z]+)")


def write_products(model: ir.Model, by: str) -> int:
    """Rewrite Einsums of two operands, and weights in front of a product; count them.

    Given:   y = Einsum<"bnd,ed->bne">(x, w)  ;  z = MatMul(w, x [batch, k, n])

    Result:  y = MatMul(x, Transpose(w))      ;  z = Conv(x, w [m, k, 1])
    """
    count, opset = 0, opset_of(model)
    names = value_names(model.graph)
    for body in graphs_of(model.graph):
        for node in list(body):
            if not is_standard(node) or node.outputs[0].dtype not in FLOATS:
                continue
            if node.op_type == "Einsum":
                count += _write_einsum(node, opset, names, by)
            elif node.op_type == "MatMul":
                count += _write_convolution(node, body, names, by)
    return count


@dataclasses.dataclass(frozen=True)
class _Product:
    """The labels of an Einsum of two matrices.

    ``batch`` labels are in both operands and the result, ``rows`` and ``columns`` in
    one operand and the result, ``summed`` in both operands only.
    """

    left: str
    right: str
    out: str
    batch: str
    rows: str
    columns: str
    summed: str

    @classmethod
    def of(cls, equation: str) -> "_Product | None":
        """Read an equation; None where it is no product of two matrices."""
        match = _TWO_OPERANDS.fullmatch(equation.replace(" ", ""))
        if match is None:
            return None
        left, right, out = match.groups()
        if any(len(set(labels)) < len(labels) for labels in (left, right, out)):
            return None
        batch = "".join(x for x in out if x in left and x in right)
        rows = "".join(x for x in out if x in left and x not in right)
        columns = "".join(x for x in out if x in right and x not in left)
        summed = "".join(x for x in left if x in right and x not in out)
        labels = {*batch, *rows, *columns, *summed}
        if not rows or not columns or not summed or labels != {*left, *right, *out}:
            return None
        return cls(left, right, out, batch, rows, columns, summed)


def _write_einsum(node: ir.Node, opset: int, names: set[str], by: str) -> int:
    product = _Product.of(node.attributes.get_string("equation", ""))
    if product is None or None in node.inputs:
        return 0
    sizes = _sizes(node, product)
    # Without a batch, rows may be several axes: MatMul broadcasts them
    groups = [product.columns, product.summed]
    groups += [product.rows] if product.batch else []
    flat = any(len(labels) > 1 for labels in groups)
    if flat and sizes is None:
        return 0
    # Bring both operands to [*batch, rows, summed] and [*batch, summed, columns]
    call = FusedCall(node, opset=opset, by=by, names=names)
    batch, rows, columns = product.batch, product.rows, product.columns
    summed, (one, two) = product.summed, filter(None, node.inputs)
    left = _transposed(call, one, product.left, batch + rows + summed)
    right = _transposed(call, two, product.right, batch + summed + columns)
    if flat and sizes is not None:
        count, depth, width = (
            math.prod(sizes[x] for x in labels) for labels in (rows, summed, columns)
        )
        lead = [sizes[x] for x in batch]
        left = call.reshape(left, [*lead, count, depth])
        right = call.reshape(right, [*lead, depth, width])
    # Multiply, and restore the axes
    result = call.add("MatMul", [left, right])
    if flat and sizes is not None:
        result = call.reshape(result, [sizes[x] for x in batch + rows + columns])
    call.put(_transposed(call, result, batch + rows + columns, product.out))
    return 1


def _transposed(call: FusedCall, value: ir.Value, have: str, want: str) -> ir.Value:
    """Transpose a value from one order of labelled axes to another, if they differ."""
    if have == want:
        return value
    return call.transpose(value, [have.index(label) for label in want])


def _sizes(node: ir.Node, product: _Product) -> dict[str, int] | None:
    """Return the size of every label; None where one is open."""
    shapes = [static_shape(value) for value in node.inputs]
    if shapes[0] is None or shapes[1] is None:
        return None
    return dict(zip(product.left + product.right, shapes[0] + shapes[1], strict=True))


def _write_convolution(node: ir.Node, graph: ir.Graph, names: set[str], by: str) -> int:
    """Write the product of a weight with columns as a convolution of kernel 1."""
    weight, columns = node.inputs
    array, shape = array_of(weight), None if columns is None else columns.shape
    if array is None or weight is None or array.ndim != 2 or shape is None:
        return 0
    if len(shape) != 3 or array_of(columns) is not None:
        return 0
    kernel = add_constant(graph, array[:, :, None], f"{weight.name}_kernel", names)
    attributes = {"kernel_shape": [1]}
    put(node, "Conv", [columns, kernel], by=by, attributes=attributes)
    return 1
