"""Random calls of a fused operator, each a node in a graph of its own."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.operators import Dialect, Operand
from me2e_compress.operators.call import AttributeValue
from me2e_compress.operators.dialect import INTEGERS, NdArray

_LARGEST_SIZE, _LARGEST_RANK = 5, 4


@dataclasses.dataclass(frozen=True)
class DrawnCall:
    """The inputs and attributes of one call of a fused operator, in some dialect.

    ``inputs`` are by name, in the order of the dialect's operands; optional ones at the
    end may be missing.
    """

    inputs: Mapping[str, NdArray]
    attributes: Mapping[str, AttributeValue] = dataclasses.field(default_factory=dict)


Draw: TypeAlias = Callable[[Dialect, np.random.Generator], DrawnCall]


def drawn(dialect: Dialect, random: np.random.Generator) -> DrawnCall:
    """Draw a call from what a dialect declares of its operands and attributes.

    A letter among the dimensions is one size in all operands; floats are normal,
    integers 0 to 4; an attribute is one of its choices, or its default.
    """
    sizes: dict[str, int] = {}
    inputs = {each.name: _array(each, sizes, random) for each in dialect.operands}
    attributes = {
        each.name: each.choices[random.integers(len(each.choices))]
        if each.choices
        else each.default
        for each in dialect.attributes
    }
    return DrawnCall(inputs, attributes)


def graph_of(call: DrawnCall, dialect: Dialect, opset: int) -> ir.Model:
    """Build the graph of one node whose inputs are those of the graph."""
    values = [
        ir.Value(
            name=name,
            shape=ir.Shape(array.shape),
            type=ir.TensorType(ir.DataType.from_numpy(array.dtype)),
        )
        for name, array in call.inputs.items()
    ]
    # one node with one output, in a graph of two opset imports
    node = ir.node(
        dialect.op_type,
        values,
        call.attributes,
        domain=dialect.domain,
        name=dialect.op_type,
        num_outputs=1,
    )
    node.outputs[0].name = "result"
    imports = {dialect.domain: 1, "": opset}
    graph = ir.Graph(
        values, node.outputs, nodes=[node], opset_imports=imports, name="one_call"
    )
    return ir.Model(graph, ir_version=9)


def _array(
    operand: Operand, sizes: dict[str, int], random: np.random.Generator
) -> NdArray:
    dims = operand.dims
    # a digit is a size, a letter one size in all operands, * any size
    letters = ["*"] * random.integers(1, _LARGEST_RANK + 1)
    shape = []
    for letter in letters if dims is None else dims.split():
        size = int(random.integers(1, _LARGEST_SIZE + 1))
        if letter.isdigit():
            size = int(letter)
        elif letter != "*":
            size = sizes.setdefault(letter, size)
        shape.append(size)
    # values of the first type that the operand allows
    kind = operand.types[0]
    if kind in INTEGERS:
        return random.integers(0, 5, shape).astype(kind.numpy())
    return random.normal(size=shape).astype(kind.numpy())
