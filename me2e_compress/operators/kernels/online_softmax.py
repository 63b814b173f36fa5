"""One step of a softmax whose scores come in blocks, over vectors of queries.

Milakov and Gimelshein, Online normalizer calculation for softmax, arXiv 1805.02867,
algorithm 3: the largest score and the sum of powers so far are kept, and what was
summed before is corrected where a block has a larger score. Powers are of 2: callers
multiply scores by log2(e). It is written as LLVM instructions, since a call of C's
``exp2f`` is not vectorized.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from me2e_compress.operators.kernels.intrinsics import FLOAT, INT, WORD

POWERS = (
    1.535336188319500e-4, 1.339887440266574e-3, 9.618437357674640e-3,
    5.550332471162809e-2, 2.402264791363012e-1, 6.931472028550421e-1, 1.0,
)  # fmt: skip
"""Polynomial of 2^r for r in -0.5..0.5, highest power first, of the Cephes library (S.
L. Moshier, single/exp2f.c, netlib.org/cephes): relative error below 2e-7 in float32."""

LEAST = -125.0
"""Smaller powers count as 2^-125, so that results are normal float32 numbers."""

ROUNDING = 1.5 * 2.0**23
"""Added to a float32, it leaves the nearest whole number in the lowest bits."""

MOST, SUM = range(2)
"""Rows of a step's state."""


def softmax_step(vectors: int, lanes: int) -> Any:
    """Return the intrinsic ``(scores, count, state, sums, channels)``.

    ``scores``, ``state`` and ``sums`` are addresses of float32 rows of ``vectors *
    lanes`` queries side by side. It replaces ``count`` rows of scores by powers,
    2^(score - the largest so far), and brings the state up to date: the largest score
    and the sum of all powers, at the start -infinity and 0. The ``channels`` rows of
    sums, which were weighted by the powers before, are corrected. NaN gives NaN.
    """

    def typed(
        context: Any, scores: Any, count: Any, state: Any, sums: Any, channels: Any
    ) -> tuple[Any, Callable[..., Any]]:
        # Numba calls this with LLVM values
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            _Step(builder, vectors, lanes, *arguments).write()
            return context.get_dummy_value()

        return types.void(*[types.intp] * 5), generate

    return intrinsic(typed)


class _Step:
    """Writes a loop that finds the largest scores, and one that computes powers."""

    def __init__(
        self,
        builder: Any,
        vectors: int,
        lanes: int,
        scores: Any,
        count: Any,
        state: Any,
        sums: Any,
        channels: Any,
    ) -> None:
        self.builder, self.vectors, self.lanes = builder, vectors, lanes
        self.kind = ir.VectorType(FLOAT, lanes)
        self.whole = ir.VectorType(INT, lanes)
        self.scores, self.state, self.sums = (
            builder.inttoptr(at, FLOAT.as_pointer()) for at in (scores, state, sums)
        )
        self.count, self.channels = count, channels

    def write(self) -> None:
        builder = self.builder
        before = self._row(self.state, WORD(MOST))
        # The largest scores, in variables that LLVM keeps in registers
        largest = [self._variable(each) for each in before]
        with cgutils.for_range(builder, self.count) as loop:
            scores = self._row(self.scores, loop.index)
            for most, score in zip(largest, scores, strict=True):
                old = builder.load(most)
                more = builder.fcmp_unordered(">", score, old)
                builder.store(builder.select(more, score, old), most)
        most = [builder.load(each) for each in largest]
        self._set_row(self.state, WORD(MOST), most)
        # Correct what was summed before
        corrections = [
            self._power(builder.fsub(old, new))
            for old, new in zip(before, most, strict=True)
        ]
        totals = [
            self._variable(builder.fmul(each, correction))
            for each, correction in zip(
                self._row(self.state, WORD(SUM)), corrections, strict=True
            )
        ]
        with cgutils.for_range(builder, self.channels) as loop:
            row = zip(self._row(self.sums, loop.index), corrections, strict=True)
            corrected = [builder.fmul(each, correction) for each, correction in row]
            self._set_row(self.sums, loop.index, corrected)
        # Powers, and their sums
        with cgutils.for_range(builder, self.count) as loop:
            row = zip(self._row(self.scores, loop.index), most, strict=True)
            powers = [self._power(builder.fsub(score, each)) for score, each in row]
            self._set_row(self.scores, loop.index, powers)
            for total, power in zip(totals, powers, strict=True):
                builder.store(builder.fadd(builder.load(total), power), total)
        self._set_row(self.state, WORD(SUM), [builder.load(each) for each in totals])

    def _power(self, x: Any) -> Any:
        """Write 2^x for x <= 0: a polynomial of its fraction, whose exponent grows."""
        builder = self.builder
        least, rounding = self._all(LEAST), self._all(ROUNDING)
        x = builder.select(builder.fcmp_ordered("<", x, least), least, x)
        rounded = builder.fadd(x, rounding)
        fraction = builder.fsub(x, builder.fsub(rounded, rounding))
        power = self._all(POWERS[0])
        for each in POWERS[1:]:
            power = builder.fmul(power, fraction, flags=("contract",))
            power = builder.fadd(power, self._all(each), flags=("contract",))
        exponent = builder.shl(
            builder.bitcast(rounded, self.whole), self.whole([23] * self.lanes)
        )
        bits = builder.add(builder.bitcast(power, self.whole), exponent)
        return builder.bitcast(bits, self.kind)

    def _all(self, number: float) -> Any:
        return self.kind([number] * self.lanes)

    def _variable(self, vector: Any) -> Any:
        return cgutils.alloca_once_value(self.builder, vector)

    def _row(self, rows: Any, index: Any) -> list[Any]:
        places = self._places(rows, index)
        return [self.builder.load(place, align=4) for place in places]

    def _set_row(self, rows: Any, index: Any, row: list[Any]) -> None:
        for vector, place in zip(row, self._places(rows, index), strict=True):
            self.builder.store(vector, place, align=4)

    def _places(self, rows: Any, index: Any) -> list[Any]:
        builder, places = self.builder, []
        first = builder.mul(index, WORD(self.vectors * self.lanes))
        for vector in range(self.vectors):
            at = builder.add(first, WORD(vector * self.lanes))
            place = builder.gep(rows, [at])
            places.append(builder.bitcast(place, self.kind.as_pointer()))
        return places
