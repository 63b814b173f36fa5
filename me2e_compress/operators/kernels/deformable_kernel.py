"""The kernel of multi-scale deformable attention, vectorized per block of queries.

For all points of one query the positions and weights of the four corners are computed
first (:mod:`sampling`); then the rows are summed (:mod:`weighted_rows`). All sizes are
read at run time.
"""

from collections.abc import Callable, Mapping
from typing import Any

from me2e_compress.operators.kernels.abi import ADDRESS, EACH
from me2e_compress.operators.kernels.attention_call import functions_of
from me2e_compress.operators.kernels.intrinsics import Word, compiled, floats, words
from me2e_compress.operators.kernels.sampling import (
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
    corners,
    share_of,
    tables,
    to_real,
)
from me2e_compress.operators.kernels.weighted_rows import CAPACITY, weighted_rows

QUERIES = 128
"""Queries per block of work, few enough to balance the threads."""

PLACES, SHARES, SHARED, WORDS = range(OTHERS, OTHERS + 4)
RANKS = (4, 2, 1, 6, 5, 1, 1)


def _block(kind: Any) -> Callable[[int, int], Word]:
    sum_rows = weighted_rows(kind)
    bytes_each = kind.bitwidth // 8
    quantized = bytes_each == 1

    def block(user: int, index: int) -> Word:
        # The queries of this block
        a = words(user)
        blocks = (a[Q] + QUERIES - 1) // QUERIES
        n = index // blocks
        from_query = (index - n * blocks) * QUERIES
        to_query = min(from_query + QUERIES, a[Q])
        points, row = a[L] * a[P], a[M] * a[D]
        at_once = a[M] if points == 0 else min(a[M], CAPACITY // points)
        if a[SHARED]:
            at_once = 1  # one head after the other looks at the same places
        # Tables are the same for all queries
        w, o = corner_weights(), corner_offsets()
        tables(a, w, o, at_once, a[L])
        for q in range(from_query, to_query):
            m = 0
            while m < a[M]:
                # As many heads at once as the tables hold
                heads = min(at_once, a[M] - m)
                first = (n * a[Q] + q) * a[M] + m
                looked_at = n * a[Q] + q if a[SHARED] else first
                places = floats(a[PLACES] + looked_at * points * 8)
                shares = floats(a[SHARES] + first * points * 4)
                corners(w, o, places, shares, 0, heads * points, row)
                rows = a[VALUE] + (n * a[S] * row + m * a[D]) * bytes_each
                out = a[OUT] + first * a[D] * 4
                for k in range(heads):
                    begin, end, to = k * points, (k + 1) * points, out + k * a[D] * 4
                    sum_rows(rows, o, w, begin, end, to, a[D])
                    if quantized:
                        to_real(a, to, m + k, share_of(w, begin, end))
                m += at_once
        return 0

    return block


@compiled
def _take(a: Any, x: Any) -> Word:
    """Take positions and weights; return whether their sizes fit."""
    a[PLACES], a[SHARES] = x[3 * EACH + ADDRESS], x[4 * EACH + ADDRESS]
    a[Q], a[P], a[SHARED] = x[31], x[34], x[32] == 1 and a[M] != 1
    for k in range(5):
        if x[40 + k] != x[30 + k] and not (k == 2 and x[32] == 1):
            return 0
    return x[30] == a[N] and x[33] == a[L] and x[35] == 2 and x[42] == a[M]


def functions(op_type: str) -> Mapping[str, Callable[[int, int], Word]]:
    """Return the functions to compile for an operator of :mod:`kernel`."""
    return functions_of(op_type, RANKS, WORDS, QUERIES, _take, _block)
