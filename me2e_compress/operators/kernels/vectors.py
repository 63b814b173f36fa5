"""Loops over float32 vectors in LLVM instructions: Numba keeps no sums in registers.

Matrix products (:func:`matrix_product`) and weighted sums of rows
(:func:`weighted_rows`), which kernels call as intrinsics. LLVM splits vectors where the
processor's are shorter.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from llvmlite import binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from me2e_compress.operators.kernels.intrinsics import ELEMENTS, FLOAT, INT, WORD

LANES = 16  # numbers of a vector of `vector_intrinsic`

LOG2_E = 1.4426950408889634
# Polynomial of 2^r for r in -0.5..0.5, highest power first, of the Cephes library (S.
# L. Moshier, single/exp2f.c, netlib.org/cephes): relative error below 2e-7 in float32.
POWERS = (
    1.535336188319500e-4, 1.339887440266574e-3, 9.618437357674640e-3,
    5.550332471162809e-2, 2.402264791363012e-1, 6.931472028550421e-1, 1.0,
)  # fmt: skip

# Smaller powers count as 2^-125, so that results are normal float32 numbers
LEAST = -125.0

# Added to a float32, it leaves the nearest whole number in the lowest bits
ROUNDING = 1.5 * 2.0**23

_FAST = ("contract",)


class Vectors:
    """Writes arithmetic, loads and stores of vectors at addresses."""

    def __init__(self, builder: Any, lanes: int = LANES) -> None:
        self.builder, self.lanes = builder, lanes
        self.kind = ir.VectorType(FLOAT, lanes)
        self.whole = ir.VectorType(INT, lanes)

    def place(self, address: Any, offset: Any) -> Any:
        """Return the pointer to the number ``offset`` behind an address."""
        return self.builder.gep(self.pointer(address), [offset])

    def pointer(self, address: Any) -> Any:
        """Return the pointer to the number at an address."""
        return self.builder.inttoptr(address, FLOAT.as_pointer())

    def load(self, place: Any, mask: Any = None) -> Any:
        """Load a vector from any place; of a mask its lanes, and 0 into the others."""
        at = self.builder.bitcast(place, self.kind.as_pointer())
        if mask is None:
            return self.builder.load(at, align=4)
        return self._masked("load", self.kind, [at, INT(4), mask, self.spread(0.0)])

    def store(self, vector: Any, place: Any, mask: Any = None) -> None:
        """Store a vector, or the lanes of a mask, to any place."""
        at = self.builder.bitcast(place, self.kind.as_pointer())
        if mask is None:
            self.builder.store(vector, at, align=4)
        else:
            self._masked("store", ir.VoidType(), [vector, at, INT(4), mask])

    def _masked(self, name: str, result: Any, arguments: list[Any]) -> Any:
        kind = ir.FunctionType(result, [value.type for value in arguments])
        name = f"llvm.masked.{name}.v{self.lanes}f32.p0"
        function = cgutils.get_or_insert_function(self.builder.module, kind, name)
        return self.builder.call(function, arguments)

    def within(self, first: Any, limit: Any) -> Any:
        """Return the lanes whose position, counted from ``first``, is in 0..limit."""
        builder, lanes = self.builder, self.whole(list(range(self.lanes)))
        start = self._same(builder.trunc(first, INT), self.whole)
        end = self._same(builder.trunc(limit, INT), self.whole)
        return builder.icmp_unsigned("<", builder.add(start, lanes), end)

    def spread(self, number: Any) -> Any:
        """Return a vector of one number."""
        if isinstance(number, float):
            return self.kind([number] * self.lanes)
        return self._same(number, self.kind)

    def _same(self, number: Any, kind: Any) -> Any:
        blank = kind(ir.Undefined)
        first = self.builder.insert_element(blank, number, INT(0))
        same = self.whole([0] * self.lanes)
        return self.builder.shuffle_vector(first, blank, same)

    def add(self, one: Any, two: Any) -> Any:
        """Return one + two."""
        return self.builder.fadd(one, two, flags=_FAST)

    def subtract(self, one: Any, two: Any) -> Any:
        """Return one - two."""
        return self.builder.fsub(one, two, flags=_FAST)

    def times(self, factor: float, one: Any) -> Any:
        """Return factor * one."""
        return self.builder.fmul(self.spread(factor), one, flags=_FAST)

    def at_least(self, one: Any, least: Any) -> Any:
        """Return the larger one; NaN stays NaN."""
        below = self.builder.fcmp_ordered("<", one, least)
        return self.builder.select(below, least, one)

    def power_of_2(self, x: Any) -> Any:
        """Return 2^x for x <= 0."""
        builder = self.builder
        # x = n + r: n whole, in the lowest bits of `rounded`, and r in -0.5..0.5
        rounding = self.spread(ROUNDING)
        x = self.at_least(x, self.spread(LEAST))
        rounded = builder.fadd(x, rounding)
        fraction = builder.fsub(x, builder.fsub(rounded, rounding))
        # 2^r by Horner's scheme
        power = self.spread(POWERS[0])
        for factor in POWERS[1:]:
            power = builder.fmul(power, fraction, flags=_FAST)
            power = self.add(power, self.spread(factor))
        # Times 2^n: n is added to the exponent, bits 23 to 30
        exponent = builder.shl(
            builder.bitcast(rounded, self.whole), self.whole([23] * self.lanes)
        )
        bits = builder.add(builder.bitcast(power, self.whole), exponent)
        return builder.bitcast(bits, self.kind)

    def choose(self, one: Any, two: Any, lanes: Sequence[int]) -> Any:
        """Return lanes of two vectors, those of the second counted from 16."""
        return self.builder.shuffle_vector(one, two, self.whole(list(lanes)))


@contextmanager
def while_fit(
    builder: Any, done: Any, step: int, end: Any, *, part: bool = False
) -> Iterator[Any]:
    """Repeat what is written inside while ``step`` more, or a part, fit."""
    head, body, after = (
        builder.append_basic_block(name) for name in ("head", "body", "after")
    )
    builder.branch(head)
    builder.position_at_end(head)
    at = builder.load(done)
    needed = builder.add(at, WORD(1 if part else step))
    builder.cbranch(builder.icmp_signed("<=", needed, end), body, after)
    builder.position_at_end(body)
    yield at
    builder.store(builder.add(at, WORD(step)), done)
    builder.branch(head)
    builder.position_at_end(after)


def vector_intrinsic(write: Callable[..., None], lanes: int = LANES) -> Any:
    """Return an intrinsic of a tuple of words that writes instructions."""

    def typed(context: Any, inputs: Any) -> tuple[Any, Callable[..., Any]]:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            write(Vectors(builder, lanes), *cgutils.unpack_tuple(builder, arguments[0]))
            return context.get_dummy_value()

        return types.void(types.UniTuple(types.intp, len(inputs))), generate

    return intrinsic(typed)


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
    """Return the largest tile of so many vectors that fits into the registers."""
    # Beside the tile, they hold one row of B and one number of A
    features = llvm.get_host_cpu_features()
    lanes, registers = next(
        (size for name, size in _VECTORS.items() if features.get(name)), _OTHERS
    )
    return Tile((registers - vectors - 1) // vectors, vectors, lanes)


def matrix_product(tile: Tile) -> Any:
    """Return the intrinsic ``((a, b, c, a_row, a_step, b_step, c_row, m, n, k, add))``.

    A tile of C, some rows by some vectors, is summed over the whole depth before
    anything of it is stored (Goto and van de Geijn, Anatomy of high-performance matrix
    multiplication, 2008, section 4). It
    writes C [m, n], or adds to it if ``add`` is not 0: the product of A [m, k] and
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
        sums = [self._from(nothing, row, zeros, adding) for row in loaded]
        builder.cbranch(builder.icmp_signed("<", step, self.k), body, after)
        # C[i, :] += A[i, step] B[step, :] for the rows and columns of the tile
        builder.position_at_end(body)
        first = builder.gep(self.b, [builder.mul(step, self.b_step)])
        lanes = WORD(self.tile.lanes)
        across = []  # B[step, :], by vectors
        for vector in range(vectors):
            at = builder.add(column, builder.mul(lanes, WORD(vector)))
            across.append(self.simd.load(builder.gep(first, [at]), mask))
        start = builder.gep(self.a, [builder.mul(step, self.a_step)])
        for index in range(rows):
            at = builder.mul(builder.add(row, WORD(index)), self.a_row)
            factor = self.simd.spread(builder.load(builder.gep(start, [at])))
            for vector in range(vectors):
                total = sums[index * vectors + vector]
                product = builder.fmul(factor, across[vector], flags=_FAST)
                total.add_incoming(self.simd.add(total, product), body)
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
            for vector in range(vectors):
                across = builder.add(column, WORD(vector * self.tile.lanes))
                places.append(builder.gep(self.c, [builder.add(at, across)]))
        return places


