"""Vectors of float32 numbers, for kernels that Numba does not vectorize itself.

LLVM splits them where the processor's are shorter.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from me2e_compress.operators.kernels.intrinsics import FLOAT, INT, WORD

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

    def fetch(self, place: Any) -> None:
        """Begin to bring what is there into the caches; nothing need be there."""
        kind = ir.FunctionType(ir.VoidType(), [place.type, INT, INT, INT])
        function = cgutils.get_or_insert_function(
            self.builder.module, kind, "llvm.prefetch.p0"
        )
        self.builder.call(function, [place, INT(0), INT(3), INT(1)])

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

    def plus(self, one: Any, factor: float, two: Any) -> Any:
        """Return one + factor * two."""
        scaled = self.builder.fmul(self.spread(factor), two, flags=_FAST)
        return self.add(one, scaled)

    def times(self, factor: float, one: Any) -> Any:
        """Return factor * one."""
        return self.builder.fmul(self.spread(factor), one, flags=_FAST)

    def at_least(self, one: Any, least: Any) -> Any:
        """Return the larger one; NaN stays NaN."""
        below = self.builder.fcmp_ordered("<", one, least)
        return self.builder.select(below, least, one)

    def power_of_2(self, x: Any) -> Any:
        """Return 2^x for x <= 0: a polynomial of its fraction, whose exponent grows."""
        builder = self.builder
        rounding = self.spread(ROUNDING)
        x = self.at_least(x, self.spread(LEAST))
        rounded = builder.fadd(x, rounding)
        fraction = builder.fsub(x, builder.fsub(rounded, rounding))
        power = self.spread(POWERS[0])
        for each in POWERS[1:]:
            power = builder.fmul(power, fraction, flags=_FAST)
            power = builder.fadd(power, self.spread(each), flags=_FAST)
        exponent = builder.shl(
            builder.bitcast(rounded, self.whole), self.whole([23] * self.lanes)
        )
        bits = builder.add(builder.bitcast(power, self.whole), exponent)
        return builder.bitcast(bits, self.kind)

    def choose(self, one: Any, two: Any, lanes: Sequence[int]) -> Any:
        """Return lanes of two vectors, those of the second counted from 16."""
        return self.builder.shuffle_vector(one, two, self.whole(list(lanes)))

    def take_apart(self, v: Sequence[Any]) -> tuple[Any, ...]:
        """Return every fourth of 64 numbers, from the first, second, third, fourth."""
        pairs = [
            self.choose(v[2 * half], v[2 * half + 1], range(part, 32, 2))
            for part in range(2)
            for half in range(2)
        ]
        return tuple(
            self.choose(pairs[2 * odd], pairs[2 * odd + 1], range(second, 32, 2))
            for second in range(2)
            for odd in range(2)
        )

    def put_together(self, v: Sequence[Any]) -> tuple[Any, ...]:
        """Undo :meth:`take_apart`."""
        even = [self.choose(v[0], v[2], _between(half)) for half in range(2)]
        odd = [self.choose(v[1], v[3], _between(half)) for half in range(2)]
        return tuple(
            self.choose(even[k // 2], odd[k // 2], _between(k % 2)) for k in range(4)
        )


def _between(half: int) -> list[int]:
    """Return the lanes that put one half of two vectors between each other."""
    first = half * LANES // 2
    return [lane for k in range(LANES // 2) for lane in (first + k, LANES + first + k)]


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

    def typed(context: Any, given: Any) -> tuple[Any, Callable[..., Any]]:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            write(Vectors(builder, lanes), *cgutils.unpack_tuple(builder, arguments[0]))
            return context.get_dummy_value()

        return types.void(types.UniTuple(types.intp, len(given))), generate

    return intrinsic(typed)
