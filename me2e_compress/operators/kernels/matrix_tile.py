"""A float32 matrix product whose accumulators stay in registers.

A tile of C, some rows by some vectors, is summed over the whole depth before anything
of it is stored (Goto and van de Geijn, Anatomy of high-performance matrix
multiplication, 2008, section 4): each step loads the vectors of one row of B, and
multiplies them by one broadcast number of A for each row of C. It is written as LLVM
instructions, since Numba's loops over arrays do not keep tiles in registers.
"""

import dataclasses
import functools
from typing import Any

from llvmlite import binding as llvm
from numba.core import cgutils

from me2e_compress.operators.kernels.intrinsics import WORD
from me2e_compress.operators.kernels.vectors import Vectors, vector_intrinsic, while_fit


@dataclasses.dataclass(frozen=True)
class Tile:
    """Rows and vectors of a tile of C; each vector has ``lanes`` float32 numbers."""

    rows: int
    vectors: int
    lanes: int

    @property
    def width(self) -> int:
        """Columns of a tile."""
        return self.vectors * self.lanes


# Lanes and number of the vector registers of x86-64, by the feature that adds them
_VECTORS = {"avx512f": (16, 32), "avx": (8, 16), "sse2": (4, 16)}

_OTHERS = (4, 32)  # those of aarch64


@functools.cache
def host_tile(vectors: int = 2) -> Tile:
    """Return the largest tile of so many vectors that this processor's registers hold.

    Beside the tile, they hold one row of B and one number of A.
    """
    features = llvm.get_host_cpu_features()
    lanes, registers = next(
        (size for name, size in _VECTORS.items() if features.get(name)), _OTHERS
    )
    return Tile((registers - vectors - 1) // vectors, vectors, lanes)


def matrix_product(tile: Tile) -> Any:
    """Return the intrinsic ``((a, b, c, a_row, a_step, b_step, c_row, m, n, k, add))``.

    It writes C [m, n], or adds to it if ``add`` is not 0: the product of A [m, k] and
    B [k, n]. ``a``, ``b`` and ``c`` are addresses of float32 numbers, the next four are
    strides in numbers: from row to row of A, from one step of k to the next in A and in
    B, and from row to row of C. Rows of B and of C are contiguous. What is constant
    where it is called is compiled as a constant.

    All of B's ``k`` rows by ``tile.width`` columns are read again for each tile of rows
    and should fit into the first-level cache: callers divide larger ``k``.
    """
    return vector_intrinsic(
        lambda simd, *words: _Product(simd, tile, *words).write(), tile.lanes
    )


class _Product:
    """Writes loops over panels of columns, tiles of rows, and steps of the depth."""

    def __init__(
        self,
        simd: Vectors,
        tile: Tile,
        a: Any, b: Any, c: Any,
        a_row: Any, a_step: Any, b_step: Any, c_row: Any,
        m: Any, n: Any, k: Any, add: Any,
    ) -> None:  # fmt: skip
        self.builder, self.tile, self.simd = simd.builder, tile, simd
        self.a, self.b, self.c = (simd.pointer(at) for at in (a, b, c))
        self.a_row, self.a_step, self.b_step, self.c_row = a_row, a_step, b_step, c_row
        self.m, self.n, self.k, self.add = m, n, k, add

    def write(self) -> None:
        done = cgutils.alloca_once_value(self.builder, WORD(0))
        with while_fit(self.builder, done, self.tile.width, self.n) as column:
            self._rows(column, self.tile.vectors, None)
        # The columns left, one vector at a time, the last one masked
        with while_fit(
            self.builder, done, self.tile.lanes, self.n, part=True
        ) as column:
            left = self.builder.sub(self.n, column)
            self._rows(column, 1, self.simd.within(WORD(0), left))

    def _rows(self, column: Any, vectors: int, mask: Any) -> None:
        done = cgutils.alloca_once_value(self.builder, WORD(0))
        rows = self.tile.rows
        while rows:
            with while_fit(self.builder, done, rows, self.m) as row:
                self._tile(row, column, rows, vectors, mask)
            rows //= 2

    def _tile(self, row: Any, column: Any, rows: int, vectors: int, mask: Any) -> None:
        """Write the loop over the depth for one tile."""
        builder = self.builder
        places = self._places(row, column, rows, vectors)
        zeros, adding, head, body, after = (
            builder.append_basic_block(name)
            for name in ("zeros", "adding", "depth", "step", "done")
        )
        # Start with what C holds, or with zeros
        wanted = builder.icmp_signed("!=", self.add, WORD(0))
        builder.cbranch(wanted, adding, zeros)
        builder.position_at_end(adding)
        loaded = [self.simd.load(place, mask) for place in places]
        builder.branch(head)
        builder.position_at_end(zeros)
        builder.branch(head)
        builder.position_at_end(head)
        step = self._from(WORD(0), WORD(0), zeros, adding)
        nothing = self.simd.spread(0.0)
        sums = [self._from(nothing, each, zeros, adding) for each in loaded]
        builder.cbranch(builder.icmp_signed("<", step, self.k), body, after)
        # Each step multiplies a row of B by one number of A for each row of C
        builder.position_at_end(body)
        first = builder.gep(self.b, [builder.mul(step, self.b_step)])
        lanes = WORD(self.tile.lanes)
        numbers = [
            builder.gep(first, [builder.add(column, builder.mul(lanes, WORD(each)))])
            for each in range(vectors)
        ]
        across = [self.simd.load(place, mask) for place in numbers]
        start = builder.gep(self.a, [builder.mul(step, self.a_step)])
        for index in range(rows):
            at = builder.mul(builder.add(row, WORD(index)), self.a_row)
            factor = self.simd.spread(builder.load(builder.gep(start, [at])))
            for each in range(vectors):
                total = sums[index * vectors + each]
                product = builder.fmul(factor, across[each], flags=("contract",))
                more = builder.fadd(total, product, flags=("contract",))
                total.add_incoming(more, body)
        step.add_incoming(builder.add(step, WORD(1)), body)
        builder.branch(head)
        builder.position_at_end(after)
        for total, place in zip(sums, places, strict=True):
            self.simd.store(total, place, mask)

    def _from(self, one: Any, two: Any, first: Any, second: Any) -> Any:
        phi = self.builder.phi(one.type)
        phi.add_incoming(one, first)
        phi.add_incoming(two, second)
        return phi

    def _places(self, row: Any, column: Any, rows: int, vectors: int) -> list[Any]:
        builder, places = self.builder, []
        for index in range(rows):
            at = builder.mul(builder.add(row, WORD(index)), self.c_row)
            for each in range(vectors):
                across = builder.add(column, WORD(each * self.tile.lanes))
                places.append(builder.gep(self.c, [builder.add(at, across)]))
        return places