# Points at a time, and the distance of the four arrays of offsets and weights
CAPACITY = 1024
CORNERS = 4
WIDTHS = (32, 16, 8, 4, 1)  # channels at a time, the widest first


def weighted_rows(kind: Any, *, onto: bool = False) -> Any:
    """Return the intrinsic ``((rows, offsets, weights, first, last, out, size))``.

    It writes ``size`` float32 numbers to the address ``out``: the sum over the points
    ``first`` to ``last`` of four rows each, times their weights, ``onto`` what is there
    or not. A point whose first offset is negative is skipped. Rows of ``kind`` are
    float32, int8 or uint8.
    """
    return vector_intrinsic(
        lambda simd, *words: _WeightedRows(simd.builder, kind, onto, *words).write()
    )


class _WeightedRows:
    """Writes a loop over channels for each width, and inside it one over points."""

    def __init__(
        self,
        builder: Any, kind: Any, onto: bool,
        rows: Any, offsets: Any, weights: Any,
        first: Any, last: Any, out: Any, size: Any,
    ) -> None:  # fmt: skip
        self.builder, self.kind, self.onto = builder, kind, onto
        self.rows = builder.inttoptr(rows, ELEMENTS[kind].as_pointer())
        self.offsets = builder.inttoptr(offsets, INT.as_pointer())
        self.weights = builder.inttoptr(weights, FLOAT.as_pointer())
        self.first, self.last, self.out, self.size = first, last, out, size

    def write(self) -> None:
        done = cgutils.alloca_once_value(self.builder, WORD(0))
        for width in WIDTHS:
            simd = Vectors(self.builder, width)
            with while_fit(self.builder, done, width, self.size) as at:
                place = simd.place(self.out, at)
                begin = simd.load(place) if self.onto else simd.spread(0.0)
                total = self._sum(simd, self.builder.gep(self.rows, [at]), begin)
                simd.store(total, place)

    def _sum(self, simd: Vectors, rows: Any, begin: Any) -> Any:
        """Write the loop over points for some channels, and return the sums."""
        builder, before = self.builder, self.builder.block
        loop, inside, ahead, end = (
            builder.append_basic_block(f"{part}{simd.lanes}")
            for part in ("point", "inside", "next", "end")
        )
        some = builder.icmp_signed("<", self.first, self.last)
        builder.cbranch(some, loop, end)
        # Skip points whose first offset is negative
        builder.position_at_end(loop)
        point, sums = builder.phi(WORD), builder.phi(simd.kind)
        point.add_incoming(self.first, before)
        sums.add_incoming(begin, before)
        offset = builder.load(builder.gep(self.offsets, [point]))
        builder.cbranch(builder.icmp_signed(">=", offset, INT(0)), inside, ahead)
        # sums += weight[corner] row[corner] for the four corners
        builder.position_at_end(inside)
        more = sums
        for corner in range(CORNERS):
            place = builder.add(point, WORD(corner * CAPACITY))
            offset = builder.load(builder.gep(self.offsets, [place]))
            weight = builder.load(builder.gep(self.weights, [place]))
            row = self._row(simd, builder.gep(rows, [builder.sext(offset, WORD)]))
            part = builder.fmul(row, simd.spread(weight), flags=_FAST)
            more = simd.add(more, part)
        builder.branch(ahead)
        # Go on with the next point
        builder.position_at_end(ahead)
        current = builder.phi(simd.kind)
        current.add_incoming(sums, loop)
        current.add_incoming(more, inside)
        following = builder.add(point, WORD(1))
        point.add_incoming(following, ahead)
        sums.add_incoming(current, ahead)
        builder.cbranch(builder.icmp_signed("<", following, self.last), loop, end)
        # The sums after the last point, or `begin` without points
        builder.position_at_end(end)
        total = builder.phi(simd.kind)
        total.add_incoming(begin, before)
        total.add_incoming(current, ahead)
        return total

    def _row(self, simd: Vectors, place: Any) -> Any:
        """Load some channels of a row as float32."""
        if self.kind == types.float32:
            return simd.load(place)
        vector = ir.VectorType(ELEMENTS[self.kind], simd.lanes)
        place = self.builder.bitcast(place, vector.as_pointer())
        row = self.builder.load(place, align=1)
        signed = self.kind.signed
        convert = self.builder.sitofp if signed else self.builder.uitofp
        return convert(row, simd.kind)
