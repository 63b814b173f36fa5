"""The inner loop of every deformable operator: a vectorized weighted sum of rows.

It is written as LLVM instructions so that the sums stay in registers for every head
size, which Numba's loops over arrays do not guarantee.
"""

from typing import Any

from llvmlite import ir
from numba.core import cgutils

from me2e_compress.operators.kernels.intrinsics import ELEMENTS, FLOAT, INT, WORD
from me2e_compress.operators.kernels.vectors import (
    Vectors,
    vector_intrinsic,
    while_fit,
)

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
        lambda simd, *words: _Loops(simd.builder, kind, onto, *words).write()
    )


class _Loops:
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
        self.weights, self.out = (
            builder.inttoptr(address, FLOAT.as_pointer()) for address in (weights, out)
        )
        self.first, self.last, self.size = first, last, size

    def write(self) -> None:
        builder = self.builder
        done = cgutils.alloca_once_value(builder, WORD(0))
        for width in WIDTHS:
            with while_fit(builder, done, width, self.size) as at:
                place = self._vector_at(builder.gep(self.out, [at]), FLOAT, width)
                zeros = ir.VectorType(FLOAT, width)([0.0] * width)
                begin = builder.load(place, align=4) if self.onto else zeros
                total = self._sum(builder.gep(self.rows, [at]), begin, width)
                builder.store(total, place, align=4)

    def _sum(self, rows: Any, begin: Any, width: int) -> Any:
        """Write the loop over points for ``width`` channels and return the sums."""
        builder, kind = self.builder, ir.VectorType(FLOAT, width)
        before = builder.block
        loop, inside, ahead, end = (
            builder.append_basic_block(f"{part}{width}")
            for part in ("point", "inside", "next", "end")
        )
        some = builder.icmp_signed("<", self.first, self.last)
        builder.cbranch(some, loop, end)

        # Skip points whose first offset is negative
        builder.position_at_end(loop)
        point, sums = builder.phi(WORD), builder.phi(kind)
        point.add_incoming(self.first, before)
        sums.add_incoming(begin, before)
        offset = builder.load(builder.gep(self.offsets, [point]))
        builder.cbranch(builder.icmp_signed(">=", offset, INT(0)), inside, ahead)

        builder.position_at_end(inside)
        # Add the four corners
        more = sums
        for corner in range(CORNERS):
            place = builder.add(point, WORD(corner * CAPACITY))
            offset = builder.load(builder.gep(self.offsets, [place]))
            weight = builder.load(builder.gep(self.weights, [place]))
            row = self._row(builder.gep(rows, [builder.sext(offset, WORD)]), width)
            part = builder.fmul(
                row, Vectors(builder, width).spread(weight), flags=("contract",)
            )
            more = builder.fadd(more, part, flags=("contract",))
        builder.branch(ahead)

        # Go on with the next point
        builder.position_at_end(ahead)
        kept = builder.phi(kind)
        kept.add_incoming(sums, loop)
        kept.add_incoming(more, inside)
        following = builder.add(point, WORD(1))
        point.add_incoming(following, ahead)
        sums.add_incoming(kept, ahead)
        going_on = builder.icmp_signed("<", following, self.last)
        builder.cbranch(going_on, loop, end)

        builder.position_at_end(end)
        total = builder.phi(kind)
        total.add_incoming(begin, before)
        total.add_incoming(kept, ahead)
        return total

    def _row(self, place: Any, width: int) -> Any:
        element = ELEMENTS[self.kind]
        builder = self.builder
        row = builder.load(
            self._vector_at(place, element, width), align=4 if element is FLOAT else 1
        )
        if element is FLOAT:
            return row
        convert = builder.sitofp if self.kind.signed else builder.uitofp
        return convert(row, ir.VectorType(FLOAT, width))

    def _vector_at(self, place: Any, element: Any, width: int) -> Any:
        return self.builder.bitcast(place, ir.VectorType(element, width).as_pointer())
