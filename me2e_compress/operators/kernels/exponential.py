"""The softmax of many short rows, in vector instructions.

A call of C's ``expf`` is not vectorized. This is ``expf`` of the Cephes library
(S. L. Moshier, single/expf.c, netlib.org/cephes): x = n ln 2 + r, a polynomial for
exp(r) with r in -0.35..0.35, then a product with 2^n. The relative error is below 2e-7.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.cgutils import get_or_insert_function
from numba.extending import intrinsic

from me2e_compress.operators.kernels.intrinsics import FLOAT, INT, compiled

F = np.float32
LANES = 16
"""Numbers at a time: one AVX-512 register, or several smaller ones."""

LEAST = -87.0
"""Smaller arguments count as this one: exp(-87) is 1.6e-38, still a normal float32."""

LOG2_E, LN_2_HIGH, LN_2_LOW = 1.44269504088896341, 0.693359375, -2.12194440e-4
POLYNOMIAL = (
    *(1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3),
    *(4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1),
)
_FUSED = ("contract",)


def exponential(builder: Any, x: Any) -> Any:
    """Write exp(x) of float32 numbers of at most 88; NaN counts as ``LEAST``."""
    kind = x.type
    count = kind.count if isinstance(kind, ir.VectorType) else 0
    whole = ir.VectorType(INT, count) if count else INT

    def number(value: float) -> Any:
        return kind([F(value)] * count) if count else kind(F(value))

    def integer(value: int) -> Any:
        return whole([value] * count) if count else whole(value)

    least = number(LEAST)
    x = builder.select(builder.fcmp_ordered(">", x, least), x, least)
    # n, and the rest r
    scaled = builder.fmul(x, number(LOG2_E), flags=_FUSED)
    scaled = builder.fadd(scaled, number(0.5), flags=_FUSED)
    name = f"llvm.floor.v{count}f32" if count else "llvm.floor.f32"
    floor = ir.FunctionType(kind, [kind])
    n = builder.call(get_or_insert_function(builder.module, floor, name), [scaled])
    r = x
    for part in (LN_2_HIGH, LN_2_LOW):
        r = builder.fsub(r, builder.fmul(n, number(part), flags=_FUSED), flags=_FUSED)
    # The polynomial, then 2^n by its exponent
    y = number(POLYNOMIAL[0])
    for coefficient in (*POLYNOMIAL[1:], 1.0, 1.0):
        y = builder.fmul(y, r, flags=_FUSED)
        y = builder.fadd(y, number(coefficient), flags=_FUSED)
    exponent = builder.add(builder.fptosi(n, whole), integer(127))
    power = builder.bitcast(builder.shl(exponent, integer(23)), kind)
    return builder.fmul(y, power)


def _softmax_of(size: int) -> Any:
    """Return the intrinsic ``(scores, weights, first)`` for LANES numbers from there.

    They are LANES / size rows; size divides LANES and is a power of two.
    """

    def typed(
        context: Any, scores: Any, weights: Any, first: Any
    ) -> tuple[Any, Callable[..., Any]]:
        kind = ir.VectorType(FLOAT, LANES)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            source, target, at = arguments

            def of(pointer: Any) -> Any:
                return builder.bitcast(builder.gep(pointer, [at]), kind.as_pointer())

            def over_row(x: Any, join: Callable[[Any, Any], Any]) -> Any:
                # Each step joins lanes twice as far apart, within a row
                step = 1
                while step < size:
                    lanes = [lane ^ step for lane in range(LANES)]
                    order = ir.VectorType(INT, LANES)(lanes)
                    x = join(x, builder.shuffle_vector(x, x, order))
                    step *= 2
                return x

            def larger(x: Any, y: Any) -> Any:
                return builder.select(builder.fcmp_ordered(">", x, y), x, y)

            x = builder.load(of(source), align=4)
            power = exponential(builder, builder.fsub(x, over_row(x, larger)))
            total = over_row(power, builder.fadd)
            builder.store(builder.fdiv(power, total), of(target), align=4)
            return context.get_dummy_value()

        return types.void(scores, weights, types.intp), generate

    return intrinsic(typed)


def _scalar(context: Any, x: Any) -> tuple[Any, Callable[..., Any]]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return exponential(builder, arguments[0])

    return types.float32(types.float32), generate


_exponential: Any = intrinsic(_scalar)
_by_4, _by_8, _by_16 = (_softmax_of(size) for size in (4, 8, 16))


@compiled
def softmax(scores: Any, weights: Any, rows: int, size: int) -> None:
    """Write the softmax of ``rows`` rows of ``size`` numbers that follow each other."""
    done, count = 0, rows * size
    # The usual sizes, several rows at a time
    if size == 4:
        while done + LANES <= count:
            _by_4(scores, weights, done)
            done += LANES
    elif size == 8:
        while done + LANES <= count:
            _by_8(scores, weights, done)
            done += LANES
    elif size == 16:
        while done + LANES <= count:
            _by_16(scores, weights, done)
            done += LANES
    # Other sizes, and what is left, row by row
    while done < count:
        most = scores[done]
        for j in range(done, done + size):
            most = scores[j] if scores[j] > most else most
        total = F(0)
        for j in range(done, done + size):
            weights[j] = _exponential(scores[j] - most)
            total += weights[j]
        for j in range(done, done + size):
            weights[j] /= total
        done += size
