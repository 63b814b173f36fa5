"""The matrices and vectors of a way to compute a linear layer."""

from collections.abc import Callable

import numpy as np
import onnx_ir as ir

from me2e_compress.graph.rewrite import Numbers, numbers_of
from me2e_compress.passes.hoist_linear.ways import (
    Composed,
    Distributed,
    Moved,
    Term,
    Way,
)


class Matrix:
    """A matrix [K, N] that becomes an initializer when it is first needed."""

    def __init__(self, numbers: Numbers, value: ir.Value | None, name: str) -> None:
        self.numbers, self.value, self.name = numbers, value, name
        self.made: dict[tuple[int, ...], Matrix] = {}

    def behind(self, way: Composed) -> "Matrix":
        """Return the product of a layer's matrix and this one."""
        layer = way.layer
        return self._once(
            (id(layer.product),),
            lambda: layer.matrix() @ self.numbers,
            f"{layer.weight.name}_{self.name}",
        )

    def part(self, term: Term) -> "Matrix":
        """Return the rows of the matrix that a term is multiplied by."""
        if term.rows is None:
            return self
        start, stop = term.rows
        name = f"{self.name}_{start}_{stop}"
        return self._once((start, stop), lambda: self.numbers[start:stop], name)

    def _once(
        self, key: tuple[int, ...], make: Callable[[], Numbers], name: str
    ) -> "Matrix":
        if key not in self.made:
            self.made[key] = Matrix(make(), None, name)
        return self.made[key]


def vector_of(way: Way, matrix: Matrix) -> Numbers | None:
    """Return the vector, [N], that the composed layers add to every row."""
    if isinstance(way, Moved):
        return vector_of(way.parts[0], matrix) if len(way.parts) == 1 else None
    if isinstance(way, Composed):
        bias = way.layer.bias()
        mine = None if bias is None else bias @ matrix.numbers
        return plus(mine, vector_of(way.way, matrix.behind(way)))
    if not isinstance(way, Distributed):
        return None
    # Add up the vectors of all terms
    total: Numbers | None = None
    for at, term in enumerate(way.terms):
        more = vector_of(term.way, matrix.part(term))
        if at and more is not None and way.node.op_type == "Sub":
            more = -more
        total = plus(total, more)
    return total


def plus(one: Numbers | None, two: Numbers | None) -> Numbers | None:
    """Add two vectors, either of which may be None."""
    if one is None or two is None:
        return two if one is None else one
    total: Numbers = one + two
    return total


def times(value: ir.Value, matrix: Matrix, vector: Numbers | None) -> Numbers:
    """Multiply a constant; a last axis of size 1 is broadcast first."""
    numbers = numbers_of(value)
    assert numbers is not None
    depth = matrix.numbers.shape[0]
    rows = np.broadcast_to(numbers, (*numbers.shape[:-1], depth))
    product: Numbers = rows @ matrix.numbers
    return product if vector is None else product + vector
