"""Nodes that are written behind a graph, to compute gradients of it."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, rewrite, static_shape
from me2e_compress.graph.nodes import Array

Attributes: TypeAlias = Mapping[
    str, int | float | str | Sequence[int] | ir.TensorProtocol | ir.Attr
]
Found: TypeAlias = Sequence[ir.Value | None]
"""Gradients of a node's inputs; None where there is none."""


_SMALL = 1024
"""Bytes."""

LARGE = 250_000
"""Numbers; 1 MB of float32."""


class NoRuleError(Exception):
    """There is no rule for this form of an operator."""


class Tape:
    """Appends nodes to a graph, and counts the bytes of it that they keep in memory."""

    def __init__(self, model: ir.Model) -> None:
        self.graph = model.graph
        self.held = 0
        self._before = {value for node in model.graph for value in node.outputs}
        self._names = rewrite.value_names(model.graph)
        self._constants: dict[tuple[str, tuple[int, ...], bytes], ir.Value] = {}

    def op(
        self,
        op_type: str,
        inputs: Found,
        attributes: Attributes | None = None,
        outputs: int = 1,
    ) -> ir.Value:
        """Append a node and return its last output."""
        node = ir.node(op_type, inputs, attributes, num_outputs=outputs)
        for made in node.outputs:
            made.name = self._name(op_type)
        for value in inputs:
            if value is not None and value in self._before:
                self._before.remove(value)
                self.held += math.prod(static_shape(value) or ()) * 4
        self.graph.append(node)
        return node.outputs[-1]

    def late(self, array: Array, g: ir.Value, size: int) -> ir.Value:
        """Return a constant that is known once a gradient of a large size is.

        What reads it waits for the gradient: onnxruntime runs nodes as soon as it may,
        and would keep what they give.
        """
        constant = self.constant(array)
        if size < LARGE:
            return constant
        first = self.constant(np.array(0))
        one = self.op("Gather", [self.shaped(g, [-1]), first], {"axis": 0})
        return self.op("Add", [constant, self.times(one, self.number(0, g))])

    def _name(self, what: str) -> str:
        return rewrite.fresh_name(f"me2e_{what}_{len(self._names)}", self._names)

    def constant(self, array: Array) -> ir.Value:
        """Return an initializer; small ones that are equal are one."""
        name = self._name("constant")
        if array.nbytes > _SMALL:
            return rewrite.add_constant(self.graph, array, name, self._names)
        key = (str(array.dtype), array.shape, array.tobytes())
        if key not in self._constants:
            self._constants[key] = rewrite.add_constant(
                self.graph, array, name, self._names
            )
        return self._constants[key]

    def ints(self, numbers: Sequence[int]) -> ir.Value:
        """Return a list of integers."""
        return self.constant(np.array(list(numbers), np.int64))

    def number(self, number: float, like: ir.Value | None) -> ir.Value:
        """Return a scalar of the type of a value."""
        return self.constant(np.array(number, numpy_of(like)))

    def as_number(self, value: ir.Value, like: ir.Value) -> ir.Value:
        """Cast to the type of a value."""
        kind = like.dtype or ir.DataType.FLOAT
        return self.op("Cast", [value], {"to": kind.value})

    def zeros(self, shape: Sequence[int], like: ir.Value | None) -> ir.Value:
        """Return a tensor of zeros of the type of a value."""
        zero = ir.tensor(np.zeros(1, numpy_of(like)))
        return self.op("ConstantOfShape", [self.ints(shape)], {"value": zero})

    def times(self, *factors: ir.Value) -> ir.Value:
        """Multiply."""
        first, *others = factors
        for each in others:
            first = self.op("Mul", [first, each])
        return first

    def shaped(self, value: ir.Value, shape: Sequence[int]) -> ir.Value:
        """Reshape."""
        return self.op("Reshape", [value, self.ints(shape)])

    def total(self, value: ir.Value, axes: Sequence[int], *, keep: bool) -> ir.Value:
        """Sum over some axes."""
        if not axes:
            return value
        return self.op("ReduceSum", [value, self.ints(axes)], {"keepdims": int(keep)})

    def only(self, where: ir.Value, value: ir.Value, like: ir.Value) -> ir.Value:
        """Return a value where a condition holds, else zero."""
        return self.op("Where", [where, value, self.number(0, like)])

    def narrowed(self, g: ir.Value, made: ir.Value, read: ir.Value) -> ir.Value:
        """Sum a gradient of the shape of ``made`` to the shape that was broadcast."""
        have, want = sizes_of(made), sizes_of(read)
        if have == want:
            return g
        lead = len(have) - len(want)
        axes = [
            at
            for at, size in enumerate(have)
            if at < lead or (want[at - lead] == 1 and size != 1)
        ]
        return self.shaped(self.total(g, axes, keep=False), want)


Rule: TypeAlias = Callable[[Tape, ir.Node, ir.Value], Found]
"""Writes the gradients of a node's inputs, of that of its first output."""


def numpy_of(value: ir.Value | None) -> np.dtype[np.generic]:
    """Return the element type of a value; float32 if unknown."""
    kind = None if value is None else value.dtype
    return np.dtype(np.float32) if kind is None else kind.numpy()


def sizes_of(value: ir.Value | None) -> tuple[int, ...]:
    """Return the shape of a value, which must be known."""
    shape = static_shape(value)
    if shape is None and (constant := array_of(value)) is not None:
        return constant.shape
    if shape is None:
        raise NoRuleError("a size is not known")
    return shape


def given(value: ir.Value | None) -> ir.Value:
    """Return an input, which must not be left out."""
    if value is None:
        raise NoRuleError("an input is left out")
    return value
