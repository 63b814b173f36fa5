"""The kernel of deformable attention from offsets and scores that levels share.

Levels that share their offsets are visited one group after the other, and a group that
the mask leaves out costs nothing: most cells of a bird's-eye view are seen by one or
two of six cameras. Then as in :mod:`deformable_kernel`.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numba import types

from me2e_compress.operators.kernels.abi import ADDRESS, EACH
from me2e_compress.operators.kernels.deformable_kernel import (
    OTHERS,
    OUT,
    VALUE,
    D,
    L,
    M,
    N,
    P,
    Q,
    S,
    corner_offsets,
    corner_weights,
    dequantize_sums,
    functions_of,
    sum_of_weights,
    write_corners,
    write_tables,
)
from me2e_compress.operators.kernels.intrinsics import (
    Word,
    address_of,
    compiled,
    floats,
    stack,
    words,
)
from me2e_compress.operators.kernels.vectors import (
    CAPACITY,
    LANES,
    LOG2_E,
    Vectors,
    vector_intrinsic,
    weighted_rows,
)

F = np.float32


def _softmax_of(size: int) -> Any:
    """Return the intrinsic ``((scores, weights))`` for LANES numbers from there."""
    # They are LANES / size rows; size divides LANES and is a power of two

    def write(simd: Vectors, scores: Any, weights: Any) -> None:
        def over_row(x: Any, join: Callable[[Any, Any], Any]) -> Any:
            # Each step joins lanes twice as far apart, within a row
            for step in [1, 2, 4, 8][: size.bit_length() - 1]:
                x = join(x, simd.choose(x, x, [n ^ step for n in range(LANES)]))
            return x

        # e^(x - max) / sum of e^(x - max), over each row
        x = simd.load(simd.pointer(scores))
        below = simd.subtract(x, over_row(x, simd.at_least))
        power = simd.power_of_2(simd.times(LOG2_E, below))
        total = over_row(power, simd.add)
        simd.store(simd.builder.fdiv(power, total), simd.pointer(weights))

    return vector_intrinsic(write)


def _write_power(simd: Vectors, at: Any) -> None:
    """Replace the number at an address by its exponential, 2^(x log2(e))."""
    place = simd.pointer(at)
    simd.store(simd.power_of_2(simd.times(LOG2_E, simd.load(place))), place)


_exponential = vector_intrinsic(_write_power, lanes=1)
_by_4, _by_8, _by_16 = (_softmax_of(size) for size in (4, 8, 16))


@compiled
def softmax(scores: Any, weights: Any, rows: int, size: int) -> None:
    """Write the softmax of ``rows`` rows of ``size`` numbers that follow each other."""
    done, count = 0, rows * size
    source, target = address_of(scores), address_of(weights)
    # The usual sizes, several rows at a time
    while (size == 4 or size == 8 or size == 16) and done + LANES <= count:
        if size == 4:
            _by_4((source + 4 * done, target + 4 * done))
        elif size == 8:
            _by_8((source + 4 * done, target + 4 * done))
        else:
            _by_16((source + 4 * done, target + 4 * done))
        done += LANES
    # Other sizes, and what is left, row by row
    while done < count:
        most = scores[done]
        for j in range(done, done + size):
            most = scores[j] if scores[j] > most else most
        total = F(0)
        for j in range(done, done + size):
            weights[j] = scores[j] - most
            _exponential((target + 4 * j,))
            total += weights[j]
        for j in range(done, done + size):
            weights[j] /= total
        done += size


# Queries per block of work: cells that cameras see are together, so fewer than in
# `deformable_kernel` to balance the threads
QUERIES = 64

# An operand's words: its address, its steps along batch, queries and heads, and how
# many levels and points it has
STEP_N, STEP_Q, STEP_M, LEVELS, POINTS, OPERAND = range(1, 7)
REFERENCE, OFFSETS, SCORES, MASK, WORDS = range(OTHERS, OTHERS + 5 * OPERAND, OPERAND)

RANKS = (4, 2, 1, 6, 6, 5, 5, 1, 1)
_numbers = stack(types.float32, CAPACITY)
_pairs = stack(types.float32, 2 * CAPACITY)


@compiled
def _from(a: Any, operand: int, n: int, q: int, m: int) -> Any:
    """Return the numbers of an operand for a query, from a head on."""
    step = n * a[operand + STEP_N] + q * a[operand + STEP_Q] + m * a[operand + STEP_M]
    return floats(a[operand] + 4 * step)


@compiled
def _places(a: Any, at: Any, near: Any, away: Any, group: int, heads: int) -> None:
    """Add the reference points to the offsets of a group of levels."""
    levels, points = a[REFERENCE + LEVELS], a[REFERENCE + POINTS]
    together = a[OFFSETS + LEVELS]
    # One reference point for all levels, points and heads
    if levels * points == 1 and a[REFERENCE + STEP_M] == 0:
        x, y = near[0], near[1]
        for j in range(heads * together * a[P]):
            at[2 * j] = away[2 * j] + x
            at[2 * j + 1] = away[2 * j + 1] + y
        return
    # at[m, k, p] = away[m, k, p] + near[m, level of k, p % points]
    j = 0
    for m in range(heads):
        for k in range(together):
            level = (group * together + k) * levels // a[L]
            first = m * a[REFERENCE + STEP_M] + level * points * 2
            for _ in range(a[P] // points):
                for i in range(2 * points):
                    at[j + i] = away[j + i] + near[first + i]
                j += 2 * points


@compiled
def _seen(a: Any, mask: Any, group: int, heads: int) -> Word:
    """Return whether the mask lets any point of a group of levels through."""
    levels, points = a[MASK + LEVELS], a[MASK + POINTS]
    together = a[OFFSETS + LEVELS]
    many = heads if a[MASK + STEP_M] else 1
    for m in range(many):
        for k in range(together):
            level = (group * together + k) * levels // a[L]
            for p in range(points):
                if mask[m * a[MASK + STEP_M] + level * points + p] != F(0):
                    return 1
    return 0


@compiled
def _shares(a: Any, w: Any, soft: Any, mask: Any, group: int, heads: int) -> None:
    """Multiply the softmax by the mask, for the points of a group of levels."""
    levels, points = a[MASK + LEVELS], a[MASK + POINTS]
    together = a[OFFSETS + LEVELS]
    row = a[SCORES + LEVELS] * a[SCORES + POINTS]  # scores of a head
    size = together * a[P]  # points of a head in a group
    # One factor for the whole group, and one score for each of its points
    alike = row == size and (a[SCORES + STEP_M] != 0 or heads == 1)
    one = points == 1 and a[MASK + STEP_M] == 0
    if alike and one and a[L] // levels % together == 0:
        factor = mask[group * together * levels // a[L]]
        for j in range(heads * size):
            w[j] = soft[j] * factor
        return
    # w[m, k, p] = soft[m, (point of the head) % row] * mask[m, level of k, p % points]
    for m in range(heads):
        own = m * row if a[SCORES + STEP_M] else 0
        score = group * size % row
        for k in range(together):
            level = (group * together + k) * levels // a[L]
            first = m * a[MASK + STEP_M] + level * points
            p = 0
            for j in range((m * together + k) * a[P], (m * together + k + 1) * a[P]):
                w[j] = soft[own + score] * mask[first + p]
                score = score + 1 if score + 1 < row else 0
                p = p + 1 if p + 1 < points else 0


def _block(kind: Any) -> Callable[[int, int], Word]:
    add_rows = weighted_rows(kind, onto=True)
    bytes_each = kind.bitwidth // 8
    quantized = bytes_each == 1

    def block(user: int, index: int) -> Word:
        # The queries of this block
        a = words(user)
        blocks = (a[Q] + QUERIES - 1) // QUERIES
        n = index // blocks
        from_query = (index - n * blocks) * QUERIES
        to_query = min(from_query + QUERIES, a[Q])
        row, together = a[M] * a[D], a[OFFSETS + LEVELS]
        size = together * a[P]  # points of a head in a group of levels
        groups = a[L] // together if size > 0 else 0
        # Tables are the same for all queries
        at_once = min(a[M], CAPACITY // max(a[L] * a[P], 1))
        w, o = corner_weights(), corner_offsets()
        write_tables(a, w, o, at_once, together)
        offsets, weights = address_of(o), address_of(w)
        soft, shares, at, total = _numbers(), _numbers(), _pairs(), _numbers()
        for q in range(from_query, to_query):
            for m in range(0, a[M], at_once):
                # As many heads at once as the tables hold
                heads = min(at_once, a[M] - m)
                mask, near = _from(a, MASK, n, q, m), _from(a, REFERENCE, n, q, m)
                away, scores = _from(a, OFFSETS, n, q, m), _from(a, SCORES, n, q, m)
                rows = a[VALUE] + (n * a[S] * row + m * a[D]) * bytes_each
                out = a[OUT] + ((n * a[Q] + q) * a[M] + m) * a[D] * 4
                numbers = floats(out)
                for d in range(heads * a[D]):
                    numbers[d] = F(0)
                for k in range(heads):
                    total[k] = F(0)
                # Groups that the mask hides cost nothing; the first other one needs
                # the softmax of all
                ready = 0
                for group in range(groups):
                    if not _seen(a, mask, group, heads):
                        continue
                    if not ready:
                        many = heads if a[SCORES + STEP_M] else 1
                        many *= a[SCORES + LEVELS]
                        softmax(scores, soft, many, a[SCORES + POINTS])
                        ready = 1
                    _places(a, at, near, away, group, heads)
                    _shares(a, shares, soft, mask, group, heads)
                    start = group * at_once * size
                    write_corners(w, o, at, shares, start, heads * size, row)
                    # out[m + k, :] += sum over points and corners of weight * row
                    for k in range(heads):
                        begin, end = k * size, (k + 1) * size
                        to = out + k * a[D] * 4
                        add_rows((rows, offsets, weights, begin, end, to, a[D]))
                        if quantized:
                            total[k] += sum_of_weights(w, begin, end)
                if quantized:
                    for k in range(heads):
                        dequantize_sums(a, out + k * a[D] * 4, m + k, total[k])
        return 0

    return block


@compiled
def _stepped(a: Any, x: Any, operand: int, index: int, pairs: int) -> Word:
    """Take an operand's address and steps; return whether its sizes fit."""
    i = EACH * index
    n, q, m, levels, points = x[i], x[i + 1], x[i + 2], x[i + 3], x[i + 4]
    if (n != 1 and n != a[N]) or (q != 1 and q != a[Q]) or (m != 1 and m != a[M]):
        return 0
    # Steps of 0 repeat what has one batch, query or head
    head = levels * points * (2 if pairs else 1)
    a[operand] = x[i + ADDRESS]
    a[operand + STEP_N] = q * m * head if n > 1 else 0
    a[operand + STEP_Q] = m * head if q > 1 else 0
    a[operand + STEP_M] = head if m > 1 else 0
    a[operand + LEVELS], a[operand + POINTS] = levels, points
    if pairs and x[i + 5] != 2:
        return 0
    if levels < 1 or points < 1:
        return a[L] * a[P] == 0
    if operand == SCORES:
        return a[L] * a[P] % (levels * points) == 0
    return a[L] % levels == 0 and a[P] % points == 0


@compiled
def _take(a: Any, x: Any) -> Word:
    """Take the operands; return whether their sizes fit."""
    a[Q], a[P] = x[4 * EACH + 1], x[4 * EACH + 4]
    if x[4 * EACH] != a[N] or x[4 * EACH + 2] != a[M]:
        return 0
    fit = _stepped(a, x, REFERENCE, 3, 1) and _stepped(a, x, OFFSETS, 4, 1)
    return fit and _stepped(a, x, SCORES, 5, 0) and _stepped(a, x, MASK, 6, 0)


def functions(op_type: str) -> Mapping[str, Callable[[int, int], Word]]:
    """Return the functions to compile for an operator of :mod:`kernel`."""
    return functions_of(op_type, RANKS, WORDS, QUERIES, _take, _block)
