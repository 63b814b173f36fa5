"""One fused node in a graph of its own: drawn inputs, its body run, its reference."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import infer_shapes, opset_of
from me2e_compress.operators import Dialect, Operator, expand
from me2e_compress.operators.call import AttributeValue
from me2e_compress.testing.check_operator import DrawnCall, dialect_reference
from tests.passes.small import compute

Arrays = Mapping[str, npt.NDArray[Any]]


def in_float32(arrays: Mapping[str, Any]) -> dict[str, npt.NDArray[Any]]:
    """Return arrays whose doubles are floats."""
    return {
        name: array.astype(np.float32) if array.dtype == np.float64 else array
        for name, array in arrays.items()
    }


def graph_of(
    dialect: Dialect,
    arrays: Arrays,
    *,
    opset: int,
    constants: Sequence[str] = (),
    attributes: Mapping[str, AttributeValue] | None = None,
    open_dims: bool = False,
) -> ir.Model:
    """Build the graph of one node whose inputs are those of the graph, in order.

    Args:
        dialect: how the node is spelt.
        arrays: by name, in the order of the operands.
        opset: of ONNX's own operators.
        constants: the inputs that are initializers.
        attributes: of the node.
        open_dims: whether the graph says no dimension of its inputs.
    """
    values = []
    for name, array in arrays.items():
        dims: list[str | int] = list(array.shape)
        if open_dims and name not in constants:
            dims = [f"{name}_{axis}" for axis in range(array.ndim)]
        value = ir.Value(
            name=name,
            shape=ir.Shape(dims),
            type=ir.TensorType(ir.DataType.from_numpy(array.dtype)),
        )
        if name in constants:
            value.const_value = ir.tensor(array, name=name)
        values.append(value)
    domain = dialect.domain
    node = ir.node(dialect.op_type, values, attributes, domain=domain, name="fused")
    node.outputs[0].name = "result"
    graph = ir.Graph(
        [value for value in values if value.name not in constants],
        node.outputs,
        nodes=[node],
        initializers=[value for value in values if value.name in constants],
        opset_imports={domain: 1, "": opset},
        name="one",
    )
    return ir.Model(graph, ir_version=9)


def run(model: ir.Model, arrays: Arrays) -> npt.NDArray[Any]:
    """Run a graph of standard operators by onnxruntime; return its output."""
    infer_shapes(model)
    names = {port.name for port in model.graph.inputs}
    feeds = {name: array for name, array in arrays.items() if name in names}
    return np.asarray(compute(model, feeds)[0])


def body_and_reference(
    operator: Operator, dialect: Dialect, model: ir.Model, arrays: Arrays
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Run the body of the only node of a graph, and compute its reference."""
    node = model.graph[0]
    call = DrawnCall(arrays, dialect.attributes_of(node))
    expand(node, opset=opset_of(model), by="test")
    assert all(node.domain == "" for node in model.graph)
    for domain in model.graph.opset_imports.keys() - {""}:
        del model.graph.opset_imports[domain]
    return run(model, arrays), dialect_reference(operator, dialect, call)
